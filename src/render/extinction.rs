//! The default extinction of lit fog.

use super::cpu::optical_depths;
use super::decoded_frame::DecodedFrame;
use super::scene::{Scene, TraceError};
use super::{Interpolation, Mode};

/// Side of the picture whose median optical depth is taken, in pixels.
const MEDIAN_SIDE: u32 = 64;
/// Pixels below this fraction of the largest optical depth do not count as covered.
const COVERED_PART: f32 = 0.01;
/// Median optical depth of the covered pixels: 5 % of the light behind passes through.
const BODY_DEPTH: f64 = 3.0;

/// An extinction at which fog looks like a body with thin edges: the median optical depth of the covered pixels is 3. An
/// extinction from the highest density alone would leave most smoke too thin, because few voxels are that dense. `None` if
/// nothing is covered.
///
/// # Errors
/// [`TraceError`].
pub fn body_extinction(frame: &DecodedFrame, scene: &Scene) -> Result<Option<f64>, TraceError> {
    let scene = Scene {
        size: [MEDIAN_SIDE; 2],
        mode: Mode::Density,
        interpolation: Interpolation::Nearest,
        ..*scene
    };
    let mut depths = optical_depths::<f32>(frame, &scene)?;
    let thickest = depths.iter().copied().filter(|depth| depth.is_finite()).fold(0.0, f32::max);
    depths.retain(|depth| depth.is_finite() && *depth > COVERED_PART * thickest);
    if depths.is_empty() {
        return Ok(None);
    }
    let middle = depths.len() / 2;
    let (_, median, _) = depths.select_nth_unstable_by(middle, f32::total_cmp);
    Ok(Some(BODY_DEPTH / f64::from(*median)))
}
