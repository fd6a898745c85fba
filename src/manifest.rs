//! `pipeline.toml` as types, with errors that name the line.

use std::collections::BTreeMap;
use std::path::{Component, Path, PathBuf};

use serde::Deserialize;

use crate::error::{Error, Result};
use crate::settings::{
    Budget, ByteSize, ClusterArgs, DEFAULT_ZSTD, Dedup, ErrorBound, Format, Integers, Masks, NonFinite,
    QualityArgs, RangeMode, Settings,
};

/// The manifest's name where none is given.
pub const DEFAULT_NAME: &str = "pipeline.toml";

/// A manifest: what to build.
#[derive(Debug)]
pub struct Manifest {
    /// The assets by name.
    pub assets: BTreeMap<String, Asset>,
    /// What all of them together may cost, and each has to keep.
    pub budget: Budget,
}

/// One asset of a manifest: a sequence, its settings, and its pack.
#[derive(Clone, Debug)]
pub struct Asset {
    /// Globs or file names, relative to the manifest's folder if they were relative in it.
    pub frames: Vec<PathBuf>,
    /// Where the pack goes.
    pub output: PathBuf,
    /// How it is made.
    pub settings: Settings,
    /// The largest mean FLIP of its pictures.
    pub max_flip: Option<f64>,
    /// What it may cost and has to keep.
    pub budget: Budget,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawManifest {
    #[serde(default)]
    asset: BTreeMap<String, RawAsset>,
    #[serde(default)]
    budget: Budget,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawAsset {
    frames: OneOrMany,
    grid: Option<String>,
    grids: Option<Vec<String>>,
    #[serde(default)]
    format: Format,
    psnr: Option<f64>,
    max_error: Option<ErrorBound>,
    bits_per_voxel: Option<f64>,
    size: Option<ByteSize>,
    min_frame_psnr: Option<f64>,
    #[serde(default)]
    dedup: Dedup,
    clusters: Option<u32>,
    iterations: Option<u32>,
    variance: Option<f64>,
    seed: Option<u64>,
    #[serde(default)]
    range: RangeMode,
    #[serde(default)]
    masks: Masks,
    #[serde(default)]
    nonfinite: NonFinite,
    #[serde(default)]
    integers: Integers,
    zstd: Option<toml::Spanned<i32>>,
    fps: Option<toml::Spanned<f32>>,
    max_flip: Option<toml::Spanned<f64>>,
    output: Option<PathBuf>,
    #[serde(default)]
    budget: Budget,
}

#[derive(Deserialize)]
#[serde(untagged, expecting = "a file name or glob, or a list of them")]
enum OneOrMany {
    One(PathBuf),
    Many(Vec<PathBuf>),
}

impl Manifest {
    /// Reads a manifest.
    ///
    /// # Errors
    /// [`Error::Manifest`] with the line, and for an unknown key the nearest known one.
    pub fn read(path: &Path) -> Result<Self> {
        let text = std::fs::read_to_string(path).map_err(Error::io(path))?;
        let folder = path.parent().unwrap_or(Path::new(""));
        Self::parse(&text, folder).map_err(|message| Error::Manifest { path: path.to_owned(), message })
    }

    fn parse(text: &str, folder: &Path) -> Result<Self, String> {
        let raw: RawManifest = toml::from_str(text).map_err(|e| describe(text, &e))?;
        let assets = raw
            .asset
            .into_iter()
            .map(|(name, asset)| Ok((name.clone(), asset.into_asset(&name, &raw.budget, text, folder)?)))
            .collect::<Result<_, String>>()?;
        Ok(Self { assets, budget: raw.budget })
    }

    /// The asset of that name.
    ///
    /// # Errors
    /// [`Error::Usage`], which lists the assets there are.
    pub fn asset(&self, name: &str) -> Result<&Asset> {
        self.assets.get(name).ok_or_else(|| {
            let names: Vec<_> = self.assets.keys().map(String::as_str).collect();
            Error::Usage(format!("no asset {name:?} in the manifest, which has: {}", names.join(", ")))
        })
    }
}

impl RawAsset {
    fn into_asset(self, name: &str, all: &Budget, text: &str, folder: &Path) -> Result<Asset, String> {
        let grids = match (self.grid, self.grids) {
            (Some(_), Some(_)) => return Err(format!("asset {name:?}: give grid or grids, not both")),
            (Some(grid), None) => vec![grid],
            (None, grids) => grids.unwrap_or_default(),
        };
        let zstd = match self.zstd {
            Some(level) if !(0..=22).contains(level.get_ref()) => {
                return Err(at_line(text, level.span().start, "zstd is a level from 1 to 22, or 0 for none"));
            }
            level => level.map_or(DEFAULT_ZSTD, toml::Spanned::into_inner),
        };
        let fps = match self.fps {
            Some(fps) if !(fps.get_ref().is_finite() && *fps.get_ref() > 0.0) => {
                return Err(at_line(text, fps.span().start, "fps is a number above 0"));
            }
            fps => fps.map(toml::Spanned::into_inner),
        };
        let max_flip = match self.max_flip {
            Some(flip) if !(flip.get_ref().is_finite() && *flip.get_ref() > 0.0) => {
                return Err(at_line(text, flip.span().start, "max_flip is a number above 0"));
            }
            flip => flip.map(toml::Spanned::into_inner),
        };
        let adaptive = QualityArgs {
            psnr: self.psnr,
            max_error: self.max_error,
            bits_per_voxel: self.bits_per_voxel,
            size: self.size,
            min_frame_psnr: self.min_frame_psnr,
        };
        let clusters = ClusterArgs {
            dedup: Some(self.dedup),
            clusters: self.clusters,
            iterations: self.iterations,
            variance: self.variance,
            seed: self.seed,
        };
        let in_asset = |e: String| format!("asset {name:?}: {e}");
        let quality = adaptive.quality(self.format).map_err(in_asset)?;
        let clustering = clusters.clustering(self.format).map_err(in_asset)?;
        let frames = match self.frames {
            OneOrMany::One(one) => vec![one],
            OneOrMany::Many(many) => many,
        };
        let output = self.output.unwrap_or_else(|| PathBuf::from(format!("{name}.volpack")));
        Ok(Asset {
            frames: frames.into_iter().map(|f| folder.join(f)).collect(),
            output: folder.join(output),
            max_flip,
            budget: all.of_asset(&self.budget),
            settings: Settings {
                grids,
                format: self.format,
                quality,
                min_frame_psnr: self.min_frame_psnr,
                clustering,
                range: self.range,
                masks: self.masks,
                nonfinite: self.nonfinite,
                integers: self.integers,
                zstd,
                fps,
            },
        })
    }
}

fn at_line(text: &str, offset: usize, message: &str) -> String {
    let line = text[..offset.min(text.len())].matches('\n').count() + 1;
    format!("line {line}: {message}")
}

fn describe(text: &str, error: &toml::de::Error) -> String {
    let mut message = error.message().to_owned();
    // serde lists the known keys of a place in backticks behind the unknown one.
    let quoted: Vec<&str> = message.split('`').skip(1).step_by(2).collect();
    if let (true, [unknown, known @ ..]) = (message.starts_with("unknown "), &quoted[..]) {
        let nearest = known
            .iter()
            .max_by(|a, b| strsim::jaro_winkler(unknown, a).total_cmp(&strsim::jaro_winkler(unknown, b)));
        if let Some(nearest) = nearest {
            message = format!("unknown {} `{unknown}`: did you mean `{nearest}`?", what_is_unknown(&message));
        }
    }
    match error.span() {
        Some(span) => at_line(text, span.start, &message),
        None => message,
    }
}

fn what_is_unknown(message: &str) -> &str {
    if message.starts_with("unknown variant") { "value" } else { "key" }
}

/// The files that globs and file names stand for, sorted within each glob.
///
/// # Errors
/// A pattern that is malformed or matches nothing.
pub fn expand(patterns: &[PathBuf]) -> Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for pattern in patterns {
        let text = pattern.to_string_lossy();
        // A file whose own name has a bracket in it is that file.
        if pattern.exists() || !text.contains(['*', '?', '[']) {
            files.push(pattern.clone());
            continue;
        }
        let matches = glob::glob(&glob_of(pattern)).map_err(|e| Error::Usage(format!("{text}: {e}")))?;
        let before = files.len();
        for file in matches {
            files.push(file.map_err(|e| Error::Io { path: e.path().to_owned(), source: e.into() })?);
        }
        if files.len() == before {
            return Err(Error::Input(format!("{text}: no file matches")));
        }
    }
    Ok(files)
}

/// A pattern in which folders that exist stand for themselves: one may have a bracket in its name.
fn glob_of(pattern: &Path) -> String {
    let mut folder = PathBuf::new();
    let mut glob = PathBuf::new();
    let mut components = pattern.components();
    loop {
        let rest = components.as_path();
        let Some(component) = components.next() else { break };
        folder.push(component);
        match component {
            Component::Normal(name) if folder.exists() => {
                glob.push(glob::Pattern::escape(&name.to_string_lossy()));
            }
            Component::Normal(_) => {
                glob.push(rest);
                break;
            }
            _ => glob.push(component),
        }
    }
    glob.to_string_lossy().into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn error(text: &str) -> String {
        Manifest::parse(text, Path::new("")).unwrap_err()
    }

    #[test]
    fn settings_have_their_defaults() {
        let manifest = Manifest::parse("[asset.a]\nframes = 'a_*.vdb'\n", Path::new("in")).unwrap();
        let asset = manifest.asset("a").unwrap();
        assert_eq!(asset.frames, [Path::new("in/a_*.vdb")]);
        assert_eq!(asset.output, Path::new("in/a.volpack"));
        assert_eq!(asset.settings, Settings::default());
    }

    #[test]
    fn errors_name_the_line_and_the_nearest_key() {
        assert_eq!(
            error("[asset.a]\nframes = 'a.vdb'\nfromat = 'bc7'\n"),
            "line 3: unknown key `fromat`: did you mean `format`?"
        );
        assert_eq!(error("[assets.a]\n"), "line 1: unknown key `assets`: did you mean `asset`?");
        assert_eq!(
            error("[asset.a]\nframes = 'a.vdb'\nformat = 'bc77'\n"),
            "line 3: unknown value `bc77`: did you mean `bc7`?"
        );
        assert!(error("[asset.a]\nframes = 'a.vdb'\n\nzstd = 40\n").starts_with("line 4: zstd"));
        assert!(error("[asset.a]\ngrid = 'x'\n").contains("missing field `frames`"));
        assert!(error("[asset.a]\nframes = 7\n").starts_with("line 2:"));
        assert!(error("[asset.a\n").starts_with("line 1:"));
    }
}
