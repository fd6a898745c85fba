//! What a build is asked for, and what it did.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

use serde::Serialize;

use crate::cache::{Cache, Uses};
use crate::report::PackSummary;
use crate::report::model::{BuildReport, Made, StageSeconds};
use crate::settings::Settings;
use crate::verify::{PictureSettings, VerifyReport};
use crate::volume::ScratchFolder;

/// How much a finished pack is checked.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, clap::ValueEnum)]
pub enum VerifyLevel {
    /// Not at all
    None,
    /// Hashes, offsets, indices and counts
    Structure,
    /// Those, and every voxel against the source
    Voxels,
    /// Those, and pictures of pack and source
    #[default]
    All,
}

/// One pack to build.
#[derive(Clone)]
pub struct Job {
    /// The source files.
    pub frames: Vec<PathBuf>,
    /// Where the pack goes.
    pub output: PathBuf,
    /// How it is made.
    pub settings: Settings,
    /// Whether warnings are errors.
    pub strict: bool,
    /// How much is checked afterwards.
    pub verify: VerifyLevel,
    /// How pictures are compared.
    pub pictures: PictureSettings,
    /// Where what stages made is kept.
    pub cache: Option<Arc<Cache>>,
    /// Whether sources that seem unchanged are hashed all the same.
    pub paranoid: bool,
    /// What of the machine it may take.
    pub resources: Resources,
}

/// What a build may take of a machine. It changes no byte of the pack.
#[derive(Clone, Debug, Default)]
pub struct Resources {
    /// The most bytes of memory; as many frames as keep all threads busy where nothing is said.
    pub memory: Option<u64>,
    /// Where what does not fit in memory is meanwhile.
    pub scratch: ScratchFolder,
}

impl Job {
    /// A build whose warnings are warnings, with the usual pictures, from the ground up.
    pub fn new(frames: Vec<PathBuf>, output: PathBuf, settings: Settings, verify: VerifyLevel) -> Self {
        let pictures = PictureSettings::default();
        let resources = Resources::default();
        Self {
            frames,
            output,
            settings,
            strict: false,
            verify,
            pictures,
            cache: None,
            paranoid: false,
            resources,
        }
    }
}

/// What a build did.
pub struct Outcome {
    /// What was odd.
    pub warnings: Vec<String>,
    /// Seconds by stage, in order.
    pub seconds: Vec<(&'static str, f64)>,
    /// What is in the pack.
    pub summary: PackSummary,
    /// What verification found, if voxels were compared.
    pub verification: Option<VerifyReport>,
    /// How much of the pack was made before.
    pub made: Made,
    /// Whether the verification was made before.
    pub was_verified: bool,
    /// How often each stage's results were found in the cache, and how often not.
    pub cache: BTreeMap<&'static str, Uses>,
}

impl Outcome {
    /// How the pack came to be.
    pub fn build_report(&self) -> BuildReport {
        let stages = self.seconds.iter().map(|&(stage, seconds)| StageSeconds { stage, seconds });
        let (made, was_verified) = (self.made, self.was_verified);
        BuildReport { made, was_verified, stages: stages.collect(), cache: self.cache.clone() }
    }
}
