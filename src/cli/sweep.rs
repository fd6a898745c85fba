//! `volpack sweep`.

use std::path::{Path, PathBuf};

use clap::Args;
use serde::Serialize;
use serde_json::json;

use super::progress::Reporter;
use super::style::{TITLE, WARNING};
use super::{Common, outln};
use crate::atomic_file;
use crate::error::{Error, Result};
use crate::manifest::expand;
use crate::report::chart::{Point, Spread, stability_svg, sweep_svg};
use crate::settings::NonFinite;
use crate::sweep::{Options, Skipped, Stability, Sweep, fronts, measure, stability};
use crate::units::psnr;

#[derive(Args)]
pub struct SweepArgs {
    /// Files of one sequence
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// Folder for sweep.csv, sweep.json and sweep.svg
    #[arg(short, long, value_name = "DIR", value_parser = super::output_path())]
    output: PathBuf,
    /// Measure stability instead: repeat each method with other seeds, frame orders, thread counts and noise, and write
    /// stability.csv, stability.json and stability.svg
    #[arg(long, conflicts_with_all = ["repeats", "trace"])]
    stability: bool,
    /// Grid to measure [default: density, else the only scalar grid]
    #[arg(short, long, value_name = "NAME")]
    grid: Option<String>,
    /// Treatment of infinities and NaNs
    #[arg(long, default_value = "refuse")]
    nonfinite: NonFinite,
    /// Minimum number of timed builds and pictures; the fastest build and the median picture count
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=1000))]
    repeats: u32,
    /// Size of the pictures timed on the GPU, in pixels; 0 0 for none
    #[arg(long, num_args = 2, value_names = ["WIDTH", "HEIGHT"], default_values_t = [960, 540])]
    trace: Vec<u32>,
}

pub fn run(args: &SweepArgs, common: Common) -> Result<()> {
    let frames = expand(&args.files)?;
    let options = Options {
        name: name(&frames),
        frames,
        grid: args.grid.clone(),
        nonfinite: args.nonfinite,
        repeats: args.repeats,
        trace: (args.trace[0] > 0 && args.trace[1] > 0).then(|| [args.trace[0], args.trace[1]]),
    };
    std::fs::create_dir_all(&args.output).map_err(Error::io(&args.output))?;
    let mut reporter = Reporter::new(&options.name, common.quiet);
    let result = if args.stability {
        let found = stability(&options, &options.repeated_methods(), &mut reporter);
        found.and_then(|found| write_stability(&options, &found, &args.output))
    } else {
        measure(&options, &mut reporter).and_then(|found| write_sweep(&options, &found, &args.output))
    };
    reporter.finish();
    let lines = result?;
    if !common.quiet {
        outln!("{TITLE}{}{TITLE:#} -> {}", options.name, args.output.display());
        lines.iter().for_each(|line| outln!("{line}"));
    }
    Ok(())
}

/// What a sequence is called: a file by its name, several by their folder's.
fn name(frames: &[PathBuf]) -> String {
    let name = match frames {
        [one] => one.file_stem(),
        many => many[0].parent().and_then(Path::file_name).or(many[0].file_stem()),
    };
    name.map_or_else(|| "volume".to_owned(), |n| n.to_string_lossy().into_owned())
}

fn write_sweep(options: &Options, sweep: &Sweep, folder: &Path) -> Result<Vec<String>> {
    #[derive(Serialize)]
    struct Row<'a> {
        #[serde(flatten)]
        point: &'a Point,
        front_in_size: bool,
        front_in_seconds: bool,
        front_in_trace: bool,
    }
    let [size, seconds, trace] = fronts(&sweep.points);
    let rows: Vec<Row> = sweep
        .points
        .iter()
        .enumerate()
        .map(|(i, point)| Row {
            point,
            front_in_size: size[i],
            front_in_seconds: seconds[i],
            front_in_trace: trace[i],
        })
        .collect();
    let subtitle = match (&sweep.device, options.trace) {
        (Some(device), Some([width, height])) => {
            format!("{}; traced by {device} at {width} × {height}", cores())
        }
        _ => cores(),
    };
    let svg = sweep_svg(&options.name, &subtitle, &sweep.points).map_err(|e| Error::Other(e.to_string()))?;
    atomic_file::write(&folder.join("sweep.svg"), svg.as_bytes())?;
    let json = json!({ "volpack": env!("CARGO_PKG_VERSION"), "volume": options.name, "frames": options.frames.len(),
        "machine": cores(), "device": sweep.device, "trace": options.trace, "points": rows, "skipped": sweep.skipped });
    atomic_file::write(
        &folder.join("sweep.json"),
        &serde_json::to_vec_pretty(&json).expect("figures are numbers"),
    )?;
    let header = "volume,method,setting,gpu_bytes,bits_per_voxel,psnr_db,max_error_of_range,build_seconds,trace_ms,\
        blockiness,front_in_size,front_in_seconds,front_in_trace,failures";
    let csv = rows.iter().map(|r| {
        let p = r.point;
        let optional = |v: Option<f64>| v.map(|v| v.to_string()).unwrap_or_default();
        [
            p.volume.clone(),
            p.method.clone(),
            p.setting.clone(),
            p.gpu_bytes.to_string(),
            p.bits_per_voxel.to_string(),
            optional(p.psnr),
            p.max_error.to_string(),
            p.build_seconds.to_string(),
            optional(p.trace_ms),
            optional(p.blockiness),
            r.front_in_size.to_string(),
            r.front_in_seconds.to_string(),
            r.front_in_trace.to_string(),
            p.failures.join("; "),
        ]
    });
    write_csv(&folder.join("sweep.csv"), header, csv)?;

    let mut lines: Vec<String> = rows
        .iter()
        .map(|r| {
            let p = r.point;
            let mark = if !p.failures.is_empty() {
                "fails"
            } else if r.front_in_size {
                "front"
            } else {
                ""
            };
            format!(
                "  {:20} {:40} {:>10} {:8.3} bits/voxel {:7.3} s  {mark}",
                p.method,
                p.setting,
                psnr(p.psnr),
                p.bits_per_voxel,
                p.build_seconds
            )
        })
        .collect();
    lines.extend(skipped(&sweep.skipped));
    if options.trace.is_some() && sweep.device.is_none() {
        lines.push("  no GPU here: no picture was traced".to_owned());
    }
    Ok(lines)
}

fn write_stability(options: &Options, found: &Stability, folder: &Path) -> Result<Vec<String>> {
    let svg = stability_svg(&options.name, "On 1, 2 and 3 threads", &found.spreads)
        .map_err(|e| Error::Other(e.to_string()))?;
    atomic_file::write(&folder.join("stability.svg"), svg.as_bytes())?;
    let json = json!({ "volpack": env!("CARGO_PKG_VERSION"), "volume": options.name, "frames": options.frames.len(),
        "spreads": found.spreads, "skipped": found.skipped });
    atomic_file::write(
        &folder.join("stability.json"),
        &serde_json::to_vec_pretty(&json).expect("figures are numbers"),
    )?;
    let header = "volume,method,setting,runs,psnr_least,psnr_most,bits_per_voxel_least,bits_per_voxel_most,\
        max_error_least,max_error_most,blockiness_least,blockiness_most,failures";
    let csv = found.spreads.iter().map(|s: &Spread| {
        let mut row = vec![s.volume.clone(), s.method.clone(), s.setting.clone(), s.runs.to_string()];
        for (least, most) in [s.psnr, s.bits_per_voxel, s.max_error, s.blockiness] {
            row.extend([least.to_string(), most.to_string()]);
        }
        row.push(s.failures.join("; "));
        row
    });
    write_csv(&folder.join("stability.csv"), header, csv)?;
    let mut lines: Vec<String> = found
        .spreads
        .iter()
        .map(|s| {
            let fails = if s.failures.is_empty() {
                String::new()
            } else {
                format!("  fails: {}", s.failures.join("; "))
            };
            format!(
                "  {:20} {:40} {:6.2} to {:6.2} dB  {:.3} to {:.3} bits/voxel{fails}",
                s.method, s.setting, s.psnr.0, s.psnr.1, s.bits_per_voxel.0, s.bits_per_voxel.1
            )
        })
        .collect();
    lines.extend(skipped(&found.skipped));
    Ok(lines)
}

fn skipped(skipped: &[Skipped]) -> impl Iterator<Item = String> + '_ {
    skipped.iter().map(|s| format!("  {WARNING}left out{WARNING:#}: {}, {}: {}", s.method, s.setting, s.why))
}

fn cores() -> String {
    let cores = rayon::current_num_threads();
    format!("{cores} CPU thread{}", if cores == 1 { "" } else { "s" })
}

fn write_csv<R: AsRef<[String]>>(path: &Path, header: &str, rows: impl Iterator<Item = R>) -> Result<()> {
    let failed = |e: csv::Error| Error::Io { path: path.to_owned(), source: std::io::Error::other(e) };
    let mut writer = csv::Writer::from_path(path).map_err(failed)?;
    writer.write_record(header.split(',')).map_err(failed)?;
    for row in rows {
        writer.write_record(row.as_ref()).map_err(failed)?;
    }
    writer.flush().map_err(Error::io(path))
}
