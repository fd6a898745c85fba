//! `volpack explain`.

use std::path::PathBuf;

use clap::Args;

use super::cache::CacheChoice;
use super::jobs::assets;
use super::style::{GOOD, TITLE, WARNING};
use super::{outln, print_json};
use crate::error::Result;
use crate::manifest::{DEFAULT_NAME, expand};
use crate::pipeline::{Job, VerifyLevel, explain};

#[derive(Args)]
pub struct ExplainArgs {
    /// Assets of the manifest [default: all]
    #[arg(value_name = "ASSET")]
    assets: Vec<String>,
    /// Manifest to read
    #[arg(short, long, value_name = "FILE", default_value = DEFAULT_NAME)]
    manifest: PathBuf,
    #[command(flatten)]
    cache: CacheChoice,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

pub fn run(args: &ExplainArgs) -> Result<()> {
    let cache = args.cache.open();
    let mut out = Vec::new();
    for (name, asset) in assets(&args.manifest, &args.assets)?.0 {
        let mut job = Job::new(expand(&asset.frames)?, asset.output, asset.settings, VerifyLevel::All);
        job.pictures.max_flip = asset.max_flip;
        job.cache = cache.clone();
        job.paranoid = args.cache.paranoid;
        let explanation = explain(&job)?;
        if args.json {
            out.push(serde_json::json!({ "asset": name, "explanation": explanation }));
            continue;
        }
        if explanation.stages.is_empty() {
            outln!("{TITLE}{name}{TITLE:#}: {GOOD}up to date{GOOD:#}");
            continue;
        }
        outln!("{TITLE}{name}{TITLE:#}: {}", job.output.display());
        for reason in &explanation.reasons {
            outln!("  {reason}");
        }
        for stage in &explanation.stages {
            outln!("    {:10} {}", stage.stage, stage.work);
        }
    }
    for warning in cache.iter().flat_map(|cache| cache.flush()) {
        anstream::eprintln!("{WARNING}warning{WARNING:#}: {warning}");
    }
    if args.json {
        print_json(&out);
    }
    Ok(())
}
