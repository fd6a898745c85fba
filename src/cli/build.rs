//! `volpack build`.

use std::path::{Path, PathBuf};

use clap::Args;
use serde_json::json;

use super::progress::Reporter;
use super::style::{self, GOOD, TITLE};
use super::{Common, SettingsArgs, VerifyArg, files, print_json};
use crate::error::{Error, Result};
use crate::manifest::{DEFAULT_NAME, Manifest, expand};
use crate::pack::Pack;
use crate::pipeline::{Job, Outcome, build};
use crate::report::PackSummary;

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
    /// Print what was built as JSON
    #[arg(long)]
    json: bool,
}

pub fn run(args: &BuildArgs, common: Common) -> Result<()> {
    let mut built = Vec::new();
    let mut failure = None;
    for (name, job) in jobs(args)? {
        match build_one(&name, &job, args, common) {
            Ok(asset) => built.push(asset),
            // One bad asset does not keep the others from being built. All errors are printed, the
            // last by the caller.
            Err(error) => failure.replace(error).iter().for_each(super::print_error),
        }
    }
    if args.json {
        print_json(&json!({ "assets": built }));
    }
    failure.map_or(Ok(()), Err)
}

fn build_one(name: &str, job: &Job, args: &BuildArgs, common: Common) -> Result<serde_json::Value> {
    let mut reporter = Reporter::new(name, common.quiet || args.json);
    let outcome = build(job, &mut reporter);
    reporter.finish();
    let outcome = outcome?;
    let summary = PackSummary::new(&Pack::open(&job.output).map_err(Error::pack(&job.output))?);
    if !args.json && !common.quiet {
        print(name, job, &outcome, &summary, common.verbose);
    }
    if let Some(report) = &outcome.verification {
        super::verify::verdict(&job.output, report)?;
    }
    Ok(json!({
        "asset": name,
        "output": job.output,
        "warnings": outcome.warnings,
        "seconds": outcome.seconds.iter().map(|(stage, s)| json!({ "stage": stage, "seconds": s })).collect::<Vec<_>>(),
        "pack": summary,
        "verification": outcome.verification,
    }))
}

/// The packs that the arguments ask for, with the names to show.
fn jobs(args: &BuildArgs) -> Result<Vec<(String, Job)>> {
    let job = |frames, output: &Path, settings, max_flip| Job {
        frames,
        output: output.to_owned(),
        settings,
        strict: args.strict,
        verify: args.verify.verify,
        pictures: args.verify.pictures.settings(max_flip),
    };
    if !args.frames.is_empty() {
        let output = args
            .output
            .as_deref()
            .ok_or_else(|| Error::Usage("FILES need a pack to go into: add -o OUT.volpack".to_owned()))?;
        let name = output.file_stem().map_or_else(|| "pack".into(), |s| s.to_string_lossy().into_owned());
        return Ok(vec![(name, job(files(&args.frames)?, output, args.settings.settings(), None))]);
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
    let named = |name: &String| {
        let asset = manifest.asset(name)?;
        Ok((name.clone(), job(expand(&asset.frames)?, &asset.output, asset.settings.clone(), asset.max_flip)))
    };
    names.into_iter().map(named).collect()
}

fn print(name: &str, job: &Job, outcome: &Outcome, pack: &PackSummary, verbose: bool) {
    let bytes = style::bytes;
    anstream::println!("{TITLE}{name}{TITLE:#} -> {} ({})", job.output.display(), bytes(pack.file_bytes));
    super::inspect::print_sizes(pack);
    if let Some(report) = &outcome.verification {
        super::verify::print_summary(report);
    } else {
        anstream::println!("  not verified against its source (--verify)");
    }
    if verbose {
        for (stage, seconds) in &outcome.seconds {
            anstream::println!("  {stage:22} {seconds:8.3} s");
        }
    } else {
        let total: f64 = outcome.seconds.iter().map(|(_, s)| s).sum();
        anstream::println!("  {GOOD}done{GOOD:#} in {}", style::seconds(total));
    }
}
