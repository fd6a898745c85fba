//! How bricks are stored: adaptively or all by one codec, each with the settings that go with it.

use clap::ValueEnum;
use serde::{Deserialize, Serialize};

use super::{Clustering, Quality};
use crate::codec::Codec;

/// How the bricks of a pack are stored.
#[derive(Clone, Debug, PartialEq)]
pub enum Encoding {
    /// The cheapest codec for each brick.
    Adaptive {
        /// What the pack meets.
        quality: Quality,
        /// The PSNR that no frame falls below, in dB; none for 6 dB below the whole.
        min_frame_psnr: Option<f64>,
    },
    /// One codec for every brick that is not constant.
    Uniform {
        /// The codec.
        codec: UniformCodec,
        /// How similar bricks are clustered; none for not at all.
        clustering: Option<Clustering>,
    },
}

impl Default for Encoding {
    fn default() -> Self {
        Quality::default().into()
    }
}

impl From<Quality> for Encoding {
    /// Adaptive, with the usual floor for single frames.
    fn from(quality: Quality) -> Self {
        Self::Adaptive { quality, min_frame_psnr: None }
    }
}

impl From<UniformCodec> for Encoding {
    /// One codec, without clusters.
    fn from(codec: UniformCodec) -> Self {
        Self::Uniform { codec, clustering: None }
    }
}

impl From<Format> for Encoding {
    /// A format with its defaults.
    fn from(format: Format) -> Self {
        format.uniform_codec().map_or_else(Self::default, Self::from)
    }
}

/// A codec that all bricks of a pack can have: one that has texels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum UniformCodec {
    /// Floats.
    F32,
    /// Half floats.
    F16,
    /// One byte a voxel.
    Unorm8,
    /// BC4 blocks.
    Bc4,
    /// BC7 blocks.
    Bc7,
}

impl UniformCodec {
    /// As one of all codecs.
    pub fn codec(self) -> Codec {
        match self {
            Self::F32 => Codec::F32,
            Self::F16 => Codec::F16,
            Self::Unorm8 => Codec::Unorm8,
            Self::Bc4 => Codec::Bc4,
            Self::Bc7 => Codec::Bc7,
        }
    }

    /// As manifests have it.
    pub fn format(self) -> Format {
        match self {
            Self::F32 => Format::F32,
            Self::F16 => Format::F16,
            Self::Unorm8 => Format::Unorm8,
            Self::Bc4 => Format::Bc4,
            Self::Bc7 => Format::Bc7,
        }
    }
}

/// The kind of [`Encoding`], as manifests, the command line and reports name it.
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
    /// The codec of every brick that is not constant; none where each brick has its own.
    pub fn uniform_codec(self) -> Option<UniformCodec> {
        match self {
            Self::Adaptive => None,
            Self::F32 => Some(UniformCodec::F32),
            Self::F16 => Some(UniformCodec::F16),
            Self::Unorm8 => Some(UniformCodec::Unorm8),
            Self::Bc4 => Some(UniformCodec::Bc4),
            Self::Bc7 => Some(UniformCodec::Bc7),
        }
    }

    /// The same as one of all codecs.
    pub fn codec(self) -> Option<Codec> {
        self.uniform_codec().map(UniformCodec::codec)
    }

    /// Its name in manifests and reports.
    pub fn name(self) -> &'static str {
        self.codec().map_or("adaptive", Codec::name)
    }

    /// Every format: those of one codec, finest first, then the adaptive one.
    pub const ALL: [Self; 6] = [Self::F32, Self::F16, Self::Unorm8, Self::Bc4, Self::Bc7, Self::Adaptive];
}
