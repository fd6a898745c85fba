//! What is past its limit, and which setting would meet it.

use schemars::JsonSchema;
use serde::Serialize;

use super::model::{Figures, Total};
use crate::pack::Pack;
use crate::settings::{Budget, Format, Masks, Quality};
use crate::units::{bytes, seconds};
use crate::vdb::voxel_size;
use crate::verify::VerifyReport;

/// A limit that is past.
#[derive(Clone, Debug, Serialize, JsonSchema)]
pub struct Breach {
    /// The asset; null for all of them together.
    pub asset: Option<String>,
    /// The limit's key in the manifest.
    pub budget: &'static str,
    /// What is; null where it was not measured.
    pub figure: Option<f64>,
    /// What may be.
    pub limit: f64,
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
    /// What was found of it.
    pub found: Option<&'a VerifyReport>,
    /// What verification took of the build's seconds.
    pub verify_seconds: f64,
}

impl Checked<'_> {
    /// Every limit that the pack is past.
    pub fn breaches(&self) -> Vec<Breach> {
        let (budget, figures) = (self.budget, self.figures);
        let mut out = Vec::new();
        let mut past = |budget, figure, limit, message, remedy| {
            let asset = Some(self.name.to_owned());
            out.push(Breach { asset, budget, figure, limit, message, remedy });
        };
        if let Some(limit) = budget.gpu_size.map(|size| size.0).filter(|limit| figures.gpu_bytes > *limit) {
            let message = format!("{} are over {}", bytes(figures.gpu_bytes), bytes(limit));
            let remedy = self.adaptive(&format!("size = {limit} would meet it"));
            past("gpu_size", Some(figures.gpu_bytes as f64), limit as f64, message, remedy);
        }
        if let Some(limit) = budget.file_size.map(|size| size.0).filter(|limit| figures.file_bytes > *limit) {
            let message = format!("{} are over {}", bytes(figures.file_bytes), bytes(limit));
            let remedy = self.smaller_file(limit);
            past("file_size", Some(figures.file_bytes as f64), limit as f64, message, remedy);
        }
        if let Some(limit) =
            budget.tree_share.map(|share| share.0).filter(|limit| figures.tree_share > *limit)
        {
            let message = format!("{:.1} % are over {:.1} %", figures.tree_share * 100.0, limit * 100.0);
            let remedy = match self.pack.provenance.settings.masks {
                Masks::Keep => "masks = \"auto\" drops those that nothing needs",
                _ => {
                    "the tree is the volume's shape: a larger tree_share, or more texels to it by a finer psnr"
                }
            };
            past("tree_share", Some(figures.tree_share), limit, message, remedy.to_owned());
        }
        if let Some(limit) = budget.min_psnr {
            let remedy = self.adaptive(&format!("psnr = {limit} would meet it"));
            match (figures.compared, figures.psnr) {
                (true, Some(psnr)) if psnr < limit => {
                    past("min_psnr", Some(psnr), limit, format!("{psnr:.2} dB are under {limit} dB"), remedy);
                }
                (true, _) => {}
                (false, _) => past("min_psnr", None, limit, NOT_COMPARED.to_owned(), COMPARE.to_owned()),
            }
        }
        self.check_errors(&mut past);
        if let Some(limit) = budget.max_flip {
            match figures.flip {
                Some(flip) if flip > limit => {
                    let remedy = match figures.psnr {
                        // FLIP falls more slowly than the error: to half for 6 to 9 dB.
                        Some(psnr) => {
                            let db = ((psnr + 30.0 * (flip / limit).log10()) * 2.0).ceil() / 2.0;
                            self.adaptive(&format!("psnr = {db} should meet it"))
                        }
                        None => "nothing is more exact than this pack".to_owned(),
                    };
                    past("max_flip", Some(flip), limit, format!("{flip:.4} is over {limit}"), remedy);
                }
                Some(_) => {}
                None => past(
                    "max_flip",
                    None,
                    limit,
                    "no pictures were compared".to_owned(),
                    "build with --verify all".to_owned(),
                ),
            }
        }
        if let Some((limit, took)) =
            budget.build_seconds.zip(figures.build_seconds).filter(|(l, took)| took > l)
        {
            let message = format!("{} are over {}", seconds(took), seconds(limit));
            let remedy = if took - self.verify_seconds <= limit {
                format!("--verify none would meet it: verification took {}", seconds(self.verify_seconds))
            } else {
                "a cache (no --no-cache) leaves only what changed; format = \"unorm8\" needs no search"
                    .to_owned()
            };
            past("build_seconds", Some(took), limit, message, remedy);
        }
        self.check_baseline(&mut past);
        out
    }

    /// What texels may take so that the file does not take more, by how well this pack's are packed.
    fn smaller_file(&self, limit: u64) -> String {
        let texels = self.pack.stored_texel_bytes();
        let Some(left) = limit.checked_sub(self.figures.file_bytes - texels).filter(|left| *left > 0) else {
            return "no size would meet it: the rest of the file is tree and tables".to_owned();
        };
        let of_texels = left as f64 / texels.max(1) as f64 * (1.0 - FILE_MARGIN);
        let tree = self.figures.gpu_bytes as f64 * self.figures.tree_share;
        let size = tree + (self.figures.gpu_bytes as f64 - tree) * of_texels;
        self.adaptive(&format!("size = {size:.0} on the GPU should meet it"))
    }

    /// A promise for every voxel, in what each grid measures it in.
    fn check_errors(&self, past: &mut impl FnMut(&'static str, Option<f64>, f64, String, String)) {
        let Some(bound) = self.budget.max_error else { return };
        let Some(found) = self.found else {
            return past("max_error", None, 0.0, NOT_COMPARED.to_owned(), COMPARE.to_owned());
        };
        for (report, grid) in found.grids.iter().zip(&self.pack.grids) {
            let voxel = grid.frames.first().map_or(1.0, |frame| voxel_size(&frame.record.transform));
            let (error, limit) = (report.active.max_error, bound.absolute(report.peak, voxel));
            if error > limit {
                let message = format!("{error:.3e} of {} is over {limit:.3e} ({bound})", report.grid);
                let remedy = self.adaptive(&format!("max_error = \"{bound}\" would meet it"));
                past("max_error", Some(error), limit, message, remedy);
            }
        }
    }

    fn check_baseline(&self, past: &mut impl FnMut(&'static str, Option<f64>, f64, String, String)) {
        let Some(old) = self.baseline else { return };
        let change = self.figures.change_from(old);
        if let Some(limit) = self.budget.max_growth.map(|share| share.0) {
            for (what, growth, old) in [
                ("on the GPU", change.gpu_bytes, old.gpu_bytes),
                ("of the file", change.file_bytes, old.file_bytes),
            ] {
                if growth > limit {
                    let message = format!(
                        "the bytes {what} grew by {:.1} % from {}, over {:.1} %",
                        growth * 100.0,
                        bytes(old),
                        limit * 100.0
                    );
                    let size = self.figures.gpu_bytes as f64 / (1.0 + growth) * (1.0 + limit);
                    let remedy = self.adaptive(&format!("size = {size:.0} should meet it"));
                    past("max_growth", Some(growth), limit, message, remedy);
                }
            }
        }
        if let Some(limit) = self.budget.max_psnr_loss {
            let was = old.psnr.map_or_else(|| "exact".to_owned(), |db| format!("{db:.2} dB"));
            let is_lost = match (self.figures.psnr, old.psnr) {
                (Some(new), Some(old)) => old - new > limit,
                // What was exact and is not has lost more than any number.
                (Some(_), None) => old.compared,
                (None, _) => false,
            };
            if let Some(new) = self.figures.psnr.filter(|_| is_lost) {
                let message = format!("{new:.2} dB, the baseline is {was}: more than {limit} dB are lost");
                let remedy = match old.psnr {
                    Some(old) => self.adaptive(&format!("psnr = {:.2} would meet it", old - limit)),
                    None => "format = \"f32\" is exact".to_owned(),
                };
                past("max_psnr_loss", old.psnr.map(|old| old - new), limit, message, remedy);
            }
        }
    }

    /// A setting of adaptive packs, said so that it can be used.
    fn adaptive(&self, setting: &str) -> String {
        let settings = &self.pack.provenance.settings;
        let replaces = match (settings.format, settings.quality) {
            (Format::Adaptive, Quality::Psnr(_)) if setting.starts_with("psnr") => "",
            (Format::Adaptive, Quality::Size(_)) if setting.starts_with("size") => "",
            (Format::Adaptive, Quality::MaxError(_)) if setting.starts_with("max_error") => "",
            (Format::Adaptive, quality) => return format!("{setting}, in place of {}", key(quality)),
            _ => "format = \"adaptive\" with ",
        };
        format!("{replaces}{setting}")
    }
}

const NOT_COMPARED: &str = "the pack was not compared with its source";
const COMPARE: &str = "build with --verify voxels";

/// What a manifest calls it.
fn key(quality: Quality) -> &'static str {
    match quality {
        Quality::Psnr(_) => "psnr",
        Quality::MaxError(_) => "max_error",
        Quality::BitsPerVoxel(_) => "bits_per_voxel",
        Quality::Size(_) => "size",
    }
}

/// Every limit that all assets together are past.
pub fn of_total(total: &Total, packs: &[(&str, &Figures)]) -> Vec<Breach> {
    let mut out = Vec::new();
    let mut past = |budget, figure: f64, limit: f64, message, remedy| {
        out.push(Breach { asset: None, budget, figure: Some(figure), limit, message, remedy });
    };
    let largest = |of: fn(&Figures) -> u64| {
        let largest = packs.iter().map(|(name, figures)| (of(figures), name)).max();
        largest.map_or_else(String::new, |(size, name)| format!("the largest is {name} with {}", bytes(size)))
    };
    if let Some(limit) = total.gpu_budget.filter(|limit| total.gpu_bytes > *limit) {
        let message = format!("{} are over {}", bytes(total.gpu_bytes), bytes(limit));
        let remedy = largest(|figures| figures.gpu_bytes);
        past("gpu_size", total.gpu_bytes as f64, limit as f64, message, format!("{remedy}: give it a size"));
    }
    if let Some(limit) = total.file_budget.filter(|limit| total.file_bytes > *limit) {
        let message = format!("{} are over {}", bytes(total.file_bytes), bytes(limit));
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
        let message = format!("{} are over {}", seconds(total.build_seconds), seconds(limit));
        let remedy = "a cache that machines share (--remote-cache) leaves only what changed".to_owned();
        past("build_seconds", total.build_seconds, limit, message, remedy);
    }
    out
}
