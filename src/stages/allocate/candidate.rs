//! The ways to code a brick.

use crate::codec::Codec;

/// One of the ways.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Candidate {
    /// Not at all: background, without a record.
    Empty,
    Constant,
    /// Another brick's texels: it costs what a constant costs.
    Borrowed,
    Bc7,
    Bc4,
    Unorm8,
    F16,
    F32,
}

impl Candidate {
    /// By ascending bits.
    pub const ALL: [Self; 8] = [
        Self::Empty,
        Self::Constant,
        Self::Borrowed,
        Self::Bc7,
        Self::Bc4,
        Self::Unorm8,
        Self::F16,
        Self::F32,
    ];

    /// The codec of its own texels; `Constant` where it has none.
    pub fn codec(self) -> Codec {
        match self {
            Self::Empty | Self::Constant | Self::Borrowed => Codec::Constant,
            Self::Bc7 => Codec::Bc7,
            Self::Bc4 => Codec::Bc4,
            Self::Unorm8 => Codec::Unorm8,
            Self::F16 => Codec::F16,
            Self::F32 => Codec::F32,
        }
    }

    /// How many have a cost that depends on the brick alone.
    pub const OWN: usize = 6;

    /// Its place among those.
    pub fn own(self) -> Option<usize> {
        match self {
            Self::Empty => Some(0),
            Self::Constant => Some(1),
            Self::Bc7 => Some(2),
            Self::Bc4 => Some(3),
            Self::Unorm8 => Some(4),
            Self::F16 => Some(5),
            Self::Borrowed | Self::F32 => None,
        }
    }

    /// Bits of the texels of a brick.
    pub fn texel_bits(self) -> u32 {
        8 * self.codec().layout().brick_bytes() as u32
    }
}
