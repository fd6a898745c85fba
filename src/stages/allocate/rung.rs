//! The ways to code a brick.

use crate::codec::Codec;
use crate::stages::encodings::{Cost, Encodings, KeptCodec};

/// One of the ways.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Rung {
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

impl Rung {
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

    /// What it does to a brick that borrows nothing; `None` while it has not been tried.
    pub fn cost(self, encodings: &Encodings, brick: u32) -> Option<Cost> {
        match self {
            Self::Empty => encodings.plain(brick).map(|plain| plain.empty),
            Self::Constant => encodings.plain(brick).map(|plain| plain.constant),
            Self::F16 => encodings.plain(brick).map(|plain| plain.f16),
            Self::F32 => Some(Cost::NONE),
            Self::Borrowed => Some(Cost::IMPOSSIBLE),
            Self::Bc7 => encodings.cost(brick, KeptCodec::Bc7),
            Self::Bc4 => encodings.cost(brick, KeptCodec::Bc4),
            Self::Unorm8 => encodings.cost(brick, KeptCodec::Unorm8),
        }
    }
}
