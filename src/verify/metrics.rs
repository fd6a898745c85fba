//! Errors as people and machines read them.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::PicturesReport;
use super::compare::{ERROR_BINS, Error, FrameError, Histogram};
use crate::pack::Pack;
use crate::settings::{FRAME_MARGIN_DB, Format, Quality, Settings};
use crate::volume::ValueRange;

/// How far decoded values are from the source's.
#[derive(Clone, Copy, Debug, Serialize, Deserialize, JsonSchema)]
pub struct Metrics {
    /// Voxels compared.
    pub voxels: u64,
    /// Root mean square error, in the grid's units.
    pub rmse: f64,
    /// Decibels under the peak (maximum less minimum of the sequence's active values); null where the
    /// error is zero.
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
    fn new(error: &Error, peak: f64) -> Self {
        let rmse = if error.voxels == 0 { 0.0 } else { (error.squares / error.voxels as f64).sqrt() };
        Self {
            voxels: error.voxels,
            rmse,
            psnr: (rmse > 0.0 && peak > 0.0).then(|| 20.0 * (peak / rmse).log10()),
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

/// What an adaptive pack promised of its grids, frames and size and does not keep. The largest error is checked voxel
/// by voxel.
fn broken_promises(
    pack: &Pack,
    settings: &Settings,
    grids: &[GridReport],
    frames: &[FrameReport],
) -> Vec<String> {
    if settings.format != Format::Adaptive {
        return Vec::new();
    }
    let below = |metrics: &Metrics, asked: f64| metrics.psnr.filter(|db| *db < asked - PSNR_TOLERANCE_DB);
    let mut broken = Vec::new();
    let mut floor = settings.min_frame_psnr;
    if let Quality::Psnr(asked) = settings.quality {
        floor = floor.or(Some(asked - FRAME_MARGIN_DB));
        broken.extend(grids.iter().filter_map(|g| {
            below(&g.active, asked).map(|db| format!("grid {:?}: {db:.3} dB, {asked} were promised", g.grid))
        }));
    }
    broken.extend(frames.iter().filter_map(|f| {
        let db = below(&f.active, floor?)?;
        Some(format!("grid {:?} frame {}: {db:.3} dB, at least {} were promised", f.grid, f.frame, floor?))
    }));
    let bytes = pack.gpu_bytes();
    let leaves =
        pack.grids.iter().flat_map(|g| &g.frames).map(|f| f.record.leaves).fold(0, u64::saturating_add);
    match settings.quality {
        Quality::Size(asked) if bytes > asked => {
            broken.push(format!("{bytes} bytes on the GPU, at most {asked} were promised"));
        }
        Quality::BitsPerVoxel(asked) if bytes as f64 > asked * 64.0 * leaves as f64 && leaves > 0 => {
            broken.push(format!(
                "{bytes} bytes on the GPU are more than the {asked} bits a voxel that were promised"
            ));
        }
        _ => {}
    }
    broken
}

impl VerifyReport {
    /// Sums up the errors of each frame of each grid.
    pub(super) fn new(pack: &Pack, settings: &Settings, errors: Vec<Vec<FrameError>>) -> Self {
        let (mut grids, mut frames, mut failures) = (Vec::new(), Vec::new(), Vec::new());
        for (grid, errors) in pack.grids.iter().zip(errors) {
            let range = super::union(&errors);
            let peak = range.map_or(0.0, ValueRange::width);
            let recorded = ValueRange { min: grid.record.active_min, max: grid.record.active_max };
            if range.is_some_and(|range| range != recorded) {
                failures.push(format!(
                    "grid {:?}: the grid table's active values are not the source's",
                    grid.name
                ));
            }
            let (mut active, mut all) = (Error::default(), Error::default());
            let mut histogram = [0; ERROR_BINS];
            for (frame, error) in grid.frames.iter().zip(errors) {
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
            grids.push(GridReport {
                grid: grid.name.clone(),
                peak,
                active: Metrics::new(&active, peak),
                all: Metrics::new(&all, peak),
                histogram,
            });
        }
        failures.extend(broken_promises(pack, settings, &grids, &frames));
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
