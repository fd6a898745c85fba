//! Runs `volpack sweep` and copies its charts to the pages.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::peer_programs;
use crate::sequence;

#[derive(clap::Args)]
pub struct Args {
    /// Sequences, each a file or a glob
    #[arg(required = true)]
    sequences: Vec<PathBuf>,
    /// Measure the stability of each method instead of its cost
    #[arg(long)]
    stability: bool,
    /// Number of runs of each build and picture
    #[arg(long, default_value_t = 5)]
    repeats: u32,
    /// Size of the pictures in pixels, as WIDTH HEIGHT
    #[arg(long, num_args = 2, default_values_t = [1920, 1080])]
    size: Vec<u32>,
    /// Threads of a build; the default is that of a small CI machine
    #[arg(long, default_value_t = 2)]
    threads: usize,
    /// Path of the volpack binary to run
    #[arg(long, default_value_os_t = peer_programs::volpack())]
    volpack: PathBuf,
    /// Folder for the results, in its folders charts/ and runs/
    #[arg(long, default_value_os_t = peer_programs::root().join("docs/benchmarks"))]
    output: PathBuf,
}

/// Sweeps each sequence and prints Markdown links to the charts.
pub fn bench(args: &Args) -> Result<(), Box<dyn Error>> {
    let kind = if args.stability { "stability" } else { "sweep" };
    for sequence in &args.sequences {
        let (name, frames) = sequence::named(sequence)?;
        let folder = tempfile::tempdir()?;
        let mut command = Command::new(&args.volpack);
        command.args(["sweep", "--quiet"]).args(&frames).arg("-o").arg(folder.path());
        if args.stability {
            command.arg("--stability");
        } else {
            command.args([
                "--repeats",
                &args.repeats.to_string(),
                "--threads",
                &args.threads.to_string(),
                "--trace",
            ]);
            command.args(args.size.iter().map(ToString::to_string));
        }
        let status = command.status()?;
        if !status.success() {
            return Err(format!("{command:?}: {status}").into());
        }
        let keep = |from: &str, to: &Path| -> Result<(), Box<dyn Error>> {
            std::fs::create_dir_all(to.parent().ok_or("a folder")?)?;
            std::fs::copy(folder.path().join(from), to)?;
            Ok(())
        };
        let chart = format!("charts/{kind}-{name}.svg");
        keep(&format!("{kind}.svg"), &args.output.join(&chart))?;
        keep(&format!("{kind}.json"), &args.output.join(format!("runs/{kind}-{name}.json")))?;
        println!("![{name}]({chart})");
    }
    Ok(())
}
