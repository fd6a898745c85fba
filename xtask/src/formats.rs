//! Measures every format and range on each volume, and compares the size of the tree with the thesis's layout.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::time::Instant;

use serde_json::json;
use volpack::pack::Pack;
use volpack::pipeline::{Job, Silent, VerifyLevel, build};
use volpack::report::PackSummary;
use volpack::settings::{Format, Quality, RangeMode, Settings};
use volpack::verify::VerifyReport;

use crate::{peer_programs, sequence};

#[derive(clap::Args)]
pub struct Args {
    /// Sequences, each a file or a glob
    #[arg(required = true)]
    sequences: Vec<PathBuf>,
    /// Print one row per format and one column per volume: bits per voxel and PSNR, with brick ranges
    #[arg(long)]
    brief: bool,
    /// Also write the raw figures to this JSON file
    #[arg(long)]
    json: Option<PathBuf>,
}

/// A format with its settings.
struct Way {
    name: String,
    range: Option<RangeMode>,
    settings: Settings,
}

/// A measured pack.
struct Measured {
    seconds: f64,
    pack: PackSummary,
    report: VerifyReport,
}

/// Builds and measures every format of every sequence.
pub fn bench(args: &Args) -> Result<(), Box<dyn Error>> {
    let folder = tempfile::tempdir()?;
    let sequences = args.sequences.iter().map(|s| sequence::named(s)).collect::<Result<Vec<_>, _>>()?;
    let mut rows = Vec::new();
    if args.brief {
        let names: Vec<&str> = sequences.iter().map(|(name, _)| name.as_str()).collect();
        println!("| format | {} |\n|---{}|", names.join(" | "), "|---".repeat(names.len()));
        for way in ways().iter().filter(|way| way.range != Some(RangeMode::Sequence)) {
            let mut line = format!("| {} |", way.name);
            for (_, frames) in &sequences {
                line += &format!(" {} |", brief(&measure(way, frames, folder.path())?));
            }
            println!("{line}");
        }
        return Ok(());
    }
    println!("| volume | format | range | GPU KiB | bits/voxel | PSNR dB | largest error / peak | build s |");
    println!("|---|---|---|---|---|---|---|---|");
    for (name, frames) in &sequences {
        for way in ways() {
            let Measured { seconds, pack, report } = measure(&way, frames, folder.path())?;
            let range = way.range.map(|range| format!("{range:?}").to_lowercase()).unwrap_or_default();
            let grid = &report.grids[0];
            println!(
                "| {name} | {} | {range} | {:.0} | {:.2} | {} | {:.4} | {seconds:.3} |",
                way.name,
                pack.gpu_bytes as f64 / 1024.0,
                pack.bits_per_voxel,
                grid.active.psnr.map_or("exact".to_owned(), |db| format!("{db:.2}")),
                grid.active.max_error / grid.peak,
            );
            if way.settings.format() == Format::UNORM8 && way.range == Some(RangeMode::Brick) {
                print_tree(name, &pack);
            }
            rows.push(json!({ "volume": name, "format": way.name, "range": range, "seconds": seconds, "pack": pack,
                "active": report.active, "all": report.all, "peak": grid.peak, "failures": report.failures.len() }));
        }
    }
    peer_programs::write(args.json.as_deref(), &json!(rows))
}

fn ways() -> Vec<Way> {
    let mut ways = Vec::new();
    for (name, quality) in
        [("adaptive (default)", Quality::default()), ("adaptive, 45 dB", Quality::Psnr(45.0))]
    {
        let settings = Settings { encoding: quality.into(), ..Settings::default() };
        ways.push(Way { name: name.to_owned(), range: None, settings });
    }
    for format in Format::ALL.into_iter().filter(|format| *format != Format::Adaptive) {
        let is_normalised = format.codec().is_some_and(|codec| codec.codec().is_normalised());
        for range in [RangeMode::Brick, RangeMode::Sequence] {
            if is_normalised || range == RangeMode::Brick {
                let settings = Settings { encoding: format.into(), range, ..Settings::default() };
                ways.push(Way {
                    name: format.name().to_owned(),
                    range: is_normalised.then_some(range),
                    settings,
                });
            }
        }
    }
    ways
}

fn measure(way: &Way, frames: &[PathBuf], folder: &Path) -> Result<Measured, Box<dyn Error>> {
    let output = folder.join("bench.volpack");
    let mut job = Job::new(frames.to_vec(), output, way.settings.clone(), VerifyLevel::None);
    let start = Instant::now();
    build(&job, &mut Silent)?;
    let seconds = start.elapsed().as_secs_f64();
    job.verify = VerifyLevel::Voxels;
    let report = build(&job, &mut Silent)?.verification.ok_or("the build returned no verification")?;
    Ok(Measured { seconds, pack: PackSummary::new(&Pack::open(&job.output)?), report })
}

fn brief(measured: &Measured) -> String {
    let psnr = measured.report.grids[0].active.psnr.map_or("exact".to_owned(), |db| format!("{db:.1} dB"));
    let refused = if measured.report.ok { "" } else { ", **refused**" };
    format!("{:.2} bits, {psnr}{refused}", measured.pack.bits_per_voxel)
}

/// The thesis's layout (its table 3): a frame has one L1 node of 4,100 bytes, all 32,768 L2 nodes of 516
/// bytes, and an L3 node of 68 bytes for each brick.
fn print_tree(name: &str, pack: &PackSummary) {
    let thesis = pack.frames as f64 * (4100.0 + 32768.0 * 516.0) + pack.bricks as f64 * 68.0;
    println!(
        "| {name} | tree | | {:.1} | | | thesis's layout: {:.0} KiB, {:.0} times as much | |",
        pack.tree_bytes as f64 / 1024.0,
        thesis / 1024.0,
        thesis / pack.tree_bytes as f64
    );
}
