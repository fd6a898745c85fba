//! Tasks for developers of volpack: benchmarks, comparison with OpenVDB, mutation runs, the build for Windows.
//!
//! `cargo run --release -p xtask -- help` lists the tasks. They are not part of the tests, because they need
//! packages of Debian (`libopenvdb-dev libboost-dev libtbb-dev libimath-dev g++`) or your own volumes.

mod cache;
mod clusters;
mod corpus;
mod formats;
mod kmeans;
mod layouts;
mod load;
mod mutate;
mod openvdb;
mod pages;
mod peer_programs;
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
mod windows;
mod wine;
mod wine_prefix;

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
    /// Measure volpack, and compare it with other programs or settings
    #[command(subcommand)]
    Bench(Bench),
    /// Build every sequence below the given folders with every setting, and list the refused builds. Run it before each release
    Corpus(corpus::Args),
    /// Redraw the chart of a sweep from its JSON
    Chart {
        /// The `sweep.json` that `volpack sweep` wrote
        json: PathBuf,
        /// SVG file to write
        svg: PathBuf,
    },
    /// Read files with volpack and with OpenVDB, and compare the results
    CheckOpenvdb {
        /// OpenVDB files
        #[arg(required = true)]
        files: Vec<PathBuf>,
    },
    /// Feed damaged files and packs to every reader, each with at most 1 GiB of memory and 10 s
    Mutate(mutate::Args),
    /// Kill builds, damage the cache and run builds in parallel, and check that the packs stay the same
    StressCache(stress::Args),
    /// Read the conformance packs in WebAssembly under node, and compare with the same read natively
    Wasm,
    /// Cross-build volpack.exe on Linux with MinGW, and check that it needs only DLLs of Windows
    Windows(windows::Args),
    /// Read files and print the time (`bench read` runs this)
    #[command(hide = true)]
    ReadOnce(read::OnceArgs),
}

#[derive(Subcommand)]
enum Bench {
    /// Run the benchmarks of docs/benchmarks and the README, and write the results into these pages
    All(pages::Args),
    /// Time and memory of reading, compared with OpenVDB's C++ io::File
    Read(read::Args),
    /// Build time with a cache: cold, without a change, after an edit, at another quality, at another zstd level
    Cache(cache::Args),
    /// Time, memory and cores in use of a long sequence, compared with a short one
    Scale(scale::Args),
    /// Whole builds compared with NanoVDB's converter, the BC7 stage with its encoder, file sizes with zstd
    Peers(peers::Args),
    /// Time to load a pack from the page cache to the bytes for the GPU, compared with reading the .vdb
    Load(load::Args),
    /// Every format and range on each volume: bytes, PSNR, maximum error, seconds; and the size of the tree,
    /// compared with the thesis's layout
    Formats(formats::Args),
    /// Bricks saved by k-means clustering, and its error: the columns of the thesis's figure 19
    Clusters(clusters::Args),
    /// K-means of all bricks of a sequence, compared with linfa's
    Kmeans(kmeans::Args),
    /// Bytes at equal PSNR, compared with NanoVDB's FpN and with uniform bc7
    Size(size::Args),
    /// Visual quality of each format: FLIP, PSNR and RMSE between pictures of pack and source
    Pictures(pictures::Args),
    /// Milliseconds per frame on a GPU: every format, with DDA and HDDA, at 1920 × 1080
    Trace(trace::Args),
    /// Milliseconds per frame on a GPU: brick layouts that the next pack format might have, sampled with trilinear
    /// filtering, with their bytes, seams and PSNR
    Layouts(layouts::Args),
    /// Charts of quality against size, build time and trace time, or of stability
    Sweep(sweep::Args),
}

fn main() -> Result<(), Box<dyn Error>> {
    match Cli::parse().task {
        Task::Bench(Bench::All(args)) => pages::bench(&args),
        Task::Bench(Bench::Read(args)) => read::bench(&args),
        Task::Bench(Bench::Cache(args)) => cache::bench(&args),
        Task::Bench(Bench::Scale(args)) => scale::bench(&args),
        Task::Bench(Bench::Peers(args)) => peers::bench(&args),
        Task::Bench(Bench::Load(args)) => load::bench(&args),
        Task::Bench(Bench::Formats(args)) => formats::bench(&args),
        Task::Bench(Bench::Clusters(args)) => clusters::bench(&args),
        Task::Bench(Bench::Kmeans(args)) => kmeans::bench(&args),
        Task::Bench(Bench::Size(args)) => size::bench(&args),
        Task::Bench(Bench::Pictures(args)) => pictures::bench(&args),
        Task::Bench(Bench::Trace(args)) => trace::bench(&args),
        Task::Bench(Bench::Layouts(args)) => layouts::bench(&args),
        Task::Bench(Bench::Sweep(args)) => sweep::bench(&args),
        Task::Corpus(args) => corpus::run(&args),
        Task::Chart { json, svg } => chart(&json, &svg),
        Task::CheckOpenvdb { files } => openvdb::check(&files),
        Task::StressCache(args) => stress::run(&args),
        Task::Mutate(args) => mutate::run(args),
        Task::Wasm => wasm::check(),
        Task::Windows(args) => windows::run(&args),
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
