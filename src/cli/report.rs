//! `volpack report`.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use clap::{Args, ValueEnum};

use super::cache::{CacheChoice, RemoteArgs};
use super::jobs::{assets, stem};
use super::progress::Reporter;
use super::style::{ERROR, GOOD, TITLE};
use super::{Common, outln};
use crate::atomic_file;
use crate::cache::Cache;
use crate::digest::digest;
use crate::error::{Error, Result};
use crate::file_name::portable;
use crate::manifest::{DEFAULT_NAME, expand};
use crate::pack::{Pack, Provenance};
use crate::pipeline::{Job, Outcome, Resources, VerifyLevel, build, check_structure, verify_against};
use crate::report::model::{AssetReport, Figures, Report};
use crate::report::{
    Baseline, Breach, Gallery, PackSummary, Reported, gallery, html, junit, markdown, schema,
};
use crate::settings::Budget;
use crate::sweep::cheaper;
use crate::units::bytes;
use crate::verify::PictureSettings;

#[derive(Args)]
pub struct ReportArgs {
    /// Finished packs, instead of a manifest's assets
    #[arg(value_name = "PACKS", conflicts_with_all = ["manifest", "assets"])]
    packs: Vec<PathBuf>,
    /// Manifest whose assets are built, or taken from the cache
    #[arg(short, long, value_name = "FILE", default_value = DEFAULT_NAME)]
    manifest: PathBuf,
    /// Asset of the manifest to report; repeat for several [default: all]
    #[arg(long = "asset", value_name = "NAME")]
    assets: Vec<String>,
    /// Source files of PACKS, to compare them with
    #[arg(long, value_name = "FILES", num_args = 1.., requires = "packs")]
    source: Vec<PathBuf>,
    /// Write an HTML page with pictures and charts
    #[arg(long, value_name = "FILE", value_parser = super::output_path())]
    html: Option<PathBuf>,
    /// Write every figure as JSON (schema: volpack report --schema)
    #[arg(long, value_name = "FILE", value_parser = super::output_path())]
    json: Option<PathBuf>,
    /// Write a Markdown table for a review comment
    #[arg(long, value_name = "FILE", value_parser = super::output_path())]
    markdown: Option<PathBuf>,
    /// Write test results as JUnit XML
    #[arg(long, value_name = "FILE", value_parser = super::output_path())]
    junit: Option<PathBuf>,
    /// JSON of an older report, to list changes against
    #[arg(long, value_name = "FILE")]
    baseline: Option<PathBuf>,
    /// Skip the possible savings, which need further builds
    #[arg(long)]
    no_cheaper: bool,
    /// How to print problems
    #[arg(long, value_name = "FORMAT", default_value = "text")]
    format: Lines,
    /// Print the JSON schema of --json and exit
    #[arg(long)]
    schema: bool,
    #[command(flatten)]
    cache: CacheChoice,
    #[command(flatten)]
    remote: RemoteArgs,
}

/// How problems are printed.
#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Lines {
    /// For people
    Text,
    /// As annotations of a GitHub runner
    Github,
}

/// Collects the assets' reports and failures.
struct Gathering<'a> {
    args: &'a ReportArgs,
    common: Common,
    cache: Option<Arc<Cache>>,
    baseline: Option<&'a Baseline>,
    assets: Vec<AssetReport>,
    breaches: Vec<Breach>,
    /// One for each asset.
    galleries: Vec<Option<Gallery>>,
    failure: Option<Error>,
}

pub fn run(args: &ReportArgs, common: Common) -> Result<()> {
    if args.schema {
        super::print_json(&schema());
        return Ok(());
    }
    let baseline = args.baseline.as_deref().map(Baseline::read).transpose()?;
    let mut gathering = Gathering {
        args,
        common,
        cache: args.cache.open_with(&args.remote),
        baseline: baseline.as_ref(),
        assets: Vec::new(),
        breaches: Vec::new(),
        galleries: Vec::new(),
        failure: None,
    };
    let mut budget = Budget::default();
    if args.packs.is_empty() {
        let (chosen, all) = assets(&args.manifest, &args.assets)?;
        budget = all;
        for (name, asset) in chosen {
            let limits = asset.budget;
            gathering.add(&name, |gathering| {
                let frames = expand(&asset.frames)?;
                let mut job = Job::new(frames, asset.output, asset.settings, VerifyLevel::All);
                job.pictures.max_flip = asset.max_flip;
                job.cache = gathering.cache.clone();
                job.paranoid = args.cache.paranoid;
                gathering.build(&name, &job, &limits)
            })?;
        }
    } else {
        let sources = expand(&args.source)?;
        let packs = expand(&args.packs)?;
        for path in &packs {
            // Two of one name are told apart by their folders.
            let is_alone = packs.iter().filter(|other| stem(other) == stem(path)).count() == 1;
            let name = if is_alone { stem(path) } else { portable(&path.with_extension("")) };
            gathering.add(&name, |gathering| gathering.look(&name, path, &sources))?;
        }
    }
    gathering.finish(&budget)
}

impl Gathering<'_> {
    /// Adds an asset. One that fails is reported too, and the others go on.
    fn add(&mut self, name: &str, make: impl FnOnce(&mut Self) -> Result<AssetReport>) -> Result<()> {
        let asset = match make(self) {
            Ok(asset) => asset,
            Err(Error::Cancelled(e)) => return Err(e.into()),
            Err(error) => {
                let message = error.to_string();
                self.fail(error);
                AssetReport { name: name.to_owned(), error: Some(message), pack: None, warnings: Vec::new() }
            }
        };
        // Those that were made stand at their assets' places.
        self.galleries.resize_with(self.assets.len() + 1, || None);
        self.assets.push(asset);
        Ok(())
    }

    /// All errors are printed, the last by the caller.
    fn fail(&mut self, error: Error) {
        self.failure.replace(error).iter().for_each(super::print_error);
    }

    /// Builds an asset and reports it.
    fn build(&mut self, name: &str, job: &Job, limits: &Budget) -> Result<AssetReport> {
        let mut reporter = Reporter::new(name, self.common.quiet);
        let made = build(job, &mut reporter).and_then(|outcome| {
            let refused = outcome.verification.as_ref().filter(|report| !report.ok);
            if let Some(report) = refused {
                return Err(Error::Verify(format!("verification failed: {}", report.failures.join("; "))));
            }
            let pack = Pack::open(&job.output).map_err(Error::pack(&job.output))?;
            let provenance = Provenance::of(&pack).map_err(Error::provenance(&pack))?;
            let figures =
                Figures::new(&provenance.sources, &outcome.summary, outcome.verification.as_ref(), None);
            if self.args.no_cheaper {
                return Ok((outcome, pack, provenance, None, None));
            }
            reporter.finish();
            reporter = Reporter::new(&format!("{name}, cheaper"), self.common.quiet);
            match cheaper(job, &pack, &figures, &mut reporter) {
                Ok(cheaper) => Ok((outcome, pack, provenance, cheaper, None)),
                Err(Error::Cancelled(e)) => Err(e.into()),
                // A size that cannot be reached is no offer.
                Err(Error::Usage(_)) => Ok((outcome, pack, provenance, None, None)),
                Err(error) => {
                    let trouble = format!("no cheaper setting was measured: {error}");
                    Ok((outcome, pack, provenance, None, Some(trouble)))
                }
            }
        });
        reporter.finish();
        let (outcome, pack, provenance, cheaper, trouble) = made?;
        let build = outcome.build_report();
        let Outcome { mut warnings, summary, verification, .. } = outcome;
        warnings.extend(trouble);
        let reported = Reported {
            name,
            pack: &pack,
            provenance: &provenance,
            file: &job.output,
            base: self.args.manifest.parent().unwrap_or(Path::new("")),
            digest: digest(&job.output)?.0,
            summary,
            found: verification,
            build: Some(build),
            cheaper,
            command: format!(
                "volpack build -m {} --asset {}",
                quoted(&portable(&self.args.manifest)),
                quoted(name)
            ),
            budget: limits,
            baseline: self.baseline,
        };
        self.report(reported, Some(&job.frames), warnings)
    }

    /// Reports a pack that is there.
    fn look(&mut self, name: &str, path: &Path, sources: &[PathBuf]) -> Result<AssetReport> {
        let pack = check_structure(path)?;
        let provenance = Provenance::of(&pack).map_err(Error::provenance(&pack))?;
        let mut reporter = Reporter::new(name, self.common.quiet);
        let files = (!sources.is_empty()).then_some(sources);
        let pictures = PictureSettings::default();
        let found = files
            .map(|files| verify_against(&pack, files, Some(&pictures), &Resources::default(), &mut reporter))
            .transpose();
        reporter.finish();
        let found = found?;
        if let Some(report) = found.as_ref().filter(|report| !report.ok) {
            let message = format!("{}: {}", path.display(), report.failures.join("; "));
            self.fail(Error::Verify(message));
        }
        let reported = Reported {
            name,
            pack: &pack,
            provenance: &provenance,
            file: path,
            base: Path::new(""),
            digest: digest(path)?.0,
            summary: PackSummary::new(&pack),
            found,
            build: None,
            cheaper: None,
            command: format!("volpack verify {} --source FILES", quoted(&portable(path))),
            budget: &Budget::default(),
            baseline: self.baseline,
        };
        self.report(reported, files, Vec::new())
    }

    fn report(
        &mut self,
        reported: Reported,
        files: Option<&[PathBuf]>,
        mut warnings: Vec<String>,
    ) -> Result<AssetReport> {
        let name = reported.name.to_owned();
        let (pack, found) = (reported.pack, reported.found.as_ref());
        if self.args.html.is_some() {
            let cache = self.cache.as_deref();
            let drawn =
                gallery(pack, reported.digest.as_bytes(), files, found, cache, &super::interrupt::TOKEN)?;
            self.galleries.push(Some(drawn));
        }
        if self.baseline.is_some_and(|baseline| baseline.figures(&name).is_none()) {
            warnings.push("the baseline has no asset of this name".to_owned());
        }
        let failed = found.filter(|found| !found.ok).map(|found| found.failures.join("; "));
        let (pack, breaches) = reported.report();
        self.breaches.extend(breaches);
        Ok(AssetReport { name, error: failed, pack: Some(pack), warnings })
    }

    /// Writes what was asked for, and says how it went.
    fn finish(self, budget: &Budget) -> Result<()> {
        let args = self.args;
        let manifest = args.packs.is_empty().then(|| portable(&args.manifest));
        let baseline = args.baseline.as_ref().map(|path| portable(path));
        let report = Report::new(self.assets, self.breaches, budget, manifest, baseline);
        let other = |e: &dyn std::fmt::Display| Error::Other(format!("the report cannot be written: {e}"));
        if let Some(path) = &args.json {
            let mut json = serde_json::to_string_pretty(&report).map_err(|e| other(&e))?;
            json.push('\n');
            atomic_file::write(path, json.as_bytes())?;
        }
        if let Some(path) = &args.markdown {
            atomic_file::write(path, markdown(&report).map_err(|e| other(&e))?.as_bytes())?;
        }
        if let Some(path) = &args.junit {
            atomic_file::write(path, junit(&report).map_err(|e| other(&e))?.as_bytes())?;
        }
        if let Some(path) = &args.html {
            atomic_file::write(path, html(&report, &self.galleries).map_err(|e| other(&e))?.as_bytes())?;
        }
        if let Some(cache) = &self.cache {
            super::cache::finish(cache, self.common.quiet)?;
        }
        if !self.common.quiet {
            print(&report);
        }
        if args.format == Lines::Github {
            annotate(&report);
        }
        end(self.failure, &report.breaches)
    }
}

/// How a command ends with assets that failed and limits that are past: all is told, the last by the caller.
pub fn end(failure: Option<Error>, breaches: &[Breach]) -> Result<()> {
    let lines: String = breaches.iter().map(|breach| format!("\n  {breach}")).collect();
    let over = (!breaches.is_empty()).then_some(Error::Budget(lines));
    match (failure, over) {
        (Some(failure), over) => {
            over.iter().for_each(super::print_error);
            Err(failure)
        }
        (None, Some(over)) => Err(over),
        (None, None) => Ok(()),
    }
}

/// A name as a shell takes it.
fn quoted(text: &str) -> String {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "._-/".contains(c);
    if text.chars().all(is_plain) { text.to_owned() } else { format!("'{}'", text.replace('\'', "'\\''")) }
}

fn print(report: &Report) {
    for asset in &report.assets {
        let name = &asset.name;
        match &asset.pack {
            None => outln!("{TITLE}{name}{TITLE:#}: {ERROR}not built{ERROR:#}"),
            Some(pack) => {
                let figures = &pack.figures;
                let quality = figures.decibels(figures.psnr);
                let (gpu, file) = (bytes(figures.gpu_bytes), bytes(figures.file_bytes));
                outln!("{TITLE}{name}{TITLE:#}: {gpu} on the GPU, file {file}, {quality}");
            }
        }
    }
    let total = &report.total;
    let verdict = if report.ok { format!("{GOOD}ok{GOOD:#}") } else { format!("{ERROR}not ok{ERROR:#}") };
    let count = report.assets.len();
    outln!(
        "{count} assets, {} on the GPU, files {}: {verdict}",
        bytes(total.gpu_bytes),
        bytes(total.file_bytes)
    );
}

/// What a GitHub runner shows beside a change.
fn annotate(report: &Report) {
    // The runner's own escapes for messages, and those for properties.
    let message = |text: &str| text.replace('%', "%25").replace('\r', "%0D").replace('\n', "%0A");
    let title = |text: &str| message(text).replace(':', "%3A").replace(',', "%2C");
    for asset in &report.assets {
        if let Some(error) = &asset.error {
            outln!("::error title={}::{}", title(&asset.name), message(error));
        }
        for warning in &asset.warnings {
            outln!("::warning title={}::{}", title(&asset.name), message(warning));
        }
    }
    for breach in &report.breaches {
        let name = format!("{} over {}", breach.asset.as_deref().unwrap_or("all assets"), breach.budget);
        outln!(
            "::error title={}::{}",
            title(&name),
            message(&format!("{}; {}", breach.message, breach.remedy))
        );
    }
}
