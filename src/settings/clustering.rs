//! Similar bricks made one, as manifests and the command line ask for it.

use clap::ValueEnum;
use serde::{Deserialize, Serialize};

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
