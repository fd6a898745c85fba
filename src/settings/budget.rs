//! What packs may cost and must keep, as a manifest writes it.

use std::str::FromStr;

use serde::{Deserialize, Deserializer};

use super::quality::{check_above_zero, from_text_or_number};
use super::{ByteSize, ErrorBound};

/// Limits; each that is past is an error of its own, and none is checked that is not given.
#[derive(Clone, Copy, Debug, Default, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Budget {
    /// Bytes on a GPU: tree, masks and texels.
    pub gpu_size: Option<ByteSize>,
    /// Bytes of the file.
    pub file_size: Option<ByteSize>,
    /// The part of the bytes on a GPU that is tree and masks.
    pub tree_share: Option<Share>,
    /// The PSNR over active leaf voxels that each grid has at least, in dB.
    #[serde(deserialize_with = "above_zero")]
    pub min_psnr: Option<f64>,
    /// The largest error of an active leaf voxel.
    pub max_error: Option<ErrorBound>,
    /// The largest mean FLIP of its pictures.
    #[serde(deserialize_with = "above_zero")]
    pub max_flip: Option<f64>,
    /// Seconds that a build takes, verification included.
    #[serde(deserialize_with = "above_zero")]
    pub build_seconds: Option<f64>,
    /// How much the bytes on a GPU, and those of the file, may grow against a baseline.
    pub max_growth: Option<Share>,
    /// How much the PSNR may fall against a baseline, in dB.
    #[serde(deserialize_with = "above_zero")]
    pub max_psnr_loss: Option<f64>,
}

impl Budget {
    /// What an asset has to keep: its own limits, and those of all assets that are not sums over them.
    pub fn of_asset(&self, own: &Self) -> Self {
        Self {
            gpu_size: own.gpu_size,
            file_size: own.file_size,
            build_seconds: own.build_seconds,
            tree_share: own.tree_share.or(self.tree_share),
            min_psnr: own.min_psnr.or(self.min_psnr),
            max_error: own.max_error.or(self.max_error),
            max_flip: own.max_flip.or(self.max_flip),
            max_growth: own.max_growth.or(self.max_growth),
            max_psnr_loss: own.max_psnr_loss.or(self.max_psnr_loss),
        }
    }
}

/// A part of a whole: `0.05` or `5%`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Share(pub f64);

impl FromStr for Share {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (number, scale) = match text.trim().strip_suffix('%') {
            Some(percent) => (percent, 0.01),
            None => (text, 1.0),
        };
        match number.trim().parse::<f64>() {
            Ok(share) if share.is_finite() && share >= 0.0 => Ok(Self(share * scale)),
            _ => Err("a share is a number, not below 0: 0.05 or \"5%\"".to_owned()),
        }
    }
}

impl<'de> Deserialize<'de> for Share {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        from_text_or_number(deserializer)
    }
}

fn above_zero<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<f64>, D::Error> {
    check_above_zero(f64::deserialize(deserializer)?).map(Some).map_err(serde::de::Error::custom)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_asset_keeps_its_own_limits_and_those_that_are_no_sums() {
        let all: Budget = toml::from_str("gpu_size = '9MB'\ntree_share = '5%'\nmin_psnr = 40\n").unwrap();
        let own: Budget = toml::from_str("min_psnr = 50.5\nfile_size = 100\n").unwrap();
        let merged = all.of_asset(&own);
        assert_eq!((merged.gpu_size, merged.tree_share), (None, Some(Share(0.05))));
        assert_eq!((merged.min_psnr, merged.file_size), (Some(50.5), Some(ByteSize(100))));
        for wrong in [
            "gpu_size = -1",
            "tree_share = 'x'",
            "tree_share = -0.1",
            "min_psnr = 0",
            "max_flip = nan",
            "psnr = 1",
        ] {
            assert!(toml::from_str::<Budget>(wrong).is_err(), "{wrong}");
        }
    }
}
