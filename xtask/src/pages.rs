//! Regenerates all benchmark pages with one command. A page has blocks that name the benchmark that writes them:
//!
//! ```text
//! <!-- bench: kmeans plume/*.vdb -->
//! …what it printed, with the date, the commit and the machine…
//! <!-- /bench -->
//! ```

use std::error::Error;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::peer_programs::root;

#[derive(clap::Args)]
pub struct Args {
    /// Pages to regenerate, such as "trace" or "README" [default: all]
    pages: Vec<String>,
    /// Folder with the volumes that the blocks name
    #[arg(long, value_name = "DIR")]
    volumes: PathBuf,
    /// Commit to print [default: the commit that is checked out]
    #[arg(long)]
    commit: Option<String>,
    /// Folder that contains nanovdb/, with NanoVDB's headers, for `trace`; repeat it for another version
    #[arg(long, value_name = "DIR")]
    nanovdb: Vec<PathBuf>,
}

const BEGIN: &str = "<!-- bench: ";
const END: &str = "<!-- /bench -->";

/// Runs the benchmarks of the pages and writes their output into the blocks. If a benchmark fails, its block is not changed.
pub fn bench(args: &Args) -> Result<(), Box<dyn Error>> {
    let commit = args.commit.clone().map_or_else(commit, Ok)?;
    let mut failed = 0;
    for page in pages()? {
        let name = page.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        if !args.pages.is_empty() && !args.pages.contains(&name) {
            continue;
        }
        let old = std::fs::read_to_string(&page)?;
        let mut new = String::new();
        let mut rest = old.as_str();
        while let Some((before, words, block, after)) = next_block(rest) {
            eprintln!("{name}: {words}");
            let block = run(args, words, &commit).unwrap_or_else(|why| {
                eprintln!("{name}: {words}: block not changed: {why}");
                failed += 1;
                block.to_owned()
            });
            new += &format!("{before}{BEGIN}{words} -->{block}{END}");
            rest = after;
        }
        new += rest;
        std::fs::write(&page, new)?;
    }
    if failed > 0 {
        Err(format!("{failed} benchmarks failed; their blocks were not changed").into())
    } else {
        Ok(())
    }
}

fn pages() -> Result<Vec<PathBuf>, Box<dyn Error>> {
    let folder = std::fs::read_dir(root().join("docs/benchmarks"))?;
    let mut pages = folder.map(|entry| Ok(entry?.path())).collect::<std::io::Result<Vec<_>>>()?;
    pages.retain(|page| page.extension().is_some_and(|extension| extension == "md"));
    pages.sort();
    pages.push(root().join("README.md"));
    Ok(pages)
}

/// The text before the next block, the block's command, its content, and the text after it.
fn next_block(text: &str) -> Option<(&str, &str, &str, &str)> {
    let (before, rest) = text.split_once(BEGIN)?;
    let (words, rest) = rest.split_once(" -->")?;
    let (block, after) = rest.split_once(END)?;
    Some((before, words, block, after))
}

/// Runs a benchmark and returns the new content of its block.
fn run(args: &Args, words: &str, commit: &str) -> Result<String, Box<dyn Error>> {
    let is_sweep = words.starts_with("sweep");
    let mut command = Command::new(std::env::current_exe()?);
    command.arg("bench").args(words.split(' ')).current_dir(&args.volumes);
    if !is_sweep {
        let figures = words.split(' ').next().unwrap_or_default();
        command.arg("--json").arg(root().join(format!("docs/benchmarks/runs/{figures}.json")));
    }
    if words.starts_with("trace") {
        for headers in &args.nanovdb {
            command.arg("--nanovdb").arg(std::path::absolute(headers)?);
        }
    }
    let output = command.stderr(std::process::Stdio::inherit()).output()?;
    if !output.status.success() {
        return Err(format!("the benchmark ended with {}", output.status).into());
    }
    let printed = String::from_utf8(output.stdout)?;
    let date = Command::new("date").args(["-u", "+%Y-%m-%d"]).output()?.stdout;
    let (date, machine) = (String::from_utf8(date)?.trim().to_owned(), machine()?);
    let shown =
        words.split(' ').map(|word| if word.contains('*') { format!("'{word}'") } else { word.to_owned() });
    let shown = shown.collect::<Vec<_>>().join(" ");
    let words = wrap(&format!("target/release/xtask bench {shown}"));
    Ok(format!("\n{date}, commit {commit}, {machine}:\n\n{words}\n\n{}\n", printed.trim()))
}

/// Wraps a command into lines of at most about 110 characters.
fn wrap(command: &str) -> String {
    let mut lines = vec![String::from("   ")];
    for word in command.split(' ') {
        let last = lines.last_mut().expect("there is one");
        if last.len() + word.len() > 110 {
            *last += " \\";
            lines.push(format!("        {word}"));
        } else {
            *last += &format!(" {word}");
        }
    }
    lines.join("\n")
}

/// The commit that is checked out, and whether anything that is measured differs from it.
fn commit() -> Result<String, Box<dyn Error>> {
    let git = |arguments: &[&str]| -> Result<String, Box<dyn Error>> {
        let output = Command::new("git").args(arguments).current_dir(root()).output()?;
        if !output.status.success() {
            return Err("git cannot tell the commit: give it with --commit".into());
        }
        Ok(String::from_utf8(output.stdout)?.trim().to_owned())
    };
    let commit = git(&["rev-parse", "--short=10", "HEAD"])?;
    let changed =
        git(&["status", "--porcelain", "--", "src", "crates", "xtask", "benches", "shaders", "Cargo.lock"])?;
    Ok(if changed.is_empty() { commit } else { format!("{commit} with changes") })
}

/// The processor and how much of it there is.
fn machine() -> Result<String, Box<dyn Error>> {
    let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model =
        info.lines().find_map(|line| line.strip_prefix("model name")).unwrap_or(": an unknown processor");
    let model = Path::new(model.trim_start_matches([' ', '\t', ':'])).display().to_string();
    Ok(format!("{} threads of {model}", std::thread::available_parallelism()?))
}
