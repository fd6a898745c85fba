//! Compares time and memory of reading with OpenVDB's reader.

use std::error::Error;
use std::path::PathBuf;
use std::process::Command;
use std::time::Instant;

use serde_json::{Value as Json, json};
use volpack::vdb::{VdbFile, with_scalar_type};

use crate::peer_programs;
use crate::process_stats::median;

#[derive(clap::Args)]
pub struct Args {
    /// Set of OpenVDB files to read; repeat the option for more sets: --set a.vdb --set 'plume/*.vdb'
    #[arg(long = "set", required = true)]
    sets: Vec<String>,
    /// Number of processes per reader and set, in turns
    #[arg(long, default_value_t = 15)]
    rounds: usize,
    /// Number of reads in one process
    #[arg(long, default_value_t = 20)]
    repeats: usize,
    /// Also write the raw figures to this JSON file
    #[arg(long)]
    json: Option<PathBuf>,
}

#[derive(clap::Args)]
pub struct OnceArgs {
    #[arg(short, default_value_t = 1)]
    n: usize,
    files: Vec<PathBuf>,
}

/// Our side: every scalar grid of the files, as often as asked.
pub fn once(args: &OnceArgs) -> Result<(), Box<dyn Error>> {
    let mut seconds = Vec::new();
    let mut voxels = 0;
    for round in 0..args.n {
        let mut total = 0.0;
        for path in &args.files {
            let start = Instant::now();
            let file = VdbFile::open(path)?;
            for grid in &file.grids {
                let read = with_scalar_type!(&grid.value_type,
                    T => {
                        let tree = file.read_tree::<T>(grid)?;
                        total += start.elapsed().as_secs_f64();
                        if round + 1 == args.n { tree.topology_stats().active_voxels } else { 0 }
                    },
                    other => return Err(format!("{}: {} grids are not read", grid.name, other.name()).into())
                );
                voxels += read;
            }
        }
        seconds.push(total);
    }
    println!("{}", json!({ "seconds": seconds, "voxels": voxels, "peak_rss_kib": peak_rss_kib()? }));
    Ok(())
}

/// The most memory this process has held, as getrusage has it.
fn peak_rss_kib() -> Result<u64, Box<dyn Error>> {
    let status = std::fs::read_to_string("/proc/self/status")?;
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:")).ok_or("no VmHWM")?;
    Ok(line.trim().trim_end_matches(" kB").parse()?)
}

/// Runs both sides in turns and prints the ratio of their medians.
pub fn bench(args: &Args) -> Result<(), Box<dyn Error>> {
    let theirs = peer_programs::compile_openvdb("benches/peers/read_openvdb.cpp")?;
    let ours = std::env::current_exe()?;
    let mut rows = Vec::new();
    println!("| files | OpenVDB ms | volpack ms | ratio | OpenVDB peak MiB | volpack peak MiB | ratio |");
    println!("|---|---|---|---|---|---|---|");
    for set in &args.sets {
        let files = volpack::manifest::expand(&[set.into()])?;
        let repeats = args.repeats.to_string();
        let run = |program: &PathBuf, first: &[&str]| -> Result<Json, Box<dyn Error>> {
            let output = Command::new(program).args(first).args(["-n", &repeats]).args(&files).output()?;
            if !output.status.success() {
                return Err(String::from_utf8_lossy(&output.stderr).into());
            }
            Ok(serde_json::from_slice(&output.stdout)?)
        };
        let (mut their_runs, mut our_runs) = (Vec::new(), Vec::new());
        for _ in 0..args.rounds {
            their_runs.push(run(&theirs, &[])?);
            our_runs.push(run(&ours, &["read-once"])?);
        }
        if their_runs[0]["voxels"] != our_runs[0]["voxels"] {
            return Err(format!("{set}: the two readers found different numbers of voxels").into());
        }
        // Memory of a process that reads once, as a build does.
        let one = |program: &PathBuf, first: &[&str]| -> Result<f64, Box<dyn Error>> {
            let output = Command::new(program).args(first).args(["-n", "1"]).args(&files).output()?;
            let run: Json = serde_json::from_slice(&output.stdout)?;
            Ok(run["peak_rss_kib"].as_f64().ok_or("no peak")? / 1024.0)
        };
        let (their_peak, our_peak) = (one(&theirs, &[])?, one(&ours, &["read-once"])?);
        let (t, o) = (median_ms(&their_runs), median_ms(&our_runs));
        println!(
            "| {set} | {t:.2} | {o:.2} | **{:.2}** | {their_peak:.1} | {our_peak:.1} | **{:.2}** |",
            o / t,
            our_peak / their_peak
        );
        rows.push(json!({ "set": set, "openvdb": their_runs, "volpack": our_runs,
            "openvdb_peak_mib": their_peak, "volpack_peak_mib": our_peak }));
    }
    if let Some(path) = &args.json {
        std::fs::write(path, serde_json::to_string(&rows)?)?;
    }
    Ok(())
}

/// The median over processes of each process's median read. Shared machines are noisy; both sides
/// are treated alike.
fn median_ms(runs: &[Json]) -> f64 {
    let of_run =
        |run: &Json| median(run["seconds"].as_array().into_iter().flatten().filter_map(Json::as_f64));
    median(runs.iter().map(of_run)) * 1e3
}
