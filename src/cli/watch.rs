//! `volpack watch`.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::{Duration, Instant, SystemTime};

use clap::Args;

use super::jobs::JobArgs;
use super::style::{ERROR, GOOD, TITLE, WARNING};
use super::{Common, interrupt, outln};
use crate::error::{Error, Result};
use crate::file_stamp::Stamp;
use crate::pipeline::{Job, Made, Outcome, Progress, VerifyLevel, build};
use crate::settings::Settings;
use crate::units::{bytes, count, psnr, seconds};

/// How often files are looked at. Asking beats being told: network drives, where farms render to, tell nothing.
const LOOK_EVERY: Duration = Duration::from_millis(200);

/// How long a pack that another program has open is left alone. Nothing tells when it is closed, and each try makes the
/// pack again, if only out of the cache.
const IN_USE: Duration = Duration::from_secs(5);

/// A frame that cannot be read is still being written while its last change is no longer ago than this.
const STILL_WRITTEN: Duration = Duration::from_secs(10);

#[derive(Args)]
pub struct WatchArgs {
    #[command(flatten)]
    jobs: JobArgs,
    /// How long files must be unchanged before they are built, in seconds
    #[arg(long, value_name = "SECONDS", default_value = "1", value_parser = super::above_zero)]
    settle: f64,
}

/// What an asset is made from and into, as it was last seen.
#[derive(PartialEq)]
struct Seen {
    files: Vec<(PathBuf, Option<Stamp>)>,
    made: Option<(PathBuf, Settings, Option<f64>)>,
    trouble: Option<String>,
}

struct Asset {
    seen: Seen,
    since: Instant,
    /// What came of building it since it changed.
    state: State,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// It is not built yet, or was a moment too early.
    Waiting,
    /// Its pack could not be replaced when it was last tried, since another program has it open.
    InUse(Instant),
    /// It was built, or found wanting.
    Done,
}

impl Asset {
    /// Whether it is to be built now, given that it did not change.
    fn is_due(&self, now: Instant, settle: Duration) -> bool {
        match self.state {
            State::Waiting => now.duration_since(self.since) >= settle,
            State::InUse(tried) => now.duration_since(tried) >= IN_USE,
            State::Done => false,
        }
    }
}

/// Keeps warnings for the one line.
#[derive(Default)]
struct Quiet(Vec<String>);

impl Progress for Quiet {
    fn warn(&mut self, warning: &str) {
        self.0.push(warning.to_owned());
    }
}

pub fn run(args: &WatchArgs, common: Common) -> Result<()> {
    let cache = args.jobs.open_cache();
    let settle = Duration::from_secs_f64(args.settle);
    let mut assets: BTreeMap<String, Asset> = BTreeMap::new();
    let mut trouble = None;
    // A manifest that is wrong to begin with is an error, one that is being edited is waited for.
    args.jobs.jobs(cache.as_ref(), VerifyLevel::Voxels)?;
    while !interrupt::TOKEN.is_cancelled() {
        match args.jobs.jobs(cache.as_ref(), VerifyLevel::Voxels) {
            Ok(jobs) => {
                trouble = None;
                for (name, job) in jobs {
                    look(&mut assets, &name, job, settle, common);
                }
            }
            Err(error) => tell_once(&mut trouble, &error),
        }
        std::thread::sleep(LOOK_EVERY);
    }
    // Ctrl-C is how it ends: what is on its way by then is told, not waited for.
    let lost = cache.iter().flat_map(|cache| cache.finish(|_| false));
    lost.for_each(|warning| anstream::eprintln!("{WARNING}warning{WARNING:#}: {warning}"));
    Ok(())
}

fn tell_once(told: &mut Option<String>, error: &Error) {
    let text = error.to_string();
    if told.as_ref() != Some(&text) {
        anstream::eprintln!("{ERROR}error{ERROR:#}: {text}");
        *told = Some(text);
    }
}

/// Looks at one asset, and builds it if it changed and has settled.
fn look(
    assets: &mut BTreeMap<String, Asset>,
    name: &str,
    job: Result<Job>,
    settle: Duration,
    common: Common,
) {
    let seen = match &job {
        Ok(job) => Seen {
            files: job.frames.iter().map(|file| (file.clone(), Stamp::of(file).ok())).collect(),
            made: Some((job.output.clone(), job.settings.clone(), job.pictures.max_flip)),
            trouble: None,
        },
        Err(error) => Seen { files: Vec::new(), made: None, trouble: Some(error.to_string()) },
    };
    let now = Instant::now();
    let asset = match assets.get_mut(name) {
        Some(asset) if asset.seen == seen => asset,
        _ => {
            assets.insert(name.to_owned(), Asset { seen, since: now, state: State::Waiting });
            return;
        }
    };
    if !asset.is_due(now, settle) {
        return;
    }
    asset.state = match job {
        Err(error) => {
            outln!("{TITLE}{name}{TITLE:#}: waiting: {error}");
            State::Done
        }
        Ok(job) => build_one(name, &job, asset.state, common),
    };
}

/// Builds and prints the one line, but for what was said `before`.
fn build_one(name: &str, job: &Job, before: State, common: Common) -> State {
    let start = Instant::now();
    let mut progress = Quiet::default();
    let outcome = build(job, &mut progress);
    let warnings = progress.0.iter().map(|w| format!("; {WARNING}{w}{WARNING:#}")).collect::<String>();
    match outcome {
        Err(Error::Cancelled(_)) => {}
        Err(Error::Vdb { path, .. } | Error::Changed(path)) if is_being_written(&path) => {
            return State::Waiting;
        }
        Err(Error::InUse(path)) => {
            if !matches!(before, State::InUse(_)) {
                let path = path.display();
                outln!("{TITLE}{name}{TITLE:#}: waiting: {path} is open in another program: close it there");
            }
            return State::InUse(Instant::now());
        }
        Err(error) => {
            outln!("{TITLE}{name}{TITLE:#}: {ERROR}kept the last good pack{ERROR:#}: {error}");
        }
        Ok(outcome) => {
            if let Some(report) = outcome.verification.as_ref().filter(|report| !report.ok) {
                let why = report.failures.first().map_or("", String::as_str);
                outln!(
                    "{TITLE}{name}{TITLE:#}: {ERROR}kept the last good pack{ERROR:#}: not verified: {why}"
                );
            } else if !common.quiet {
                let line = summary(&outcome);
                outln!(
                    "{TITLE}{name}{TITLE:#}: {line}, in {}{warnings}",
                    seconds(start.elapsed().as_secs_f64())
                );
            }
        }
    }
    State::Done
}

fn is_being_written(path: &std::path::Path) -> bool {
    let changed = std::fs::metadata(path).and_then(|m| m.modified());
    let age = changed.ok().and_then(|changed| SystemTime::now().duration_since(changed).ok());
    age.is_some_and(|age| age < STILL_WRITTEN)
}

fn summary(outcome: &Outcome) -> String {
    let pack = &outcome.summary;
    let frames = if pack.frames == 1 { "frame" } else { "frames" };
    let quality =
        outcome.verification.as_ref().map_or(String::new(), |r| format!(", {}", psnr(r.active.psnr)));
    let how = match outcome.made {
        Made::Unchanged => format!("{GOOD}up to date{GOOD:#}"),
        Made::Copied => format!("{GOOD}taken from the cache{GOOD:#}"),
        Made::Repacked => format!("{GOOD}packed anew{GOOD:#}"),
        Made::Built => match outcome.cache.get("outline") {
            Some(uses) => {
                let read = if uses.misses == 0 { "none".to_owned() } else { count(uses.misses) };
                format!("{GOOD}built{GOOD:#}, {read} of {} frames re-read", uses.hits + uses.misses)
            }
            None => format!("{GOOD}built{GOOD:#}"),
        },
    };
    format!("{how}: {} {frames}, {}{quality}", pack.frames, bytes(pack.file_bytes))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pack_that_is_in_use_is_tried_again_without_a_change_and_one_that_is_done_is_not() {
        let (start, settle) = (Instant::now(), Duration::from_secs(1));
        let is_due = |state, after| {
            let seen = Seen { files: Vec::new(), made: None, trouble: None };
            Asset { seen, since: start, state }.is_due(start + after, settle)
        };
        assert_eq!([0, 1].map(|s| is_due(State::Waiting, Duration::from_secs(s))), [false, true]);
        assert_eq!([1, 5].map(|s| is_due(State::InUse(start), Duration::from_secs(s))), [false, true]);
        assert!(!is_due(State::Done, Duration::from_secs(100)));
    }
}
