//! `pipeline.toml` as types, with errors that name the line.

use std::collections::BTreeMap;
use std::path::{Component, Path, PathBuf};

use glob::{MatchOptions, glob_with};
use serde::{Deserialize, Deserializer};
use toml::Spanned;
use toml::de::{DeTable, DeValue};

use crate::error::{Error, Result};
use crate::file_name::check_path;
use crate::settings::{Budget, Look, Settings, SettingsArgs, check_above_zero};

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
    /// How `volpack render` shows it.
    pub look: Look,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawManifest {
    #[serde(default)]
    asset: BTreeMap<String, RawAsset>,
    #[serde(default)]
    budget: Budget,
}

/// What an asset has beside its settings.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawAsset {
    frames: OneOrMany,
    grid: Option<String>,
    #[serde(default, deserialize_with = "checked_max_flip")]
    max_flip: Option<f64>,
    output: Option<PathBuf>,
    #[serde(default)]
    budget: Budget,
    #[serde(default)]
    look: Look,
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
        let described = |e| describe(text, &e);
        let mut document = DeTable::parse(text).map_err(described)?;
        let mut settings = take_settings(document.get_mut());
        let raw = RawManifest::deserialize(toml::Deserializer::from(document)).map_err(described)?;
        let asset = |(name, asset): (String, RawAsset)| {
            let settings = match settings.remove(&name) {
                Some(table) => {
                    SettingsArgs::deserialize(toml::Deserializer::from(table)).map_err(described)?
                }
                None => SettingsArgs::default(),
            };
            let asset = asset.into_asset(&name, settings, &raw.budget, folder);
            Ok((name.clone(), asset.map_err(|e| format!("asset {name:?}: {e}"))?))
        };
        let assets = raw.asset.into_iter().map(asset).collect::<Result<_, String>>()?;
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

/// Takes the settings out of every asset, by its name. They are read on their own, and not by serde's `flatten`, which
/// forgets where a value stands and which keys there are.
fn take_settings<'a>(document: &mut DeTable<'a>) -> BTreeMap<String, Spanned<DeTable<'a>>> {
    let keys = SettingsArgs::keys();
    let mut settings = BTreeMap::new();
    let assets = document.get_mut("asset").and_then(|assets| table_of(assets.get_mut()));
    for (name, asset) in assets.into_iter().flatten() {
        let span = asset.span();
        let Some(asset) = table_of(asset.get_mut()) else { continue };
        let mut taken = DeTable::new();
        for (key, value) in std::mem::take(asset) {
            let is_setting = keys.iter().any(|known| known == key.get_ref());
            if is_setting { &mut taken } else { &mut *asset }.insert(key, value);
        }
        settings.insert(name.get_ref().to_string(), Spanned::new(span, taken));
    }
    settings
}

fn table_of<'d, 'a>(value: &'d mut DeValue<'a>) -> Option<&'d mut DeTable<'a>> {
    match value {
        DeValue::Table(table) => Some(table),
        _ => None,
    }
}

fn checked_max_flip<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<f64>, D::Error> {
    let flip = check_above_zero(f64::deserialize(deserializer)?);
    flip.map(Some).map_err(|_| serde::de::Error::custom("max_flip is a number above 0"))
}

impl RawAsset {
    fn into_asset(
        self,
        name: &str,
        mut settings: SettingsArgs,
        all: &Budget,
        folder: &Path,
    ) -> Result<Asset, String> {
        if let Some(grid) = self.grid {
            if settings.grids.is_some() {
                return Err("give grid or grids, not both".to_owned());
            }
            settings.grids = Some(vec![grid]);
        }
        let frames = match self.frames {
            OneOrMany::One(one) => vec![one],
            OneOrMany::Many(many) => many,
        };
        let output = self.output.unwrap_or_else(|| PathBuf::from(format!("{name}.volpack")));
        check_path(&output).map_err(|e| format!("output: {e}"))?;
        self.look.check().map_err(|e| format!("look: {e}"))?;
        Ok(Asset {
            frames: frames.into_iter().map(|f| folder.join(f)).collect(),
            output: folder.join(output),
            max_flip: self.max_flip,
            budget: all.of_asset(&self.budget),
            settings: settings.settings()?,
            look: self.look,
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
        // An asset's settings were taken out of it.
        let settings = if known.contains(&"frames") { SettingsArgs::keys() } else { Vec::new() };
        let nearest = known
            .iter()
            .copied()
            .chain(settings.iter().map(String::as_str))
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

/// How globs match: upper and lower case are one where file names are found by either.
const MATCHING: MatchOptions = MatchOptions {
    case_sensitive: !cfg!(any(windows, target_os = "macos")),
    require_literal_separator: false,
    require_literal_leading_dot: false,
};

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
        let matches =
            glob_with(&glob_of(pattern), MATCHING).map_err(|e| Error::Usage(format!("{text}: {e}")))?;
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

    /// The names of the files that a manifest's globs stand for.
    fn expanded(folder: &Path, frames: &str) -> Vec<String> {
        let manifest = Manifest::parse(&format!("[asset.a]\nframes = '{frames}'\n"), folder).unwrap();
        let files = expand(&manifest.assets["a"].frames).unwrap_or_default();
        files.iter().map(|file| file.file_name().unwrap().to_string_lossy().into_owned()).collect()
    }

    #[test]
    fn folders_may_have_brackets_in_their_names() {
        let folder = tempfile::tempdir().unwrap();
        let project = folder.path().join("x[1]");
        let frames = project.join("sim[a-z]");
        std::fs::create_dir_all(&frames).unwrap();
        for name in ["a_1.vdb", "a_2.vdb", "b[1].vdb"] {
            std::fs::write(frames.join(name), "").unwrap();
        }
        // It matches the folder's name as a pattern.
        std::fs::create_dir(folder.path().join("x1")).unwrap();
        assert_eq!(expanded(&project, "sim[a-z]/*.vdb"), ["a_1.vdb", "a_2.vdb", "b[1].vdb"]);
        assert_eq!(expanded(&project, "sim*/a_[0-9].vdb"), ["a_1.vdb", "a_2.vdb"]);
        assert_eq!(expanded(&project, "../x[1]/sim[a-z]/b[1].vdb"), ["b[1].vdb"]);
    }

    #[test]
    fn globs_match_by_the_case_rule_of_the_system() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["Puff_1.VDB", "puff_2.vdb"] {
            std::fs::write(folder.path().join(name), "").unwrap();
        }
        let is_one = cfg!(any(windows, target_os = "macos"));
        let expected: &[&str] = if is_one { &["Puff_1.VDB", "puff_2.vdb"] } else { &["puff_2.vdb"] };
        assert_eq!(expanded(folder.path(), "puff_*.vdb"), expected);
    }

    #[test]
    fn outputs_that_windows_does_not_take_are_refused_by_the_asset() {
        assert_eq!(
            error("[asset.Aux]\nframes = 'a.vdb'\n"),
            "asset \"Aux\": output: \"Aux.volpack\" is the name of a device on Windows: choose another name"
        );
        assert!(error("[asset.a]\nframes = 'a.vdb'\noutput = 'nul/a.volpack'\n").starts_with("asset \"a\""));
        let named = "[asset.aux]\nframes = 'nul.vdb'\noutput = 'a.volpack'\n";
        assert!(Manifest::parse(named, Path::new("con")).is_ok(), "neither becomes the name of a file");
    }
}
