//! Strings the stages together.

use std::path::{Path, PathBuf};
use std::time::Instant;

use rayon::prelude::*;

use crate::error::{Error, Result};
use crate::pack::{Pack, Provenance, Source};
use crate::report::PackSummary;
use crate::settings::{Format, Masks, NOT_WITH_ADAPTIVE, Quality, Settings};
use crate::stages::allocate::{self, AdaptiveGrid, AllocateError, Allocation, Target};
use crate::stages::dedup::{DedupError, MaskPolicy, SequenceTree};
use crate::stages::flatten::{Flattened, flatten};
use crate::stages::metadata::{self, FrameSource, SequenceInfo};
use crate::stages::quantise::QuantiseError;
use crate::stages::select::{SelectedGrid, Selection, find, select};
use crate::stages::serialise::{FrameInput, GridInput, SerialiseError, gpu_bytes, serialise, tree_bytes};
use crate::vdb::{GridClass, VdbFile, voxel_size};
use crate::verify::{self, PictureSettings, Sources, VerifyReport};
use crate::volume::FlatFrame;

/// How much a finished pack is checked.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, clap::ValueEnum)]
pub enum VerifyLevel {
    /// Not at all
    None,
    /// Digests, offsets, indices and counts
    Structure,
    /// Those, and every voxel against the source
    Voxels,
    /// Those, and pictures of pack and source
    #[default]
    All,
}

/// One pack to build.
#[derive(Clone, Debug)]
pub struct Job {
    /// The source files.
    pub frames: Vec<PathBuf>,
    /// Where the pack goes.
    pub output: PathBuf,
    /// How it is made.
    pub settings: Settings,
    /// Whether warnings are errors.
    pub strict: bool,
    /// How much is checked afterwards.
    pub verify: VerifyLevel,
    /// How pictures are compared.
    pub pictures: PictureSettings,
}

impl Job {
    /// A build whose warnings are warnings, with the usual pictures.
    pub fn new(frames: Vec<PathBuf>, output: PathBuf, settings: Settings, verify: VerifyLevel) -> Self {
        Self { frames, output, settings, strict: false, verify, pictures: PictureSettings::default() }
    }
}

/// Hears how a build is getting on. Called from one thread at a time.
pub trait Progress {
    /// A stage begins, which has that many steps of that kind.
    fn stage(&mut self, name: &'static str, steps: u64, unit: &'static str);
    /// That many more steps of the stage are done.
    fn advance(&mut self, steps: u64);
    /// Something is odd but does not stop the build.
    fn warn(&mut self, warning: &str);
}

/// Progress that nobody hears of.
pub struct Silent;

impl Progress for Silent {
    fn stage(&mut self, _: &'static str, _: u64, _: &'static str) {}
    fn advance(&mut self, _: u64) {}
    fn warn(&mut self, _: &str) {}
}

/// What a build did.
pub struct Outcome {
    /// What was odd.
    pub warnings: Vec<String>,
    /// Seconds by stage, in order.
    pub seconds: Vec<(&'static str, f64)>,
    /// What is in the pack.
    pub summary: PackSummary,
    /// What verification found, if voxels were compared.
    pub verification: Option<VerifyReport>,
}

/// Builds one pack, and verifies it as the job asks.
///
/// # Errors
/// The first thing that is wrong, with its file and grid. A report that is not ok is no error. In both
/// cases the output is what it was before.
pub fn build(job: &Job, progress: &mut dyn Progress) -> Result<Outcome> {
    build_altered(job, &|_| (), progress)
}

/// The same from frames that pass through `alter` first, for measurements on input that is in no file. What is
/// altered cannot be verified against its files.
///
/// # Errors
/// As [`build`].
pub fn build_altered(
    job: &Job,
    alter: &(dyn Fn(&mut FlatFrame) + Sync),
    progress: &mut dyn Progress,
) -> Result<Outcome> {
    check_output(job)?;
    if job.settings.format == Format::Adaptive && job.settings.clustering.is_some() {
        return Err(Error::Usage(NOT_WITH_ADAPTIVE.to_owned()));
    }
    let mut clock = Clock::new();
    progress.stage("metadata", job.frames.len() as u64, "files");
    let sequence = metadata::read(&job.frames)?;
    let selection = select(&sequence, &job.settings.grids)?;
    let warnings = [&sequence.warnings[..], &selection.warnings].concat();
    for warning in &warnings {
        if job.strict {
            return Err(Error::Input(format!("{warning} (an error because of --strict)")));
        }
        progress.warn(warning);
    }
    clock.lap("metadata");

    progress.stage("flatten", sequence.frames.len() as u64, "frames");
    let trees = flatten_and_dedup(&sequence, &selection, &job.settings, alter, progress)?;
    clock.lap("flatten and dedup");

    let each = selection.grids.iter().zip(trees);
    let mut grids: Vec<GridInput> =
        each.map(|(grid, tree)| grid_input(&sequence, grid, tree, &job.settings)).collect();
    allocate_all(&mut grids, &job.settings, progress)?;
    clock.lap("allocate");

    let provenance = provenance(&sequence, &job.settings);
    let bricks: u64 = grids.iter().map(|g| u64::from(g.tree.pool.len())).sum();
    progress.stage("encode", bricks, "bricks");
    let level = (job.settings.zstd != 0).then_some(job.settings.zstd);
    let finished = serialise(&job.output, &mut grids, &provenance, level, |bricks| progress.advance(bricks))
        .map_err(|e| serialise_error(e, &grids, &job.output))?;
    clock.lap("encode and serialise");

    let pack = match job.verify {
        VerifyLevel::None => Pack::open(finished.path()).map_err(Error::pack(finished.path()))?,
        _ => check_structure(finished.path())?,
    };
    let verification = if job.verify >= VerifyLevel::Voxels {
        let pictures = (job.verify == VerifyLevel::All).then_some(&job.pictures);
        Some(verify_against(&pack, &job.frames, pictures, progress)?)
    } else {
        None
    };
    clock.lap("verify");
    let summary = PackSummary::new(&pack);
    // A mapped file cannot be renamed everywhere.
    drop(pack);
    if verification.as_ref().is_none_or(|report| report.ok) {
        finished.persist().map_err(Error::io(&job.output))?;
    }
    Ok(Outcome { warnings, seconds: clock.laps, summary, verification })
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
    let mut magic = [0; 8];
    let is_pack =
        std::fs::File::open(&output).and_then(|mut f| std::io::Read::read_exact(&mut f, &mut magic)).is_ok()
            && magic == crate::pack::layout::MAGIC;
    if !is_pack {
        return Err(Error::Usage(format!(
            "{} exists and is not a pack: delete it, or choose another output",
            job.output.display()
        )));
    }
    Ok(())
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
    progress: &mut dyn Progress,
) -> Result<VerifyReport> {
    progress.stage("verify", files.len() as u64, "frames");
    let sources = Sources::find(pack, files)?;
    let mut report = verify::voxels(pack, &sources, |frames| progress.advance(frames))?;
    if let Some(settings) = pictures {
        report.add_pictures(verify::pictures(pack, &sources, settings)?);
    }
    Ok(report)
}

/// Opens a pack and checks every byte of it that can be checked without its source.
///
/// # Errors
/// [`Error::Pack`].
pub fn check_structure(path: &Path) -> Result<Pack> {
    let pack = Pack::open(path).map_err(Error::pack(path))?;
    pack.check_chunks().map_err(Error::pack(path))?;
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

/// Reads frames, as many at a time as there are threads, and adds them in order.
fn flatten_and_dedup(
    sequence: &SequenceInfo,
    selection: &Selection,
    settings: &Settings,
    alter: &(dyn Fn(&mut FlatFrame) + Sync),
    progress: &mut dyn Progress,
) -> Result<Vec<SequenceTree>> {
    let scratch = |e| Error::io(std::env::temp_dir())(e);
    let mut trees = selection
        .grids
        .iter()
        .map(|grid| SequenceTree::new(mask_policy(settings, grid.class)).map_err(scratch))
        .collect::<Result<Vec<_>>>()?;
    for window in sequence.frames.chunks(rayon::current_num_threads()) {
        let flat: Vec<_> = window.par_iter().map(|f| flatten_frame(f, selection, settings)).collect();
        for (frame, flat) in window.iter().zip(flat) {
            for ((tree, grid), flat) in trees.iter_mut().zip(&selection.grids).zip(flat?) {
                let Some(mut flat) = flat else { continue };
                alter(&mut flat.frame);
                tree.add(flat).map_err(|e| match e {
                    DedupError::Scratch { source } => scratch(source),
                    DedupError::Background { .. } => Error::Input(format!(
                        "{}: grid {:?}: {e}: export the whole sequence with one background",
                        frame.path.display(),
                        grid.name
                    )),
                })?;
            }
            progress.advance(1);
        }
    }
    Ok(trees)
}

/// The selected grids of one file; `None` for those that it does not have.
fn flatten_frame(
    frame: &FrameSource,
    selection: &Selection,
    settings: &Settings,
) -> Result<Vec<Option<Flattened>>> {
    let file = VdbFile::open(&frame.path).map_err(Error::vdb(&frame.path))?;
    let one = |grid: &SelectedGrid| {
        let found = find(&file.grids, &grid.name);
        found.map(|info| flatten(&file, &frame.path, info, settings.nonfinite)).transpose()
    };
    selection.grids.iter().map(one).collect()
}

fn mask_policy(settings: &Settings, class: GridClass) -> MaskPolicy {
    match (settings.masks, settings.format, class) {
        (Masks::Keep, ..) | (Masks::Auto, Format::F32, _) | (Masks::Auto, _, GridClass::LevelSet) => {
            MaskPolicy::Keep
        }
        (Masks::Auto, ..) => MaskPolicy::DropFog,
        (Masks::Drop, ..) => MaskPolicy::DropWhereBackground,
    }
}

fn grid_input(
    sequence: &SequenceInfo,
    grid: &SelectedGrid,
    tree: SequenceTree,
    settings: &Settings,
) -> GridInput {
    let frames = grid.frames.iter().map(|&i| {
        let frame = &sequence.frames[i];
        let info = find(&frame.grids, &grid.name).expect("the grid was selected in this frame");
        let transform = info.transform.matrix.expect("the grid was selected for its linear map");
        FrameInput { number: frame.number, source: i as u32, transform }
    });
    GridInput {
        name: grid.name.clone(),
        class: grid.class,
        fps: settings.fps.unwrap_or(0.0),
        frames: frames.collect(),
        tree,
        allocation: Allocation::default(),
    }
}

/// Decides how the bricks of every grid are coded.
fn allocate_all(grids: &mut [GridInput], settings: &Settings, progress: &mut dyn Progress) -> Result<()> {
    if let Some(codec) = settings.format.codec() {
        for g in 0..grids.len() {
            let tree = &mut grids[g].tree;
            let allocation = match &settings.clustering {
                None => {
                    allocate::uniform(tree, codec, settings.range).ok_or(AllocateError::TooWide { grid: g })
                }
                Some(clustering) => {
                    progress.stage("cluster", tree.pool.len().into(), "bricks");
                    allocate::clustered(tree, codec, settings.range, clustering).map_err(|e| e.in_grid(g))
                }
            };
            grids[g].allocation = allocation.map_err(|e| allocate_error(e, grids))?;
        }
        return Ok(());
    }
    let target = Target {
        quality: settings.quality,
        min_frame_psnr: settings.min_frame_psnr,
        range: settings.range,
        fixed_bytes: tree_bytes(grids).map_err(|e| Error::Unsupported(e.to_string()))?,
    };
    let bricks: u64 = grids.iter().map(|g| u64::from(g.tree.pool.len())).sum();
    progress.stage("allocate", bricks, "bricks");
    let mut candidates: Vec<AdaptiveGrid> = grids.iter_mut().map(adaptive_grid).collect();
    let allocations = allocate::adaptive(&mut candidates, &target, &mut |bricks| progress.advance(bricks));
    let allocations = allocations.map_err(|e| allocate_error(e, grids))?;
    grids.iter_mut().zip(allocations).for_each(|(grid, allocation)| grid.allocation = allocation);
    check_size(grids, settings.quality)
}

/// A size that the coarsest choice does not meet is an error that names the least.
fn check_size(grids: &[GridInput], quality: Quality) -> Result<()> {
    let leaves: u64 = grids.iter().flat_map(|g| &g.tree.frames).map(|f| f.stats.leaves).sum();
    let bits_of = |bytes: u64| if leaves == 0 { 0.0 } else { bytes as f64 / (64.0 * leaves as f64) };
    let bytes = gpu_bytes(grids).map_err(|e| Error::Unsupported(e.to_string()))?;
    match quality {
        Quality::Size(asked) if bytes > asked => Err(Error::Usage(format!(
            "size: {asked} bytes on the GPU cannot be reached, the least is {bytes}: raise it, or pack fewer frames"
        ))),
        Quality::BitsPerVoxel(asked) if bits_of(bytes) > asked => Err(Error::Usage(format!(
            "bits_per_voxel: {asked} cannot be reached, the least is {:.4}: raise it, or pack fewer frames",
            bits_of(bytes)
        ))),
        _ => Ok(()),
    }
}

fn allocate_error(error: AllocateError, grids: &[GridInput]) -> Error {
    match error {
        AllocateError::Io(source) => Error::io(std::env::temp_dir())(source),
        AllocateError::TooWide { grid } => Error::Input(format!(
            "grid {:?}: its values span more than an f32 can hold: scale the grid down before the export",
            grids[grid].name
        )),
        AllocateError::OutOfRange { grid, source } => {
            Error::OutOfRange { grid: grids[grid].name.clone(), source }
        }
    }
}

fn adaptive_grid(grid: &mut GridInput) -> AdaptiveGrid<'_> {
    let voxel_size = grid.frames.iter().map(|f| voxel_size(&f.transform)).fold(f64::INFINITY, f64::min);
    let is_level_set = grid.class == GridClass::LevelSet;
    AdaptiveGrid {
        sign_matters: is_level_set.then_some(verify::SIGN_MATTERS_VOXELS * voxel_size),
        voxel_size,
        tree: &mut grid.tree,
    }
}

fn provenance(sequence: &SequenceInfo, settings: &Settings) -> Provenance {
    let uses_block_encoder = matches!(settings.format, Format::Bc4 | Format::Bc7 | Format::Adaptive);
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
                bytes: f.bytes,
                blake3: f.digest.to_hex().to_string(),
            })
            .collect(),
    }
}

fn serialise_error(error: SerialiseError, grids: &[GridInput], output: &Path) -> Error {
    match error {
        SerialiseError::Io(source) | SerialiseError::Quantise(QuantiseError::Io(source)) => {
            Error::io(output)(source)
        }
        SerialiseError::Quantise(QuantiseError::OutOfRange { grid, source }) => {
            Error::OutOfRange { grid: grids[grid].name.clone(), source }
        }
        SerialiseError::TooLarge { .. } => Error::Unsupported(error.to_string()),
    }
}
