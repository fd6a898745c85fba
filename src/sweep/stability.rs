//! How steady each method is: other seeds, frame orders, thread counts, and noise on the input.

use std::path::{Path, PathBuf};

use super::field::{Bricks, Difference, Jumps};
use super::noise::Noise;
use super::points::flat_frame;
use super::{Method, Options, Stability, each};
use crate::error::{Error, Result};
use crate::pack::{Pack, Provenance};
use crate::pipeline::{Progress, Silent, build_altered};
use crate::report::PackSummary;
use crate::report::chart::Spread;
use crate::settings::{Encoding, Integers, Quality};
use crate::stages::flatten::Flattened;
use crate::stages::metadata;
use crate::stages::select::select;
use crate::volume::ValueRange;

/// PSNR that differs by more from one repetition to another is a method that fails.
const STEADY_DB: f64 = 1.0;

/// One repetition.
#[derive(Clone, Debug, PartialEq)]
enum Variation {
    Threads(usize),
    /// The frames' numbers run the other way, or begin in the middle.
    Order(Order),
    Noise(Noise, u64),
    Seed(u64),
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Order {
    Reversed,
    Rotated,
}

/// What one repetition gave.
struct Run {
    psnr: f64,
    bits_per_voxel: f64,
    max_error: f64,
    jumps: [Jumps; 2],
    digest: blake3::Hash,
    variation: Variation,
}

fn variations(options: &Options, method: &Method) -> Vec<Variation> {
    // The first is what the others are compared with.
    let mut out: Vec<Variation> = [2, 1, 3].map(Variation::Threads).to_vec();
    if options.frames.len() > 1 {
        out.extend([Order::Reversed, Order::Rotated].map(Variation::Order));
    }
    for noise in [Noise::Ulp, Noise::Fraction(1e-3)] {
        out.extend([1, 2].map(|seed| Variation::Noise(noise, seed)));
    }
    if method.settings.clustering().is_some() {
        out.extend([1, 2, 3].map(Variation::Seed));
    }
    out
}

/// Repeats each method.
///
/// # Errors
/// When a source cannot be read or packed.
pub fn stability(options: &Options, methods: &[Method], progress: &mut dyn Progress) -> Result<Stability> {
    let scratch = tempfile::tempdir().map_err(Error::io(std::env::temp_dir()))?;
    // A grid that is not there is an error of the whole, not of each method.
    select(
        &metadata::read(&options.frames, metadata::Digests::default())?,
        &options.grid.iter().cloned().collect::<Vec<_>>(),
        Integers::Nearest,
    )?;
    let (spreads, skipped) = each(methods, progress, |method| spread(options, method, scratch.path()))?;
    Ok(Stability { spreads, skipped })
}

fn spread(options: &Options, method: &Method, folder: &Path) -> Result<Spread> {
    let runs: Vec<Run> = variations(options, method)
        .into_iter()
        .map(|variation| run(options, method, variation, folder))
        .collect::<Result<_>>()?;
    let range = |of: &dyn Fn(&Run) -> f64| {
        let each = runs.iter().map(of).filter(|v| !v.is_nan());
        each.fold((f64::INFINITY, f64::NEG_INFINITY), |(min, max), v| (min.min(v), max.max(v)))
    };
    let blockiness = |run: &Run| run.jumps[1].blockiness(&run.jumps[0]);
    let mut failures = Vec::new();
    let differs = |run: &&Run| matches!(run.variation, Variation::Threads(_)) && run.digest != runs[0].digest;
    if runs.iter().any(|run| differs(&run)) {
        failures.push("its bytes depend on the number of threads".to_owned());
    }
    let psnr = range(&|run| run.psnr);
    if psnr.1 - psnr.0 > STEADY_DB {
        failures.push(format!("PSNR differs by {:.1} dB from run to run", psnr.1 - psnr.0));
    }
    let max_error = range(&|run| run.max_error);
    if let Encoding::Adaptive { quality: Quality::MaxError(bound), .. } = method.settings.encoding
        && bound.fraction().is_some_and(|bound| max_error.1 > bound)
    {
        failures.push("its error is past the bound".to_owned());
    }
    failures.extend(runs.iter().find_map(|run| super::blocky(&run.jumps[1], &run.jumps[0])));
    Ok(Spread {
        volume: options.name.clone(),
        method: method.method.to_owned(),
        setting: method.setting.clone(),
        psnr,
        bits_per_voxel: range(&|run| run.bits_per_voxel),
        max_error,
        blockiness: range(&blockiness),
        runs: runs.len(),
        failures,
    })
}

fn run(options: &Options, method: &Method, variation: Variation, folder: &Path) -> Result<Run> {
    let (mut threads, mut noise) = (2, None);
    let mut frames = options.frames.clone();
    let mut method = method.clone();
    match variation {
        Variation::Threads(count) => threads = count,
        Variation::Order(order) => frames = renumbered(&options.frames, order, folder)?,
        Variation::Noise(of, seed) => noise = Some((of, seed)),
        Variation::Seed(seed) => {
            if let Encoding::Uniform { clustering: Some(clustering), .. } = &mut method.settings.encoding {
                clustering.seed = seed;
            }
        }
    }
    let alter = |frame: &mut crate::volume::FlatFrame| {
        if let Some((noise, seed)) = noise {
            noise.apply(frame, seed);
        }
    };
    let job = options.job(&method, &frames, folder.join("stability.volpack"));
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
    let pool = pool.map_err(|e| Error::Other(e.to_string()))?;
    pool.install(|| build_altered(&job, &alter, &mut Silent))?;

    let pack = Pack::open(&job.output).map_err(Error::pack(&job.output))?;
    let bytes = std::fs::read(&job.output).map_err(Error::io(&job.output))?;
    let provenance = Provenance::of(&pack).map_err(Error::provenance(&pack))?;
    let grid = &pack.grids()[0];
    let (mut difference, mut range) = (Difference::default(), None);
    let mut jumps = [Jumps::default(); 2];
    for (f, frame) in grid.frames.iter().enumerate() {
        let name = &provenance.source(&frame.record).map_err(Error::provenance(&pack))?.file;
        let path = frames.iter().find(|p| p.file_name().is_some_and(|n| n == name.as_str()));
        let path = path.ok_or_else(|| Error::Other(format!("{name} is not among the files")))?;
        let Some(Flattened { frame: mut flat, .. }) = flat_frame(path, &grid.name, options)? else {
            continue;
        };
        alter(&mut flat);
        range = ValueRange::union_all(range.into_iter().chain(flat.stats.active_range));
        let source = Bricks::of_source(&flat);
        let reader = pack.frame(0, f).map_err(Error::pack(&job.output))?;
        let packed = source.in_pack(&reader).map_err(Error::pack(&job.output))?;
        // Leaves of one value are no bricks: they are exact, and count.
        let bricks = source.difference(&packed);
        difference.add(&Difference { voxels: flat.stats.active_leaf_voxels, ..bricks });
        jumps[0].add(&source.jumps());
        jumps[1].add(&packed.jumps());
    }
    let peak = ValueRange::peak(range, grid.background);
    Ok(Run {
        psnr: difference.psnr(peak).unwrap_or(f64::INFINITY),
        bits_per_voxel: PackSummary::new(&pack).bits_per_voxel,
        max_error: difference.max / peak,
        jumps,
        digest: blake3::hash(&bytes),
        variation,
    })
}

/// Copies of the files whose numbers are in another order.
fn renumbered(files: &[PathBuf], order: Order, folder: &Path) -> Result<Vec<PathBuf>> {
    let folder = folder.join(format!("{order:?}"));
    std::fs::create_dir_all(&folder).map_err(Error::io(&folder))?;
    let count = files.len();
    let place = |i: usize| match order {
        Order::Reversed => count - 1 - i,
        Order::Rotated => (i + count / 2) % count,
    };
    let copy = |(i, file): (usize, &PathBuf)| {
        let to = folder.join(format!("frame_{:05}.vdb", place(i)));
        std::fs::copy(file, &to).map_err(Error::io(file))?;
        Ok(to)
    };
    files.iter().enumerate().map(copy).collect()
}
