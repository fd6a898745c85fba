//! Compares a pack with its source.
//!
//! Three rings. Structure is [`crate::pack::Pack::open`] with [`crate::pack::Pack::check_chunks`]. Voxels
//! ([`voxels`]) reads the source anew and asks the pack for every leaf voxel and every tile of it,
//! without anything that the build computed. Pictures
//! ([`pictures()`]) traces both.

mod compare;
mod metrics;
mod pictures;

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use rayon::prelude::*;

pub use compare::{ERROR_BINS, Histogram, SIGN_MATTERS_VOXELS};
pub use metrics::{FrameReport, GridReport, Metrics, VerifyReport, WorstFrame};
pub use pictures::{
    DIFFERENCE_GAIN, PictureReport, PictureSettings, PicturesReport, Seen, TracerDifference, difference_map,
    look, pictures, shown_frames,
};

use crate::error::{Error, Result};
use crate::pack::{Pack, Provenance};
use crate::settings::Settings;
use crate::stages::metadata::digest;
use crate::stages::select::find;
use crate::vdb::{VdbFile, with_scalar_type};
use crate::volume::ValueRange;
use compare::{FrameError, compare};

/// The files that a pack was made from, told by their digests.
pub struct Sources {
    files: Vec<PathBuf>,
    /// What the pack was built with, which says what has to hold.
    settings: Settings,
}

impl Sources {
    /// Finds the pack's sources among some files.
    ///
    /// # Errors
    /// When one is missing, changed or unreadable, or the pack's provenance cannot be used.
    pub fn find(pack: &Pack, files: &[PathBuf]) -> Result<Self> {
        let provenance = pack.provenance().map_err(Error::provenance(pack))?;
        for frame in pack.grids.iter().flat_map(|grid| &grid.frames) {
            provenance.source(&frame.record).map_err(Error::provenance(pack))?;
        }
        Ok(Self { files: match_sources(&provenance, files)?, settings: provenance.settings })
    }

    /// The file at a place of the provenance's list.
    fn path(&self, source: u32) -> &Path {
        &self.files[source as usize]
    }
}

/// Compares every voxel of every frame with the pack's sources, so many of them at a time. `advance` hears of each source
/// file that is done.
///
/// # Errors
/// When a source is unreadable, or a chunk of the pack is damaged. Differences are no error: they are in
/// the report.
pub fn voxels(
    pack: &Pack,
    sources: &Sources,
    at_once: usize,
    mut advance: impl FnMut(u64),
) -> Result<VerifyReport> {
    let Sources { files: paths, settings } = sources;
    let mut errors: Vec<Vec<Option<FrameError>>> =
        pack.grids.iter().map(|g| g.frames.iter().map(|_| None).collect()).collect();
    let places: Vec<usize> = (0..paths.len()).collect();
    for window in places.chunks(at_once) {
        crate::interrupt::check()?;
        let results: Vec<_> =
            window.par_iter().map(|&source| compare_source(pack, settings, source, &paths[source])).collect();
        for result in results {
            for (grid, frame, error) in result? {
                errors[grid][frame] = Some(error);
            }
            advance(1);
        }
    }
    let errors =
        errors.into_iter().map(|g| g.into_iter().map(|f| f.expect("every frame has a source")).collect());
    Ok(VerifyReport::new(pack, settings, errors.collect()))
}

/// The file of each of the pack's sources.
fn match_sources(provenance: &Provenance, sources: &[PathBuf]) -> Result<Vec<PathBuf>> {
    let digests: Vec<_> = sources.par_iter().map(|path| digest(path).map(|(hash, _)| hash)).collect();
    let mut by_digest = HashMap::new();
    for (path, digest) in sources.iter().zip(digests) {
        by_digest.insert(digest?.to_hex().to_string(), path);
    }
    let found = provenance.sources.iter().map(|source| {
        by_digest.get(&source.blake3).map(|path| (*path).clone()).ok_or_else(|| {
            let same_name = sources.iter().find(|p| p.file_name().is_some_and(|n| *n == *source.file));
            Error::Verify(match same_name {
                Some(path) => {
                    format!("{} has changed since the pack was built from it: build again", path.display())
                }
                None => format!(
                    "frame {}: its source {:?} is not among the {} files given",
                    source.frame,
                    source.file,
                    sources.len()
                ),
            })
        })
    });
    found.collect()
}

/// Compares the frames that one source file holds: grid, frame, and what differs.
fn compare_source(
    pack: &Pack,
    settings: &Settings,
    source: usize,
    path: &Path,
) -> Result<Vec<(usize, usize, FrameError)>> {
    let file = VdbFile::open(path).map_err(Error::vdb(path))?;
    let mut out = Vec::new();
    for (g, grid) in pack.grids.iter().enumerate() {
        let of_source = |f: &crate::pack::Frame| f.record.source as usize == source;
        for f in (0..grid.frames.len()).filter(|&f| of_source(&grid.frames[f])) {
            let info = find(&file.grids, &grid.name).ok_or_else(|| {
                Error::Verify(format!(
                    "{}: grid {:?} is in the pack, but not in the file",
                    path.display(),
                    grid.name
                ))
            })?;
            let reader = pack.frame(g, f).map_err(|e| {
                Error::Verify(format!("grid {:?} frame {}: {e}", grid.name, grid.frames[f].record.number))
            })?;
            let error = with_scalar_type!(&info.value_type,
                T => {
                    let tree = file.read_tree::<T>(info).map_err(Error::vdb(path))?;
                    compare(&tree, info, &reader, settings)
                },
                other => return Err(Error::Verify(format!(
                    "{}: grid {:?} is {} in the file", path.display(), grid.name, other.name()
                )))
            );
            out.push((g, f, error));
        }
    }
    Ok(out)
}

/// The range of all frames' active values.
fn union(errors: &[FrameError]) -> Option<ValueRange> {
    ValueRange::union_all(errors.iter().filter_map(|e| e.active_range))
}
