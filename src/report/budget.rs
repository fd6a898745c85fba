//! Budgets that are exceeded, and which setting would meet them.

use super::model::{Breach, BuildReport, Figures, Total};
use crate::pack::Pack;
use crate::settings::{Budget, ErrorBound, Masks, Quality, Settings};
use crate::units::{bytes, seconds};
use crate::vdb::voxel_size;
use crate::verify::VerifyReport;

/// Texels that are fewer are packed less well, since what goes first is what packs best.
const FILE_MARGIN: f64 = 0.1;

/// What a pack is checked by.
pub struct Checked<'a> {
    /// The asset's name.
    pub name: &'a str,
    /// Its limits.
    pub budget: &'a Budget,
    /// Its figures.
    pub figures: &'a Figures,
    /// The baseline's, if that has it.
    pub baseline: Option<&'a Figures>,
    /// The pack.
    pub pack: &'a Pack,
    /// What it was built with.
    pub settings: &'a Settings,
    /// What was found of it.
    pub found: Option<&'a VerifyReport>,
    /// How it came to be.
    pub build: Option<&'a BuildReport>,
}

impl Checked<'_> {
    /// Every budget that the pack exceeds.
    pub fn breaches(&self) -> Vec<Breach> {
        let past = [self.sizes(), self.quality(), self.time(), self.changes()];
        past.into_iter().flatten().collect()
    }

    fn breach(
        &self,
        budget: &'static str,
        figure: Option<f64>,
        limit: f64,
        message: String,
        remedy: String,
    ) -> Breach {
        Breach { asset: Some(self.name.to_owned()), budget, figure, limit: Some(limit), message, remedy }
    }

    /// What was not measured is past its limit: one that cannot fail is none.
    fn unknown(&self, budget: &'static str, limit: Option<f64>, message: &str, remedy: &str) -> Breach {
        let (message, remedy) = (message.to_owned(), remedy.to_owned());
        Breach { asset: Some(self.name.to_owned()), budget, figure: None, limit, message, remedy }
    }

    fn sizes(&self) -> Vec<Breach> {
        let (budget, figures) = (self.budget, self.figures);
        let over = |is: u64, limit: u64| format!("{} exceeds the {} limit", bytes(is), bytes(limit));
        let mut out = Vec::new();
        if let Some(limit) = budget.gpu_size.map(|size| size.0).filter(|limit| figures.gpu_bytes > *limit) {
            let message = over(figures.gpu_bytes, limit);
            let is = Some(figures.gpu_bytes as f64);
            out.push(self.breach("gpu_size", is, limit as f64, message, self.smaller(limit as f64)));
        }
        if let Some(limit) = budget.file_size.map(|size| size.0).filter(|limit| figures.file_bytes > *limit) {
            let message = over(figures.file_bytes, limit);
            let is = Some(figures.file_bytes as f64);
            out.push(self.breach("file_size", is, limit as f64, message, self.smaller_file(limit as f64)));
        }
        if let Some(limit) =
            budget.tree_share.map(|share| share.0).filter(|limit| figures.tree_share > *limit)
        {
            let message =
                format!("{:.1} % exceeds the {:.1} % limit", figures.tree_share * 100.0, limit * 100.0);
            let remedy = match self.settings.masks {
                Masks::Keep => "use `masks = \"auto\"`, which drops masks that nothing needs",
                _ => "the tree follows the volume's shape: allow a larger tree_share",
            };
            out.push(self.breach("tree_share", Some(figures.tree_share), limit, message, remedy.to_owned()));
        }
        out
    }

    fn quality(&self) -> Vec<Breach> {
        let (budget, figures) = (self.budget, self.figures);
        let mut out = Vec::new();
        if let Some(limit) = budget.min_psnr.filter(|_| !figures.exact) {
            match figures.psnr {
                Some(psnr) if psnr < limit => {
                    let message = format!("{psnr:.2} dB is below the {limit} dB minimum");
                    let remedy = self.adaptive(&format!("psnr = {limit}"), "use");
                    out.push(self.breach("min_psnr", Some(psnr), limit, message, remedy));
                }
                Some(_) => {}
                None if figures.compared => {
                    out.push(self.unknown("min_psnr", Some(limit), NO_RANGE, USE_MAX_ERROR))
                }
                None => out.push(self.unknown("min_psnr", Some(limit), NOT_COMPARED, COMPARE)),
            }
        }
        if let Some(bound) = budget.max_error {
            match self.found {
                Some(found) => out.extend(self.errors(found, bound)),
                None => out.push(self.unknown("max_error", bound.fraction(), NOT_COMPARED, COMPARE)),
            }
        }
        if let Some(limit) = budget.max_flip {
            match figures.flip {
                Some(flip) if flip > limit => {
                    // FLIP falls more slowly than the error: to half for 6 to 9 dB.
                    let finer = |psnr: f64| ((psnr + 30.0 * (flip / limit).log10()) * 2.0).ceil() / 2.0;
                    let remedy = figures.psnr.map_or_else(
                        || "use `format = \"f32\"`, which is exact".to_owned(),
                        |psnr| self.adaptive(&format!("psnr = {}", finer(psnr)), "try"),
                    );
                    out.push(self.breach(
                        "max_flip",
                        Some(flip),
                        limit,
                        format!("{flip:.4} exceeds the {limit} limit"),
                        remedy,
                    ));
                }
                Some(_) => {}
                None => out.push(self.unknown(
                    "max_flip",
                    Some(limit),
                    "no pictures were compared",
                    "build with --verify all",
                )),
            }
        }
        out
    }

    /// The largest error of each grid, in what it measures it in.
    fn errors(&self, found: &VerifyReport, bound: ErrorBound) -> Vec<Breach> {
        let grids = found.grids.iter().zip(self.pack.grids());
        let past = grids.filter_map(|(report, grid)| {
            let voxel = grid.frames.first().map_or(1.0, |frame| voxel_size(&frame.record.transform));
            let (error, limit) = (report.active.max_error, bound.absolute(report.peak, voxel));
            let message = format!("{error:.3e} of {} exceeds the {limit:.3e} limit ({bound})", report.grid);
            let remedy = self.adaptive(&format!("max_error = \"{bound}\""), "use");
            (error > limit).then(|| self.breach("max_error", Some(error), limit, message, remedy))
        });
        past.collect()
    }

    fn time(&self) -> Vec<Breach> {
        let Some((limit, build)) = self.budget.build_seconds.zip(self.build) else { return Vec::new() };
        let (all, verify) = (build.seconds(None), build.seconds(Some("verify")));
        if all <= limit {
            return Vec::new();
        }
        let remedy = if all - verify <= limit {
            format!("verification took {}: build with --verify structure", seconds(verify))
        } else {
            "build with the cache (without --no-cache), or use `format = \"unorm8\"`, which needs no search"
                .to_owned()
        };
        let message = format!("{} exceeds the {} limit", seconds(all), seconds(limit));
        vec![self.breach("build_seconds", Some(all), limit, message, remedy)]
    }

    fn changes(&self) -> Vec<Breach> {
        let Some(old) = self.baseline else { return Vec::new() };
        let change = self.figures.change_from(old);
        let mut out = Vec::new();
        if let Some(limit) = self.budget.max_growth.map(|share| share.0) {
            let grew = |what: &str, growth: f64, old: u64| {
                let (growth, limit) = (growth * 100.0, limit * 100.0);
                format!(
                    "the size {what} grew by {growth:.1} % from {}; the limit is {limit:.1} %",
                    bytes(old)
                )
            };
            if change.gpu_bytes > limit {
                let message = grew("on the GPU", change.gpu_bytes, old.gpu_bytes);
                let remedy = self.smaller(old.gpu_bytes as f64 * (1.0 + limit));
                out.push(self.breach("max_growth", Some(change.gpu_bytes), limit, message, remedy));
            }
            if change.file_bytes > limit {
                let message = grew("of the file", change.file_bytes, old.file_bytes);
                let remedy = self.smaller_file(old.file_bytes as f64 * (1.0 + limit));
                out.push(self.breach("max_growth", Some(change.file_bytes), limit, message, remedy));
            }
        }
        if let Some(limit) = self.budget.max_psnr_loss.filter(|_| !self.figures.exact) {
            match (self.figures.psnr, old.psnr) {
                (Some(new), Some(old)) if old - new > limit => {
                    let message =
                        format!("{new:.2} dB loses more than {limit} dB against the baseline's {old:.2} dB");
                    // Rounded up, so that what is typed is enough.
                    let asked = ((old - limit) * 100.0).ceil() / 100.0;
                    let remedy = self.adaptive(&format!("psnr = {asked}"), "use");
                    out.push(self.breach("max_psnr_loss", Some(old - new), limit, message, remedy));
                }
                (Some(_), Some(_)) => {}
                (Some(new), None) if old.exact => {
                    let message = format!("{new:.2} dB, the baseline is exact");
                    out.push(self.breach(
                        "max_psnr_loss",
                        None,
                        limit,
                        message,
                        "use `format = \"f32\"`, which is exact".to_owned(),
                    ));
                }
                _ => {
                    let message = "the pack, or that of the baseline, was not measured";
                    out.push(self.unknown("max_psnr_loss", Some(limit), message, COMPARE));
                }
            }
        }
        out
    }

    /// What to ask for so that the pack takes at most `limit` bytes on a GPU.
    fn smaller(&self, limit: f64) -> String {
        let tree = self.figures.gpu_bytes as f64 * self.figures.tree_share;
        if limit <= tree {
            return format!("no size meets it: tree and masks take {}", bytes(tree as u64));
        }
        self.adaptive(&format!("size = {limit:.0}"), "try")
    }

    /// The same for its file, by how well this pack's texels are packed.
    fn smaller_file(&self, limit: f64) -> String {
        let stored = self.pack.stored_texel_bytes() as f64;
        let left = limit - (self.figures.file_bytes as f64 - stored);
        if left <= 0.0 {
            return "no size meets it: the rest of the file is tree and tables".to_owned();
        }
        let tree = self.figures.gpu_bytes as f64 * self.figures.tree_share;
        let texels = self.figures.gpu_bytes as f64 - tree;
        self.smaller(tree + texels * left / stored.max(1.0) * (1.0 - FILE_MARGIN))
    }

    /// A setting of adaptive packs, and what it does not go with: "use" where it certainly meets the limit, else "try".
    fn adaptive(&self, setting: &str, verb: &str) -> String {
        let settings = self.settings;
        let asked = key(settings.quality()).filter(|asked| !setting.starts_with(asked));
        let format = if settings.is_adaptive() { "" } else { "format = \"adaptive\"` with `" };
        let mut remedy = format!("{verb} `{format}{setting}`");
        if let Some(asked) = asked.filter(|_| settings.is_adaptive()) {
            remedy += &format!(" instead of `{asked}`");
        }
        if settings.clustering().is_some() {
            remedy += ", without `dedup`";
        }
        if settings.min_frame_psnr().is_some() && !setting.starts_with("psnr") {
            remedy += ", without `min_frame_psnr`";
        }
        remedy
    }
}

const NOT_COMPARED: &str = "the pack was not compared with its source";
const COMPARE: &str = "build with --verify voxels";
const NO_RANGE: &str = "all active values are equal, so PSNR has no value range";
const USE_MAX_ERROR: &str = "limit max_error, in units";

/// What a manifest calls it; nothing where the manifest says nothing.
fn key(quality: Quality) -> Option<&'static str> {
    match quality {
        Quality::ByClass { .. } => None,
        Quality::Psnr(_) => Some("psnr"),
        Quality::MaxError(_) => Some("max_error"),
        Quality::BitsPerVoxel(_) => Some("bits_per_voxel"),
        Quality::Size(_) => Some("size"),
    }
}

/// Every budget that all assets together exceed.
pub fn of_total(total: &Total, packs: &[(&str, &Figures)]) -> Vec<Breach> {
    let mut out = Vec::new();
    let mut past = |budget, figure: f64, limit: f64, message, remedy| {
        out.push(Breach { asset: None, budget, figure: Some(figure), limit: Some(limit), message, remedy });
    };
    let largest = |of: fn(&Figures) -> u64| {
        let largest = packs.iter().map(|(name, figures)| (of(figures), name)).max();
        largest.map_or_else(String::new, |(size, name)| format!("the largest is {name} with {}", bytes(size)))
    };
    if let Some(limit) = total.gpu_budget.filter(|limit| total.gpu_bytes > *limit) {
        let message = format!("{} exceeds the {} limit", bytes(total.gpu_bytes), bytes(limit));
        let remedy = largest(|figures| figures.gpu_bytes);
        past("gpu_size", total.gpu_bytes as f64, limit as f64, message, format!("{remedy}: give it a size"));
    }
    if let Some(limit) = total.file_budget.filter(|limit| total.file_bytes > *limit) {
        let message = format!("{} exceeds the {} limit", bytes(total.file_bytes), bytes(limit));
        let remedy = largest(|figures| figures.file_bytes);
        past(
            "file_size",
            total.file_bytes as f64,
            limit as f64,
            message,
            format!("{remedy}: give it a size"),
        );
    }
    if let Some(limit) = total.seconds_budget.filter(|limit| total.build_seconds > *limit) {
        let message = format!("{} exceeds the {} limit", seconds(total.build_seconds), seconds(limit));
        let remedy = "share a cache between machines (--remote-cache)".to_owned();
        past("build_seconds", total.build_seconds, limit, message, remedy);
    }
    out
}
