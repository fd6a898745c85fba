//! Errors as people and machines read them.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::PicturesReport;
use super::frame_error::{ERROR_BINS, ErrorSums, FrameError, Histogram};
use super::promise::Promise;
use crate::codec::Codec;
use crate::pack::{Grid, Pack};
use crate::settings::{FRAME_MARGIN_DB, Quality, Settings};
use crate::units::count;
use crate::volume::ValueRange;

/// How far decoded values are from the source's.
#[derive(Clone, Copy, Debug, Serialize, Deserialize, JsonSchema)]
pub struct Metrics {
    /// Voxels compared.
    pub voxels: u64,
    /// Root mean square error, in the grid's units.
    pub rmse: f64,
    /// Decibels under the peak: the range of the sequence's active values, or where they are all one their distance from the
    /// background. Null where there is no error.
    pub psnr: Option<f64>,
    /// The largest error, in the grid's units.
    pub max_error: f64,
    /// Level sets: voxels that changed sides.
    pub sign_flips: u64,
}

/// One frame of one grid.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
pub struct FrameReport {
    /// The grid.
    pub grid: String,
    /// The frame's number.
    pub frame: i32,
    /// Over active leaf voxels.
    pub active: Metrics,
    /// Over all leaf voxels.
    pub all: Metrics,
}

/// The frame with the lowest PSNR.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
pub struct WorstFrame {
    /// Its grid.
    pub grid: String,
    /// Its number.
    pub frame: i32,
    /// Its PSNR over active leaf voxels.
    pub psnr: f64,
}

/// One grid over all its frames.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
pub struct GridReport {
    /// Its name.
    pub grid: String,
    /// What its PSNR is measured against.
    pub peak: f64,
    /// Over active leaf voxels.
    pub active: Metrics,
    /// Over all leaf voxels.
    pub all: Metrics,
    /// Active leaf voxels by error: none, below 2⁻¹⁵ of the peak, then by octaves to half of the peak and more.
    pub histogram: Histogram,
}

/// What the voxel ring found.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
pub struct VerifyReport {
    /// Whether nothing failed.
    pub ok: bool,
    /// What failed, at most one line a frame.
    pub failures: Vec<String>,
    /// The grid with the lowest PSNR, over active leaf voxels.
    pub active: Metrics,
    /// The grid with the lowest PSNR, over all leaf voxels.
    pub all: Metrics,
    /// The worst frame; null where every frame is exact.
    pub worst_frame: Option<WorstFrame>,
    /// Each grid.
    pub grids: Vec<GridReport>,
    /// Each frame of each grid.
    pub frames: Vec<FrameReport>,
    /// The picture ring, if it ran.
    pub pictures: Option<PicturesReport>,
}

impl Metrics {
    fn new(error: &ErrorSums, peak: f64) -> Self {
        let voxels = error.voxels.max(1) as f64;
        // The squares of the smallest errors are 0, but an error is one.
        let rmse = (error.squares / voxels).sqrt().max(error.max / voxels.sqrt());
        Self {
            voxels: error.voxels,
            rmse,
            psnr: (error.max > 0.0).then(|| 20.0 * (peak / rmse).log10()),
            max_error: error.max,
            sign_flips: error.sign_flips,
        }
    }
}

/// The less exact of two; no PSNR is no error.
fn worse(a: Metrics, b: Metrics) -> Metrics {
    let psnr = |m: &Metrics| m.psnr.unwrap_or(f64::INFINITY);
    if psnr(&b) < psnr(&a) { b } else { a }
}

/// PSNR is summed in another order here than when bricks were allocated.
const PSNR_TOLERANCE_DB: f64 = 1e-3;

/// A PSNR at which nothing of a grid can be recognised: an RMSE of a tenth of its range.
const RUINED_DB: f64 = 20.0;

/// What an adaptive pack was asked for and does not keep, of a grid and its frames. The largest error is checked voxel
/// by voxel.
fn broken_psnr(promise: &Promise, grid: &GridReport, frames: &[FrameReport]) -> Vec<String> {
    let settings = promise.settings;
    let mut broken = Vec::new();
    let mut floor = settings.min_frame_psnr();
    let below = |metrics: &Metrics, asked: f64| metrics.psnr.filter(|db| *db < asked - PSNR_TOLERANCE_DB);
    match promise.quality {
        Quality::Psnr(asked) => {
            floor = floor.or(Some(asked - FRAME_MARGIN_DB));
            broken.extend(below(&grid.active, asked).map(|db| {
                format!("grid {:?}: {db:.3} dB is below the {asked} dB that were asked", grid.grid)
            }));
        }
        // Every voxel of every frame keeps the bound that was asked instead.
        Quality::MaxError(_) => floor = None,
        _ => {}
    }
    broken.extend(frames.iter().filter_map(|f| {
        let db = below(&f.active, floor?)?;
        Some(format!(
            "grid {:?} frame {}: {db:.3} dB is below the {} dB minimum of a frame",
            f.grid, f.frame, floor?
        ))
    }));
    broken
}

/// Bytes that are more than an adaptive pack was asked for.
fn broken_size(pack: &Pack, settings: &Settings) -> Option<String> {
    let bytes = pack.gpu_bytes();
    let leaves =
        pack.grids().iter().flat_map(|g| &g.frames).map(|f| f.record.leaves).fold(0, u64::saturating_add);
    match settings.quality() {
        Quality::Size(asked) if bytes > asked => {
            Some(format!("{bytes} bytes on the GPU exceed the {asked} that were asked"))
        }
        Quality::BitsPerVoxel(asked) if bytes as f64 > asked * 64.0 * leaves as f64 && leaves > 0 => {
            Some(format!("{bytes} bytes on the GPU exceed the {asked} bits a voxel that were asked"))
        }
        _ => None,
    }
}

/// What is so far from its source that nobody can have meant it, where nothing of the kind was asked.
fn ruined(promise: &Promise, grid: &GridReport, errors: &[FrameError]) -> Option<String> {
    let voxels: u64 = errors.iter().map(|error| error.active_voxels).sum();
    if grid.active.max_error > 0.0 && !errors.iter().any(|error| error.has_regions) {
        return Some(format!(
            "grid {:?}: the pack has none of its {} active voxels: ask for a finer quality or more bytes",
            grid.grid,
            count(voxels)
        ));
    }
    let is_asked =
        promise.settings.is_adaptive() && matches!(promise.quality, Quality::Psnr(_) | Quality::MaxError(_));
    let psnr = grid.active.psnr.filter(|db| *db < RUINED_DB && !is_asked)?;
    Some(format!(
        "grid {:?}: {psnr:.1} dB is under {RUINED_DB} dB, at which nothing of it can be recognised: ask for a finer quality, \
         more bytes or another format",
        grid.grid
    ))
}

/// How far the square root of a sum of squares is from itself as an `f32`, and summed in another order; and the step of the
/// smallest floats.
const CODEC_NORM_TOLERANCE: f64 = 1e-6;
const SMALLEST_FLOAT: f64 = 1.5e-45;

/// What the grid table says of its source or its encoding and is not so.
fn broken_table(grid: &Grid, errors: &[FrameError]) -> Vec<String> {
    let mut broken = Vec::new();
    let range = ValueRange::union_all(errors.iter().filter_map(|error| error.active_range));
    let recorded = ValueRange { min: grid.record.active_min, max: grid.record.active_max };
    if range.is_some_and(|range| range != recorded) {
        broken.push(format!("grid {:?}: the grid table's active values are not the source's", grid.name));
    }
    for (tag, recorded) in grid.record.codec_error_l2s.into_iter().enumerate() {
        let found = errors.iter().map(|error| error.codec_squares[tag]).sum::<f64>().sqrt();
        let recorded = f64::from(recorded);
        let is_near = (found - recorded).abs() <= CODEC_NORM_TOLERANCE * found + SMALLEST_FLOAT
            || found > f64::from(f32::MAX);
        if !is_near {
            let codec = Codec::from_tag(tag as u32).map_or("unknown", Codec::name);
            broken.push(format!(
                "grid {:?}: the error of its {codec} bricks is {found:e}, the grid table has {recorded:e}",
                grid.name
            ));
        }
    }
    broken
}

impl VerifyReport {
    /// Sums up the errors of each frame of each grid, to which belongs whether its source's values are integers. `failures` are
    /// what was found to be wrong before.
    pub(super) fn new(
        pack: &Pack,
        settings: &Settings,
        errors: Vec<(Vec<FrameError>, bool)>,
        mut failures: Vec<String>,
    ) -> Self {
        let (mut grids, mut frames) = (Vec::new(), Vec::new());
        for (grid, (errors, is_integer)) in pack.grids().iter().zip(errors) {
            let promise = Promise::new(grid, settings, is_integer);
            let peak = promise.peak;
            let (mut active, mut all) = (ErrorSums::default(), ErrorSums::default());
            let mut histogram = [0; ERROR_BINS];
            let first_frame = frames.len();
            for (frame, error) in grid.frames.iter().zip(&errors) {
                active.add(&error.active);
                all.add(&error.all);
                histogram.iter_mut().zip(error.histogram).for_each(|(sum, count)| *sum += count);
                frames.push(FrameReport {
                    grid: grid.name.clone(),
                    frame: frame.record.number,
                    active: Metrics::new(&error.active, peak),
                    all: Metrics::new(&error.all, peak),
                });
                failures.extend(
                    error
                        .failure()
                        .map(|f| format!("grid {:?} frame {}: {f}", grid.name, frame.record.number)),
                );
            }
            let report = GridReport {
                grid: grid.name.clone(),
                peak,
                active: Metrics::new(&active, peak),
                all: Metrics::new(&all, peak),
                histogram,
            };
            failures.extend(broken_table(grid, &errors));
            if settings.is_adaptive() {
                failures.extend(broken_psnr(&promise, &report, &frames[first_frame..]));
            }
            failures.extend(ruined(&promise, &report, &errors));
            grids.push(report);
        }
        if settings.is_adaptive() {
            failures.extend(broken_size(pack, settings));
        }
        let worst_frame = frames
            .iter()
            .filter_map(|f| {
                f.active.psnr.map(|psnr| WorstFrame { grid: f.grid.clone(), frame: f.frame, psnr })
            })
            .min_by(|a, b| a.psnr.total_cmp(&b.psnr));
        let whole = |of: fn(&GridReport) -> Metrics| grids.iter().map(of).reduce(worse);
        Self {
            ok: failures.is_empty(),
            active: whole(|g| g.active).expect("a pack has a grid"),
            all: whole(|g| g.all).expect("a pack has a grid"),
            failures,
            worst_frame,
            grids,
            frames,
            pictures: None,
        }
    }

    /// Adds what the picture ring found.
    pub fn add_pictures(&mut self, pictures: PicturesReport) {
        self.failures.extend(pictures.failures.iter().cloned());
        self.ok = self.failures.is_empty();
        self.pictures = Some(pictures);
    }
}
