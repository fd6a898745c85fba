//! Time and memory of a long sequence beside those of a short one.

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
    /// How often each build is measured, in turns; the median counts
    #[arg(long, default_value_t = 5)]
    rounds: usize,
    /// The volpack to run
    #[arg(long, default_value_os_t = peer_programs::volpack())]
    volpack: PathBuf,
    /// Write the raw figures here too
    #[arg(long)]
    json: Option<PathBuf>,
}

/// Each with what the table calls it.
const CASES: [(&str, &[&str]); 4] = [
    ("adaptive, 45 dB", &["--psnr", "45"]),
    ("bc7", &["--format", "bc7"]),
    ("unorm8", &["--format", "unorm8"]),
    ("f16", &["--format", "f16"]),
];

/// What a long sequence may take of what a short one does.
const MOST_MEMORY: f64 = 1.3;
const MOST_TIME: f64 = 1.1;
/// What cores may not fall below.
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
    /// The frames of a short sequence
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// How many times as long the long one is
    #[arg(long, default_value_t = 10)]
    repeats: usize,
}

impl Sequences {
    /// The files of the long one, and how many of them are the short one. Each repeat is moved and scaled so that nothing
    /// in it is in another.
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
            return Err("the long sequence could not be made".into());
        }
        Ok((volpack::manifest::expand(&[frames.join("*.vdb")])?, files.len()))
    }
}
