//! The nearest cheaper setting of a pack, built and compared.

use crate::error::{Error, Result};
use crate::pack::{Grid, Pack, Provenance};
use crate::pipeline::{Job, Progress, VerifyLevel, build};
use crate::report::model::{Cheaper, Figures};
use crate::settings::{Encoding, ErrorBound, Quality, Settings};

/// A step down: half a bit a voxel on fog, too little to see from one to the next.
const STEP_DB: f64 = 3.0;
/// The same for sizes.
const STEP_SIZE: f64 = 0.75;
/// What an adaptive pack is asked for in place of one that is exact or nearly so.
const FINEST_DB: f64 = 60.0;

/// Builds a job's pack at the nearest cheaper setting, aside, and compares its voxels; `None` where that is no
/// smaller.
///
/// # Errors
/// As [`build`].
pub fn cheaper(
    job: &Job,
    pack: &Pack,
    figures: &Figures,
    progress: &mut dyn Progress,
) -> Result<Option<Cheaper>> {
    let most = figures.gpu_bytes;
    let only_level_sets = pack.grids().iter().all(Grid::is_level_set);
    let Some((setting, settings)) = next(&job.settings, figures, only_level_sets) else { return Ok(None) };
    let folder = tempfile::tempdir().map_err(Error::io(std::env::temp_dir()))?;
    let mut job = job.clone();
    job.output = folder.path().join("cheaper.volpack");
    job.settings = settings;
    job.verify = VerifyLevel::Voxels;
    job.pictures.images = None;
    let outcome = build(&job, progress)?;
    let pack = Pack::open(&job.output).map_err(Error::pack(&job.output))?;
    let provenance = Provenance::of(&pack).map_err(Error::provenance(&pack))?;
    let figures = Figures::new(&provenance.sources, &outcome.summary, outcome.verification.as_ref(), None);
    // One that fails verification is no offer.
    Ok((figures.ok && figures.gpu_bytes < most).then_some(Cheaper { setting, figures }))
}

/// The next setting down, as a manifest has it.
fn next(settings: &Settings, figures: &Figures, only_level_sets: bool) -> Option<(String, Settings)> {
    // A floor for frames stays: what is below it is not what was asked for.
    let (before, (text, quality), after, min_frame_psnr) = match settings.encoding {
        Encoding::Adaptive { quality, min_frame_psnr } => {
            ("", coarser(quality, only_level_sets)?, "", min_frame_psnr)
        }
        // One codec for all costs more than the same quality from several.
        Encoding::Uniform { clustering, .. } => {
            let quality = psnr(figures.psnr.map_or(FINEST_DB, |db| db.min(FINEST_DB).floor()))?;
            ("format = \"adaptive\", ", quality, if clustering.is_some() { ", no dedup" } else { "" }, None)
        }
    };
    let encoding = Encoding::Adaptive { quality, min_frame_psnr };
    Some((format!("{before}{text}{after}"), Settings { encoding, ..settings.clone() }))
}

fn coarser(quality: Quality, only_level_sets: bool) -> Option<(String, Quality)> {
    match quality {
        // What suits fog does not suit level sets: a pack that has both goes by what its fog is asked for.
        Quality::ByClass { level_set_error, .. } if only_level_sets => Some(max_error(level_set_error)),
        Quality::Psnr(db) | Quality::ByClass { psnr: db, .. } => psnr(db - STEP_DB),
        Quality::MaxError(bound) => Some(max_error(bound)),
        Quality::BitsPerVoxel(bits) => {
            let bits = bits * STEP_SIZE;
            Some((format!("bits_per_voxel = {bits}"), Quality::BitsPerVoxel(bits)))
        }
        Quality::Size(bytes) => {
            let bytes = (bytes as f64 * STEP_SIZE) as u64;
            Some((format!("size = {bytes}"), Quality::Size(bytes)))
        }
    }
}

fn max_error(bound: ErrorBound) -> (String, Quality) {
    let twice = bound.times(2.0);
    (format!("max_error = \"{twice}\""), Quality::MaxError(twice))
}

fn psnr(db: f64) -> Option<(String, Quality)> {
    (db > 0.0).then(|| (format!("psnr = {db}"), Quality::Psnr(db)))
}
