//! Every format and range on each volume, and the tree beside the thesis's layout.

use std::error::Error;
use std::path::PathBuf;
use std::time::Instant;

use volpack::codec::Codec;
use volpack::pack::Pack;
use volpack::pipeline::{Job, Silent, VerifyLevel, build};
use volpack::report::PackSummary;
use volpack::settings::{Format, RangeMode, Settings};

use crate::sequence;

#[derive(clap::Args)]
pub struct Args {
    /// Sequences: a file or a glob each
    #[arg(required = true)]
    sequences: Vec<PathBuf>,
    /// Write the raw figures here too
    #[arg(long)]
    json: Option<PathBuf>,
}

/// Builds and measures all of it.
pub fn bench(args: &Args) -> Result<(), Box<dyn Error>> {
    let folder = tempfile::tempdir()?;
    let mut rows = Vec::new();
    println!("| volume | format | range | GPU KiB | bits/voxel | PSNR dB | largest error / peak | build s |");
    println!("|---|---|---|---|---|---|---|---|");
    for sequence in &args.sequences {
        let (name, frames) = sequence::named(sequence)?;
        for format in Format::ALL {
            let normalised = format.codec().is_some_and(Codec::is_normalised);
            for range in [RangeMode::Brick, RangeMode::Sequence] {
                if range == RangeMode::Sequence && !normalised {
                    continue;
                }
                let settings = Settings { format, range, ..Settings::default() };
                let output = folder.path().join("bench.volpack");
                let mut job = Job::new(frames.clone(), output, settings, VerifyLevel::None);
                let start = Instant::now();
                build(&job, &mut Silent)?;
                let seconds = start.elapsed().as_secs_f64();
                job.verify = VerifyLevel::Voxels;
                let report = build(&job, &mut Silent)?.verification.ok_or("it was verified")?;
                let pack = PackSummary::new(&Pack::open(&job.output)?);
                let (range_name, grid) = (format!("{range:?}").to_lowercase(), &report.grids[0]);
                println!(
                    "| {name} | {} | {} | {:.0} | {:.2} | {} | {:.4} | {seconds:.3} |",
                    format.name(),
                    if normalised { range_name.as_str() } else { "" },
                    pack.gpu_bytes as f64 / 1024.0,
                    pack.bits_per_voxel,
                    grid.active.psnr.map_or("exact".to_owned(), |db| format!("{db:.2}")),
                    grid.active.max_error / grid.peak,
                );
                rows.push(serde_json::json!({ "volume": name, "format": format, "range": range, "seconds": seconds,
                    "pack": pack, "active": report.active, "all": report.all, "peak": grid.peak, "failures": report.failures.len() }));
            }
        }
        print_tree(&name, &rows)?;
    }
    if let Some(path) = &args.json {
        std::fs::write(path, serde_json::to_string(&rows)?)?;
    }
    Ok(())
}

/// The thesis's layout (its table 3): a frame has one L1 node of 4,100 bytes, all 32,768 L2 nodes of 516
/// bytes, and an L3 node of 68 bytes for each brick.
fn print_tree(name: &str, rows: &[serde_json::Value]) -> Result<(), Box<dyn Error>> {
    let pack = &rows.iter().rfind(|r| r["format"] == "unorm8").ok_or("a unorm8 row")?["pack"];
    let figure = |key: &str| pack[key].as_f64().ok_or("a figure");
    let thesis = figure("frames")? * (4100.0 + 32768.0 * 516.0) + figure("bricks")? * 68.0;
    println!(
        "| {name} | tree | | {:.1} | | | thesis's layout: {:.0} KiB, {:.0} times as much | |",
        figure("tree_bytes")? / 1024.0,
        thesis / 1024.0,
        thesis / figure("tree_bytes")?
    );
    Ok(())
}
