//! Measures loading: from a pack in the page cache to the bytes for the GPU.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::time::Instant;

use rayon::prelude::*;
use serde_json::json;
use volpack::pack::Pack;
use volpack::pipeline::{Job, Silent, VerifyLevel, build};
use volpack::settings::{Format, Quality, Settings};
use volpack::vdb::VdbFile;

use crate::peer_programs;
use crate::process_stats::median;
use crate::scale::Sequences;

#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    sequences: Sequences,
    /// Number of runs of each load; the median is printed
    #[arg(long, default_value_t = 25)]
    rounds: usize,
    /// Also write the raw figures to this JSON file
    #[arg(long)]
    json: Option<PathBuf>,
}

pub fn bench(args: &Args) -> Result<(), Box<dyn Error>> {
    let folder = tempfile::tempdir()?;
    let (long, short) = args.sequences.make(folder.path())?;
    let short = &long[..short];
    let mut rows = Vec::new();
    println!(
        "{} and {} frames, {} threads, medians\n",
        short.len(),
        long.len(),
        rayon::current_num_threads()
    );
    println!(
        "| format | frames | file MB | GPU MB | whole pack ms | GB/s of GPU bytes | open ms | one more frame ms | its .vdb ms |"
    );
    println!("|---|---|---|---|---|---|---|---|---|");
    for format in [Format::Adaptive, Format::BC7, Format::UNORM8, Format::F16] {
        for frames in [short, &long[..]] {
            let path = folder.path().join("bench.volpack");
            let encoding = match format {
                Format::Adaptive => Quality::Psnr(45.0).into(),
                uniform => uniform.into(),
            };
            let settings = Settings { encoding, ..Settings::default() };
            build(&Job::new(frames.to_vec(), path.clone(), settings, VerifyLevel::None), &mut Silent)?;
            let pack = Pack::open(&path)?;
            let (file_bytes, gpu_bytes) = (pack.file_bytes() as f64, pack.gpu_bytes() as f64);
            // The densest frame.
            let leaves = |frame: &usize| pack.grids()[0].frames[*frame].record.leaves;
            let frame = (0..frames.len()).max_by_key(leaves).ok_or("no frames")?;
            let (mut whole, mut open, mut one, mut vdb) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
            for _ in 0..args.rounds {
                whole.push(timed(|| load(&path))?);
                open.push(timed(|| Pack::open(&path))?);
                // Opened again, because a pack does not check a chunk twice.
                let fresh = Pack::open(&path)?;
                one.push(timed(|| fresh.frame(0, frame))?);
                vdb.push(timed(|| read(&frames[frame]))?);
            }
            let ms = |seconds: &[f64]| median(seconds.iter().copied()) * 1e3;
            println!(
                "| {} | {} | {:.2} | {:.2} | {:.2} | {:.2} | {:.2} | {:.2} | {:.2} |",
                format.name(),
                frames.len(),
                file_bytes / 1e6,
                gpu_bytes / 1e6,
                ms(&whole),
                gpu_bytes / 1e9 / median(whole.iter().copied()),
                ms(&open),
                ms(&one),
                ms(&vdb),
            );
            rows.push(json!({ "format": format, "frames": frames.len(), "file_bytes": file_bytes,
                "gpu_bytes": gpu_bytes, "whole": whole, "open": open, "frame": one, "vdb": vdb }));
        }
    }
    peer_programs::write(
        args.json.as_deref(),
        &json!({ "threads": rayon::current_num_threads(), "rows": rows }),
    )
}

/// Loads all data for the GPU: the tree and each slab of each atlas, checked and decompressed.
fn load(path: &Path) -> Result<(), Box<dyn Error>> {
    let pack = Pack::open(path)?;
    let slabs: Vec<_> =
        pack.atlases().iter().flat_map(|a| (0..a.slabs).map(|slab| (a.codec, slab))).collect();
    slabs.into_par_iter().try_for_each(|(codec, slab)| pack.slab(codec, slab).map(drop))?;
    Ok(())
}

fn read(path: &Path) -> Result<(), Box<dyn Error>> {
    let file = VdbFile::open(path)?;
    let grid = file.grids.first().ok_or("no grid")?;
    file.read_tree::<f32>(grid)?;
    Ok(())
}

fn timed<T, E: Into<Box<dyn Error>>>(work: impl FnOnce() -> Result<T, E>) -> Result<f64, Box<dyn Error>> {
    let start = Instant::now();
    work().map(drop).map_err(Into::into)?;
    Ok(start.elapsed().as_secs_f64())
}
