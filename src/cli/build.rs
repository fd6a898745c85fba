//! `volpack build`.

use std::path::PathBuf;

use clap::Args;
use serde_json::{Value as Json, json};

use super::jobs::JobArgs;
use super::progress::Reporter;
use super::style::{ERROR, GOOD, TITLE};
use super::{Common, outln, print_json};
use crate::error::{Error, Result};
use crate::file_name::portable;
use crate::pack::{Pack, Provenance};
use crate::pipeline::{Job, Made, Outcome, VerifyLevel, build};
use crate::report::model::{Figures, Total};
use crate::report::{Breach, Checked, of_total};
use crate::settings::Budget;
use crate::{profile, units};

const EXAMPLES: &str = "\
Examples:
  volpack build                                        every asset of pipeline.toml
  volpack build smoke/*.vdb -o smoke.volpack           one sequence at the default quality
  volpack build smoke/*.vdb -o smoke.volpack --size 20MB
  volpack build fluid/*.vdb -o fluid.volpack -g phi --max-error \"0.02 voxels\"
  volpack build --asset puff --images out/pictures     and pictures of source and pack";

#[derive(Args)]
#[command(after_help = EXAMPLES)]
pub struct BuildArgs {
    #[command(flatten)]
    jobs: JobArgs,
    /// Print the result as JSON
    #[arg(long, help_heading = "Output")]
    json: bool,
    /// Write a profile of all threads, for chrome://tracing or ui.perfetto.dev
    #[arg(long, value_name = "FILE.json", value_parser = super::output_path(), help_heading = "Output")]
    profile: Option<PathBuf>,
}

pub fn run(args: &BuildArgs, common: Common) -> Result<()> {
    let mut assets = Vec::new();
    let mut failure = None;
    if args.profile.is_some() {
        profile::record();
    }
    let cache = args.jobs.open_cache();
    let (all, limits) = args.jobs.budgets()?;
    let is_limited = [all].iter().chain(limits.values()).any(|budget| *budget != Budget::default());
    let mut built: Vec<(String, Figures)> = Vec::new();
    let mut breaches: Vec<Breach> = Vec::new();
    for (name, job) in args.jobs.jobs(cache.as_ref(), VerifyLevel::All)? {
        if matches!(failure, Some(Error::Cancelled(_))) {
            break;
        }
        let mut asset = json!({ "asset": name });
        let made = job.and_then(|job| {
            let outcome = build_one(&name, &job, args, common, &mut asset)?;
            if is_limited {
                let limits = limits.get(&name).copied().unwrap_or_default();
                let figures = check(&name, &job, &outcome, &limits, &mut breaches)?;
                built.push((name.clone(), figures));
            }
            Ok(())
        });
        if let Err(error) = made {
            asset["error"] = error.to_string().into();
            // One bad asset does not keep the others from being built. All errors are printed, the
            // last by the caller.
            failure.replace(error).iter().for_each(super::print_error);
        }
        assets.push(asset);
    }
    if let Some(cache) = cache.filter(|_| !matches!(failure, Some(Error::Cancelled(_)))) {
        super::cache::finish(&cache, common.quiet || args.json)?;
    }
    args.profile.as_deref().map_or(Ok(()), profile::write)?;
    let packs: Vec<(&str, &Figures)> = built.iter().map(|(name, figures)| (&**name, figures)).collect();
    breaches.extend(of_total(&Total::new(&packs, &all), &packs));
    if args.json {
        print_json(&json!({ "assets": assets, "breaches": breaches }));
    }
    super::report::end(failure, &breaches)
}

/// A pack's figures; adds every limit that it is past.
fn check(
    name: &str,
    job: &Job,
    outcome: &Outcome,
    budget: &Budget,
    breaches: &mut Vec<Breach>,
) -> Result<Figures> {
    let pack = Pack::open(&job.output).map_err(Error::pack(&job.output))?;
    let found = outcome.verification.as_ref();
    let build = outcome.build_report();
    let Provenance { settings, sources, .. } = &Provenance::of(&pack).map_err(Error::provenance(&pack))?;
    let figures = Figures::new(sources, &outcome.summary, found, Some(&build));
    let (figures_of, build) = (&figures, Some(&build));
    let checked =
        Checked { name, budget, figures: figures_of, baseline: None, pack: &pack, settings, found, build };
    breaches.extend(checked.breaches());
    Ok(figures)
}

/// Builds one pack and adds to `asset` what JSON says of it.
fn build_one(name: &str, job: &Job, args: &BuildArgs, common: Common, asset: &mut Json) -> Result<Outcome> {
    let mut reporter = Reporter::new(name, common.quiet || args.json);
    let outcome = build(job, &mut reporter);
    reporter.finish();
    let outcome = outcome?;
    if !args.json && !common.quiet {
        print(name, job, &outcome, common.verbose);
    }
    asset["output"] = json!(portable(&job.output));
    asset["warnings"] = json!(outcome.warnings);
    asset["seconds"] = json!(outcome.build_report().stages);
    asset["pack"] = json!(outcome.summary);
    asset["verification"] = json!(outcome.verification);
    asset["made"] = json!(outcome.made);
    asset["cache"] = json!(outcome.cache);
    if let Some(report) = &outcome.verification {
        super::verify::verdict(&job.output, report).map_err(|e| {
            Error::Verify(format!("{e}\n  Not written. Use --verify none to write it anyway."))
        })?;
    }
    Ok(outcome)
}

fn print(name: &str, job: &Job, outcome: &Outcome, verbose: bool) {
    let pack = &outcome.summary;
    let bytes = units::bytes;
    let verified = match &outcome.verification {
        Some(report) if report.ok => format!("{GOOD}verified{GOOD:#}"),
        Some(_) => format!("{ERROR}verification failed{ERROR:#}"),
        None => "not verified".to_owned(),
    };
    let source: u64 =
        job.frames.iter().filter_map(|file| std::fs::metadata(file).ok()).map(|file| file.len()).sum();
    let share = 100.0 * pack.file_bytes as f64 / source.max(1) as f64;
    let quality = outcome.verification.as_ref().map_or_else(String::new, super::verify::quality);
    outln!("{TITLE}{name}{TITLE:#} -> {}", job.output.display());
    outln!("  {} → {} ({share:.0} %), {quality}{verified}", bytes(source), bytes(pack.file_bytes));
    super::inspect::print_sizes(pack, verbose);
    if let Some(report) = &outcome.verification {
        super::verify::print_details(report);
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
        Made::Repacked => "repacked from the cache",
        Made::Copied => "taken from the cache",
        Made::Unchanged => "up to date",
    };
    outln!("  {GOOD}{how}{GOOD:#} in {}", units::seconds(total));
}
