//! The same pack at another level of zstd.

use std::path::Path;

use rayon::prelude::*;

use super::layout::{CHUNK_BYTES, encoding, kind};
use super::{FinishedPack, Pack, PackError, PackWriter, Provenance, SectionSpec, compress_chunk};
use crate::cancel::{CancelToken, Cancelled};

/// Chunks that are in memory at a time: enough for every core, a few megabytes.
const CHUNKS_IN_FLIGHT: usize = 64;

/// The pack could not be written anew.
#[derive(Debug, thiserror::Error)]
pub enum RepackError {
    /// The pack is damaged, or the file cannot be written.
    #[error(transparent)]
    Pack(#[from] PackError),
    /// The caller cancelled it.
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
}

impl From<std::io::Error> for RepackError {
    fn from(error: std::io::Error) -> Self {
        Self::Pack(error.into())
    }
}

/// Writes `pack` beside `path` with another level (none for raw) and another provenance: byte for byte what packing
/// its source with them would give.
///
/// # Errors
/// [`RepackError`].
pub fn repack(
    pack: &Pack,
    path: &Path,
    provenance: &Provenance,
    zstd_level: Option<i32>,
    cancel: &CancelToken,
) -> Result<FinishedPack, RepackError> {
    let provenance = provenance.to_json()?;
    let spec = |section: &super::layout::Section| SectionSpec {
        kind: section.kind,
        codec: section.codec,
        encoding: encoding::of(section.kind, section.codec, zstd_level.is_some()),
        chunk_bytes: section.chunk_bytes,
        raw_bytes: section.raw_bytes,
    };
    let specs = pack.sections().iter().map(|section| match section.kind {
        kind::PROVENANCE => {
            SectionSpec { chunk_bytes: CHUNK_BYTES, raw_bytes: provenance.len() as u64, ..spec(section) }
        }
        _ => spec(section),
    });
    let specs: Vec<SectionSpec> = specs.collect();
    let level = zstd_level.unwrap_or(0);
    let mut writer = PackWriter::create(path, specs.clone())?;
    for (section, spec) in pack.sections().iter().zip(specs) {
        if section.kind == kind::PROVENANCE {
            writer.section(&provenance, level)?;
            continue;
        }
        writer.begin()?;
        let chunks: Vec<usize> = section.chunk_range().collect();
        for chunks in chunks.chunks(CHUNKS_IN_FLIGHT) {
            cancel.check()?;
            let packed: Vec<_> = chunks
                .par_iter()
                .map(|&chunk| {
                    let raw = pack.chunk(chunk)?.into_owned();
                    Ok(compress_chunk(raw, spec.encoding, level)?)
                })
                .collect::<Result<_, PackError>>()?;
            packed.iter().try_for_each(|chunk| writer.chunk(chunk))?;
        }
    }
    Ok(writer.finish()?)
}
