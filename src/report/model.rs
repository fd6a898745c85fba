//! What a report says, as its JSON has it (docs/report.schema.json).

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::PackSummary;
use crate::cache::Uses;
use crate::pack::Source;
use crate::settings::Budget;
use crate::verify::VerifyReport;

/// The version of the JSON: raised when something is renamed, removed or means something else.
pub const VERSION: u32 = 1;

/// All assets, and what is wrong with them.
#[derive(Clone, Debug, Serialize, JsonSchema)]
pub struct Report {
    /// The version of this layout.
    pub version: u32,
    /// `volpack` and its version.
    pub tool: String,
    /// The manifest that names the assets; null where packs were named.
    pub manifest: Option<String>,
    /// The report that changes are told against; null where none was given.
    pub baseline: Option<String>,
    /// Whether every asset was built and verified, and none is over budget.
    pub ok: bool,
    /// The assets, by name.
    pub assets: Vec<AssetReport>,
    /// Sums over those that were built.
    pub total: Total,
    /// Every limit that is past.
    pub breaches: Vec<Breach>,
}

/// An exceeded budget.
#[derive(Clone, Debug, Serialize, JsonSchema)]
pub struct Breach {
    /// The asset; null for all of them together.
    pub asset: Option<String>,
    /// The limit's key in the manifest.
    pub budget: &'static str,
    /// What is; null where it was not measured.
    pub figure: Option<f64>,
    /// What may be; null where that has the unit of a grid that was not measured.
    pub limit: Option<f64>,
    /// Both, for people.
    pub message: String,
    /// What would meet it.
    pub remedy: String,
}

impl std::fmt::Display for Breach {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let asset = self.asset.as_deref().unwrap_or("all assets");
        write!(f, "{asset}: {}: {}; {}", self.budget, self.message, self.remedy)
    }
}

/// Sums over assets.
#[derive(Clone, Debug, Default, Serialize, Deserialize, JsonSchema)]
pub struct Total {
    /// Bytes on a GPU: tree, masks and texels.
    pub gpu_bytes: u64,
    /// Bytes of the files.
    pub file_bytes: u64,
    /// Bytes of the source files.
    pub source_bytes: u64,
    /// Seconds of this run's builds.
    pub build_seconds: f64,
    /// The most that `gpu_bytes` may be.
    pub gpu_budget: Option<u64>,
    /// The most that `file_bytes` may be.
    pub file_budget: Option<u64>,
    /// The most that `build_seconds` may be.
    pub seconds_budget: Option<f64>,
}

/// One asset.
#[derive(Clone, Debug, Serialize, JsonSchema)]
pub struct AssetReport {
    /// Its name.
    pub name: String,
    /// Why there is no pack, or not a good one; null where it is as it should be.
    pub error: Option<String>,
    /// What is in the pack; null where there is none.
    pub pack: Option<PackReport>,
    /// What is odd.
    pub warnings: Vec<String>,
}

/// One asset's pack.
#[derive(Clone, Debug, Serialize, JsonSchema)]
pub struct PackReport {
    /// The file, relative to the manifest if it lies in its folder. Paths have slashes on every system.
    pub file: String,
    /// What people look at first.
    pub figures: Figures,
    /// How those differ from the baseline's; null where that has none of this name.
    pub change: Option<Change>,
    /// Sizes and counts.
    pub summary: PackSummary,
    /// What was found against the source; null where it was not compared.
    pub verification: Option<VerifyReport>,
    /// What each frame of each grid costs.
    pub frames: Vec<FrameCost>,
    /// How it came to be in this run; null for a pack that was there.
    pub build: Option<BuildReport>,
    /// The nearest cheaper setting, as it was measured; null where none is cheaper, or none was tried.
    pub cheaper: Option<Cheaper>,
    /// How to make it again.
    pub reproduce: Reproduce,
}

/// What people look at first.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
pub struct Figures {
    /// Bytes on a GPU: tree, masks and texels.
    pub gpu_bytes: u64,
    /// Bytes of the file.
    pub file_bytes: u64,
    /// Bytes of the source files.
    pub source_bytes: u64,
    /// The part of `gpu_bytes` that is tree and masks.
    pub tree_share: f64,
    /// GPU bits for each voxel of the source's leaves.
    pub bits_per_voxel: f64,
    /// Whether voxels were compared with the source.
    pub compared: bool,
    /// Whether nothing is wrong with what was compared.
    pub ok: bool,
    /// Whether voxels were compared, and no active leaf voxel has an error.
    pub exact: bool,
    /// The PSNR of the worst grid over active leaf voxels, in dB; null where it is exact, was not compared, or has no
    /// range of values to measure by.
    pub psnr: Option<f64>,
    /// The worst frame's; null likewise.
    pub worst_frame_psnr: Option<f64>,
    /// The largest error of an active leaf voxel, as a part of its grid's range; null where it was not compared.
    pub max_error: Option<f64>,
    /// The largest mean FLIP of its pictures; null where none were compared.
    pub flip: Option<f64>,
    /// Seconds of this run's build; null for a pack that was there.
    pub build_seconds: Option<f64>,
}

/// How figures differ from a baseline's.
#[derive(Clone, Debug, Default, Serialize, JsonSchema)]
pub struct Change {
    /// Of `gpu_bytes`, as a part of the baseline's: 0.1 is a tenth more.
    pub gpu_bytes: f64,
    /// Of `file_bytes`, likewise.
    pub file_bytes: f64,
    /// Of `psnr`, in dB; null where either has none.
    pub psnr: Option<f64>,
    /// Of `worst_frame_psnr`, likewise.
    pub worst_frame_psnr: Option<f64>,
    /// Whether it was exact and is not.
    pub lost_exactness: bool,
}

/// What one frame of one grid costs.
#[derive(Clone, Debug, Serialize, JsonSchema)]
pub struct FrameCost {
    /// The grid.
    pub grid: String,
    /// The frame's number.
    pub frame: i32,
    /// Bytes of the texels that it shows.
    pub texel_bytes: u64,
    /// Those that no frame before it shows.
    pub new_texel_bytes: u64,
    /// Its PSNR over active leaf voxels, in dB; null as that of the pack.
    pub psnr: Option<f64>,
    /// Whether voxels were compared, and no active leaf voxel has an error.
    pub exact: bool,
}

/// How a pack came to be in this run.
#[derive(Clone, Debug, Serialize, JsonSchema)]
pub struct BuildReport {
    /// How much of it was made before.
    pub made: Made,
    /// Whether the verification was.
    pub was_verified: bool,
    /// Seconds by stage, in order.
    pub stages: Vec<StageSeconds>,
    /// How often each stage's results were in the cache, and how often not.
    pub cache: BTreeMap<&'static str, Uses>,
}

/// How a pack came to be.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Made {
    /// By the stages, each with what the cache had for it.
    Built,
    /// From a pack that differs in nothing but zstd's level.
    Repacked,
    /// It was in the cache.
    Copied,
    /// It was there already.
    Unchanged,
}

/// What one stage took.
#[derive(Clone, Debug, Serialize, JsonSchema)]
pub struct StageSeconds {
    /// Its name.
    pub stage: &'static str,
    /// Wall time.
    pub seconds: f64,
}

/// What another setting gives.
#[derive(Clone, Debug, Serialize, JsonSchema)]
pub struct Cheaper {
    /// The setting, as a manifest has it.
    pub setting: String,
    /// What it gives.
    pub figures: Figures,
}

/// How to make a pack again.
#[derive(Clone, Debug, Serialize, JsonSchema)]
pub struct Reproduce {
    /// What to type.
    pub command: String,
    /// What made it.
    pub tool: String,
    /// The instruction set of the block encoder; null where no block format is used.
    pub encoder_isa: Option<String>,
    /// The settings that its bytes depend on.
    pub settings: serde_json::Value,
    /// BLAKE3 of the file.
    pub blake3: String,
    /// The source files.
    pub sources: Vec<SourceFile>,
}

/// A source file.
#[derive(Clone, Debug, Serialize, JsonSchema)]
pub struct SourceFile {
    /// Its name without its folder.
    pub file: String,
    /// Its length.
    pub bytes: u64,
    /// BLAKE3 of its bytes.
    pub blake3: String,
}

impl From<&Source> for SourceFile {
    fn from(source: &Source) -> Self {
        Self { file: source.file.clone(), bytes: source.bytes, blake3: source.blake3.clone() }
    }
}

impl BuildReport {
    /// Seconds of a stage, or of all.
    pub fn seconds(&self, stage: Option<&str>) -> f64 {
        let of = self.stages.iter().filter(|each| stage.is_none_or(|stage| stage == each.stage));
        of.map(|stage| stage.seconds).sum()
    }
}

impl Total {
    /// Adds packs up.
    pub fn new(packs: &[(&str, &Figures)], budget: &Budget) -> Self {
        let sum = |of: fn(&Figures) -> u64| packs.iter().map(|(_, f)| of(f)).fold(0, u64::saturating_add);
        Self {
            gpu_bytes: sum(|figures| figures.gpu_bytes),
            file_bytes: sum(|figures| figures.file_bytes),
            source_bytes: sum(|figures| figures.source_bytes),
            // The sum of no floats is -0.
            build_seconds: packs
                .iter()
                .filter_map(|(_, figures)| figures.build_seconds)
                .fold(0.0, |a, b| a + b),
            gpu_budget: budget.gpu_size.map(|size| size.0),
            file_budget: budget.file_size.map(|size| size.0),
            seconds_budget: budget.build_seconds,
        }
    }
}

impl Figures {
    /// A PSNR of this pack, for people.
    pub fn decibels(&self, psnr: Option<f64>) -> String {
        match psnr {
            Some(_) => crate::units::psnr(psnr),
            None if self.exact => "exact".to_owned(),
            None if self.compared => "exact where active".to_owned(),
            None => "not compared".to_owned(),
        }
    }

    /// Sums up a pack, its sources and what was found of it.
    pub fn new(
        sources: &[Source],
        summary: &PackSummary,
        found: Option<&VerifyReport>,
        build: Option<&BuildReport>,
    ) -> Self {
        let tree = summary.tree_bytes + summary.mask_bytes;
        let largest = |all: &mut dyn Iterator<Item = f64>| all.fold(0.0, f64::max);
        // Where the ring found nothing to draw, nothing differs.
        let pictures = found.and_then(|found| found.pictures.as_ref());
        Self {
            gpu_bytes: summary.gpu_bytes,
            file_bytes: summary.file_bytes,
            source_bytes: sources.iter().fold(0, |sum, source| sum.saturating_add(source.bytes)),
            tree_share: tree as f64 / summary.gpu_bytes.max(1) as f64,
            bits_per_voxel: summary.bits_per_voxel,
            compared: found.is_some(),
            ok: found.is_none_or(|found| found.ok),
            exact: found.is_some_and(|found| found.grids.iter().all(|grid| grid.all.max_error == 0.0)),
            psnr: found.and_then(|found| found.active.psnr),
            worst_frame_psnr: found.and_then(|found| found.worst_frame.as_ref()).map(|worst| worst.psnr),
            max_error: found
                .map(|found| largest(&mut found.grids.iter().map(|g| g.active.max_error / g.peak))),
            flip: pictures.map(|p| largest(&mut p.pictures.iter().map(|p| p.source.flip))),
            build_seconds: build.map(|build| build.seconds(None)),
        }
    }

    /// How they differ from `old` ones.
    pub fn change_from(&self, old: &Self) -> Change {
        let growth = |new: u64, old: u64| new as f64 / old.max(1) as f64 - 1.0;
        let difference = |new: Option<f64>, old: Option<f64>| Some(new? - old?);
        Change {
            gpu_bytes: growth(self.gpu_bytes, old.gpu_bytes),
            file_bytes: growth(self.file_bytes, old.file_bytes),
            psnr: difference(self.psnr, old.psnr),
            worst_frame_psnr: difference(self.worst_frame_psnr, old.worst_frame_psnr),
            lost_exactness: old.exact && self.compared && !self.exact,
        }
    }
}
