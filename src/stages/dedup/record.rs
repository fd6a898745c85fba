//! What a tree says of an 8³ region: its values, its mask and its inactive rule.

use crate::volume::InactiveRule;

/// One distinct 8³ region.
#[derive(Clone, Copy, Debug)]
pub struct Record {
    /// [`Record::NO_MASK`] for none.
    mask: u32,
    /// The bits of a value, or the number of a brick.
    payload_bits: u32,
    is_brick: bool,
    /// What its inactive voxels are.
    pub rule: InactiveRule,
}

impl Record {
    const NO_MASK: u32 = u32::MAX;

    pub(super) fn new(mask: Option<u32>, rule: InactiveRule, payload: Payload) -> Self {
        let (is_brick, payload_bits) = match payload {
            Payload::Constant(value) => (false, value.to_bits()),
            Payload::Brick(id) => (true, id),
        };
        Self { mask: mask.unwrap_or(Self::NO_MASK), payload_bits, is_brick, rule }
    }

    /// The place of its mask in [`super::SequenceTree::masks`]; `None` where a voxel is active if its value is
    /// not the background.
    pub fn mask(&self) -> Option<u32> {
        (self.mask != Self::NO_MASK).then_some(self.mask)
    }

    /// What its other voxels are.
    pub fn payload(&self) -> Payload {
        if self.is_brick {
            Payload::Brick(self.payload_bits)
        } else {
            Payload::Constant(f32::from_bits(self.payload_bits))
        }
    }
}

/// The values of a [`Record`].
#[derive(Clone, Copy, Debug)]
pub enum Payload {
    /// All the same.
    Constant(f32),
    /// Those of this brick of the pool.
    Brick(u32),
}
