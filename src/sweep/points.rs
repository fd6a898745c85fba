//! One figure a setting: size, quality, build seconds, trace milliseconds.

use std::path::Path;
use std::time::Instant;

use super::field::{Bricks, Difference, Jumps};
use super::nanovdb::{self, NanoError, Quantise};
use super::steady::steady;
use super::{Method, Options, Skipped, Sweep, each};
use crate::component::Component;
use crate::error::{Error, Result};
use crate::pack::Pack;
use crate::pipeline::{Progress, Silent, build};
use crate::render::gpu::Gpu;
use crate::render::{Mode, Scene, View};
use crate::report::PackSummary;
use crate::report::chart::Point;
use crate::settings::Integers;
use crate::stages::flatten::{Flattened, flatten};
use crate::vdb::{Accessor, GridInfo, Tree, VdbFile, find_grid, with_scalar_type};
use crate::verify::{self, Sources};
use crate::volume::{Coord, ValueRange};

/// Tolerances of NanoVDB's FpN, as fractions of the range of values.
const FPN: [f64; 6] = [0.1, 0.05, 0.02, 0.01, 0.005, 0.002];

/// Measures every method, and NanoVDB beside them where its tool is installed.
///
/// # Errors
/// When a source cannot be read or packed.
pub fn measure(options: &Options, progress: &mut dyn Progress) -> Result<Sweep> {
    let scratch = tempfile::tempdir().map_err(Error::io(std::env::temp_dir()))?;
    let gpu = options.trace.and_then(|_| Gpu::shared().ok()).filter(|gpu| !gpu.is_software);
    let source = Reference::read(options)?;
    let methods = options.methods();
    let (mut points, mut skipped) =
        each(&methods, progress, |method| point(options, method, &source, scratch.path(), gpu))?;
    if nanovdb::is_installed() {
        progress.stage("NanoVDB", 3 + FPN.len() as u64, "settings");
        for (method, setting, quantise) in peers(source.peak) {
            match nano_point(options, &source, (method, &setting), &quantise, scratch.path()) {
                Ok(point) => points.push(point),
                Err(why) => {
                    skipped.push(Skipped {
                        method: format!("NanoVDB {method}"),
                        setting,
                        why: why.to_string(),
                    });
                }
            }
            progress.advance(1);
        }
    }
    Ok(Sweep { device: gpu.map(|gpu| gpu.name.clone()), points, skipped })
}

fn peers(peak: f64) -> Vec<(&'static str, String, Quantise)> {
    let mut peers = vec![
        ("fp4", "4 bits".to_owned(), Quantise::Fp4),
        ("fp8", "8 bits".to_owned(), Quantise::Fp8),
        ("fp16", "16 bits".to_owned(), Quantise::Fp16),
    ];
    peers.extend(
        FPN.map(|f| ("fpN", format!("tolerance {} %", f * 100.0), Quantise::FpN { absolute: f * peak })),
    );
    peers
}

/// What all methods are measured against.
struct Reference {
    grid: String,
    peak: f64,
    /// Some frames, by their place among the files.
    shown: Vec<(usize, Bricks)>,
    jumps: Jumps,
}

impl Reference {
    fn read(options: &Options) -> Result<Self> {
        let sequence =
            crate::stages::metadata::read(&options.frames, crate::stages::metadata::Digests::default())?;
        let grids: Vec<String> = options.grid.iter().cloned().collect();
        let selection = crate::stages::select::select(&sequence, &grids, Integers::Nearest)?;
        let grid = selection.grids[0].name.clone();
        // Blockiness is measured where pictures are taken.
        let shown = verify::shown_frames(sequence.frames.len());
        let (mut range, mut background) = (None, 0.0);
        let (mut jumps, mut kept) = (Jumps::default(), Vec::new());
        for (i, frame) in sequence.frames.iter().enumerate() {
            let Some(Flattened { frame: flat, background: outside }) =
                flat_frame(&frame.path, &grid, options)?
            else {
                continue;
            };
            background = outside;
            range = ValueRange::union_all(range.into_iter().chain(flat.stats.active_range));
            if shown.contains(&i) {
                let bricks = Bricks::of_source(&flat);
                jumps.add(&bricks.jumps());
                kept.push((i, bricks));
            }
        }
        let peak = ValueRange::peak(range, background);
        Ok(Self { grid, peak, shown: kept, jumps })
    }
}

/// One frame of the source; `None` if it lacks the grid.
pub(super) fn flat_frame(path: &Path, grid: &str, options: &Options) -> Result<Option<Flattened>> {
    let file = VdbFile::open(path).map_err(Error::vdb(path))?;
    let Some(info) = find_grid(&file.grids, grid) else { return Ok(None) };
    Ok(Some(flatten(&file, path, info, Component::Whole, options.nonfinite)?))
}

fn point(
    options: &Options,
    method: &Method,
    source: &Reference,
    folder: &Path,
    gpu: Option<&Gpu>,
) -> Result<Point> {
    let job = options.job(method, &options.frames, folder.join("sweep.volpack"));
    let mut seconds = f64::INFINITY;
    for _ in 0..options.repeats {
        let start = Instant::now();
        build(&job, &mut Silent)?;
        seconds = seconds.min(start.elapsed().as_secs_f64());
    }
    let pack = Pack::open(&job.output).map_err(Error::pack(&job.output))?;
    let report = verify::voxels(
        &pack,
        &Sources::find(&pack, &options.frames)?,
        rayon::current_num_threads(),
        &mut Silent,
    )?;
    let mut jumps = Jumps::default();
    for (place, bricks) in &source.shown {
        let Some(frame) = pack.grids()[0].frames.iter().position(|f| f.record.source as usize == *place)
        else {
            continue;
        };
        let decoded = pack.frame(0, frame).and_then(|reader| bricks.in_pack(&reader));
        jumps.add(&decoded.map_err(Error::pack(&job.output))?.jumps());
    }
    let trace_ms = match (gpu, options.trace) {
        (Some(gpu), Some(size)) => trace(gpu, &pack, size, options.repeats),
        _ => None,
    };
    let summary = PackSummary::new(&pack);
    let grid = &report.grids[0];
    let failures = report.failures.first().map(|f| format!("verification failed: {f}"));
    Ok(Point {
        volume: options.name.clone(),
        method: method.method.to_owned(),
        setting: method.setting.clone(),
        gpu_bytes: summary.gpu_bytes,
        bits_per_voxel: summary.bits_per_voxel,
        psnr: grid.active.psnr,
        max_error: grid.active.max_error / grid.peak,
        build_seconds: seconds,
        trace_ms,
        blockiness: Some(jumps.blockiness(&source.jumps)).filter(|b| b.is_finite()),
        failures: failures.into_iter().chain(super::blocky(&jumps, &source.jumps)).collect(),
    })
}

/// The milliseconds of the last frame's picture; `None` where the device cannot hold it, or times nothing.
fn trace(gpu: &Gpu, pack: &Pack, size: [u32; 2], repeats: u32) -> Option<f64> {
    let uploaded = gpu.upload(pack).ok()?;
    let grid = &pack.grids()[0];
    let frame = grid.frames.len() - 1;
    let bounds = pack.frame_tree(0, frame).bounds();
    let mode = if grid.is_level_set() { Mode::Depth } else { Mode::Density };
    let scene = Scene::new(grid, frame, &View::default(), mode, size);
    let place = [0, frame as u32];
    let timed = steady(repeats, |n| gpu.trace_timed(&uploaded, place, bounds, &scene, n).map(|(_, ms)| ms));
    timed.ok().map(|timed| timed.median()).filter(|ms| ms.is_finite())
}

/// A peer's figures, all frames together.
fn nano_point(
    options: &Options,
    source: &Reference,
    (method, setting): (&str, &str),
    quantise: &Quantise,
    folder: &Path,
) -> Result<Point, PeerError> {
    let (nvdb, back) = (folder.join("peer.nvdb"), folder.join("peer.vdb"));
    let (mut bytes, mut leaves, mut seconds) = (0, 0, 0.0);
    let mut error = Difference::default();
    for path in &options.frames {
        let converted = nanovdb::convert(path, &source.grid, quantise, &nvdb)?;
        bytes += converted.grid_bytes;
        leaves += converted.leaf_count;
        seconds += converted.seconds;
        nanovdb::back_to_vdb(&nvdb, &back)?;
        error.add(&difference(path, &back, &source.grid)?);
    }
    Ok(Point {
        volume: options.name.clone(),
        method: format!("NanoVDB {method}"),
        setting: setting.to_owned(),
        gpu_bytes: bytes,
        bits_per_voxel: bytes as f64 * 8.0 / (512.0 * leaves as f64),
        psnr: error.psnr(source.peak),
        max_error: error.max / source.peak,
        build_seconds: seconds,
        trace_ms: None,
        blockiness: None,
        failures: Vec::new(),
    })
}

/// Why a peer has no figure.
#[derive(Debug, thiserror::Error)]
pub enum PeerError {
    /// Its tool failed.
    #[error(transparent)]
    Tool(#[from] NanoError),
    /// A file cannot be read.
    #[error(transparent)]
    File(#[from] Error),
}

/// How far a grid of one OpenVDB file is from that of another, over the first one's active leaf voxels.
///
/// # Errors
/// When a file cannot be read or lacks the grid.
pub fn difference(source: &Path, other: &Path, grid: &str) -> Result<Difference> {
    let open = |path: &Path| VdbFile::open(path).map_err(Error::vdb(path));
    let (source_file, other_file) = (open(source)?, open(other)?);
    let info = |file: &VdbFile, path: &Path| -> Result<GridInfo> {
        let found = find_grid(&file.grids, grid).cloned();
        found.ok_or_else(|| Error::Input(format!("{}: there is no grid {grid:?}", path.display())))
    };
    let (a, b) = (info(&source_file, source)?, info(&other_file, other)?);
    let theirs: Tree<f32> = other_file.read_tree(&b).map_err(Error::vdb(other))?;
    let accessor = Accessor::new(&theirs);
    let mut out = Difference::default();
    with_scalar_type!(&a.value_type,
        T => {
            let tree = source_file.read_tree::<T>(&a).map_err(Error::vdb(source))?;
            for leaf in 0..tree.leaves.len() {
                for i in tree.leaves.masks[leaf].ones() {
                    let at = tree.leaves.origins[leaf].offset_by(Coord::child_offset(i, 3, 1));
                    let ours = crate::vdb::Scalar::to_f32(tree.leaves.values(leaf)[i]);
                    out.voxel(ours, accessor.get(at).0);
                }
            }
        },
        other => return Err(Error::Unsupported(format!("{}: grid {grid:?} is {}", source.display(), other.name())))
    );
    Ok(out)
}
