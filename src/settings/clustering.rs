//! Similar bricks made one, as manifests and the command line ask for it.

use clap::{Args, ValueEnum};
use serde::{Deserialize, Serialize};

use super::Format;

/// Which bricks are one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Dedup {
    /// Merge identical bricks
    #[default]
    Exact,
    /// Merge similar bricks by k-means, as in the Utrecht thesis
    Kmeans,
}

/// How `dedup = "kmeans"` clusters (Utrecht thesis, 4.5 and 5.3).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Clustering {
    /// How many clusters there are at most: the thesis's k.
    pub clusters: u32,
    /// How often centroids are moved to the middle of their members.
    pub iterations: u32,
    /// Bricks of more variance than this, once each is stretched to 0..1, stay as they are.
    pub variance: f64,
    /// What the first centroids are drawn by.
    pub seed: u64,
}

impl Default for Clustering {
    /// The settings at which the thesis's cloud is no longer blocky (its figure 19, d).
    fn default() -> Self {
        Self { clusters: 100, iterations: 5, variance: 0.01, seed: 0 }
    }
}

/// Why an adaptive pack cannot be clustered.
pub const NOT_WITH_ADAPTIVE: &str = "dedup = \"kmeans\" goes with one codec for all bricks, such as format = \"bc7\": \
    the adaptive format promises a quality that clusters know nothing of";

/// The settings that make a [`Clustering`].
#[derive(Args, Clone, Debug, Default, PartialEq)]
pub struct ClusterArgs {
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
}

impl ClusterArgs {
    /// How similar bricks are clustered; `None` for not at all.
    ///
    /// # Errors
    /// When a number makes no sense, k-means is given settings without being asked for, or the format is adaptive.
    pub fn clustering(&self, format: Format) -> Result<Option<Clustering>, String> {
        let default = Clustering::default();
        let clustering = Clustering {
            clusters: self.clusters.unwrap_or(default.clusters),
            iterations: self.iterations.unwrap_or(default.iterations),
            variance: self.variance.unwrap_or(default.variance),
            seed: self.seed.unwrap_or(default.seed),
        };
        if self.dedup != Some(Dedup::Kmeans) {
            let given = self.clusters.is_some() || self.iterations.is_some();
            return match given || self.variance.is_some() || self.seed.is_some() {
                false => Ok(None),
                true => Err("clusters, iterations, variance and seed are for dedup = \"kmeans\"".to_owned()),
            };
        }
        if format == Format::Adaptive {
            return Err(NOT_WITH_ADAPTIVE.to_owned());
        }
        if clustering.clusters == 0 {
            return Err("clusters is a number above 0".to_owned());
        }
        if !(clustering.variance >= 0.0 && clustering.variance.is_finite()) {
            return Err("variance is a number not below 0".to_owned());
        }
        Ok(Some(clustering))
    }
}
