//! Settings as the command line and manifests write them: one struct for both.

use clap::Args;
use serde::{Deserialize, Deserializer};

use super::quality::{check_above_zero, check_decibels, decibels};
use super::{
    ByteSize, Clustering, DEFAULT_ZSTD, Dedup, Encoding, ErrorBound, Format, Integers, Masks, NonFinite,
    Quality, RangeMode, Settings, TexelCodec, above_zero, whole_range,
};

/// How a pack is made. The names of fields are the keys of a manifest; what is said of them is the help.
#[derive(Args, Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SettingsArgs {
    /// Grid to pack; repeat for several [default: density, else the only scalar grid]
    #[arg(short, long = "grid", value_name = "NAME", help_heading = "Input")]
    pub grids: Option<Vec<String>>,
    /// Codec of the bricks [default: adaptive]
    #[arg(short, long, help_heading = "Quality")]
    pub format: Option<Format>,
    /// Minimum PSNR over active voxels, in dB [default: 55; level sets have --max-error "0.05 voxels"]
    #[arg(long, value_name = "DB", value_parser = decibels, group = "quality", help_heading = "Quality")]
    pub psnr: Option<f64>,
    /// Maximum error of any voxel: 0.01 or 1% of the value range, "0.2 units" or "0.1 voxels"
    #[arg(long, value_name = "ERROR", group = "quality", help_heading = "Quality")]
    pub max_error: Option<ErrorBound>,
    /// Maximum GPU bits per voxel, counted over all 512 voxels of each leaf
    #[arg(long, value_name = "BITS", value_parser = above_zero, group = "quality", help_heading = "Quality")]
    pub bits_per_voxel: Option<f64>,
    /// Maximum size on the GPU (tree, masks and texels): 40MB, 512KiB
    #[arg(long, value_name = "BYTES", group = "quality", help_heading = "Quality")]
    pub size: Option<ByteSize>,
    /// Minimum PSNR of any single frame, in dB [default: 6 dB below the sequence's]
    #[arg(long, value_name = "DB", value_parser = decibels, help_heading = "Quality")]
    pub min_frame_psnr: Option<f64>,
    /// How duplicate bricks are merged [default: exact]
    #[arg(long, help_heading = "k-means")]
    pub dedup: Option<Dedup>,
    /// Number of clusters, the thesis's k [default: 100]
    #[arg(long, value_name = "K", help_heading = "k-means")]
    pub clusters: Option<u32>,
    /// Number of iterations [default: 5]
    #[arg(long, value_name = "N", help_heading = "k-means")]
    pub iterations: Option<u32>,
    /// Variance above which a brick is not merged [default: 0.01]
    #[arg(long, value_name = "VARIANCE", help_heading = "k-means")]
    pub variance: Option<f64>,
    /// Seed of the first centroids [default: 0]
    #[arg(long, help_heading = "k-means")]
    pub seed: Option<u64>,
    /// Value range that 0 to 1 of normalised texels (unorm and BC) stand for [default: brick]
    #[arg(short, long, help_heading = "Quality")]
    pub range: Option<RangeMode>,
    /// Which bricks keep their active masks [default: auto]
    #[arg(long, help_heading = "Quality")]
    pub masks: Option<Masks>,
    /// Treatment of infinities and NaNs [default: refuse]
    #[arg(long, help_heading = "Input")]
    pub nonfinite: Option<NonFinite>,
    /// Treatment of integer grids [default: keep]
    #[arg(long, help_heading = "Input")]
    pub integers: Option<Integers>,
    /// zstd level of the file, 1 to 22; 0 for no compression [default: 3]
    #[arg(long, value_name = "LEVEL", value_parser = clap::value_parser!(i32).range(0..=22), help_heading = "Output")]
    #[serde(deserialize_with = "checked_zstd")]
    pub zstd: Option<i32>,
    /// Frame rate recorded in the pack, in frames per second
    #[arg(long, value_name = "RATE", value_parser = frame_rate, help_heading = "Output")]
    #[serde(deserialize_with = "checked_fps")]
    pub fps: Option<f32>,
}

impl SettingsArgs {
    /// The manifest's keys.
    pub fn keys() -> Vec<String> {
        let command = Self::augment_args(clap::Command::new(""));
        command.get_arguments().map(|arg| arg.get_id().to_string()).collect()
    }

    /// Whether any is given.
    pub fn any(&self) -> bool {
        *self != Self::default()
    }

    /// What is asked for, with defaults for what is not given.
    ///
    /// # Errors
    /// When a number makes no sense, or settings do not go with each other.
    pub fn settings(&self) -> Result<Settings, String> {
        Ok(Settings {
            grids: self.grids.clone().unwrap_or_default(),
            encoding: match self.format.unwrap_or_default().codec() {
                None => self.adaptive()?,
                Some(codec) => self.uniform(codec)?,
            },
            range: self.range.unwrap_or_default(),
            masks: self.masks.unwrap_or_default(),
            nonfinite: self.nonfinite.unwrap_or_default(),
            integers: self.integers.unwrap_or_default(),
            zstd: self.zstd.map_or(Ok(DEFAULT_ZSTD), check_zstd)?,
            fps: self.fps.map(check_fps).transpose()?,
        })
    }

    fn adaptive(&self) -> Result<Encoding, String> {
        let quality = self.quality()?;
        if self.clustering()?.is_some() {
            return Err(
                "dedup = \"kmeans\" goes with one codec for all bricks, such as format = \"bc7\": the \
                        adaptive format promises a quality that clusters know nothing of"
                    .to_owned(),
            );
        }
        Ok(Encoding::Adaptive { quality, min_frame_psnr: self.min_frame_psnr })
    }

    fn uniform(&self, codec: TexelCodec) -> Result<Encoding, String> {
        let numbers = [self.psnr, self.bits_per_voxel, self.min_frame_psnr];
        if numbers.iter().any(Option::is_some) || self.max_error.is_some() || self.size.is_some() {
            return Err(format!(
                "psnr, max_error, bits_per_voxel, size and min_frame_psnr are for the adaptive format, not for {}",
                codec.name()
            ));
        }
        Ok(Encoding::Uniform { codec, clustering: self.clustering()? })
    }

    fn quality(&self) -> Result<Quality, String> {
        for (key, db) in [("psnr", self.psnr), ("min_frame_psnr", self.min_frame_psnr)] {
            db.map_or(Ok(0.0), check_decibels).map_err(|e| format!("{key}: {e}"))?;
        }
        let bits = self.bits_per_voxel.map_or(Ok(0.0), check_above_zero);
        bits.map_err(|e| format!("bits_per_voxel: {e}"))?;
        if let Some(bound) = self.max_error.filter(|bound| bound.fraction().is_some_and(|part| part >= 1.0)) {
            return Err(whole_range(bound, 1.0, 1.0));
        }
        if self.max_error.is_some() && self.min_frame_psnr.is_some() {
            return Err("max_error holds for every voxel of every frame: min_frame_psnr does not go with it"
                .to_owned());
        }
        let asked = [
            self.psnr.map(Quality::Psnr),
            self.max_error.map(Quality::MaxError),
            self.bits_per_voxel.map(Quality::BitsPerVoxel),
            self.size.map(|size| Quality::Size(size.0)),
        ];
        let mut asked = asked.into_iter().flatten();
        match (asked.next(), asked.next()) {
            (_, Some(_)) => Err("give one of psnr, max_error, bits_per_voxel and size".to_owned()),
            (quality, None) => Ok(quality.unwrap_or_default()),
        }
    }

    /// How similar bricks are clustered; `None` for not at all.
    fn clustering(&self) -> Result<Option<Clustering>, String> {
        if self.dedup != Some(Dedup::Kmeans) {
            let given = self.clusters.is_some() || self.iterations.is_some();
            return match given || self.variance.is_some() || self.seed.is_some() {
                false => Ok(None),
                true => Err("clusters, iterations, variance and seed are for dedup = \"kmeans\"".to_owned()),
            };
        }
        let default = Clustering::default();
        let clustering = Clustering {
            clusters: self.clusters.unwrap_or(default.clusters),
            iterations: self.iterations.unwrap_or(default.iterations),
            variance: self.variance.unwrap_or(default.variance),
            seed: self.seed.unwrap_or(default.seed),
        };
        if clustering.clusters == 0 {
            return Err("clusters is a number above 0".to_owned());
        }
        if !(clustering.variance >= 0.0 && clustering.variance.is_finite()) {
            return Err("variance is a number not below 0".to_owned());
        }
        Ok(Some(clustering))
    }
}

fn check_zstd(level: i32) -> Result<i32, String> {
    match level {
        0..=22 => Ok(level),
        _ => Err("zstd is a level from 1 to 22, or 0 for none".to_owned()),
    }
}

fn check_fps(rate: f32) -> Result<f32, String> {
    if rate > 0.0 && rate.is_finite() { Ok(rate) } else { Err("fps is a number above 0".to_owned()) }
}

/// The command line names the option itself.
fn frame_rate(text: &str) -> Result<f32, String> {
    text.parse().ok().filter(|rate| check_fps(*rate).is_ok()).ok_or_else(|| "a number above 0".to_owned())
}

// Checked where they are read, so that the error has their line.

fn checked_zstd<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<i32>, D::Error> {
    check_zstd(i32::deserialize(deserializer)?).map(Some).map_err(serde::de::Error::custom)
}

fn checked_fps<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<f32>, D::Error> {
    check_fps(f32::deserialize(deserializer)?).map(Some).map_err(serde::de::Error::custom)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn settings(text: &str) -> Result<Settings, String> {
        toml::from_str::<SettingsArgs>(text).map_err(|e| e.message().to_owned())?.settings()
    }

    #[test]
    fn settings_that_do_not_go_together_are_refused() {
        assert_eq!(settings(""), Ok(Settings::default()));
        for (text, error) in [
            ("dedup = 'kmeans'", "one codec for all bricks"),
            ("dedup = 'kmeans'\nclusters = 0\nformat = 'bc7'", "clusters is a number above 0"),
            ("dedup = 'kmeans'\nvariance = -1\nformat = 'bc7'", "variance is a number not below 0"),
            ("clusters = 7\nformat = 'bc7'", "are for dedup = \"kmeans\""),
            ("psnr = 45\nformat = 'bc7'", "are for the adaptive format, not for bc7"),
            ("size = '1MB'\nformat = 'f32'", "are for the adaptive format, not for f32"),
            ("min_frame_psnr = 45\nformat = 'bc4'", "are for the adaptive format, not for bc4"),
            ("psnr = 45\nsize = 100", "give one of psnr, max_error, bits_per_voxel and size"),
            ("max_error = 0.1\nmin_frame_psnr = 30", "min_frame_psnr does not go with it"),
            ("psnr = 300", "psnr: a number of dB from 0 to 200"),
            ("bits_per_voxel = 0", "bits_per_voxel: a number above 0"),
            ("max_error = 1", "is the whole range of values or more"),
            ("zstd = 23", "zstd is a level from 1 to 22, or 0 for none"),
            ("fps = 0", "fps is a number above 0"),
        ] {
            let found = settings(text).unwrap_err();
            assert!(found.contains(error), "{text}: {found}");
        }
    }

    #[test]
    fn keys_are_those_that_manifests_have() {
        for key in SettingsArgs::keys() {
            let error = toml::from_str::<SettingsArgs>(&format!("{key} = {{}}")).unwrap_err();
            assert!(!error.message().contains("unknown field"), "{key}: {error}");
        }
        assert!(toml::from_str::<SettingsArgs>("colour = 1").is_err());
    }
}
