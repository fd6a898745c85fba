//! How bricks are stored: adaptively or all by one codec, each with the settings that go with it.

use std::borrow::Cow;

use clap::ValueEnum;
use clap::builder::PossibleValue;
use serde::{Deserialize, Deserializer, Serialize, Serializer, de::Error};

use super::{Clustering, Quality};
use crate::codec::TexelCodec;

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
        codec: TexelCodec,
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

impl From<TexelCodec> for Encoding {
    /// One codec, without clusters.
    fn from(codec: TexelCodec) -> Self {
        Self::Uniform { codec, clustering: None }
    }
}

impl From<Format> for Encoding {
    /// A format with its defaults.
    fn from(format: Format) -> Self {
        format.codec().map_or_else(Self::default, Self::from)
    }
}

/// The kind of [`Encoding`], as manifests, the command line and reports name it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Format {
    /// The cheapest codec for each brick at the quality asked.
    #[default]
    Adaptive,
    /// One codec for every brick that is not constant.
    Uniform(TexelCodec),
}

impl Format {
    /// All bricks in [`TexelCodec::F32`].
    pub const F32: Self = Self::Uniform(TexelCodec::F32);
    /// All bricks in [`TexelCodec::F16`].
    pub const F16: Self = Self::Uniform(TexelCodec::F16);
    /// All bricks in [`TexelCodec::UNORM8`].
    pub const UNORM8: Self = Self::Uniform(TexelCodec::UNORM8);
    /// All bricks in [`TexelCodec::BC4`].
    pub const BC4: Self = Self::Uniform(TexelCodec::BC4);
    /// All bricks in [`TexelCodec::BC7`].
    pub const BC7: Self = Self::Uniform(TexelCodec::BC7);

    /// Every format: the adaptive one, then those of one codec, finest first.
    pub const ALL: [Self; 1 + TexelCodec::ALL.len()] = {
        let mut all = [Self::Adaptive; 1 + TexelCodec::ALL.len()];
        let mut i = 0;
        while i < TexelCodec::ALL.len() {
            all[TexelCodec::ALL.len() - i] = Self::Uniform(TexelCodec::ALL[i]);
            i += 1;
        }
        all
    };

    const NAMES: [&str; Self::ALL.len()] = {
        let mut names = [""; Self::ALL.len()];
        let mut i = 0;
        while i < names.len() {
            names[i] = Self::ALL[i].name();
            i += 1;
        }
        names
    };

    /// The codec of every brick that is not constant; none where each brick has its own.
    pub fn codec(self) -> Option<TexelCodec> {
        match self {
            Self::Adaptive => None,
            Self::Uniform(codec) => Some(codec),
        }
    }

    /// Its name in manifests and reports.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Adaptive => "adaptive",
            Self::Uniform(codec) => codec.name(),
        }
    }
}

impl ValueEnum for Format {
    fn value_variants<'a>() -> &'a [Self] {
        &Self::ALL
    }

    fn to_possible_value(&self) -> Option<PossibleValue> {
        let help = match self {
            Self::Adaptive => "The cheapest codec for each brick at the quality asked",
            Self::Uniform(codec) => codec.help(),
        };
        Some(PossibleValue::new(self.name()).help(help))
    }
}

impl Serialize for Format {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}

impl<'de> Deserialize<'de> for Format {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let name = Cow::<str>::deserialize(deserializer)?;
        let format = Self::ALL.into_iter().find(|format| format.name() == name);
        format.ok_or_else(|| D::Error::unknown_variant(&name, &Self::NAMES))
    }
}
