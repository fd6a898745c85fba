//! `volpack build`.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use clap::Args;
use serde_json::{Value as Json, json};

use super::cache::CacheChoice;
use super::progress::Reporter;
use super::style::{self, GOOD, TITLE};
use super::{Common, SettingsArgs, VerifyArg, outln, print_json};
use crate::error::{Error, Result};
use crate::manifest::{DEFAULT_NAME, Manifest, expand};
use crate::pipeline::{Job, Made, Outcome, build};

#[derive(Args)]
pub struct BuildArgs {
    /// The files of one sequence, in place of a manifest
    #[arg(value_name = "FILES", conflicts_with_all = ["manifest", "assets"])]
    frames: Vec<PathBuf>,
    /// The pack to write, with FILES
    #[arg(short, long, value_name = "OUT.volpack", requires = "frames")]
    output: Option<PathBuf>,
    /// The manifest
    #[arg(short, long, value_name = "FILE", default_value = DEFAULT_NAME)]
    manifest: PathBuf,
    /// Build only this asset of the manifest; may be given more than once
    #[arg(long = "asset", value_name = "NAME")]
    assets: Vec<String>,
    #[command(flatten)]
    settings: SettingsArgs,
    #[command(flatten)]
    verify: VerifyArg,
    /// Make warnings errors: a missing frame, a grid that some frames lack
    #[arg(long)]
    strict: bool,
    #[command(flatten)]
    cache: CacheChoice,
    /// Print what was built as JSON
    #[arg(long)]
    json: bool,
}

pub fn run(args: &BuildArgs, common: Common) -> Result<()> {
    let mut assets = Vec::new();
    let mut failure = None;
    for (name, job) in jobs(args)? {
        let mut asset = json!({ "asset": name });
        if let Err(error) = job.and_then(|job| build_one(&name, &job, args, common, &mut asset)) {
            asset["error"] = error.to_string().into();
            // One bad asset does not keep the others from being built. All errors are printed, the
            // last by the caller.
            failure.replace(error).iter().for_each(super::print_error);
        }
        assets.push(asset);
    }
    if args.json {
        print_json(&json!({ "assets": assets }));
    }
    failure.map_or(Ok(()), Err)
}

/// Builds one pack and adds to `asset` what JSON says of it.
fn build_one(name: &str, job: &Job, args: &BuildArgs, common: Common, asset: &mut Json) -> Result<()> {
    let mut reporter = Reporter::new(name, common.quiet || args.json);
    let outcome = build(job, &mut reporter);
    reporter.finish();
    let outcome = outcome?;
    if !args.json && !common.quiet {
        print(name, job, &outcome, common.verbose);
    }
    let seconds = outcome.seconds.iter().map(|(stage, s)| json!({ "stage": stage, "seconds": s }));
    asset["output"] = json!(job.output);
    asset["warnings"] = json!(outcome.warnings);
    asset["seconds"] = seconds.collect();
    asset["pack"] = json!(outcome.summary);
    asset["verification"] = json!(outcome.verification);
    asset["made"] = json!(outcome.made);
    asset["cache"] = json!(outcome.cache);
    match &outcome.verification {
        Some(report) => super::verify::verdict(&job.output, report).map_err(|e| {
            Error::Verify(format!("{e}\n  It was not written; --verify none writes it all the same."))
        }),
        None => Ok(()),
    }
}

/// The packs that the arguments ask for, with the names to show.
/// One whose files cannot be found is an error of its own.
fn jobs(args: &BuildArgs) -> Result<Vec<(String, Result<Job>)>> {
    let cache = args.cache.open();
    let job = |frames, output: &Path, settings, max_flip| Job {
        frames,
        output: output.to_owned(),
        settings,
        strict: args.strict,
        verify: args.verify.verify,
        pictures: args.verify.pictures.settings(max_flip),
        cache: cache.clone(),
        paranoid: args.cache.paranoid,
    };
    if !args.frames.is_empty() {
        let output = args
            .output
            .as_deref()
            .ok_or_else(|| Error::Usage("FILES need a pack to go into: add -o OUT.volpack".to_owned()))?;
        let name = output.file_stem().map_or_else(|| "pack".into(), |s| s.to_string_lossy().into_owned());
        return Ok(vec![(name, Ok(job(expand(&args.frames)?, output, args.settings.settings()?, None)))]);
    }
    if args.output.is_some() || args.settings.any() {
        return Err(Error::Usage(
            "-o and the settings of a pack go with FILES; for a manifest they stand in it".to_owned(),
        ));
    }
    if !args.manifest.exists() {
        return Err(Error::Usage(format!(
            "there is no manifest {}: name one with -m, or give files: volpack build FILES... -o OUT.volpack",
            args.manifest.display()
        )));
    }
    let manifest = Manifest::read(&args.manifest)?;
    let names: Vec<&String> =
        if args.assets.is_empty() { manifest.assets.keys().collect() } else { args.assets.iter().collect() };
    if names.is_empty() {
        return Err(Error::Manifest {
            path: args.manifest.clone(),
            message: "there is nothing to build: add an [asset.NAME] with its frames".to_owned(),
        });
    }
    let mut jobs: Vec<(String, Result<Job>)> = Vec::new();
    let mut outputs = HashMap::new();
    for name in names {
        let asset = manifest.asset(name)?;
        if let Some(other) = outputs.insert(&asset.output, name) {
            return Err(Error::Usage(format!(
                "assets {other:?} and {name:?} would both be {}",
                asset.output.display()
            )));
        }
        let frames = expand(&asset.frames);
        let job = frames.map(|f| job(f, &asset.output, asset.settings.clone(), asset.max_flip));
        jobs.push((name.clone(), job));
    }
    Ok(jobs)
}

fn print(name: &str, job: &Job, outcome: &Outcome, verbose: bool) {
    let pack = &outcome.summary;
    let bytes = style::bytes;
    outln!("{TITLE}{name}{TITLE:#} -> {} ({})", job.output.display(), bytes(pack.file_bytes));
    super::inspect::print_sizes(pack);
    if let Some(report) = &outcome.verification {
        super::verify::print_summary(report);
    } else {
        outln!("  not verified against its source (--verify)");
    }
    if verbose {
        for (stage, seconds) in &outcome.seconds {
            outln!("  {stage:22} {seconds:8.3} s");
        }
        for (stage, uses) in &outcome.cache {
            outln!("  {stage:22} {} of {} from the cache", uses.hits, uses.hits + uses.misses);
        }
    }
    let total: f64 = outcome.seconds.iter().map(|(_, s)| s).sum();
    let how = match outcome.made {
        Made::Built => "done",
        Made::Repacked => "packed anew from the cache",
        Made::Copied => "taken from the cache",
        Made::Unchanged => "nothing changed: looked at",
    };
    outln!("  {GOOD}{how}{GOOD:#} in {}", style::seconds(total));
}
