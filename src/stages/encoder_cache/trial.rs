//! What a brick is tried as, and what comes of it.

use bytemuck::{Pod, Zeroable};
use serde::{Deserialize, Serialize};

use crate::codec::TexelCodec;
use crate::pods;

/// What one codec does to one brick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cost {
    /// Root of the squared error over the voxels that texels give; infinite where the codec is out of the
    /// question.
    pub error_l2: f64,
    /// The same over active voxels.
    pub active_error_l2: f64,
    /// The largest error that an engine can read, on any GPU.
    pub max: f32,
}

impl Cost {
    /// No error at all.
    pub const NONE: Self = Self { error_l2: 0.0, active_error_l2: 0.0, max: 0.0 };
    /// More error than any.
    pub const IMPOSSIBLE: Self =
        Self { error_l2: f64::INFINITY, active_error_l2: f64::INFINITY, max: f32::INFINITY };
}

/// What a constant brick's value keeps small.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub enum ConstantAim {
    /// The squared error: it is the mean.
    Squares,
    /// The largest error: it is the middle of the range.
    Max,
}

/// A brick without texels, or with raw ones: what can be said of it without keeping a byte.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WithoutTexels {
    /// What it would be as a constant.
    pub value: f32,
    /// As that constant.
    pub constant: Cost,
    /// As background, without a record.
    pub empty: Cost,
    /// In each codec of [`TexelCodec::ERROR_ONLY`].
    pub error_only: [Cost; TexelCodec::ERROR_ONLY.len()],
}

impl WithoutTexels {
    pub(super) const NOTES: usize = 2 + TexelCodec::ERROR_ONLY.len();

    pub(super) fn to_notes(self) -> impl Iterator<Item = Note> {
        let own = [Note::new(self.constant, self.value.to_bits()), Note::new(self.empty, 0)];
        own.into_iter().chain(self.error_only.map(|cost| Note::new(cost, 0)))
    }

    pub(super) fn from_notes([constant, empty, error_only @ ..]: [Note; Self::NOTES]) -> Self {
        Self {
            value: f32::from_bits(constant.word),
            constant: constant.cost(),
            empty: empty.cost(),
            error_only: error_only.map(|note| note.cost()),
        }
    }
}

/// What a brick is tried as.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub enum Trial {
    /// Without texels, or with texels that are not kept: [`WithoutTexels`].
    WithoutTexels,
    /// With texels of a codec that [keeps them](TexelCodec::keeps_texels).
    Texels(TexelCodec),
}

impl Trial {
    /// All of them.
    pub const ALL: [Self; 1 + TexelCodec::ALL.len()] = {
        let mut all = [Self::WithoutTexels; 1 + TexelCodec::ALL.len()];
        let mut i = 0;
        while i < TexelCodec::ALL.len() {
            all[1 + i] = Self::Texels(TexelCodec::ALL[i]);
            i += 1;
        }
        all
    };

    /// Its place among them.
    pub fn index(self) -> usize {
        match self {
            Self::WithoutTexels => 0,
            Self::Texels(codec) => 1 + codec.index(),
        }
    }

    /// Notes that are kept of a brick.
    pub fn notes(self) -> usize {
        match self {
            Self::WithoutTexels => WithoutTexels::NOTES,
            Self::Texels(_) => 1,
        }
    }

    /// Bytes of texels of a brick.
    pub fn texels(self) -> usize {
        match self {
            Self::WithoutTexels => 0,
            Self::Texels(codec) => codec.codec().layout().brick_bytes(),
        }
    }
}

/// What was made of some bricks in a trial, one brick after another.
#[derive(Default, Serialize, Deserialize)]
pub struct TrialResults {
    /// [`Trial::notes`] a brick.
    #[serde(with = "pods")]
    pub notes: Vec<Note>,
    /// [`Trial::texels`] a brick.
    #[serde(with = "pods")]
    pub texels: Vec<u8>,
}

/// A [`Cost`], and something more of what it is the cost of.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub struct Note {
    error_l2: f64,
    active_error_l2: f64,
    max: f32,
    /// What depends on the trial: a constant's value, a packing axis.
    pub word: u32,
}

impl Note {
    /// The note of a cost.
    pub fn new(cost: Cost, word: u32) -> Self {
        Self { error_l2: cost.error_l2, active_error_l2: cost.active_error_l2, max: cost.max, word }
    }

    /// The cost.
    pub fn cost(&self) -> Cost {
        Cost { error_l2: self.error_l2, active_error_l2: self.active_error_l2, max: self.max }
    }
}
