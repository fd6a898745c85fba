//! The nearest cheaper setting of a pack, built and compared.

use crate::error::{Error, Result};
use crate::pipeline::{Job, Progress, VerifyLevel, build};
use crate::report::model::{Cheaper, Figures};
use crate::settings::{Format, Quality, Settings};

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
pub fn cheaper(job: &Job, figures: &Figures, progress: &mut dyn Progress) -> Result<Option<Cheaper>> {
    let Some((setting, settings)) = next(&job.settings, figures) else { return Ok(None) };
    let folder = tempfile::tempdir().map_err(Error::io(std::env::temp_dir()))?;
    let mut job = job.clone();
    job.output = folder.path().join("cheaper.volpack");
    job.settings = settings;
    job.verify = VerifyLevel::Voxels;
    job.pictures.images = None;
    let outcome = build(&job, progress)?;
    let found = outcome.verification.expect("voxels were asked for");
    let of_range = |grid: &crate::verify::GridReport| {
        if grid.peak > 0.0 { grid.active.max_error / grid.peak } else { grid.active.max_error }
    };
    // One that fails verification is no offer.
    let is_offer = found.ok && outcome.summary.gpu_bytes < figures.gpu_bytes;
    Ok(is_offer.then(|| Cheaper {
        setting,
        gpu_bytes: outcome.summary.gpu_bytes,
        file_bytes: outcome.summary.file_bytes,
        psnr: found.active.psnr,
        max_error: found.grids.iter().map(of_range).fold(0.0, f64::max),
    }))
}

/// The next setting down, as a manifest has it.
fn next(settings: &Settings, figures: &Figures) -> Option<(String, Settings)> {
    let (text, quality) = match (settings.format, settings.quality) {
        (Format::Adaptive, Quality::Psnr(db)) => psnr(db - STEP_DB)?,
        (Format::Adaptive, Quality::MaxError(bound)) => {
            let twice = bound.times(2.0);
            (format!("max_error = \"{twice}\""), Quality::MaxError(twice))
        }
        (Format::Adaptive, Quality::BitsPerVoxel(bits)) => {
            let bits = bits * STEP_SIZE;
            (format!("bits_per_voxel = {bits}"), Quality::BitsPerVoxel(bits))
        }
        (Format::Adaptive, Quality::Size(bytes)) => {
            let bytes = (bytes as f64 * STEP_SIZE) as u64;
            (format!("size = {bytes}"), Quality::Size(bytes))
        }
        // One codec for all costs more than the same quality from several.
        _ => psnr(figures.psnr.map_or(FINEST_DB, |db| db.min(FINEST_DB).floor()))?,
    };
    let format = if settings.format == Format::Adaptive { "" } else { "format = \"adaptive\", " };
    let floor = settings.min_frame_psnr.filter(|floor| !matches!(quality, Quality::Psnr(db) if *floor > db));
    let settings = Settings {
        format: Format::Adaptive,
        quality,
        min_frame_psnr: floor,
        clustering: None,
        ..settings.clone()
    };
    Some((format!("{format}{text}"), settings))
}

fn psnr(db: f64) -> Option<(String, Quality)> {
    (db > 0.0).then(|| (format!("psnr = {db}"), Quality::Psnr(db)))
}
