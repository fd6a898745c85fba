//! Strings the stages together.

mod allocation;
mod cached_bricks;
mod explain;
mod frames;
mod job;
mod memory;
mod reuse;

use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use crate::atomic_file::is_in_use;
use crate::cache::Cache;
use crate::error::{Error, Result};
use crate::pack::{FinishedPack, Grid, Pack, Provenance, Source};
pub use crate::progress::{Progress, Silent};
use crate::report::PackSummary;
pub use crate::report::model::Made;
use crate::settings::Settings;
use crate::stages::allocate::Allocation;
use crate::stages::metadata::{self, Digests, KnownDigests, SequenceInfo};
use crate::stages::quantise::{GridBricks, quantise};
use crate::stages::relayout::place;
use crate::stages::select::{Selection, select};
use crate::stages::serialise::{GridParts, Serialiser, compress_slab};
use crate::verify::{self, PictureSettings, Sources, VerifyReport};
use allocation::GridBuild;
pub use explain::{Explanation, StagePlan, explain};
use frames::Alter;
pub use job::{Job, Outcome, Resources, VerifyLevel};
use reuse::{Reuse, Reused};

/// Builds one pack, and verifies it as the job asks.
///
/// # Errors
/// The first thing that is wrong, with its file and grid. A report that is not ok is no error. In both
/// cases the output is what it was before.
pub fn build(job: &Job, progress: &mut dyn Progress) -> Result<Outcome> {
    build_with(job, None, progress)
}

/// The same from frames that pass through `alter` first, for measurements on input that is in no file. What is
/// altered cannot be verified against its files, and is not cached.
///
/// # Errors
/// As [`build`].
pub fn build_altered(job: &Job, alter: Alter, progress: &mut dyn Progress) -> Result<Outcome> {
    build_with(job, Some(alter), progress)
}

fn build_with(job: &Job, alter: Option<Alter>, progress: &mut dyn Progress) -> Result<Outcome> {
    let cache = job.cache.as_ref().filter(|_| alter.is_none());
    let mut outcome = build_cached(job, cache, alter, progress);
    if let Err(Error::Misled(what)) = &outcome {
        progress
            .warn(&format!("what the cache gave does not verify, so the pack is built without it: {what}"));
        outcome = build_cached(job, None, alter, progress);
    }
    // Also after an error: what was done until then is there for the next build.
    let warnings = cache.map(|cache| cache.flush()).unwrap_or_default();
    warnings.iter().for_each(|warning| progress.warn(warning));
    if let Ok(outcome) = &mut outcome {
        outcome.warnings.extend(warnings);
    }
    outcome
}

fn build_cached(
    job: &Job,
    cache: Option<&Arc<Cache>>,
    alter: Option<Alter>,
    progress: &mut dyn Progress,
) -> Result<Outcome> {
    // Those of a build before that failed are not this one's.
    cache.map(|cache| cache.take_uses());
    let mut clock = Clock::new();
    let (plan, mut warnings) = plan(job, progress)?;
    warn(job, &warnings, progress)?;
    clock.lap("metadata");

    let mut reuse = cache.map(|cache| Reuse::new(cache, &plan.provenance));
    // Without a cache a pack of ours that cannot be read is an error; with one it may be the cache's.
    let misled = |error: Error| match error {
        Error::Pack { source, .. } if cache.is_some() => Error::Misled(source.to_string()),
        error => error,
    };
    let reused = match &mut reuse {
        Some(reuse) => reuse.find(job, &plan.provenance, &progress.cancel_token())?,
        None => Reused::Nothing,
    };
    let (made, finished) = match reused {
        Reused::Unchanged => (Made::Unchanged, None),
        Reused::Pack(made, pack) => (made, Some(pack)),
        Reused::Nothing => (Made::Built, Some(run_stages(job, cache, alter, &plan, &mut clock, progress)?)),
    };
    let path = finished.as_ref().map_or(&*job.output, FinishedPack::path);
    if let (Some(reuse), Made::Built | Made::Repacked) = (&mut reuse, made) {
        reuse.keep(path)?;
    }
    clock.lap(if made == Made::Built { "encode and serialise" } else { "reuse" });

    let (pack, verification, was_verified) = match reuse.as_ref().and_then(|reuse| reuse.verification(job)) {
        Some(report) => (Pack::open(path).map_err(Error::pack(path)).map_err(misled)?, report, true),
        None => {
            let (pack, report) = verified(job, path, progress).map_err(misled)?;
            // An entry with a right digest may still be another's: a build without the cache tells whose fault it is.
            let failure = report.as_ref().and_then(|report| report.failures.first());
            if let Some(failure) = failure.filter(|_| cache.is_some_and(|cache| cache.gave_something())) {
                return Err(Error::Misled(failure.clone()));
            }
            if let Some(reuse) = &reuse {
                reuse.keep_verification(job, report.as_ref());
            }
            (pack, report, false)
        }
    };
    if reuse.is_some() && !Provenance::of(&pack).is_ok_and(|found| plan.provenance.is(&found)) {
        return Err(Error::Misled("the pack under its key is another one".to_owned()));
    }
    clock.lap("verify");
    let empty = empty_grids(&pack);
    warn(job, &empty, progress)?;
    warnings.extend(empty);
    let summary = PackSummary::new(&pack);
    // A mapped file cannot be renamed everywhere.
    drop(pack);
    if verification.as_ref().is_none_or(|report| report.ok) {
        finished.map_or(Ok(()), FinishedPack::persist)?;
    }
    let uses = cache.map(|cache| cache.take_uses()).unwrap_or_default();
    let seconds = clock.laps;
    Ok(Outcome { warnings, seconds, summary, verification, made, was_verified, cache: uses })
}

/// Tells what is odd, or ends a strict job by it.
fn warn(job: &Job, warnings: &[String], progress: &mut dyn Progress) -> Result<()> {
    if let Some(warning) = warnings.first().filter(|_| job.strict) {
        return Err(Error::Input(format!("{warning} (an error because of --strict)")));
    }
    warnings.iter().for_each(|warning| progress.warn(warning));
    Ok(())
}

/// A grid that was asked for and has nothing in any frame is likely another than was meant.
fn empty_grids(pack: &Pack) -> Vec<String> {
    let is_empty = |grid: &&Grid| grid.frames.iter().all(|frame| frame.record.active_voxels == 0);
    let warning = |grid: &Grid| format!("grid {:?} has no active voxels in any frame", grid.name);
    pack.grids().iter().filter(is_empty).map(warning).collect()
}

/// What a job comes to, as far as it can be told without a voxel.
struct Plan {
    sequence: SequenceInfo,
    selection: Selection,
    provenance: Provenance,
}

/// Stages 1 and 2, and what they found odd.
fn plan(job: &Job, progress: &mut dyn Progress) -> Result<(Plan, Vec<String>)> {
    check_output(job)?;
    progress.stage("metadata", job.frames.len() as u64, "files");
    let digests = Digests {
        known: job.cache.as_deref().map(|cache| cache as &dyn KnownDigests),
        paranoid: job.paranoid,
    };
    let sequence = metadata::read(&job.frames, digests)?;
    let selection = select(&sequence, &job.settings.grids, job.settings.integers)?;
    let warnings = [&sequence.warnings[..], &selection.warnings].concat();
    let provenance = provenance(&sequence, &job.settings);
    Ok((Plan { sequence, selection, provenance }, warnings))
}

/// Stages 3 to 8, in order. The cache is around them: what it has of frames and bricks is not made.
fn run_stages(
    job: &Job,
    cache: Option<&Arc<Cache>>,
    alter: Option<Alter>,
    plan: &Plan,
    clock: &mut Clock,
    progress: &mut dyn Progress,
) -> Result<FinishedPack> {
    let (Plan { sequence, selection, provenance }, settings) = (plan, &job.settings);
    progress.stage("flatten", sequence.frames.len() as u64, "frames");
    let trees = frames::read(job, plan, cache, alter, progress)?;
    clock.lap("flatten and dedup");
    // On a thread of the pool, since what follows goes to the pool some hundred times: from outside each time means to be
    // put to sleep and woken.
    rayon::scope(|_| {
        let cancel = progress.cancel_token();
        let caches = frames::caches(sequence, selection, settings, cache);
        let mut grids: Vec<GridBuild> = Vec::new();
        for ((grid, tree), cache) in selection.grids.iter().zip(trees).zip(caches) {
            let facts = grid.facts(sequence, settings.fps);
            grids.push(GridBuild::new(facts, tree, cache, settings, &cancel)?);
        }

        let allocations = allocation::allocate(&mut grids, settings, progress)?;
        for (grid, allocation) in grids.iter_mut().zip(&allocations) {
            if allocation.has_empty_bricks() {
                grid.tree.prune(|id| allocation.is_empty_brick(id))?;
            }
        }
        let placement = place(&allocations.iter().collect::<Vec<_>>());
        allocation::check_size(&grids, placement.bytes(), settings)?;
        // Written while slabs are encoded.
        grids.iter_mut().try_for_each(GridBuild::save)?;
        clock.lap("allocate");

        progress.stage("encode", grids.iter().map(|grid| u64::from(grid.tree.pool.len())).sum(), "bricks");
        let level = (settings.zstd != 0).then_some(settings.zstd);
        let parts = parts(&grids, &allocations);
        let mut serialiser = Serialiser::begin(&job.output, &parts, &placement, provenance, level)?;
        let bricks = |(grid, allocation): (_, _)| {
            let GridBuild { facts, tree, encoders, .. }: &mut GridBuild = grid;
            GridBricks { name: &facts.name, tree, allocation, encoders }
        };
        let mut bricks: Vec<GridBricks> = grids.iter_mut().zip(&allocations).map(bricks).collect();
        let encoded = quantise(
            &placement,
            &mut bricks,
            &cancel,
            |atlas, slab| compress_slab(atlas, slab, level).map_err(Error::io(&job.output)),
            |atlas, slab, chunk| {
                serialiser.slab(slab, &chunk)?;
                progress.advance(atlas.slab_bricks().into());
                Ok(())
            },
        )?;
        let finished = serialiser.finish(&self::parts(&grids, &allocations), &placement, &encoded)?;
        grids.iter_mut().try_for_each(GridBuild::save)?;
        Ok(finished)
    })
}

fn parts<'a>(grids: &'a [GridBuild], allocations: &'a [Allocation]) -> Vec<GridParts<'a>> {
    let each = grids.iter().zip(allocations);
    each.map(|(GridBuild { facts, tree, .. }, allocation)| GridParts { facts, tree, allocation }).collect()
}

/// Opens a pack and checks as much of it as the job asks.
fn verified(job: &Job, path: &Path, progress: &mut dyn Progress) -> Result<(Pack, Option<VerifyReport>)> {
    let pack = match job.verify {
        VerifyLevel::None => Pack::open(path).map_err(Error::pack(path))?,
        _ => check_structure(path)?,
    };
    if job.verify < VerifyLevel::Voxels {
        return Ok((pack, None));
    }
    let pictures = (job.verify == VerifyLevel::All).then_some(&job.pictures);
    let report = verify_against(&pack, &job.frames, pictures, &job.resources, progress)?;
    Ok((pack, Some(report)))
}

/// A slip in the arguments must not cost anyone a source file.
fn check_output(job: &Job) -> Result<()> {
    let Ok(output) = job.output.canonicalize() else { return Ok(()) };
    if job.frames.iter().any(|f| f.canonicalize().is_ok_and(|f| f == output)) {
        return Err(Error::Usage(format!(
            "{} is a source of the pack and its output too",
            job.output.display()
        )));
    }
    // Windows does not open folders.
    let is_pack = !output.is_dir() && is_pack(&output).map_err(|e| cannot_be_read(job, &e))?;
    if !is_pack {
        return Err(Error::Usage(format!(
            "{} exists and is not a pack: delete it, or choose another output",
            job.output.display()
        )));
    }
    Ok(())
}

/// Whether a file begins as packs do.
fn is_pack(path: &Path) -> std::io::Result<bool> {
    let mut magic = Vec::new();
    std::fs::File::open(path)?.take(crate::pack::layout::MAGIC.len() as u64).read_to_end(&mut magic)?;
    Ok(magic == crate::pack::layout::MAGIC)
}

/// An output of which nobody can tell whether it is a pack is not replaced.
fn cannot_be_read(job: &Job, error: &std::io::Error) -> Error {
    if is_in_use(error) {
        return Error::InUse(job.output.clone());
    }
    let why = format!("the output exists and cannot be read, so it is not replaced: {error}");
    Error::io(&job.output)(std::io::Error::new(error.kind(), why))
}

/// Compares a pack's voxels, and pictures where settings for them are given, with its sources.
///
/// # Errors
/// When a source is missing, changed or unreadable, or the pack is damaged. Differences are no error:
/// they are in the report.
pub fn verify_against(
    pack: &Pack,
    files: &[PathBuf],
    pictures: Option<&PictureSettings>,
    resources: &Resources,
    progress: &mut dyn Progress,
) -> Result<VerifyReport> {
    progress.stage("verify", files.len() as u64, "frames");
    let sources = Sources::find(pack, files)?;
    let at_once = memory::compared_at_once(pack, files, resources)?;
    let mut report = verify::voxels(pack, &sources, at_once, progress)?;
    if let Some(settings) = pictures {
        report.add_pictures(verify::pictures(pack, &sources, settings, &progress.cancel_token())?);
    }
    Ok(report)
}

/// Opens a pack and checks every byte of it that can be checked without its source.
///
/// # Errors
/// [`Error::Pack`].
pub fn check_structure(path: &Path) -> Result<Pack> {
    let pack = Pack::open(path).map_err(Error::pack(path))?;
    crate::pack::check_chunks(&pack).map_err(Error::pack(path))?;
    Ok(pack)
}

struct Clock {
    last: Instant,
    laps: Vec<(&'static str, f64)>,
}

impl Clock {
    fn new() -> Self {
        Self { last: Instant::now(), laps: Vec::new() }
    }

    fn lap(&mut self, name: &'static str) {
        let now = Instant::now();
        self.laps.push((name, (now - self.last).as_secs_f64()));
        self.last = now;
    }
}

fn provenance(sequence: &SequenceInfo, settings: &Settings) -> Provenance {
    let uses_block_encoder = settings.codec().is_none_or(|codec| codec.codec().is_blocks());
    Provenance {
        tool: env!("CARGO_PKG_NAME").to_owned(),
        version: env!("CARGO_PKG_VERSION").to_owned(),
        encoder_isa: uses_block_encoder.then(|| crate::codec::encoder_isa().to_owned()),
        settings: settings.clone(),
        sources: sequence
            .frames
            .iter()
            .map(|f| Source {
                file: f.file_name(),
                frame: f.number,
                bytes: f.stamp.bytes(),
                blake3: f.digest.to_hex().to_string(),
            })
            .collect(),
    }
}
