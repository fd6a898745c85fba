//! Compares time and memory of a long sequence with those of a short one.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::json;

use crate::peer_programs;
use crate::process_stats::{self, median};

#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    sequences: Sequences,
    /// Number of runs of each build, in turns; the median is printed
    #[arg(long, default_value_t = 5)]
    rounds: usize,
    /// Path of the volpack binary to run
    #[arg(long, default_value_os_t = peer_programs::volpack())]
    volpack: PathBuf,
    /// Also write the raw figures to this JSON file
    #[arg(long)]
    json: Option<PathBuf>,
}

/// The builds, each with its name in the table.
const CASES: [(&str, &[&str]); 4] = [
    ("adaptive, 45 dB", &["--psnr", "45"]),
    ("bc7", &["--format", "bc7"]),
    ("unorm8", &["--format", "unorm8"]),
    ("f16", &["--format", "f16"]),
];

/// Limits of the ratios between the long and the short sequence.
const MOST_MEMORY: f64 = 1.3;
const MOST_TIME: f64 = 1.1;
/// Minimum fraction of cores in use.
const LEAST_USE: f64 = 0.85;

pub fn bench(args: &Args) -> Result<(), Box<dyn Error>> {
    let folder = tempfile::tempdir()?;
    let (long, short) = args.sequences.make(folder.path())?;
    let short = &long[..short];
    let cores = std::thread::available_parallelism()?.get() as f64;
    let output = folder.path().join("bench.volpack");
    let mut rows = Vec::new();
    println!("{} and {} frames, {cores} cores\n", short.len(), long.len());
    println!(
        "| build | short s | long s | ratio / {} | short MiB | long MiB | ratio | long: cores in use |",
        args.sequences.repeats
    );
    println!("|---|---|---|---|---|---|---|---|");
    for (name, options) in CASES {
        let (mut shorts, mut longs) = (Vec::new(), Vec::new());
        for _ in 0..args.rounds {
            shorts.push(process_stats::run(&mut process_stats::build(
                &args.volpack,
                options,
                short,
                &output,
            ))?);
            longs.push(process_stats::run(&mut process_stats::build(
                &args.volpack,
                options,
                &long,
                &output,
            ))?);
        }
        let of = |figure: fn(&process_stats::Run) -> f64| {
            (median(shorts.iter().map(figure)), median(longs.iter().map(figure)))
        };
        let (short_s, long_s) = of(|run| run.seconds);
        let (short_mib, long_mib) = of(|run| run.peak_mib);
        let usage = median(longs.iter().map(|run| run.cpu_seconds / run.seconds)) / cores;
        let verdict = |met: bool| if met { "met" } else { "**missed**" };
        let (time, memory) = (long_s / short_s / args.sequences.repeats as f64, long_mib / short_mib);
        println!(
            "| {name} | {short_s:.3} | {long_s:.3} | {time:.2} ({}) | {short_mib:.1} | {long_mib:.1} | {memory:.2} ({}) | {:.0} % ({}) |",
            verdict(time <= MOST_TIME),
            verdict(memory <= MOST_MEMORY),
            usage * 100.0,
            verdict(usage >= LEAST_USE),
        );
        rows.push(json!({ "build": options, "short": shorts, "long": longs }));
    }
    peer_programs::write(
        args.json.as_deref(),
        &json!({ "frames": [short.len(), long.len()], "cores": cores, "rows": rows }),
    )
}

/// A short sequence and a long one made of it.
#[derive(clap::Args)]
pub struct Sequences {
    /// Files of the short sequence
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// Length of the long sequence, in repeats of the short one
    #[arg(long, default_value_t = 10)]
    repeats: usize,
}

impl Sequences {
    /// Returns the files of the long sequence, and how many of them are the short one. Each repeat is moved and scaled, so that
    /// no brick occurs twice.
    ///
    /// # Errors
    /// When OpenVDB is not installed.
    pub fn make(&self, folder: &Path) -> Result<(Vec<PathBuf>, usize), Box<dyn Error>> {
        let files = volpack::manifest::expand(&self.files)?;
        let program = peer_programs::compile_openvdb("benches/peers/repeat_openvdb.cpp")?;
        let frames = folder.join("frames");
        std::fs::create_dir(&frames)?;
        let status =
            Command::new(program).arg(&frames).arg(self.repeats.to_string()).args(&files).status()?;
        if !status.success() {
            return Err("repeat_openvdb failed to write the long sequence".into());
        }
        Ok((volpack::manifest::expand(&[frames.join("*.vdb")])?, files.len()))
    }
}
