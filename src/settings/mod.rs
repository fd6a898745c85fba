//! What a build can be asked for: the words of the manifest, the command line and a pack's provenance.

mod args;
mod budget;
mod clustering;
mod document;
mod encoding;
mod look;
mod quality;

use clap::ValueEnum;
use serde::{Deserialize, Serialize};

pub use crate::codec::TexelCodec;
pub use args::SettingsArgs;
pub use budget::{Budget, Share};
pub use clustering::{Clustering, Dedup};
pub use encoding::{Encoding, Format};
pub use look::{Look, Step, Sun, Up, View, ViewError};
pub(crate) use quality::check_above_zero;
pub use quality::{ByteSize, ErrorBound, FRAME_MARGIN_DB, Quality, above_zero, whole_range};

use document::Document;

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

/// The zstd level of a pack where none is chosen: the level of zstd's own tool.
pub const DEFAULT_ZSTD: i32 = 3;

/// Everything that a pack's bytes depend on beside its sources. Its JSON is a flat object.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(into = "Document", try_from = "Document")]
pub struct Settings {
    /// The grids to pack; none for the default one.
    pub grids: Vec<String>,
    /// How bricks are stored.
    pub encoding: Encoding,
    /// What normalised texels are fractions of.
    pub range: RangeMode,
    /// Whether bricks keep their masks.
    pub masks: Masks,
    /// What to do with infinities and NaNs.
    pub nonfinite: NonFinite,
    /// What becomes of grids of integers.
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
            encoding: Encoding::default(),
            range: RangeMode::default(),
            masks: Masks::default(),
            nonfinite: NonFinite::default(),
            integers: Integers::default(),
            zstd: DEFAULT_ZSTD,
            fps: None,
        }
    }
}

impl Settings {
    /// The kind of encoding.
    pub fn format(&self) -> Format {
        match self.encoding {
            Encoding::Adaptive { .. } => Format::Adaptive,
            Encoding::Uniform { codec, .. } => Format::Uniform(codec),
        }
    }

    /// Whether each brick has a codec of its own.
    pub fn is_adaptive(&self) -> bool {
        matches!(self.encoding, Encoding::Adaptive { .. })
    }

    /// The codec of every brick that is not constant, where there is one for all.
    pub fn codec(&self) -> Option<TexelCodec> {
        self.format().codec()
    }

    /// What an adaptive pack meets. With one codec for all bricks nothing is asked, and it is the default: by that the
    /// values of constant bricks are chosen.
    pub fn quality(&self) -> Quality {
        match self.encoding {
            Encoding::Adaptive { quality, .. } => quality,
            Encoding::Uniform { .. } => Quality::default(),
        }
    }

    /// The PSNR that no frame of an adaptive pack falls below, in dB; none for 6 dB below the whole.
    pub fn min_frame_psnr(&self) -> Option<f64> {
        match self.encoding {
            Encoding::Adaptive { min_frame_psnr, .. } => min_frame_psnr,
            Encoding::Uniform { .. } => None,
        }
    }

    /// How similar bricks are clustered; none for not at all.
    pub fn clustering(&self) -> Option<&Clustering> {
        match &self.encoding {
            Encoding::Adaptive { .. } => None,
            Encoding::Uniform { clustering, .. } => clustering.as_ref(),
        }
    }
}
