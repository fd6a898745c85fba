//! Work on volpack itself: benchmarks, checks against OpenVDB, mutation runs.
//!
//! `cargo run --release -p xtask -- help` lists the tasks. None of them is part of the tests: they need
//! peers from Debian (`libopenvdb-dev libboost-dev libtbb-dev libimath-dev g++`) or volumes of your own.

mod beside;
mod cache;
mod clusters;
mod corpus;
mod formats;
mod kmeans;
mod load;
mod mutate;
mod openvdb;
mod pages;
mod peers;
mod pictures;
mod process_stats;
mod read;
mod scale;
mod sequence;
mod size;
mod stress;
mod sweep;
mod trace;
mod wasm;

use std::error::Error;
use std::path::{Path, PathBuf};

use clap::{Parser, Subcommand};

#[derive(Parser)]
struct Cli {
    #[command(subcommand)]
    task: Task,
}

#[derive(Subcommand)]
enum Task {
    /// Measure, side by side with a peer or a setting
    #[command(subcommand)]
    Bench(Bench),
    /// Pack every sequence below some folders in every way, and list what was refused: run before each release
    Corpus(corpus::Args),
    /// Draw the chart of a sweep anew from its JSON
    Chart {
        /// The `sweep.json` of a `volpack sweep`
        json: PathBuf,
        /// The SVG to write
        svg: PathBuf,
    },
    /// Compare what volpack reads with what OpenVDB reads, on any files
    CheckOpenvdb {
        /// OpenVDB files
        #[arg(required = true)]
        files: Vec<PathBuf>,
    },
    /// Run mutated files and packs through every reader, in 1 GiB of memory and 10 s each
    Mutate(mutate::Args),
    /// Kill builds, damage the cache, run builds side by side: the packs must come out the same
    StressCache(stress::Args),
    /// Read the conformance packs in WebAssembly, under node, and compare with the same read natively
    Wasm,
    /// Read files once and print how long it took (what `bench read` runs)
    #[command(hide = true)]
    ReadOnce(read::OnceArgs),
}

#[derive(Subcommand)]
enum Bench {
    /// Run what the pages of docs/benchmarks and the README are made of, and write it into them
    All(pages::Args),
    /// Reading time and memory beside OpenVDB's C++ io::File
    Read(read::Args),
    /// Builds with a cache: cold, without a change, after an edit, at another quality, at another level of zstd
    Cache(cache::Args),
    /// A long sequence beside a short one: time, memory, cores in use
    Scale(scale::Args),
    /// Whole builds beside NanoVDB's converter, the BC7 stage beside its encoder, files beside zstd
    Peers(beside::Args),
    /// From a pack in the page cache to the bytes that a GPU is given, beside reading the .vdb
    Load(load::Args),
    /// Every format and range on each volume: bytes, PSNR, largest error, seconds; and the tree beside
    /// the thesis's layout
    Formats(formats::Args),
    /// What clustering gives and costs: the columns of the thesis's figure 19
    Clusters(clusters::Args),
    /// K-means of all bricks of a sequence beside linfa's own fit
    Kmeans(kmeans::Args),
    /// Bytes at equal PSNR beside NanoVDB's FpN and beside uniform bc7
    Size(size::Args),
    /// What each format costs the eye: FLIP, PSNR and RMSE of pictures of pack and source
    Pictures(pictures::Args),
    /// Milliseconds a frame on a GPU: every format, DDA and HDDA, at 1920 × 1080
    Trace(trace::Args),
    /// The charts of quality against size, build time and trace time, or of stability
    Sweep(sweep::Args),
}

fn main() -> Result<(), Box<dyn Error>> {
    match Cli::parse().task {
        Task::Bench(Bench::All(args)) => pages::bench(&args),
        Task::Bench(Bench::Read(args)) => read::bench(&args),
        Task::Bench(Bench::Cache(args)) => cache::bench(&args),
        Task::Bench(Bench::Scale(args)) => scale::bench(&args),
        Task::Bench(Bench::Peers(args)) => beside::bench(&args),
        Task::Bench(Bench::Load(args)) => load::bench(&args),
        Task::Bench(Bench::Formats(args)) => formats::bench(&args),
        Task::Bench(Bench::Clusters(args)) => clusters::bench(&args),
        Task::Bench(Bench::Kmeans(args)) => kmeans::bench(&args),
        Task::Bench(Bench::Size(args)) => size::bench(&args),
        Task::Bench(Bench::Pictures(args)) => pictures::bench(&args),
        Task::Bench(Bench::Trace(args)) => trace::bench(&args),
        Task::Bench(Bench::Sweep(args)) => sweep::bench(&args),
        Task::Corpus(args) => corpus::run(&args),
        Task::Chart { json, svg } => chart(&json, &svg),
        Task::CheckOpenvdb { files } => openvdb::check(&files),
        Task::StressCache(args) => stress::run(&args),
        Task::Mutate(args) => mutate::run(args),
        Task::Wasm => wasm::check(),
        Task::ReadOnce(args) => read::once(&args),
    }
}

fn chart(json: &Path, svg: &Path) -> Result<(), Box<dyn Error>> {
    let sweep: serde_json::Value = serde_json::from_slice(&std::fs::read(json)?)?;
    let points: Vec<volpack::report::chart::Point> = serde_json::from_value(sweep["points"].clone())?;
    let text = |key: &str| sweep[key].as_str().unwrap_or_default().to_owned();
    let subtitle = match sweep["device"].as_str() {
        Some(device) => format!(
            "{}; traced by {device} at {} × {}",
            text("machine"),
            sweep["trace"][0],
            sweep["trace"][1]
        ),
        None => text("machine"),
    };
    std::fs::write(svg, volpack::report::chart::sweep_svg(&text("volume"), &subtitle, &points)?)?;
    Ok(())
}
