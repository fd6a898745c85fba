//! How far decoded values are from a brick's.

use super::{Cost, Terms};
use crate::volume::{BRICK_VOXELS, Brick, Mask512};

/// Sums that run side by side: the order of adding is fixed, and a compiler may use vectors.
const LANES: usize = 8;

/// A brick to which decoded values are compared.
pub struct Measure<'a> {
    brick: &'a Brick,
    texel_mask: &'a Mask512,
    /// 1 for voxels that texels give, and for those of them that are active; else 0.
    counts: [f32; BRICK_VOXELS],
    active: [f32; BRICK_VOXELS],
    sign_matters: Option<f64>,
    error_below: f64,
}

impl<'a> Measure<'a> {
    /// `texel_mask` are the voxels that texels give; `terms` say what must not become of them.
    pub(super) fn new(brick: &'a Brick, texel_mask: &'a Mask512, terms: &Terms) -> Self {
        Self {
            brick,
            texel_mask,
            counts: texel_mask.weights(),
            active: brick.active.weights(),
            sign_matters: terms.sign_matters,
            error_below: terms.error_below.unwrap_or(f64::INFINITY),
        }
    }

    /// What `decoded` costs, and what a GPU that is `spread` off at each voxel may read.
    pub fn of(&self, decoded: &[f32; BRICK_VOXELS], spread: Option<&[f32; BRICK_VOXELS]>) -> Cost {
        let (mut squares, mut active, mut max) = ([0.0f64; LANES], [0.0f64; LANES], [0.0f64; LANES]);
        let spread = spread.unwrap_or(&[0.0; BRICK_VOXELS]);
        for at in (0..BRICK_VOXELS).step_by(LANES) {
            for lane in 0..LANES {
                let i = at + lane;
                let counts = f64::from(self.counts[i]);
                let error = (f64::from(decoded[i]) - f64::from(self.brick.values[i])).abs() * counts;
                squares[lane] += error * error;
                active[lane] += error * error * f64::from(self.active[i]);
                let reach = error + f64::from(spread[i]) * counts;
                max[lane] = if reach > max[lane] { reach } else { max[lane] };
            }
        }
        if let Some(distance) = self.sign_matters {
            let values = &self.brick.values;
            let flips =
                |i: usize| (decoded[i] < 0.0) != (values[i] < 0.0) && f64::from(values[i]).abs() > distance;
            if self.texel_mask.ones().any(flips) {
                return Cost::IMPOSSIBLE;
            }
        }
        let max = max.into_iter().fold(0.0, f64::max);
        if max >= self.error_below {
            return Cost::IMPOSSIBLE;
        }
        // Rounded up, because a bound is what it is compared with.
        let max = if f64::from(max as f32) < max { (max as f32).next_up() } else { max as f32 };
        let root = |lanes: [f64; LANES]| lanes.iter().sum::<f64>().sqrt();
        Cost { error_l2: root(squares), active_error_l2: root(active), max }
    }
}

/// The mean of the voxels that texels would give.
pub(super) fn mean(brick: &Brick, texel_mask: &Mask512) -> f32 {
    let sum: f64 = texel_mask.ones().map(|i| f64::from(brick.values[i])).sum();
    (sum / f64::from(texel_mask.count().max(1))) as f32
}
