//! What files hold and what packs cost, as people and machines read it.
//!
//! The feature `report` adds the pages (HTML, Markdown, JUnit XML) and the charts; the figures need no feature.

mod baseline;
mod budget;
#[cfg(feature = "report")]
pub mod chart;
mod frames;
mod gallery;
pub mod model;
mod pack;
#[cfg(feature = "report")]
mod pages;
mod vdb;

use std::path::Path;

pub use baseline::Baseline;
pub use budget::{Checked, of_total};
pub use gallery::{Gallery, KeyFrame, Png, Strip, gallery};
pub use model::Breach;
pub use pack::{CodecSummary, PackSummary};
#[cfg(feature = "report")]
pub use pages::{PageError, html, junit, markdown};
pub use vdb::{GridSummary, TopologySummary, ValueSummary, VdbSummary};

use crate::file_name::portable;
use crate::pack::{Pack, Provenance};
use crate::settings::Budget;
use crate::verify::VerifyReport;
use model::{AssetReport, BuildReport, Cheaper, Figures, PackReport, Report, Reproduce, Total};

/// The JSON schema of a report.
pub fn schema() -> serde_json::Value {
    schemars::schema_for!(Report).into()
}

/// What is known of a pack that is reported.
pub struct Reported<'a> {
    /// The asset's name.
    pub name: &'a str,
    /// The pack.
    pub pack: &'a Pack,
    /// Where it comes from.
    pub provenance: &'a Provenance,
    /// Its file.
    pub file: &'a Path,
    /// The folder from which on the report names it: the manifest's.
    pub base: &'a Path,
    /// BLAKE3 of the file.
    pub digest: blake3::Hash,
    /// Its sizes and counts.
    pub summary: PackSummary,
    /// What was found of it.
    pub found: Option<VerifyReport>,
    /// How it came to be.
    pub build: Option<BuildReport>,
    /// What a cheaper setting gives.
    pub cheaper: Option<Cheaper>,
    /// What to type to make it again.
    pub command: String,
    /// Its limits.
    pub budget: &'a Budget,
    /// What changes are told against.
    pub baseline: Option<&'a Baseline>,
}

impl Reported<'_> {
    /// The figures, and every limit that is past.
    pub fn report(self) -> (PackReport, Vec<Breach>) {
        let (pack, provenance) = (self.pack, self.provenance);
        let figures =
            Figures::new(&provenance.sources, &self.summary, self.found.as_ref(), self.build.as_ref());
        let baseline = self.baseline.and_then(|baseline| baseline.figures(self.name));
        let breaches = budget::Checked {
            name: self.name,
            budget: self.budget,
            figures: &figures,
            baseline,
            pack,
            settings: &provenance.settings,
            found: self.found.as_ref(),
            build: self.build.as_ref(),
        }
        .breaches();
        let mut settings = serde_json::to_value(&provenance.settings).unwrap_or_default();
        settings["quality"] = provenance.settings.quality().to_string().into();
        let report = PackReport {
            file: portable(self.file.strip_prefix(self.base).unwrap_or(self.file)),
            change: baseline.map(|old| figures.change_from(old)),
            frames: frames::costs(pack, self.found.as_ref()),
            figures,
            summary: self.summary,
            verification: self.found,
            build: self.build,
            cheaper: self.cheaper,
            reproduce: Reproduce {
                command: self.command,
                tool: format!("{} {}", provenance.tool, provenance.version),
                encoder_isa: provenance.encoder_isa.clone(),
                settings,
                blake3: self.digest.to_hex().to_string(),
                sources: provenance.sources.iter().map(Into::into).collect(),
            },
        };
        (report, breaches)
    }
}

impl Report {
    /// Puts assets together, and checks what all of them may cost.
    pub fn new(
        assets: Vec<AssetReport>,
        mut breaches: Vec<Breach>,
        budget: &Budget,
        manifest: Option<String>,
        baseline: Option<String>,
    ) -> Self {
        let packs = assets.iter().filter_map(|asset| Some((&*asset.name, &asset.pack.as_ref()?.figures)));
        let packs: Vec<(&str, &Figures)> = packs.collect();
        let total = Total::new(&packs, budget);
        breaches.extend(budget::of_total(&total, &packs));
        Self {
            version: model::VERSION,
            tool: format!("{} {}", env!("CARGO_PKG_NAME"), env!("CARGO_PKG_VERSION")),
            manifest,
            baseline,
            ok: breaches.is_empty() && assets.iter().all(|asset| asset.error.is_none()),
            assets,
            total,
            breaches,
        }
    }
}
