//! Charts of measured settings, as SVG: what `volpack sweep` found, readable by someone new to the tool.
//!
//! The pages are 1200 units wide and scale with the page that holds them. Text is 16 units or more: at half
//! width, where many documentation pages show a picture, that is still 8 px.

use plotters::drawing::DrawingAreaErrorKind;

mod asset;
mod axis;
mod labels;
mod paint;
mod plot;
mod stability;
mod sweep;
#[cfg(test)]
mod tests;

pub use asset::{Line, frames_svg, histogram_svg};
pub use stability::stability_svg;
pub use sweep::sweep_svg;

/// One measured setting.
#[derive(Clone, Debug, serde::Deserialize, serde::Serialize)]
pub struct Point {
    /// The volume that was measured.
    pub volume: String,
    /// "adaptive", "f16", "unorm8", "bc4", "bc7", "kmeans", "NanoVDB fpN", "NanoVDB fp8", "NanoVDB fp4", ...
    pub method: String,
    /// "psnr = 45", "range = sequence", "k = 100, variance 0.1"
    pub setting: String,
    /// Bytes the volume takes on the GPU.
    pub gpu_bytes: u64,
    /// The same, in bits per voxel.
    pub bits_per_voxel: f64,
    /// dB; None for lossless (exact).
    pub psnr: Option<f64>,
    /// Largest error as a fraction of the range of values.
    pub max_error: f64,
    /// Wall time of the build.
    pub build_seconds: f64,
    /// None where no GPU traced it.
    pub trace_ms: Option<f64>,
    /// Mean jump across brick faces over mean jump inside, relative to the source's; None where it was not measured.
    pub blockiness: Option<f64>,
    /// Why it failed, e.g. "verification failed: signs flipped"; empty = fine.
    pub failures: Vec<String>,
}

/// The spread of a method over repetitions (seeds, frame orders, thread counts, noise).
#[derive(Clone, Debug, serde::Serialize)]
pub struct Spread {
    /// The volume that was measured.
    pub volume: String,
    /// As in [`Point`].
    pub method: String,
    /// As in [`Point`].
    pub setting: String,
    /// (min, max) over the repetitions, in dB; infinite where a repetition was exact.
    pub psnr: (f64, f64),
    /// (min, max) over the repetitions.
    pub bits_per_voxel: (f64, f64),
    /// (min, max) over the repetitions, as a fraction of the range of values.
    pub max_error: (f64, f64),
    /// (min, max) over the repetitions, relative to the source's.
    pub blockiness: (f64, f64),
    /// How many repetitions.
    pub runs: usize,
    /// Why it failed; empty = fine.
    pub failures: Vec<String>,
}

/// Why a chart could not be drawn.
#[derive(Debug, thiserror::Error)]
pub enum ChartError {
    /// The drawing library refused.
    #[error("cannot draw the chart: {0}")]
    Draw(String),
}

impl<E: std::error::Error + Send + Sync> From<DrawingAreaErrorKind<E>> for ChartError {
    fn from(e: DrawingAreaErrorKind<E>) -> Self {
        ChartError::Draw(e.to_string())
    }
}

/// Which of these (cost, quality) points are on the Pareto front: no other point is at least as good on both
/// counts and better on one. Twins are both on it; a point with a NaN is never on it and beats nothing.
pub fn pareto(points: &[(f64, f64)]) -> Vec<bool> {
    let beats = |a: &(f64, f64), b: &(f64, f64)| a.0 <= b.0 && a.1 >= b.1 && (a.0 < b.0 || a.1 > b.1);
    let valid = |p: &(f64, f64)| !p.0.is_nan() && !p.1.is_nan();
    points.iter().map(|p| valid(p) && !points.iter().any(|q| beats(q, p))).collect()
}
