//! NanoVDB's trilinear sampler on the same rays, run by `benches/peers/nanovdb_march.cu`.

use std::error::Error;
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use tempfile::TempDir;
use volpack::sweep::nanovdb::{self, Quantise};

use super::STEP;
use super::source::Source;
use crate::peer_programs;

const PROGRAM: &str = include_str!("../../../benches/peers/nanovdb_march.cu");

/// The compiled program.
pub struct Peer {
    program: PathBuf,
    pub version: String,
    folder: TempDir,
}

/// The program while it runs on a volume.
pub struct March {
    child: Child,
    input: ChildStdin,
    output: BufReader<ChildStdout>,
    picture: PathBuf,
}

impl Peer {
    /// Compiles the program with the headers of a folder, or with those on the compiler's path.
    pub fn compile(headers: Option<&Path>) -> Result<Self, Box<dyn Error>> {
        let folder = tempfile::tempdir()?;
        let source = folder.path().join("nanovdb_march.cu");
        std::fs::write(&source, PROGRAM)?;
        let program = folder.path().join("nanovdb_march");
        let version = peer_programs::nvcc(&source, headers, &program)?;
        Ok(Self { program, version, folder })
    }

    /// The volume as a .nvdb file: converted, or the one beside it where the converter is not installed.
    pub fn nvdb(&self, source: &Source) -> Result<PathBuf, Box<dyn Error>> {
        if nanovdb::is_installed() {
            let nvdb = self.folder.path().join(format!("{}.nvdb", source.name));
            nanovdb::convert(&source.path, &source.grid, &Quantise::Float, &nvdb)?;
            return Ok(nvdb);
        }
        let nvdb = source.path.with_extension("nvdb");
        if !nvdb.exists() {
            return Err(
                format!("nanovdb_convert is not installed, and there is no {}", nvdb.display()).into()
            );
        }
        Ok(nvdb)
    }

    /// Starts on a volume. `mode` is `all` or `skip`.
    pub fn start(
        &self,
        nvdb: &Path,
        mode: &str,
        source: &Source,
        size: [u32; 2],
    ) -> Result<March, Box<dyn Error>> {
        let picture = self.folder.path().join(format!("{mode}.f32"));
        let mut child = Command::new(&self.program)
            .arg(nvdb)
            .arg(mode)
            .args(size.map(|s| s.to_string()))
            .arg(&picture)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()?;
        let mut input = child.stdin.take().ok_or("no pipe")?;
        let output = BufReader::new(child.stdout.take().ok_or("no pipe")?);
        let view = &source.view;
        let numbers = [view.origin, view.forward, view.right, view.up, view.low, view.high].concat();
        let numbers: Vec<String> = numbers.iter().map(ToString::to_string).collect();
        writeln!(input, "{} {STEP}", numbers.join(" "))?;
        Ok(March { child, input, output, picture })
    }
}

impl March {
    /// Makes that many frames, and returns the milliseconds of each.
    pub fn time(&mut self, frames: u32) -> Result<Vec<f64>, Box<dyn Error>> {
        writeln!(self.input, "{frames}")?;
        self.input.flush()?;
        let mut line = || {
            let mut line = String::new();
            self.output.read_line(&mut line)?;
            Ok(line.trim().parse()?)
        };
        (0..frames).map(|_| line()).collect()
    }

    /// Ends the program and returns its picture.
    pub fn finish(mut self) -> Result<Vec<f32>, Box<dyn Error>> {
        drop(self.input);
        if !self.child.wait()?.success() {
            return Err("nanovdb_march failed".into());
        }
        Ok(bytemuck::allocation::pod_collect_to_vec(&std::fs::read(&self.picture)?))
    }
}
