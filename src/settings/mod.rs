//! What a build can be asked for: the words of the manifest, the command line and a pack's provenance.

mod budget;
mod clustering;
mod quality;

use clap::ValueEnum;
use serde::{Deserialize, Serialize};

pub use budget::{Budget, Share};
pub use clustering::{ClusterArgs, Clustering, Dedup, NOT_WITH_ADAPTIVE};
pub use quality::{ByteSize, ErrorBound, FRAME_MARGIN_DB, Quality, QualityArgs, above_zero, whole_range};

use crate::codec::Codec;

/// How the bricks of an asset are stored.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Format {
    /// The cheapest codec for each brick at the quality asked
    #[default]
    Adaptive,
    /// 32-bit floats, lossless
    F32,
    /// 16-bit floats, exact where the source is half
    F16,
    /// 8 bits per voxel
    Unorm8,
    /// BC4 blocks, 4 bits per voxel
    Bc4,
    /// BC7 blocks, 2 bits per voxel
    Bc7,
}

impl Format {
    /// The codec of every brick that is not constant, where there is one for all.
    pub fn codec(self) -> Option<Codec> {
        match self {
            Self::Adaptive => None,
            Self::F32 => Some(Codec::F32),
            Self::F16 => Some(Codec::F16),
            Self::Unorm8 => Some(Codec::Unorm8),
            Self::Bc4 => Some(Codec::Bc4),
            Self::Bc7 => Some(Codec::Bc7),
        }
    }

    /// Its name in manifests and reports.
    pub fn name(self) -> &'static str {
        self.codec().map_or("adaptive", Codec::name)
    }

    /// Every format: those of one codec, finest first, then the adaptive one.
    pub const ALL: [Self; 6] = [Self::F32, Self::F16, Self::Unorm8, Self::Bc4, Self::Bc7, Self::Adaptive];
}

/// What the 0 and 1 of normalised texels stand for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum RangeMode {
    /// The minimum and maximum of each brick
    #[default]
    Brick,
    /// The minimum and maximum of the whole sequence, as in the Utrecht thesis
    Sequence,
}

/// Whether bricks keep their active masks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Masks {
    /// Keep them for level sets, f32, and backgrounds other than 0; else drop them from bricks whose inactive voxels are
    /// background
    #[default]
    Auto,
    /// Keep them everywhere
    Keep,
    /// Drop them from every brick whose inactive voxels are background
    Drop,
}

/// What to do with voxels that are infinite or not a number.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum NonFinite {
    /// Fail the build and count them
    #[default]
    Refuse,
    /// Replace them by 0
    Zero,
}

/// What becomes of grids of integers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Integers {
    /// Keep every integer: the error is below 0.5, so rounding gives it back
    #[default]
    Keep,
    /// Pack integers past 2^24 as several grids of 24 bits each (NAME.low, NAME.high)
    Split,
    /// Treat them as floats
    Nearest,
}

impl Integers {
    /// What packs were made with before there was a choice.
    fn before_there_was_a_choice() -> Self {
        Self::Nearest
    }
}

/// The zstd level of a pack where none is chosen: the level of zstd's own tool.
pub const DEFAULT_ZSTD: i32 = 3;

/// Everything that a pack's bytes depend on beside its sources.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// The grids to pack; none for the default one.
    pub grids: Vec<String>,
    /// How bricks are stored.
    pub format: Format,
    /// What an adaptive pack meets.
    pub quality: Quality,
    /// The PSNR that no frame of an adaptive pack falls below, in dB; none for 6 dB below the whole.
    pub min_frame_psnr: Option<f64>,
    /// How similar bricks are clustered; none for not at all.
    pub clustering: Option<Clustering>,
    /// What normalised texels are fractions of.
    pub range: RangeMode,
    /// Whether bricks keep their masks.
    pub masks: Masks,
    /// What to do with infinities and NaNs.
    pub nonfinite: NonFinite,
    /// What becomes of grids of integers.
    #[serde(default = "Integers::before_there_was_a_choice")]
    pub integers: Integers,
    /// zstd's level, 1 to 22; 0 stores everything raw.
    pub zstd: i32,
    /// Frames per second.
    pub fps: Option<f32>,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            grids: Vec::new(),
            format: Format::default(),
            quality: Quality::default(),
            min_frame_psnr: None,
            clustering: None,
            range: RangeMode::default(),
            masks: Masks::default(),
            nonfinite: NonFinite::default(),
            integers: Integers::default(),
            zstd: DEFAULT_ZSTD,
            fps: None,
        }
    }
}
