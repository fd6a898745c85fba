//! Measures builds with a cache: cold, and after each kind of change.

use std::error::Error;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Instant;

use serde_json::json;

use crate::peer_programs;
use crate::process_stats::median;

#[derive(clap::Args)]
pub struct Args {
    /// Files of one sequence
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// Number of runs of each build; the median is printed
    #[arg(long, default_value_t = 9)]
    rounds: usize,
    /// Path of the volpack binary to run
    #[arg(long, default_value_os_t = peer_programs::volpack())]
    volpack: PathBuf,
    /// Also write the raw figures to this JSON file
    #[arg(long)]
    json: Option<PathBuf>,
}

/// One kind of build, and the limit of its time as a fraction of a cold build.
struct Case {
    name: &'static str,
    options: &'static [&'static str],
    frames: Frames,
    start: Start,
    limit: Option<f64>,
}

#[derive(Clone, Copy, PartialEq)]
enum Frames {
    Source,
    /// The middle frame is edited after the previous build.
    Edited,
}

/// State of the cache when a build begins.
#[derive(Clone, Copy, PartialEq)]
enum Start {
    /// No cache.
    NoCache,
    /// An empty cache.
    Empty,
    /// The cache and the pack of an earlier build with these options.
    After(&'static [&'static str]),
}

const PLAIN: &[&str] = &["--psnr", "45", "--verify", "none"];
const VERIFIED: &[&str] = &["--psnr", "45"];

/// Each case with what it is measured against: the case before it that begins with an empty cache.
fn cases() -> Vec<Case> {
    let case = |name, options, frames, start, limit| Case { name, options, frames, start, limit };
    let after = Start::After(PLAIN);
    vec![
        case("no cache", PLAIN, Frames::Source, Start::NoCache, None),
        case("cold", PLAIN, Frames::Source, Start::Empty, None),
        case("no change", PLAIN, Frames::Source, after, Some(1.0 / 50.0)),
        case("one frame edited", PLAIN, Frames::Edited, after, Some(1.0 / 8.0)),
        case("45 to 46 dB", &["--psnr", "46", "--verify", "none"], Frames::Source, after, Some(1.0 / 3.0)),
        case("45 to 52 dB", &["--psnr", "52", "--verify", "none"], Frames::Source, after, Some(1.0 / 3.0)),
        case(
            "zstd 3 to 9",
            &["--psnr", "45", "--verify", "none", "--zstd", "9"],
            Frames::Source,
            after,
            Some(1.0 / 5.0),
        ),
        case("cold, verified", VERIFIED, Frames::Source, Start::Empty, None),
        case("no change, verified", VERIFIED, Frames::Source, Start::After(VERIFIED), Some(1.0 / 50.0)),
    ]
}

/// Absolute time limit of a build without a change, in seconds.
const INSTANT: f64 = 0.15;

pub fn bench(args: &Args) -> Result<(), Box<dyn Error>> {
    let files = volpack::manifest::expand(&args.files)?;
    let scratch = tempfile::tempdir()?;
    let (source, edited) = (scratch.path().join("source"), scratch.path().join("edited.vdb"));
    fs::create_dir(&source)?;
    for file in &files {
        fs::copy(file, source.join(file.file_name().ok_or("a file has a name")?))?;
    }
    let middle = &files[files.len() / 2];
    let in_place = source.join(middle.file_name().ok_or("a file has a name")?);
    edit(middle, &edited)?;
    // volpack hashes files again that changed less than two seconds ago.
    std::thread::sleep(std::time::Duration::from_secs(3));

    let cases = cases();
    let mut seconds: Vec<Vec<f64>> = cases.iter().map(|_| Vec::new()).collect();
    for round in 0..args.rounds {
        for (i, case) in cases.iter().enumerate() {
            // Never the same folder twice: removing thousands of files between runs slows the next ones down.
            let folder = scratch.path().join(format!("{round}-{i}"));
            fs::create_dir(&folder)?;
            if let Start::After(options) = case.start {
                run(args, &source, &folder, options, true)?;
                if case.frames == Frames::Source && case.options == options {
                    // What a build wrote this moment is hashed once more by the next one.
                    std::thread::sleep(std::time::Duration::from_secs(3));
                    run(args, &source, &folder, options, true)?;
                }
            }
            if case.frames == Frames::Edited {
                fs::copy(&edited, &in_place)?;
            }
            let start = Instant::now();
            run(args, &source, &folder, case.options, case.start != Start::NoCache)?;
            seconds[i].push(start.elapsed().as_secs_f64());
            if round == 0 {
                check(args, case, &source, &folder)?;
            }
            if case.frames == Frames::Edited {
                fs::copy(middle, &in_place)?;
            }
        }
    }
    print(&cases, &seconds);
    if let Some(path) = &args.json {
        let each = cases.iter().zip(&seconds).map(|(c, s)| json!({ "case": c.name, "seconds": s }));
        fs::write(
            path,
            serde_json::to_string(&json!({ "frames": files.len(), "cases": each.collect::<Vec<_>>() }))?,
        )?;
    }
    Ok(())
}

fn print(cases: &[Case], seconds: &[Vec<f64>]) {
    println!("| build | ms | time / cold | limit | time / no cache |\n|---|---|---|---|---|");
    let uncached = median(seconds[0].iter().copied());
    let mut cold = uncached;
    for (case, seconds) in cases.iter().zip(seconds) {
        let time = median(seconds.iter().copied());
        if case.start == Start::Empty {
            cold = time;
        }
        let limit = match case.limit {
            Some(limit) => {
                let instant = case.name.starts_with("no change") && time > INSTANT;
                let verdict = if time / cold <= limit && !instant { "met" } else { "**missed**" };
                format!("1/{:.0}: {verdict}", 1.0 / limit)
            }
            None => String::new(),
        };
        let of = |whole: f64| {
            if time < whole { format!("1/{:.1}", whole / time) } else { format!("{:.2}", time / whole) }
        };
        println!("| {} | {:.1} | {} | {limit} | {} |", case.name, time * 1e3, of(cold), of(uncached));
    }
}

/// Checks that a build with a cache writes the same pack as a build without one.
fn check(args: &Args, case: &Case, frames: &Path, folder: &Path) -> Result<(), Box<dyn Error>> {
    let alone = folder.join("alone");
    fs::create_dir(&alone)?;
    run(args, frames, &alone, case.options, false)?;
    if fs::read(folder.join("out.volpack"))? != fs::read(alone.join("out.volpack"))? {
        return Err(format!("{}: the pack differs from that of a build without a cache", case.name).into());
    }
    Ok(())
}

fn run(
    args: &Args,
    frames: &Path,
    folder: &Path,
    options: &[&str],
    cached: bool,
) -> Result<(), Box<dyn Error>> {
    let mut command = Command::new(&args.volpack);
    command.args(["build", "--quiet"]).arg(frames.join("*.vdb")).args(options);
    command.arg("-o").arg(folder.join("out.volpack")).env_remove("VOLPACK_CACHE");
    if cached {
        command.arg("--cache").arg(folder.join("cache"));
    } else {
        command.arg("--no-cache");
    }
    let status = command.stdout(Stdio::null()).status()?;
    if status.success() { Ok(()) } else { Err(format!("{command:?}: {status}").into()) }
}

/// Edits a frame so that every brick changes: every value is multiplied by 0.97.
fn edit(from: &Path, to: &Path) -> Result<(), Box<dyn Error>> {
    let program = peer_programs::compile_openvdb("benches/peers/scale_openvdb.cpp")?;
    let status = Command::new(program).arg(from).arg(to).arg("0.97").status()?;
    if status.success() { Ok(()) } else { Err("the frame could not be edited".into()) }
}
