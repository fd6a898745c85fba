//! `volpack verify`.

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use serde_json::json;

use super::progress::Reporter;
use super::style::{ERROR, GOOD, TITLE, WARNING};
use super::{Common, MemoryArg, PictureArgs, outln, print_json};
use crate::error::{Error, Result};
use crate::manifest::{DEFAULT_NAME, Manifest, expand};
use crate::pipeline::{Resources, check_structure, verify_against};
use crate::units::psnr;
use crate::verify::{PicturesReport, VerifyReport};

#[derive(Args)]
pub struct VerifyArgs {
    /// Pack to verify
    pack: PathBuf,
    /// Source files of the pack [default: those of the manifest]
    #[arg(long, value_name = "FILES", num_args = 1..)]
    source: Vec<PathBuf>,
    /// Manifest that names the source files
    #[arg(short, long, value_name = "FILE", default_value = DEFAULT_NAME)]
    manifest: PathBuf,
    /// How much to verify
    #[arg(long, value_name = "RING", default_value = "all")]
    level: Level,
    #[command(flatten)]
    pictures: PictureArgs,
    #[command(flatten)]
    memory: MemoryArg,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, PartialEq, ValueEnum)]
enum Level {
    /// Hashes, offsets, indices and counts; needs no source
    Structure,
    /// The structure, and every voxel against the source
    Voxels,
    /// The structure, every voxel, and pictures of pack and source
    All,
}

pub fn run(args: &VerifyArgs, common: Common) -> Result<()> {
    let pack = check_structure(&args.pack)?;
    if args.level == Level::Structure {
        if args.json {
            print_json(&json!({ "ok": true }));
        } else if !common.quiet {
            outln!("{TITLE}{}{TITLE:#}: structure {GOOD}ok{GOOD:#}", args.pack.display());
        }
        return Ok(());
    }
    let (sources, max_flip) =
        if args.source.is_empty() { sources_in_manifest(args)? } else { (expand(&args.source)?, None) };
    let settings = args.pictures.settings(max_flip);
    let mut reporter = Reporter::new("verify", common.quiet || args.json);
    let pictures = (args.level == Level::All).then_some(&settings);
    let resources = Resources { memory: args.memory.bytes(), ..Resources::default() };
    let report = verify_against(&pack, &sources, pictures, &resources, &mut reporter);
    reporter.finish();
    let report = report?;
    if args.json {
        print_json(&report);
    } else if !common.quiet {
        outln!("{TITLE}{}{TITLE:#}", args.pack.display());
        print_summary(&report);
        if common.verbose {
            print_frames(&report);
        }
    }
    verdict(&args.pack, &report)
}

/// An error if a report has failures, with all of them.
pub fn verdict(pack: &Path, report: &VerifyReport) -> Result<()> {
    if report.ok {
        return Ok(());
    }
    Err(Error::Verify(format!(
        "{} does not match its source:\n  {}",
        pack.display(),
        report.failures.join("\n  ")
    )))
}

/// The files that the manifest builds the pack from, and its limit for pictures.
fn sources_in_manifest(args: &VerifyArgs) -> Result<(Vec<PathBuf>, Option<f64>)> {
    let unknown = || {
        Error::Usage(format!(
            "{}: source files unknown: give --source FILES, or the manifest that builds it with -m",
            args.pack.display()
        ))
    };
    if !args.manifest.exists() {
        return Err(unknown());
    }
    let manifest = Manifest::read(&args.manifest)?;
    let pack = args.pack.canonicalize().map_err(Error::io(&args.pack))?;
    let asset = manifest.assets.values().find(|a| a.output.canonicalize().is_ok_and(|output| output == pack));
    let asset = asset.ok_or_else(unknown)?;
    Ok((expand(&asset.frames)?, asset.max_flip))
}

/// Prints whether a pack matches its source, and how closely.
pub fn print_summary(report: &VerifyReport) {
    let verdict =
        if report.ok { format!("{GOOD}verified{GOOD:#}") } else { format!("{ERROR}failed{ERROR:#}") };
    outln!("  {}{verdict}", quality(report));
    print_details(report);
}

/// The PSNR of the least exact grid and of the worst frame, as the beginning of a sentence: "55.00 dB, worst frame 51.45 dB, ".
pub fn quality(report: &VerifyReport) -> String {
    let mut text = format!("{}, ", psnr(report.active.psnr));
    if let (Some(worst), true) = (&report.worst_frame, report.frames.len() > 1) {
        text += &format!("worst frame {:.2} dB, ", worst.psnr);
    }
    text
}

/// Prints the errors of each grid and what the pictures showed.
pub fn print_details(report: &VerifyReport) {
    for grid in &report.grids {
        let m = &grid.active;
        let percent = |error: f64| 100.0 * error / grid.peak;
        let flips = if m.sign_flips > 0 { format!(", {} sign flips", m.sign_flips) } else { String::new() };
        let error = if m.max_error > 0.0 {
            format!(
                ", RMSE {:.2} %, maximum error {:.2} % of the value range",
                percent(m.rmse),
                percent(m.max_error)
            )
        } else {
            String::new()
        };
        outln!("    {:12} {}{error}{flips}", grid.grid, psnr(m.psnr));
    }
    if let (Some(worst), true) = (&report.worst_frame, report.frames.len() > 1) {
        outln!("    worst frame  {} of {}: {:.2} dB", worst.frame, worst.grid, worst.psnr);
    }
    if let Some(pictures) = &report.pictures {
        print_pictures(pictures);
    }
}

fn print_pictures(report: &PicturesReport) {
    let of_tracers = report.pictures.iter().filter_map(|p| p.tracers);
    match (&report.device, &report.skipped) {
        (Some(device), _) => {
            let pixels: u64 = of_tracers.map(|t| t.pixels).sum();
            let verdict = if pixels == 0 { "match".to_owned() } else { format!("differ in {pixels} pixels") };
            outln!("    pictures     {device} and the CPU reference {verdict}");
        }
        (None, Some(why)) => outln!("    pictures     rendered on the CPU only: {why}"),
        (None, None) => outln!("    pictures     rendered on the CPU only"),
    }
    let worst = report.pictures.iter().max_by(|a, b| a.source.flip.total_cmp(&b.source.flip));
    if let Some(p) = worst {
        let limit = report.max_flip.map(|limit| format!(", limit {limit:.4}")).unwrap_or_default();
        outln!(
            "    FLIP         {:.4}{limit}, {} (frame {} of {})",
            p.source.flip,
            psnr(p.source.psnr),
            p.frame,
            p.grid
        );
    }
    for note in &report.not_compared {
        outln!("    not compared {note}");
    }
    for warning in &report.warnings {
        outln!("  {WARNING}warning{WARNING:#}: {warning}");
    }
}

fn print_frames(report: &VerifyReport) {
    for frame in &report.frames {
        outln!(
            "      {:12} frame {:5}  {:>10}  largest error {:.3e}",
            frame.grid,
            frame.frame,
            psnr(frame.active.psnr),
            frame.active.max_error
        );
    }
}
