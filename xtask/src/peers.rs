//! Compares whole builds with NanoVDB's converter, our BC7 stage with the encoder that it calls, and file sizes with the sources and zstd.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Instant;

use intel_tex_2::RgbaSurface;
use rayon::prelude::*;
use serde_json::{Value as Json, json};
use volpack::codec::{BATCH, BrickRange, SequenceRange, TexelCodec, Texels, encode};
use volpack::pipeline::{Job, Silent, VerifyLevel, build};
use volpack::settings::{Format, Quality, Settings};
use volpack::sweep::nanovdb::{self, Quantise};
use volpack::sweep::{Difference, difference};
use volpack::vdb::VdbFile;
use volpack::volume::{Mask512, ValueRange};

use crate::peer_programs;
use crate::process_stats::{self, Run, median};

#[derive(clap::Args)]
pub struct Args {
    /// Files of one sequence of float grids
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// Number of runs of each program, in turns; the median is printed
    #[arg(long, default_value_t = 9)]
    rounds: usize,
    /// Path of the volpack binary to run
    #[arg(long, default_value_os_t = peer_programs::volpack())]
    volpack: PathBuf,
    /// Name of the grid to use
    #[arg(long, default_value = "density")]
    grid: String,
    /// Also write the raw figures to this JSON file
    #[arg(long)]
    json: Option<PathBuf>,
}

/// Default tolerance of `nanovdb_convert --fpN` for fog.
pub const TOLERANCE: f64 = 0.01;

pub fn bench(args: &Args) -> Result<(), Box<dyn Error>> {
    let folder = tempfile::tempdir()?;
    let files = volpack::manifest::expand(&args.files)?;
    let mut figures = json!({});
    if nanovdb::is_installed() {
        figures["builds"] = builds(args, &files, folder.path())?;
    } else {
        println!(
            "NanoVDB is not installed, so whole builds are not measured: apt-get install libnanovdb-tools"
        );
    }
    figures["bc7"] = blocks(&files, args)?;
    println!("\nTo compare reading .vdb files with OpenVDB: `xtask bench read`");
    peer_programs::write(args.json.as_deref(), &figures)
}

/// One way to convert a sequence.
struct Side {
    name: &'static str,
    /// Index of the peer that it is compared with, and the limit of its time divided by the peer's.
    peer: Option<(usize, f64)>,
    runs: Vec<Run>,
    bytes: u64,
    psnr: Option<f64>,
}

fn builds(args: &Args, files: &[PathBuf], folder: &Path) -> Result<Json, Box<dyn Error>> {
    let (nvdb, pack) = (folder.join("peer.nvdb"), folder.join("ours.volpack"));
    let tolerance = TOLERANCE.to_string();
    let convert = |options: &[&str]| {
        let mut command = Command::new("nanovdb_convert");
        command.args(options).args(["-f", "-g", &args.grid]).args(files).arg(&nvdb);
        command
    };
    let ours = |options: &[&str]| {
        let grid = [&["-g", &args.grid], options].concat();
        process_stats::build(&args.volpack, &grid, files, &pack)
    };
    let side = |name, peer| Side { name, peer, runs: Vec::new(), bytes: 0, psnr: None };
    let mut sides = [
        (side("nanovdb_convert --fp8", None), convert(&["--fp8"])),
        (side("nanovdb_convert --fpN", None), convert(&["--fpN", "-a", &tolerance])),
        (side("volpack f16, raw", Some((0, 1.0))), ours(&["--format", "f16", "--zstd", "0"])),
        (side("volpack unorm8, raw", Some((0, 1.0))), ours(&["--format", "unorm8", "--zstd", "0"])),
        (side("volpack adaptive, 45 dB", Some((1, 6.0))), ours(&["--psnr", "45"])),
    ];
    for round in 0..args.rounds {
        for (side, command) in &mut sides {
            side.runs.push(process_stats::run(command)?);
            if round == 0 {
                side.bytes = if side.peer.is_some() { &pack } else { &nvdb }.metadata()?.len();
            }
        }
    }
    let (peak, psnrs) = our_psnrs(args, files, &pack)?;
    for ((side, _), psnr) in sides[2..].iter_mut().zip(psnrs) {
        side.psnr = psnr;
    }
    for (i, quantise) in [Quantise::Fp8, Quantise::FpN { absolute: TOLERANCE }].iter().enumerate() {
        sides[i].0.psnr = their_psnr(args, files, quantise, peak, folder)?;
    }
    println!(
        "| {} frames | ms | time / peer's | limit | peak MiB | file MB | size / peer's | PSNR dB |",
        files.len()
    );
    println!("|---|---|---|---|---|---|---|---|");
    for (side, _) in &sides {
        let seconds = median(side.runs.iter().map(|run| run.seconds));
        let peer = side.peer.map(|(peer, limit)| (&sides[peer].0, limit));
        let [time, limit, bytes] = peer.map_or_else(Default::default, |(peer, limit)| {
            let time = seconds / median(peer.runs.iter().map(|run| run.seconds));
            let verdict = if time <= limit { "met" } else { "**missed**" };
            let bytes = side.bytes as f64 / peer.bytes as f64;
            [format!("{time:.2}"), format!("{limit:.1}: {verdict}"), format!("{bytes:.2}")]
        });
        println!(
            "| {} | {:.1} | {time} | {limit} | {:.1} | {:.2} | {bytes} | {} |",
            side.name,
            seconds * 1e3,
            median(side.runs.iter().map(|run| run.peak_mib)),
            side.bytes as f64 / 1e6,
            side.psnr.map_or("exact".to_owned(), |db| format!("{db:.2}")),
        );
    }
    let on_disk = on_disk(files, &nvdb, sides[4].0.bytes)?;
    let row = |(side, _): &(Side, Command)| json!({ "name": side.name, "runs": side.runs, "bytes": side.bytes, "psnr": side.psnr });
    Ok(json!({ "sides": sides.iter().map(row).collect::<Vec<_>>(), "on_disk": on_disk }))
}

/// The peak value, and the PSNR of each build against it; `None` if the build is exact.
type Psnrs = (f64, Vec<Option<f64>>);

/// Builds with each of our formats and returns the PSNRs.
fn our_psnrs(args: &Args, files: &[PathBuf], pack: &Path) -> Result<Psnrs, Box<dyn Error>> {
    let (mut peak, mut psnrs) = (0.0, Vec::new());
    for format in [Format::F16, Format::UNORM8, Format::Adaptive] {
        let encoding = match format {
            Format::Adaptive => Quality::Psnr(45.0).into(),
            uniform => uniform.into(),
        };
        let settings = Settings { encoding, grids: vec![args.grid.clone()], ..Settings::default() };
        let job = Job::new(files.to_vec(), pack.to_owned(), settings, VerifyLevel::Voxels);
        let report = build(&job, &mut Silent)?.verification.ok_or("the build returned no verification")?;
        peak = report.grids[0].peak;
        psnrs.push(report.grids[0].active.psnr);
    }
    Ok((peak, psnrs))
}

fn their_psnr(
    args: &Args,
    files: &[PathBuf],
    quantise: &Quantise,
    peak: f64,
    folder: &Path,
) -> Result<Option<f64>, Box<dyn Error>> {
    let (nvdb, back) = (folder.join("frame.nvdb"), folder.join("frame.vdb"));
    let mut error = Difference::default();
    for file in files {
        nanovdb::convert(file, &args.grid, quantise, &nvdb)?;
        nanovdb::back_to_vdb(&nvdb, &back)?;
        error.add(&difference(file, &back, &args.grid)?);
    }
    Ok(error.psnr(peak))
}

/// Prints file sizes: the sources, NanoVDB's file compressed with zstd -19, and our pack.
fn on_disk(files: &[PathBuf], nvdb: &Path, ours: u64) -> Result<Json, Box<dyn Error>> {
    let sources: u64 = files.iter().map(|file| Ok(file.metadata()?.len())).sum::<std::io::Result<u64>>()?;
    println!("\n| file size | MB |\n|---|---|");
    println!("| sources | {:.2} |", sources as f64 / 1e6);
    println!("| volpack adaptive, 45 dB | {:.2} |", ours as f64 / 1e6);
    // `nvdb` has the output of the last converter run, which was --fpN.
    let packed = Command::new("zstd").args(["-19", "-q", "-c"]).arg(nvdb).stderr(Stdio::null()).output();
    let packed = packed.ok().filter(|output| output.status.success()).map(|output| output.stdout.len());
    match packed {
        Some(bytes) => println!("| nanovdb_convert --fpN, then zstd -19 | {:.2} |", bytes as f64 / 1e6),
        None => {
            println!("zstd is not installed, so the compressed .nvdb is not measured: apt-get install zstd")
        }
    }
    Ok(json!({ "sources": sources, "ours": ours, "fpn_zstd_19": packed }))
}

/// Minimum throughput of our BC7 stage, as a fraction of the encoder's alone on the same texels.
const LEAST_THROUGHPUT: f64 = 0.8;

/// Compares our BC7 stage, which tries three packing axes and uses the best, with three calls of the encoder alone.
fn blocks(files: &[PathBuf], args: &Args) -> Result<Json, Box<dyn Error>> {
    let sequence = SequenceRange::around(0.0, 1.0).ok_or("a range")?;
    let mut bricks: Vec<Texels> = Vec::new();
    for path in files {
        let file = VdbFile::open(path)?;
        let grid = file.grids.iter().find(|g| g.name == args.grid).ok_or("no such grid")?;
        let tree = file.read_tree::<f32>(grid)?;
        for leaf in 0..tree.leaves.len() {
            let values = *tree.leaves.values(leaf);
            let range = ValueRange::union_all(values.iter().copied().map(ValueRange::of)).ok_or("values")?;
            if range.width() > 0.0 {
                // Normalised to 0..1, as a brick range does.
                let values = values.map(|v| (v - range.min) / (range.max - range.min));
                bricks.push(Texels { values, texel_mask: Mask512::ALL, range: BrickRange::SEQUENCE });
            }
        }
    }
    let surfaces: Vec<Vec<u8>> =
        bricks.chunks(BATCH).flat_map(|batch| [0, 1, 2].map(|axis| surface(batch, axis))).collect();
    let settings = intel_tex_2::bc7::alpha_very_fast_settings();
    let (mut raw, mut ours) = (Vec::new(), Vec::new());
    for _ in 0..args.rounds {
        let start = Instant::now();
        let blocks: usize = surfaces
            .par_iter()
            .map(|data| {
                let width = data.len() as u32 / 32;
                let surface = RgbaSurface { data, width, height: 8, stride: width * 4 };
                intel_tex_2::bc7::compress_blocks(&settings, &surface).len()
            })
            .sum();
        raw.push(start.elapsed().as_secs_f64());
        let start = Instant::now();
        let encoded = encode(TexelCodec::BC7, &sequence, &bricks)?;
        ours.push(start.elapsed().as_secs_f64());
        // Each of the three axes has as many blocks as the chosen one.
        assert!(blocks >= 3 * encoded.bytes.len(), "both sides encode the same texels");
    }
    let middle = |seconds: &[f64]| {
        let mut sorted = seconds.to_vec();
        sorted.sort_by(f64::total_cmp);
        sorted[sorted.len() / 2]
    };
    let texels = bricks.len() as f64 * 3.0 * 128.0 / 1e6;
    let part = middle(&raw) / middle(&ours);
    println!(
        "\nBC7, {} bricks, three axes each, {} threads: intel_tex_2 alone {:.2} Mtexel/s, our stage {:.2}: {:.0} % ({})",
        bricks.len(),
        rayon::current_num_threads(),
        texels / middle(&raw),
        texels / middle(&ours),
        part * 100.0,
        if part >= LEAST_THROUGHPUT { "met" } else { "**missed**" },
    );
    Ok(json!({ "bricks": bricks.len(), "raw": raw, "ours": ours }))
}

/// An RGBA surface with bricks next to each other, 16 texels each, and four neighbours along an axis in the channels.
fn surface(batch: &[Texels], axis: usize) -> Vec<u8> {
    let strides = [[64, 1, 8], [8, 1, 64], [1, 8, 64]][axis];
    // The encoder needs a width of at least 64 texels.
    let width = (16 * batch.len()).max(64);
    let mut data = vec![0; width * 8 * 4];
    for (b, brick) in batch.iter().enumerate() {
        for (a, v, u) in (0..512).map(|i| (i >> 6, i >> 3 & 7, i & 7)) {
            let value = brick.values[a * strides[0] + v * strides[1] + u * strides[2]];
            data[(v * width + b * 16 + a / 4 * 8 + u) * 4 + a % 4] = (value * 255.0).round() as u8;
        }
    }
    data
}
