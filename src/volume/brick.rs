//! An 8³ block of voxels, and what its inactive voxels are.

use super::{BRICK_VOXELS, InactiveRule, Mask512};

/// One brick of the source: every voxel's value and active state, x slowest, z fastest.
#[derive(Clone, PartialEq)]
pub struct Brick {
    /// The 512 values, those of inactive voxels too.
    pub values: [f32; BRICK_VOXELS],
    /// Which voxels of the source are active.
    pub active: Mask512,
    /// Whether that has to be kept. Else a pack's voxel is active where its value is not the background.
    pub keeps_mask: bool,
}

impl Brick {
    /// The simplest rule that gives every inactive voxel back bit by bit, and for
    /// [`InactiveRule::Sign`] the mask of those at minus the background.
    pub fn inactive_rule(&self, background: f32) -> (InactiveRule, Mask512) {
        let mut sign_mask = Mask512::NONE;
        let mut inactive = 0;
        for i in (0..BRICK_VOXELS).filter(|&i| !self.active.get(i)) {
            inactive += 1;
            let bits = self.values[i].to_bits();
            if bits == background.to_bits() {
            } else if bits == (-background).to_bits() {
                sign_mask.set(i);
            } else {
                return (InactiveRule::Texel, Mask512::NONE);
            }
        }
        match sign_mask.count() {
            0 => (InactiveRule::Background, sign_mask),
            n if n == inactive => (InactiveRule::MinusBackground, sign_mask),
            _ => (InactiveRule::Sign, sign_mask),
        }
    }

    /// Whether every voxel is active with the same bits, or inactive with the same bits.
    pub fn constant(&self) -> Option<super::Constant> {
        let mask = self.active;
        let first = self.values[0];
        let same = || self.values.iter().all(|v| v.to_bits() == first.to_bits());
        (mask == Mask512::ALL && same()).then_some(super::Constant { value: first, active: true }).or_else(
            || (mask == Mask512::NONE && same()).then_some(super::Constant { value: first, active: false }),
        )
    }

    /// The root of the sum of squared differences between other values and this brick's, over the voxels that
    /// `texel_mask` names.
    pub fn error_l2(&self, values: &[f32; BRICK_VOXELS], texel_mask: &Mask512) -> f64 {
        let square = |i: usize| (f64::from(values[i]) - f64::from(self.values[i])).powi(2);
        texel_mask.ones().map(square).sum::<f64>().sqrt()
    }

    /// Smallest and largest value among the voxels that `texel_mask` names.
    pub fn range_over(&self, texel_mask: &Mask512) -> Option<(f32, f32)> {
        texel_mask.ones().map(|i| self.values[i]).fold(None, |range, v| match range {
            None => Some((v, v)),
            Some((min, max)) => Some((min.min(v), max.max(v))),
        })
    }
}
