//! Compares bytes at equal PSNR: adaptive packs with NanoVDB's FpN and with our own uniform bc7.

use std::error::Error;
use std::path::{Path, PathBuf};

use serde_json::{Value as Json, json};
use volpack::pack::Pack;
use volpack::pipeline::{Job, Silent, VerifyLevel, build};
use volpack::report::PackSummary;
use volpack::settings::{Encoding, Format, Quality, Settings};
use volpack::sweep::nanovdb::{self, NanoGrid, Quantise};
use volpack::sweep::{Difference, difference};

#[derive(clap::Args)]
pub struct Args {
    /// OpenVDB files
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// PSNRs in dB to reach with NanoVDB
    #[arg(long, value_delimiter = ',', default_value = "46,52")]
    psnr: Vec<f64>,
    /// Name of the grid to use
    #[arg(long, default_value = "density")]
    grid: String,
    /// Also write the raw figures to this JSON file
    #[arg(long)]
    json: Option<PathBuf>,
}

/// Halvings of the tolerance's exponent: past 16 the PSNR no longer moves.
const HALVINGS: u32 = 16;

pub fn bench(args: &Args) -> Result<(), Box<dyn Error>> {
    if !nanovdb::is_installed() {
        return Err("NanoVDB is not installed: apt-get install libnanovdb-tools".into());
    }
    let folder = tempfile::tempdir()?;
    let mut rows = Vec::new();
    println!(
        "| volume | compared with | its dB | volpack dB | its leaves KiB | its grid KiB | volpack KiB | volpack / leaves | volpack / grid |"
    );
    println!("|---|---|---|---|---|---|---|---|---|");
    for file in &args.files {
        let name = file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let bc7 = pack(file, args, Format::BC7.into(), folder.path())?;
        for &target in &args.psnr {
            let (tolerance, theirs, error) = fpn(file, args, target, bc7.peak, folder.path())?;
            let psnr = error.psnr(bc7.peak).ok_or("a lossy grid")?;
            let ours = pack(file, args, Quality::Psnr(psnr).into(), folder.path())?;
            let kib = |bytes: u64| bytes as f64 / 1024.0;
            println!(
                "| {name} | NanoVDB fpN -a {tolerance:.5} | {psnr:.2} | {:.2} | {:.1} | {:.1} | {:.1} | {:.3} | {:.3} |",
                ours.psnr,
                kib(theirs.leaf_bytes),
                kib(theirs.grid_bytes),
                kib(ours.bytes),
                ours.bytes as f64 / theirs.leaf_bytes as f64,
                ours.bytes as f64 / theirs.grid_bytes as f64
            );
            rows.push(json!({ "volume": name, "beside": "NanoVDB fpN", "tolerance": tolerance, "psnr": psnr,
                "leaf_bytes": theirs.leaf_bytes, "grid_bytes": theirs.grid_bytes, "ours": ours.json }));
        }
        let ours = pack(file, args, Quality::Psnr(bc7.psnr).into(), folder.path())?;
        println!(
            "| {name} | uniform bc7 | {:.2} | {:.2} | | {:.1} | {:.1} | | {:.3} |",
            bc7.psnr,
            ours.psnr,
            bc7.bytes as f64 / 1024.0,
            ours.bytes as f64 / 1024.0,
            ours.bytes as f64 / bc7.bytes as f64
        );
        rows.push(json!({ "volume": name, "beside": "bc7", "theirs": bc7.json, "ours": ours.json }));
    }
    if let Some(path) = &args.json {
        std::fs::write(path, serde_json::to_string(&rows)?)?;
    }
    Ok(())
}

struct Measured {
    bytes: u64,
    psnr: f64,
    peak: f64,
    json: Json,
}

fn pack(file: &Path, args: &Args, encoding: Encoding, folder: &Path) -> Result<Measured, Box<dyn Error>> {
    let job = Job::new(
        vec![file.to_owned()],
        folder.join("bench.volpack"),
        Settings { grids: vec![args.grid.clone()], encoding, ..Settings::default() },
        VerifyLevel::Voxels,
    );
    let report = build(&job, &mut Silent)?.verification.ok_or("the build returned no verification")?;
    let grid = &report.grids[0];
    let summary = PackSummary::new(&Pack::open(&job.output)?);
    Ok(Measured {
        bytes: summary.gpu_bytes,
        psnr: grid.active.psnr.ok_or("a lossy pack")?,
        peak: grid.peak,
        json: json!({ "pack": summary, "active": grid.active, "failures": report.failures }),
    })
}

/// The grid with the lowest PSNR that is at least `target`, by bisection of the tolerance.
fn fpn(
    file: &Path,
    args: &Args,
    target: f64,
    peak: f64,
    folder: &Path,
) -> Result<(f64, NanoGrid, Difference), Box<dyn Error>> {
    let (nvdb, back) = (folder.join("peer.nvdb"), folder.join("peer.vdb"));
    let convert = |tolerance: f64| -> Result<(NanoGrid, Difference), Box<dyn Error>> {
        let grid = nanovdb::convert(file, &args.grid, &Quantise::FpN { absolute: tolerance }, &nvdb)?;
        nanovdb::back_to_vdb(&nvdb, &back)?;
        Ok((grid, difference(file, &back, &args.grid)?))
    };
    let (mut low, mut high) = ((1e-5 * peak).ln(), (0.3 * peak).ln());
    let mut best = None;
    for _ in 0..HALVINGS {
        let middle = f64::midpoint(low, high);
        let (grid, error) = convert(middle.exp())?;
        if error.psnr(peak).is_none_or(|db| db >= target) {
            low = middle;
            best = Some((middle.exp(), grid, error));
        } else {
            high = middle;
        }
    }
    best.ok_or_else(|| format!("fpN does not reach {target} dB on {}", file.display()).into())
}
