//! The ways to code a brick.

use crate::codec::TexelCodec;

/// One of the ways.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Candidate {
    /// Not at all: background, without a record.
    Empty,
    Constant,
    /// Another brick's texels: it costs what a constant costs.
    Borrowed,
    Texels(TexelCodec),
}

/// A value for each candidate, by [`Candidate::index`].
pub(super) type PerCandidate<T> = [T; Candidate::ALL.len()];

impl Candidate {
    /// How many there are without texels of their own.
    const WITHOUT_TEXELS: usize = 3;

    /// By ascending bits.
    pub const ALL: [Self; Self::WITHOUT_TEXELS + TexelCodec::ALL.len()] = {
        let mut all = [Self::Empty; Self::WITHOUT_TEXELS + TexelCodec::ALL.len()];
        all[1] = Self::Constant;
        all[2] = Self::Borrowed;
        let mut i = 0;
        while i < TexelCodec::ALL.len() {
            all[Self::WITHOUT_TEXELS + i] = Self::Texels(TexelCodec::ALL[i]);
            i += 1;
        }
        all
    };

    /// The one without error, which any brick can have.
    pub const EXACT: Self = Self::Texels(TexelCodec::EXACT);

    /// Its place in [`Self::ALL`].
    pub fn index(self) -> usize {
        match self {
            Self::Empty => 0,
            Self::Constant => 1,
            Self::Borrowed => 2,
            Self::Texels(codec) => Self::WITHOUT_TEXELS + codec.index(),
        }
    }

    /// How many have an error that depends on the brick alone: all but [`Self::Borrowed`] and [`Self::EXACT`].
    pub const WITH_OWN_ERROR: usize = Self::ALL.len() - 2;

    /// Its place among those.
    pub fn own_error_index(self) -> Option<usize> {
        match self {
            Self::Borrowed => None,
            Self::Empty | Self::Constant => Some(self.index()),
            // The exact one is the last.
            Self::Texels(_) => Some(self.index() - 1).filter(|index| *index < Self::WITH_OWN_ERROR),
        }
    }

    /// The codec of its own texels, if it has any.
    pub fn codec(self) -> Option<TexelCodec> {
        match self {
            Self::Texels(codec) => Some(codec),
            Self::Empty | Self::Constant | Self::Borrowed => None,
        }
    }

    /// Bits of the texels of a brick.
    pub fn texel_bits(self) -> u32 {
        self.codec().map_or(0, |codec| 8 * codec.codec().layout().brick_bytes() as u32)
    }
}
