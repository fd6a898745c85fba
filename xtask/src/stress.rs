//! Kills builds, damages caches and runs builds in parallel, and checks that the packs stay the same.

use std::error::Error;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use rand::{Rng, SeedableRng};
use rand_xoshiro::Xoshiro256Plus;

#[derive(clap::Args)]
pub struct Args {
    /// Files of one sequence
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// Number of builds to kill at a random moment, and of cache files to damage
    #[arg(long, default_value_t = 200)]
    times: usize,
    /// Number of processes that build in parallel
    #[arg(long, default_value_t = 8)]
    processes: usize,
    /// Path of the volpack binary to run
    #[arg(long, default_value = "target/release/volpack")]
    volpack: PathBuf,
    /// Seed of the random moments and damage
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

/// Settings of the builds, in turns, so that builds find partial results of each other.
const SETTINGS: [&[&str]; 4] =
    [&["--psnr", "45"], &["--psnr", "50"], &["--format", "bc7"], &["--max-error", "0.01"]];

struct Stress<'a> {
    args: &'a Args,
    files: Vec<PathBuf>,
    folder: PathBuf,
    cache: PathBuf,
    /// The pack of a build without a cache, for each of the settings.
    expected: Vec<Vec<u8>>,
    random: Xoshiro256Plus,
}

pub fn run(args: &Args) -> Result<(), Box<dyn Error>> {
    let scratch = tempfile::tempdir()?;
    let mut stress = Stress {
        args,
        files: volpack::manifest::expand(&args.files)?,
        folder: scratch.path().to_owned(),
        cache: scratch.path().join("cache"),
        expected: Vec::new(),
        random: Xoshiro256Plus::seed_from_u64(args.seed),
    };
    for (i, options) in SETTINGS.iter().enumerate() {
        let output = stress.folder.join(format!("alone-{i}.volpack"));
        let status = stress.command(options, &output).arg("--no-cache").status()?;
        assert!(status.success(), "{status}");
        stress.expected.push(fs::read(output)?);
    }
    stress.kills()?;
    stress.damages()?;
    stress.side_by_side()?;
    Ok(())
}

impl Stress<'_> {
    fn command(&self, options: &[&str], output: &Path) -> Command {
        let mut command = Command::new(&self.args.volpack);
        command.args(["build", "--verify", "none"]).args(&self.files).args(options);
        command.arg("-o").arg(output).stdout(Stdio::null()).stderr(Stdio::piped());
        command
    }

    fn cached(&self, options: &[&str], output: &Path) -> Command {
        let mut command = self.command(options, output);
        command.arg("--cache").arg(&self.cache);
        command
    }

    /// Builds with the current cache and compares the pack; returns the number of warnings.
    fn build(&self, i: usize, output: &Path) -> Result<usize, Box<dyn Error>> {
        let out = self.cached(SETTINGS[i], output).output()?;
        let said = String::from_utf8_lossy(&out.stderr);
        if !out.status.success() || fs::read(output)? != self.expected[i] {
            return Err(format!("{:?}: {}, or different bytes: {said}", SETTINGS[i], out.status).into());
        }
        Ok(said.matches("warning").count())
    }

    /// Kills builds at random moments; a complete build follows each.
    fn kills(&mut self) -> Result<(), Box<dyn Error>> {
        let output = self.folder.join("killed.volpack");
        let (mut killed, mut finished, mut warnings) = (0, 0, 0);
        while killed < self.args.times {
            let time = killed + finished;
            let i = time % SETTINGS.len();
            // An empty cache half of the time: there is most to lose.
            if time % 2 == 0 {
                let _ = fs::remove_dir_all(&self.cache);
            }
            let before = fs::read(&output).ok();
            let start = Instant::now();
            let mut child: Child = self.cached(SETTINGS[i], &output).spawn()?;
            let wait = Duration::from_micros(self.random.gen_range(0..700_000));
            while start.elapsed() < wait && child.try_wait()?.is_none() {
                std::thread::sleep(Duration::from_micros(200));
            }
            child.kill()?;
            let status = child.wait()?;
            if status.success() {
                finished += 1;
            } else {
                killed += 1;
                let after = fs::read(&output).ok();
                if after != before && after.as_ref() != Some(&self.expected[i]) {
                    return Err(format!("a build killed after {wait:?} left a different pack").into());
                }
            }
            warnings += self.build(i, &output)?;
        }
        let leftovers = fs::read_dir(&self.folder)?.flatten();
        let leftovers =
            leftovers.filter(|e| e.file_name().to_string_lossy().starts_with(".volpack-")).count();
        println!(
            "{killed} builds killed ({finished} ended before the kill): every next build wrote the same bytes ({warnings} \
             warnings, {leftovers} unfinished packs left in the folder)"
        );
        Ok(())
    }

    /// Damages one file of the cache at a time: flips a bit, truncates it, empties it, or appends bytes.
    fn damages(&mut self) -> Result<(), Box<dyn Error>> {
        let output = self.folder.join("damaged.volpack");
        let _ = fs::remove_dir_all(&self.cache);
        let mut warnings = 0;
        for i in 0..SETTINGS.len() {
            self.build(i, &output)?;
        }
        for time in 0..self.args.times {
            let i = time % SETTINGS.len();
            let files = files(&self.cache)?;
            let file = &files[self.random.gen_range(0..files.len())];
            let mut bytes = fs::read(file)?;
            match self.random.gen_range(0..4) {
                0 => bytes.clear(),
                1 => bytes.truncate(self.random.gen_range(0..bytes.len().max(1))),
                2 => bytes.extend([0; 7]),
                _ if bytes.is_empty() => {}
                _ => {
                    let at = self.random.gen_range(0..bytes.len());
                    bytes[at] ^= 1 << self.random.gen_range(0..8);
                }
            }
            fs::write(file, bytes)?;
            // The pack itself would hide what is wrong below it.
            let _ = fs::remove_file(&output);
            if time % 2 == 0 {
                forget_packs(&self.cache)?;
            }
            warnings += self.build(i, &output)?;
        }
        println!(
            "{} cache files damaged: every next build wrote the same bytes ({warnings} warnings)",
            self.args.times
        );
        Ok(())
    }

    /// Builds all settings in parallel processes on one cache.
    fn side_by_side(&mut self) -> Result<(), Box<dyn Error>> {
        let _ = fs::remove_dir_all(&self.cache);
        let mut children = Vec::new();
        for process in 0..self.args.processes {
            let i = process % SETTINGS.len();
            let output = self.folder.join(format!("side-{process}.volpack"));
            children.push((i, self.cached(SETTINGS[i], &output).spawn()?, output));
        }
        let mut warnings = 0;
        for (i, child, output) in children {
            let out = child.wait_with_output()?;
            if !out.status.success() || fs::read(output)? != self.expected[i] {
                return Err(format!("{:?} side by side: {:?}", SETTINGS[i], out).into());
            }
            warnings += String::from_utf8_lossy(&out.stderr).matches("warning").count();
        }
        let verified = Command::new(&self.args.volpack)
            .args(["cache", "verify", "--cache"])
            .arg(&self.cache)
            .output()?;
        if !verified.status.success() {
            return Err(format!("the cache does not verify: {verified:?}").into());
        }
        println!(
            "{} processes on one cache: all wrote the same bytes, and the cache verifies ({warnings} warnings)",
            self.args.processes
        );
        Ok(())
    }
}

fn files(folder: &Path) -> Result<Vec<PathBuf>, Box<dyn Error>> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder)? {
        let path = entry?.path();
        if path.is_dir() {
            found.extend(files(&path)?);
        } else {
            found.push(path);
        }
    }
    found.sort();
    Ok(found)
}

/// Removes the actions that give whole packs, so that the stages have to run.
fn forget_packs(cache: &Path) -> Result<(), Box<dyn Error>> {
    for file in files(&cache.join("actions"))? {
        // The stage's name stands behind eight bytes of magic.
        if fs::read(&file)?.get(8..12) == Some(b"pack") {
            fs::remove_file(file)?;
        }
    }
    Ok(())
}
