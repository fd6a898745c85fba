//! Builds and verifies every sequence below the given folders with every setting, to find good packs that are refused and
//! bad packs that pass. Run it before each release on all real files.

use std::collections::BTreeSet;
use std::error::Error;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use serde_json::json;
use volpack::cache::Cache;
use volpack::error::Error as VolpackError;
use volpack::pipeline::{Job, Silent, VerifyLevel, build};
use volpack::sequence::{Sequence, sequences};
use volpack::settings::{ErrorBound, Format, NonFinite, Quality, Settings};
use volpack::units;
use volpack::vdb::{GridClass, VdbFile};

#[derive(clap::Args)]
pub struct Args {
    /// Folders with OpenVDB files
    #[arg(required = true)]
    folders: Vec<PathBuf>,
    /// Verify voxels only, not pictures
    #[arg(long)]
    no_pictures: bool,
    /// Also write the raw figures to this JSON file
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

/// One grid of a sequence.
struct Grid {
    name: String,
    class: GridClass,
    is_integer: bool,
}

/// How a build ended.
enum End {
    Packed {
        gpu_bytes: u64,
        psnr: Option<f64>,
    },
    /// The message, and the reason why the refusal is correct, if there is one.
    Refused {
        why: String,
        right_since: Option<&'static str>,
    },
}

/// One build.
struct Row {
    sequence: String,
    grid: String,
    setting: String,
    seconds: f64,
    end: End,
}

/// Packs every grid of every sequence.
pub fn run(args: &Args) -> Result<(), Box<dyn Error>> {
    let scratch = tempfile::tempdir()?;
    let mut files = Vec::new();
    args.folders.iter().try_for_each(|folder| find(folder, &mut files))?;
    let mut rows = Vec::new();
    for sequence in sequences(&files) {
        let first = &sequence.files[0];
        let name = args.folders.iter().find_map(|folder| first.strip_prefix(folder).ok()).unwrap_or(first);
        let name = format!("{} ({})", name.display(), sequence.files.len());
        match grids(&sequence) {
            Ok(grids) => {
                for grid in grids {
                    pack_grid(args, &name, &sequence, &grid, scratch.path(), &mut rows)?;
                }
            }
            Err(why) => {
                let right_since =
                    (volpack::cli::exit_code::of(&why) == 6).then_some("no grid has a supported type");
                let end = End::Refused { why: why.to_string(), right_since };
                rows.push(Row {
                    sequence: name,
                    grid: String::new(),
                    setting: String::new(),
                    seconds: 0.0,
                    end,
                });
            }
        }
    }
    print(&rows);
    if let Some(path) = &args.json {
        std::fs::write(path, serde_json::to_string_pretty(&rows.iter().map(to_json).collect::<Vec<_>>())?)?;
    }
    let wrong = rows.iter().filter(|row| matches!(&row.end, End::Refused { right_since: None, .. })).count();
    if wrong > 0 {
        Err(format!(
            "{wrong} builds were refused without a known reason: see the rows with \"no known reason\""
        )
        .into())
    } else {
        Ok(())
    }
}

fn find(folder: &Path, out: &mut Vec<PathBuf>) -> Result<(), Box<dyn Error>> {
    let mut entries =
        std::fs::read_dir(folder)?.map(|entry| Ok(entry?.path())).collect::<std::io::Result<Vec<_>>>()?;
    entries.sort();
    for path in entries {
        if path.is_dir() {
            find(&path, out)?;
        } else if path.extension().is_some_and(|extension| extension == "vdb") {
            out.push(path);
        }
    }
    Ok(())
}

/// The grids of any frame that can be packed.
fn grids(sequence: &Sequence) -> Result<Vec<Grid>, VolpackError> {
    let mut grids: Vec<Grid> = Vec::new();
    let mut seen = BTreeSet::new();
    let mut obstacle = None;
    for path in &sequence.files {
        for info in VdbFile::open(path).map_err(VolpackError::vdb(path))?.grids {
            match info.obstacle() {
                Some(why) => obstacle = Some(format!("{}: grid {:?} {why}", path.display(), info.name)),
                None if seen.insert(info.name.clone()) => {
                    let is_integer = info.value_type.is_integer();
                    grids.push(Grid { name: info.name, class: info.class, is_integer });
                }
                None => {}
            }
        }
    }
    match obstacle {
        Some(why) if grids.is_empty() => Err(VolpackError::Unsupported(why)),
        _ => Ok(grids),
    }
}

/// The settings for every grid, with their names.
fn settings(half_of_default: Option<u64>) -> Vec<(String, Settings)> {
    let quality =
        |name: String, quality: Quality| (name, Settings { encoding: quality.into(), ..Settings::default() });
    let mut all = Vec::new();
    all.extend((35..=65).step_by(5).map(|db| quality(format!("psnr {db}"), Quality::Psnr(db.into()))));
    all.extend(
        [0.02, 0.005]
            .map(|part| quality(format!("max_error {part}"), Quality::MaxError(ErrorBound::of_range(part)))),
    );
    all.extend(half_of_default.map(|size| quality("half the size".to_owned(), Quality::Size(size))));
    all.push(quality("1 bit per voxel".to_owned(), Quality::BitsPerVoxel(1.0)));
    let uniform = Format::ALL.into_iter().filter(|format| format.codec().is_some());
    all.extend(uniform.map(|format| {
        (format.name().to_owned(), Settings { encoding: format.into(), ..Settings::default() })
    }));
    all
}

fn pack_grid(
    args: &Args,
    sequence: &str,
    files: &Sequence,
    grid: &Grid,
    scratch: &Path,
    rows: &mut Vec<Row>,
) -> Result<(), Box<dyn Error>> {
    // One cache per grid, so work that settings share is done once.
    let folder = tempfile::tempdir_in(scratch)?;
    let cache = Arc::new(Cache::open(&folder.path().join("cache"))?);
    let verify = if args.no_pictures { VerifyLevel::Voxels } else { VerifyLevel::All };
    let pack = |setting: String, settings: Settings| {
        let settings = Settings { grids: vec![grid.name.clone()], nonfinite: NonFinite::Zero, ..settings };
        let mut job = Job::new(files.files.clone(), folder.path().join("corpus.volpack"), settings, verify);
        job.cache = Some(Arc::clone(&cache));
        let start = Instant::now();
        let end = end(&job, grid);
        let (sequence, grid, seconds) =
            (sequence.to_owned(), grid.name.clone(), start.elapsed().as_secs_f64());
        Row { sequence, grid, setting, seconds, end }
    };
    let default = pack("default".to_owned(), Settings::default());
    let half = match default.end {
        End::Packed { gpu_bytes, .. } => Some(gpu_bytes / 2),
        End::Refused { .. } => None,
    };
    rows.push(default);
    for (setting, settings) in settings(half) {
        rows.push(pack(setting, settings));
    }
    eprintln!("{sequence} {}: {} builds", grid.name, rows.len());
    Ok(())
}

fn end(job: &Job, grid: &Grid) -> End {
    let outcome = match build(job, &mut Silent) {
        Ok(outcome) => outcome,
        Err(error) => {
            let why = error.to_string();
            return End::Refused { right_since: reason(job, grid, &why), why };
        }
    };
    match outcome.verification {
        Some(report) if report.ok => {
            End::Packed { gpu_bytes: outcome.summary.gpu_bytes, psnr: report.active.psnr }
        }
        Some(report) => {
            let why = report.failures.join("; ");
            // Every failure needs a known reason.
            let reasons = report.failures.iter().map(|why| reason(job, grid, why));
            let right_since =
                reasons.collect::<Option<Vec<_>>>().and_then(|reasons| reasons.first().copied());
            End::Refused { why, right_since }
        }
        None => End::Refused { why: "the build returned no verification".to_owned(), right_since: None },
    }
}

/// The reason why a refusal is correct: a list of what volpack cannot pack at all, or not with the given setting.
fn reason(job: &Job, grid: &Grid, why: &str) -> Option<&'static str> {
    let format = job.settings.format();
    let is_uniform = format.codec().is_some();
    let is_blocks = matches!(format, Format::BC4 | Format::BC7);
    let is_bytes = is_blocks || format == Format::UNORM8;
    let asks_for_bytes = job.settings.quality().is_size() && !is_uniform;
    let list = [
        (
            asks_for_bytes && why.contains("cannot be reached, the least is"),
            "below the smallest possible size",
        ),
        (
            asks_for_bytes && (why.contains("is under 20 dB") || why.contains("the pack has none of its")),
            "too few bytes to represent the grid",
        ),
        (
            is_bytes && grid.class == GridClass::LevelSet && why.contains("flipped"),
            "a level set in one codec of one byte or less per voxel",
        ),
        (is_blocks && why.contains("is under 20 dB"), "a uniform block format on steep values"),
        (
            is_uniform && grid.is_integer && why.contains("integer"),
            "a uniform codec that does not keep integers",
        ),
        (
            grid.is_integer && why.contains("no 32-bit float holds"),
            "integers above 2^24 without integers = \"split\"",
        ),
        (why.contains("the background is"), "frames with different backgrounds, which format 1 cannot store"),
        (format == Format::F16 && why.contains("65504"), "values above the range of f16"),
        (format == Format::F16 && why.contains("is under 20 dB"), "values below the precision of f16"),
    ];
    list.into_iter().find(|(is_it, _)| *is_it).map(|(_, reason)| reason)
}

fn print(rows: &[Row]) {
    println!("| sequence (files) | grid | builds | refused | seconds | default, GPU bytes | default, PSNR |");
    println!("|---|---|---|---|---|---|---|");
    for of_grid in rows.chunk_by(|a, b| (&a.sequence, &a.grid) == (&b.sequence, &b.grid)) {
        let refused = of_grid.iter().filter(|row| matches!(row.end, End::Refused { .. })).count();
        let seconds: f64 = of_grid.iter().map(|row| row.seconds).sum();
        let default = match &of_grid[0].end {
            End::Packed { gpu_bytes, psnr } => {
                format!("{} | {}", units::bytes(*gpu_bytes), units::psnr(*psnr))
            }
            End::Refused { .. } => "refused | ".to_owned(),
        };
        let (sequence, grid) = (&of_grid[0].sequence, &of_grid[0].grid);
        println!("| {sequence} | {grid} | {} | {refused} | {seconds:.1} | {default} |", of_grid.len());
    }
    println!("\n| refused: sequence | grid | setting | known reason | message |");
    println!("|---|---|---|---|---|");
    for row in rows {
        let End::Refused { why, right_since } = &row.end else { continue };
        let (right_since, why) =
            (right_since.unwrap_or("**no known reason**"), why.replace(['\n', '|'], " "));
        println!("| {} | {} | {} | {right_since} | {why} |", row.sequence, row.grid, row.setting);
    }
    let refused = rows.iter().filter(|row| matches!(row.end, End::Refused { .. })).count();
    println!("\n{} builds, {refused} refused", rows.len());
}

fn to_json(row: &Row) -> serde_json::Value {
    let end = match &row.end {
        End::Packed { gpu_bytes, psnr } => json!({ "gpu_bytes": gpu_bytes, "psnr": psnr }),
        End::Refused { why, right_since } => json!({ "refused": why, "right_since": right_since }),
    };
    json!({ "sequence": row.sequence, "grid": row.grid, "setting": row.setting, "seconds": row.seconds, "end": end })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_good_pack_of_the_fixtures_is_refused() {
        let fixtures = crate::peer_programs::root().join("fixtures");
        run(&Args { folders: vec![fixtures], no_pictures: true, json: None }).unwrap();
    }
}
