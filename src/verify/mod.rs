//! Compares a pack with its source.
//!
//! Three rings. Structure is [`crate::pack::Pack::open`] with [`crate::pack::Pack::check_chunks`]. Voxels
//! ([`voxels`]) reads the source anew and asks the pack for every leaf voxel and every tile of it.
//! Pictures ([`pictures()`]) traces both. Neither uses anything that the build computed, nor any of its
//! [`crate::stages`]: what a stage does wrong would be wrong on both sides, and seen on none.

mod compare;
mod frame_error;
mod metrics;
mod pictures;
mod promise;

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use rayon::prelude::*;

pub use frame_error::{ERROR_BINS, Histogram};
pub use metrics::{FrameReport, GridReport, Metrics, VerifyReport, WorstFrame};
pub use pictures::{
    DIFFERENCE_GAIN, PictureReport, PictureSettings, PicturesReport, Seen, TracerDifference, difference_map,
    look, pictures, shown_frames,
};

use crate::component::{Component, find_packed};
use crate::digest::digest;
use crate::error::{Error, Result};
use crate::pack::{Frame, Grid, Pack, Provenance};
use crate::progress::Progress;
use crate::settings::{NonFinite, Settings};
use crate::vdb::{GridClass, Scalar, ValueType, VdbFile, with_scalar_type};
use compare::compare;
use frame_error::FrameError;
use promise::Promise;
pub use promise::{KEPT_INTEGER_ERROR, SIGN_MATTERS_VOXELS};

/// The files that a pack was made from, told by their digests.
pub struct Sources {
    files: Vec<PathBuf>,
    /// What the pack was built from and with, which says what has to hold.
    provenance: Provenance,
}

impl Sources {
    /// Finds the pack's sources among some files.
    ///
    /// # Errors
    /// When one is missing, changed or unreadable, or the pack's provenance cannot be used.
    pub fn find(pack: &Pack, files: &[PathBuf]) -> Result<Self> {
        let provenance = Provenance::of(pack).map_err(Error::provenance(pack))?;
        for frame in pack.grids().iter().flat_map(|grid| &grid.frames) {
            provenance.source(&frame.record).map_err(Error::provenance(pack))?;
        }
        Ok(Self { files: match_sources(&provenance, files)?, provenance })
    }

    /// The file at a place of the provenance's list.
    fn path(&self, source: u32) -> &Path {
        &self.files[source as usize]
    }
}

/// Compares every voxel of every frame with the pack's sources, so many of them at a time. A step of `progress` is a source
/// file.
///
/// # Errors
/// When a source is unreadable, or a chunk of the pack is damaged. Differences are no error: they are in
/// the report.
pub fn voxels(
    pack: &Pack,
    sources: &Sources,
    at_once: usize,
    progress: &mut dyn Progress,
) -> Result<VerifyReport> {
    let Sources { files: paths, provenance } = sources;
    let settings = &provenance.settings;
    let cancel = progress.cancel_token();
    let mut found: Vec<Vec<Option<FoundFrame>>> =
        pack.grids().iter().map(|g| g.frames.iter().map(|_| None).collect()).collect();
    let mut failures = check_tables(pack, provenance);
    let places: Vec<usize> = (0..paths.len()).collect();
    for window in places.chunks(at_once) {
        cancel.check()?;
        let results: Vec<_> =
            window.par_iter().map(|&source| compare_source(pack, settings, source, &paths[source])).collect();
        for result in results {
            let (frames, missing) = result?;
            failures.extend(missing);
            for frame in frames {
                let [g, f] = frame.place;
                found[g][f] = Some(frame);
            }
            progress.advance(1);
        }
    }
    let mut errors = Vec::new();
    for (grid, frames) in pack.grids().iter().zip(found) {
        let frames: Vec<FoundFrame> =
            frames.into_iter().map(|f| f.expect("every frame has a source")).collect();
        failures.extend(check_class(grid, &frames));
        let is_integer = frames.iter().any(|frame| frame.is_integer);
        errors.push((frames.into_iter().map(|frame| frame.error).collect(), is_integer));
    }
    Ok(VerifyReport::new(pack, settings, errors, failures))
}

/// How values of a source are read: as a pack should have them.
#[derive(Clone, Copy)]
struct Reading {
    component: Component,
    nonfinite: NonFinite,
}

impl Reading {
    /// The value that a pack should have.
    fn value<T: Scalar>(self, value: T) -> f32 {
        let value = self.component.to_f32(value);
        if self.keeps(value) { value } else { 0.0 }
    }

    /// How far a decoded value is from the source's, in the source's own type.
    fn error<T: Scalar>(self, ours: f32, theirs: T) -> f64 {
        if self.keeps(self.component.to_f32(theirs)) {
            self.component.error_of(theirs, ours)
        } else {
            f64::from(ours)
        }
    }

    /// Whether a value is packed as it is, not as 0.
    fn keeps(self, value: f32) -> bool {
        value.is_finite() || self.nonfinite == NonFinite::Refuse
    }
}

/// The error for a grid of a type that no pack is made from.
fn not_packable(path: &Path, grid: &str, value_type: &ValueType) -> Error {
    Error::Verify(format!("{}: grid {grid:?} is {} in the file", path.display(), value_type.name()))
}

/// What a frame of a pack came to beside its source.
struct FoundFrame {
    /// Its grid and its place among the grid's frames.
    place: [usize; 2],
    class: GridClass,
    is_integer: bool,
    error: FrameError,
}

/// What the tables say and was not asked for.
fn check_tables(pack: &Pack, provenance: &Provenance) -> Vec<String> {
    let settings = &provenance.settings;
    let mut broken = Vec::new();
    for grid in pack.grids() {
        if grid.record.fps != settings.fps.unwrap_or(0.0) {
            broken.push(format!(
                "grid {:?}: {} frames per second, {} were asked",
                grid.name,
                grid.record.fps,
                settings.fps.unwrap_or(0.0)
            ));
        }
        for frame in &grid.frames {
            let (number, source) = (frame.record.number, &provenance.sources[frame.record.source as usize]);
            if number != source.frame {
                broken.push(format!(
                    "grid {:?}: frame {number} is frame {} of its source",
                    grid.name, source.frame
                ));
            }
        }
    }
    let is_there = |name: &&String| {
        let is_part = |grid: &Grid| grid.name.rsplit_once('.').is_some_and(|(base, _)| base == **name);
        pack.grids().iter().any(|grid| grid.name == **name || is_part(grid))
    };
    let missing = settings.grids.iter().filter(|name| !is_there(name));
    broken.extend(missing.map(|name| format!("grid {name:?} was asked for and is not in the pack")));
    broken
}

/// A grid has the class that any of its frames states.
fn check_class(grid: &Grid, frames: &[FoundFrame]) -> Option<String> {
    let stated = frames.iter().map(|frame| frame.class).find(|class| *class != GridClass::Unknown);
    let class = stated.unwrap_or(GridClass::Unknown);
    (grid.record.class != class as u32)
        .then(|| format!("grid {:?}: its class is not the source's, which is {}", grid.name, class.name()))
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

/// Compares the frames that one source file holds, and says which of them the pack lacks.
fn compare_source(
    pack: &Pack,
    settings: &Settings,
    source: usize,
    path: &Path,
) -> Result<(Vec<FoundFrame>, Vec<String>)> {
    let file = VdbFile::open(path).map_err(Error::vdb(path))?;
    let (mut out, mut missing) = (Vec::new(), Vec::new());
    for (g, grid) in pack.grids().iter().enumerate() {
        let of_source = |f: &Frame| f.record.source as usize == source;
        let frames: Vec<usize> = (0..grid.frames.len()).filter(|&f| of_source(&grid.frames[f])).collect();
        let Some((info, component)) = find_packed(&file.grids, &grid.name, settings.integers) else {
            if frames.is_empty() {
                continue;
            }
            return Err(pictures::missing_grid(path, &grid.name));
        };
        if frames.len() != 1 {
            missing.push(format!(
                "grid {:?}: the pack has {} frames of {}, which is one",
                grid.name,
                frames.len(),
                path.display()
            ));
        }
        let promise = Promise::new(grid, settings, info.value_type.is_integer());
        let reading = Reading { component, nonfinite: settings.nonfinite };
        for f in frames {
            let reader = pack.frame(g, f).map_err(|e| {
                Error::Verify(format!("grid {:?} frame {}: {e}", grid.name, grid.frames[f].record.number))
            })?;
            let error = with_scalar_type!(&info.value_type,
                T => {
                    let tree = file.read_tree::<T>(info).map_err(Error::vdb(path))?;
                    compare(&tree, info, reading, &reader, &promise)
                },
                other => return Err(not_packable(path, &grid.name, other))
            );
            let is_integer = info.value_type.is_integer();
            out.push(FoundFrame { place: [g, f], class: info.class, is_integer, error });
        }
    }
    Ok((out, missing))
}
