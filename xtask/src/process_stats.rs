//! Measures time, cores and memory of a program.

use std::error::Error;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use serde::Serialize;

/// One run.
#[derive(Clone, Copy, Serialize)]
pub struct Run {
    /// Wall time.
    pub seconds: f64,
    /// CPU seconds of all cores together, in the kernel's steps of 0.01 s.
    pub cpu_seconds: f64,
    /// Peak memory, sampled every 2 ms.
    pub peak_mib: f64,
}

/// Runs a program and waits until it ends.
///
/// # Errors
/// When it cannot be started or fails.
pub fn run(command: &mut Command) -> Result<Run, Box<dyn Error>> {
    let cpu = children_seconds()?;
    let start = Instant::now();
    let mut child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn()?;
    let status = format!("/proc/{}/status", child.id());
    let mut peak_kib = 0.0;
    let ended = loop {
        if let Some(ended) = child.try_wait()? {
            break ended;
        }
        let now = std::fs::read_to_string(&status).unwrap_or_default();
        let line = now.lines().find_map(|line| line.strip_prefix("VmHWM:"));
        let kib = line.and_then(|line| line.trim().trim_end_matches(" kB").parse().ok());
        peak_kib = f64::max(peak_kib, kib.unwrap_or(0.0));
        std::thread::sleep(Duration::from_millis(2));
    };
    let seconds = start.elapsed().as_secs_f64();
    if !ended.success() {
        return Err(format!("{command:?}: {ended}").into());
    }
    Ok(Run { seconds, cpu_seconds: children_seconds()? - cpu, peak_mib: peak_kib / 1024.0 })
}

/// CPU seconds of all child processes that have ended.
fn children_seconds() -> Result<f64, Box<dyn Error>> {
    let stat = std::fs::read_to_string("/proc/self/stat")?;
    // The name in parentheses may hold blanks; `cutime` and `cstime` are fields 16 and 17.
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or_default().split_whitespace().collect();
    let ticks =
        |field: usize| fields.get(field - 3).and_then(|f| f.parse::<f64>().ok()).ok_or("no such field");
    // USER_HZ is 100 wherever Linux runs today.
    Ok((ticks(16)? + ticks(17)?) / 100.0)
}

/// The median; NaN if there are no values.
pub fn median(figures: impl IntoIterator<Item = f64>) -> f64 {
    let mut figures: Vec<f64> = figures.into_iter().collect();
    figures.sort_by(f64::total_cmp);
    figures.get(figures.len() / 2).copied().unwrap_or(f64::NAN)
}

/// A build without cache and without verification.
pub fn build(volpack: &Path, options: &[&str], files: &[impl AsRef<Path>], output: &Path) -> Command {
    let mut command = Command::new(volpack);
    command.args(["build", "--quiet", "--no-cache", "--verify", "none"]).args(options);
    command.args(files.iter().map(AsRef::as_ref)).arg("-o").arg(output);
    command
}
