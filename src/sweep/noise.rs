//! Small changes of the input, to see what a method makes of them.

use crate::volume::{CellContent, Child, Coord, FlatFrame, ValueRange};

/// What is added to active voxels of bricks.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Noise {
    /// The least change that an `f32` has, up or down.
    Ulp,
    /// Up to this fraction of the frame's range of active values, up or down, evenly.
    Fraction(f64),
}

impl Noise {
    /// Changes a frame; the same seed changes the same voxels by the same.
    pub fn apply(self, frame: &mut FlatFrame, seed: u64) {
        let range = frame.stats.active_range.unwrap_or(ValueRange::of(0.0));
        let origins = frame.brick_origins();
        for (brick, origin) in frame.bricks.iter_mut().zip(origins) {
            for i in brick.active.ones() {
                let random = hash(seed, origin, i);
                let value = brick.values[i];
                brick.values[i] = match self {
                    Self::Ulp if random & 1 == 0 => value.next_up(),
                    Self::Ulp => value.next_down(),
                    Self::Fraction(fraction) => {
                        let unit = random as f64 / u64::MAX as f64 * 2.0 - 1.0;
                        (f64::from(value) + fraction * range.width() * unit) as f32
                    }
                };
            }
        }
        frame.stats.active_range = ValueRange::union_all(active(frame));
    }
}

/// The range of each active part of a frame.
fn active(frame: &FlatFrame) -> impl Iterator<Item = ValueRange> + '_ {
    let constants = frame.roots.iter().map(|(_, c)| *c).chain(frame.cells.iter().flat_map(|cell| {
        match &cell.content {
            CellContent::Constant(constant) => vec![*constant],
            CellContent::Node(children) => children
                .iter()
                .filter_map(|(_, child)| match child {
                    Child::Constant(constant) => Some(*constant),
                    Child::Brick(_) => None,
                })
                .collect(),
        }
    }));
    let constants = constants.filter(|c| c.active).map(|c| ValueRange::of(c.value));
    let bricks = frame.bricks.iter().filter_map(|b| b.range_over(&b.active));
    constants.chain(bricks.map(|(min, max)| ValueRange { min, max }))
}

/// Sixty-four bits that look random (the finaliser of SplitMix64).
fn hash(seed: u64, origin: Coord, voxel: usize) -> u64 {
    let [x, y, z] = origin.0.map(|v| u64::from(v as u32));
    let mut h = seed ^ x << 42 ^ y << 21 ^ z ^ (voxel as u64) << 54;
    for multiplier in [0xbf58_476d_1ce4_e5b9, 0x94d0_49bb_1331_11eb] {
        h = (h ^ h >> 30).wrapping_mul(multiplier);
    }
    h ^ h >> 31
}
