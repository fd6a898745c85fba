//! `xtask mutate`: thousands of damaged files, each in at most 1 GiB and 10 s.
//!
//! The cases run in child processes, a batch each, so that one that aborts (as Rust does when memory
//! runs out), overflows the stack or hangs is found and named, and the others still run. Each child is
//! started by `sh -c 'ulimit -v 1048576; exec …'`, which holds its address space to 1 GiB; where there is
//! no such limit (Windows, macOS) that bound is not checked.

use std::error::Error;
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::mpsc;
use std::time::{Duration, Instant};

#[path = "../../fuzz/common/mod.rs"]
mod common;

use common::mutate::{Case, pack_case, vdb_case};
use common::seeds::Seed;
use common::{entry, guard, seeds};

/// Cases a child runs.
const BATCH: u64 = 500;
/// Address space of a child in KiB: 1 GiB.
const MEMORY: u64 = 1 << 20;
/// Time limit of a case.
const LIMIT: Duration = Duration::from_secs(10);
/// How long nothing is heard of a child before it is killed. More than the limit, so that a case that
/// is only slow is told from one that hangs.
const SILENCE: Duration = Duration::from_secs(30);
/// Set for a child: its batch as `KIND FIRST END FOLDER`.
const CHILD: &str = "VOLPACK_MUTATE_BATCH";

/// Feed damaged files to the readers
#[derive(clap::Args)]
pub struct Args {
    /// Number of damaged files of each kind
    #[arg(long, default_value_t = 20_000)]
    count: u64,
    /// Seed of the random damage
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Run only this case of `--kind`, in this process and without limits, to debug it
    #[arg(long, requires = "kind")]
    case: Option<u64>,
    /// Run only this kind
    #[arg(long)]
    kind: Option<Kind>,
}

#[derive(Clone, Copy, PartialEq, clap::ValueEnum)]
enum Kind {
    Vdb,
    Pack,
}

impl Kind {
    fn name(self) -> &'static str {
        match self {
            Self::Vdb => "vdb",
            Self::Pack => "pack",
        }
    }

    fn seeds(self, packs: &Path) -> std::io::Result<Vec<Seed>> {
        match self {
            Self::Vdb => seeds::vdbs(&fixtures()),
            Self::Pack => seeds::packs(packs),
        }
    }

    fn case(self, seeds: &[Seed], seed: u64, case: u64) -> Case {
        match self {
            Self::Vdb => vdb_case(seeds, seed, case),
            Self::Pack => pack_case(seeds, seed, case),
        }
    }

    fn entry(self) -> fn(Vec<u8>) -> bool {
        match self {
            Self::Vdb => entry::vdb,
            Self::Pack => entry::pack,
        }
    }
}

/// What became of the cases of one kind.
#[derive(Default)]
struct Tally {
    accepted: u64,
    refused: u64,
    slowest: Duration,
    failures: Vec<String>,
}

/// Runs the cases.
///
/// # Errors
/// When a case panics, aborts or takes too long, or the seeds cannot be made.
pub fn run(args: Args) -> Result<(), Box<dyn Error>> {
    if let Ok(batch) = std::env::var(CHILD) {
        return child(&batch, args.seed);
    }
    let folder = tempfile::tempdir()?;
    seeds::build_packs(&fixtures(), folder.path())?;
    if let (Some(kind), Some(case)) = (args.kind, args.case) {
        let Case { name, bytes } = kind.case(&kind.seeds(folder.path())?, args.seed, case);
        println!("{} case {case} of seed {}, from {name}, {} bytes", kind.name(), args.seed, bytes.len());
        println!("{}", if kind.entry()(bytes) { "accepted" } else { "refused" });
        return Ok(());
    }
    let mut failures = 0;
    for kind in [Kind::Vdb, Kind::Pack].into_iter().filter(|&k| args.kind.is_none_or(|only| only == k)) {
        let start = Instant::now();
        let tally = run_kind(kind, &args, folder.path())?;
        println!(
            "{}: {} cases in {:.0} s: {} accepted, {} refused, {} failed; the slowest took {:.2} s",
            kind.name(),
            args.count,
            start.elapsed().as_secs_f64(),
            tally.accepted,
            tally.refused,
            tally.failures.len(),
            tally.slowest.as_secs_f64(),
        );
        failures += tally.failures.len();
    }
    if failures > 0 {
        return Err(format!("{failures} cases failed").into());
    }
    Ok(())
}

fn run_kind(kind: Kind, args: &Args, packs: &Path) -> Result<Tally, Box<dyn Error>> {
    let mut tally = Tally::default();
    let mut next = 0;
    while next < args.count {
        let end = (next / BATCH * BATCH + BATCH).min(args.count);
        let failed = tally.failures.len();
        next = run_batch(kind, next, end, packs, &mut tally)?;
        for failure in &tally.failures[failed..] {
            println!("{} seed {} case {failure}", kind.name(), args.seed);
        }
        if next.is_multiple_of(4 * BATCH) {
            println!("{}: {next} of {}", kind.name(), args.count);
        }
    }
    Ok(tally)
}

/// Runs cases in one child until it has done them all or one kills it. The case to go on with.
fn run_batch(
    kind: Kind,
    first: u64,
    end: u64,
    packs: &Path,
    tally: &mut Tally,
) -> Result<u64, Box<dyn Error>> {
    let mut child = Command::new("sh")
        .args(["-c", &format!("ulimit -v {MEMORY}; exec \"$0\" \"$@\"")])
        .arg(std::env::current_exe()?)
        .args(std::env::args_os().skip(1))
        .env(CHILD, format!("{} {first} {end} {}", kind.name(), packs.display()))
        // Address space goes to stacks and heaps of idle threads, too: the bound is for the files.
        .env("RAYON_NUM_THREADS", "2")
        .env("MALLOC_ARENA_MAX", "2")
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .spawn()?;
    let stdout = child.stdout.take().ok_or("the child has no output")?;
    let (send, lines) = mpsc::channel();
    let reader = std::thread::spawn(move || {
        BufReader::new(stdout).lines().map_while(Result::ok).all(|line| send.send(line).is_ok())
    });

    let mut running = None;
    let why = loop {
        match lines.recv_timeout(SILENCE) {
            Ok(line) => {
                if let Some(case) = line.strip_prefix("begin ") {
                    running = Some(case.parse::<u64>()?);
                } else if let Some(case) = running.take() {
                    tally.count(case, &line)?;
                }
            }
            Err(mpsc::RecvTimeoutError::Timeout) => {
                child.kill()?;
                break format!("hangs: no output for {SILENCE:?}");
            }
            Err(mpsc::RecvTimeoutError::Disconnected) => break String::new(),
        }
    };
    let status = child.wait()?;
    drop(lines);
    let _ = reader.join();
    match running {
        Some(case) => {
            let why = if why.is_empty() { format!("killed its process: {status}") } else { why };
            tally.failures.push(format!("{case}: {why}"));
            Ok(case + 1)
        }
        None if status.success() => Ok(end),
        None => Err(format!("a child ended between cases: {status}").into()),
    }
}

impl Tally {
    /// Takes in what a child says of a case: `accepted`, `refused` or `panic`, milliseconds, a message.
    fn count(&mut self, case: u64, line: &str) -> Result<(), Box<dyn Error>> {
        let mut words = line.splitn(3, ' ');
        let verdict = words.next().unwrap_or_default();
        let took = Duration::from_millis(words.next().unwrap_or_default().parse()?);
        match verdict {
            "accepted" => self.accepted += 1,
            "refused" => self.refused += 1,
            _ => self.failures.push(format!("{case}: {}", words.next().unwrap_or_default())),
        }
        if took > LIMIT {
            self.failures.push(format!("{case}: took {took:?}"));
        }
        self.slowest = self.slowest.max(took);
        Ok(())
    }
}

/// Runs a batch and says of each case that it begins and how it ended, at once: the last line is what
/// is left of a process that was killed.
fn child(batch: &str, seed: u64) -> Result<(), Box<dyn Error>> {
    let [kind, first, end, packs] = batch.splitn(4, ' ').collect::<Vec<_>>()[..] else {
        return Err(format!("{CHILD}={batch:?} is not a batch").into());
    };
    let kind = <Kind as clap::ValueEnum>::from_str(kind, false)?;
    let seeds = kind.seeds(Path::new(packs))?;
    let mut out = std::io::stdout().lock();
    for number in first.parse()?..end.parse::<u64>()? {
        writeln!(out, "begin {number}")?;
        out.flush()?;
        let Case { name, bytes } = kind.case(&seeds, seed, number);
        let start = Instant::now();
        let verdict = guard::guarded(|| kind.entry()(bytes));
        let took = start.elapsed().as_millis();
        match verdict {
            Ok(true) => writeln!(out, "accepted {took}")?,
            Ok(false) => writeln!(out, "refused {took}")?,
            Err(panic) => writeln!(out, "panic {took} ({name}) {panic}")?,
        }
    }
    Ok(())
}

fn fixtures() -> PathBuf {
    crate::peer_programs::root().join("fixtures")
}
