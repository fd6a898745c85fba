//! What there is to build, as the command line or a manifest says it.

use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use clap::Args;

use super::cache::{CacheChoice, RemoteArgs};
use super::{MemoryArg, VerifyArg};
use crate::cache::Cache;
use crate::error::{Error, Result};
use crate::manifest::{Asset, DEFAULT_NAME, Manifest, expand};
use crate::pipeline::{Job, Resources, VerifyLevel};
use crate::settings::{Budget, SettingsArgs};
use crate::volume::ScratchFolder;

#[derive(Args)]
pub struct JobArgs {
    /// Files of one sequence, instead of a manifest
    #[arg(value_name = "FILES", conflicts_with_all = ["manifest", "assets"])]
    pub frames: Vec<PathBuf>,
    /// Manifest to read
    #[arg(short, long, value_name = "FILE", default_value = DEFAULT_NAME, help_heading = "Input")]
    manifest: PathBuf,
    /// Asset of the manifest to build; repeat for several [default: all]
    #[arg(long = "asset", value_name = "NAME", help_heading = "Input")]
    assets: Vec<String>,
    /// Pack to write, for FILES
    #[arg(short, long, value_name = "OUT.volpack", value_parser = super::output_path(), requires = "frames", help_heading = "Output")]
    output: Option<PathBuf>,
    #[command(flatten)]
    settings: SettingsArgs,
    #[command(flatten)]
    verify: VerifyArg,
    /// Treat warnings as errors, for example a missing frame
    #[arg(long, help_heading = "Input")]
    strict: bool,
    #[command(flatten)]
    cache: CacheChoice,
    #[command(flatten)]
    remote: RemoteArgs,
    #[command(flatten)]
    memory: MemoryArg,
    /// Directory for temporary spill files [default: the cache folder, else the system's temporary folder]
    #[arg(long, value_name = "DIR", env = "VOLPACK_SCRATCH", help_heading = "General")]
    scratch: Option<PathBuf>,
}

impl JobArgs {
    /// The cache that is asked for.
    pub fn open_cache(&self) -> Option<Arc<Cache>> {
        self.cache.open_with(&self.remote)
    }

    fn scratch_folder(&self, cache: Option<&Arc<Cache>>) -> Result<ScratchFolder> {
        match (&self.scratch, cache) {
            (Some(folder), _) => {
                std::fs::create_dir_all(folder).map_err(Error::io(folder))?;
                Ok(ScratchFolder::asked_for(folder.clone()))
            }
            (None, Some(cache)) => Ok(ScratchFolder::preferred(cache.scratch_folder())),
            (None, None) => Ok(ScratchFolder::default()),
        }
    }

    /// What all assets together may cost, and what each that is asked for has to keep, by name.
    pub fn budgets(&self) -> Result<(Budget, BTreeMap<String, Budget>)> {
        if !self.frames.is_empty() {
            return Ok(Default::default());
        }
        let (assets, all) = assets(&self.manifest, &self.assets)?;
        Ok((all, assets.into_iter().map(|(name, asset)| (name, asset.budget)).collect()))
    }

    /// The packs that are asked for, with the names to show. `verify` is the level if the command line has none.
    /// One whose files cannot be found is an error of its own.
    pub fn jobs(
        &self,
        cache: Option<&Arc<Cache>>,
        verify: VerifyLevel,
    ) -> Result<Vec<(String, Result<Job>)>> {
        let scratch = self.scratch_folder(cache)?;
        let job = |frames, output: &Path, settings, max_flip| Job {
            frames,
            output: output.to_owned(),
            settings,
            strict: self.strict,
            verify: self.verify.verify.unwrap_or(verify),
            pictures: self.verify.pictures.settings(max_flip),
            cache: cache.cloned(),
            paranoid: self.cache.paranoid,
            resources: Resources { memory: self.memory.bytes(), scratch: scratch.clone() },
        };
        if !self.frames.is_empty() {
            let output = self
                .output
                .as_deref()
                .ok_or_else(|| Error::Usage("no output given: add -o OUT.volpack".to_owned()))?;
            let name = stem(output);
            let settings = self.settings.settings().map_err(Error::Usage)?;
            return Ok(vec![(name, expand(&self.frames).map(|f| job(f, output, settings, None)))]);
        }
        if self.output.is_some() || self.settings.any() {
            return Err(Error::Usage(
                "-o and the settings of a pack go with FILES; for a manifest they stand in it".to_owned(),
            ));
        }
        let (assets, _) = assets(&self.manifest, &self.assets)?;
        let of_asset = |(name, asset): (String, Asset)| {
            let frames = expand(&asset.frames);
            (name, frames.map(|frames| job(frames, &asset.output, asset.settings, asset.max_flip)))
        };
        Ok(assets.into_iter().map(of_asset).collect())
    }
}

/// What a pack is called after its file.
pub fn stem(path: &Path) -> String {
    path.file_stem().map_or_else(|| "pack".into(), |s| s.to_string_lossy().into_owned())
}

/// Some assets of a manifest, or all of them where none are named, and the budget of all together. That applies only if all
/// are built.
pub fn assets(path: &Path, names: &[String]) -> Result<(Vec<(String, Asset)>, Budget)> {
    if !path.exists() {
        return Err(Error::Usage(format!(
            "there is no manifest {}: name one with -m, or give files: volpack build FILES... -o OUT.volpack",
            path.display()
        )));
    }
    let manifest = Manifest::read(path)?;
    let budget = if names.is_empty() { manifest.budget } else { Budget::default() };
    let names: Vec<&String> =
        if names.is_empty() { manifest.assets.keys().collect() } else { names.iter().collect() };
    if names.is_empty() {
        return Err(Error::Manifest {
            path: path.to_owned(),
            message: "there is nothing to build: add an [asset.NAME] with its frames".to_owned(),
        });
    }
    let mut assets: Vec<(String, Asset)> = Vec::new();
    let mut outputs = HashMap::new();
    for name in names {
        let asset = manifest.asset(name)?;
        if let Some(other) = outputs.insert(&asset.output, name) {
            return Err(Error::Usage(format!(
                "assets {other:?} and {name:?} would both be {}",
                asset.output.display()
            )));
        }
        assets.push((name.clone(), asset.clone()));
    }
    Ok((assets, budget))
}
