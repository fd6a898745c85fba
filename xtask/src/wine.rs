//! Runs `volpack.exe` under wine, end to end, beside the Linux program.

use std::collections::BTreeMap;
use std::error::Error;
use std::ffi::OsStr;
use std::fmt::Write as _;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value as Json;
use volpack::report::VdbSummary;

use crate::peer_programs::root;
use crate::windows::output;
use crate::wine_prefix::Prefix;

type Result<T> = std::result::Result<T, Box<dyn Error>>;

/// Settings of each build of the fixtures: a name and the lines of the manifest.
const SETTINGS: [(&str, &str); 9] = [
    ("adaptive", "format = 'adaptive'"),
    ("45dB", "format = 'adaptive'\npsnr = 45"),
    ("f32", "format = 'f32'"),
    ("f16", "format = 'f16'"),
    ("unorm8", "format = 'unorm8'"),
    ("bc4", "format = 'bc4'"),
    ("bc7", "format = 'bc7'"),
    ("bc7-sequence", "format = 'bc7'\nrange = 'sequence'"),
    ("bc7-kmeans", "format = 'bc7'\ndedup = 'kmeans'\nclusters = 8"),
];

/// Limit for each step that is waited for. None takes more than a few seconds; a busy machine may take much longer.
const PATIENCE: Duration = Duration::from_secs(120);

/// Runs the program for Windows and the one for Linux on the fixtures, and compares.
///
/// # Errors
/// When they differ, or a step fails.
pub fn check(exe: &Path, linux: &Path, cc: &OsStr) -> Result<()> {
    let linux = fs::canonicalize(linux).map_err(|error| {
        format!(
            "{}: {error}; build it with cargo build --release, or name another with --volpack",
            linux.display()
        )
    })?;
    let start = Instant::now();
    let prefix = Prefix::new(cc)?;
    println!("wine starts ({:.1} s)", start.elapsed().as_secs_f64());
    let windows = Runner::new(exe.to_owned(), Some(&prefix))?;
    let linux = Runner::new(linux, None)?;
    for (what, step) in [
        ("manifest", manifest as fn(&Runner, &Runner) -> Result<String>),
        ("cache", cached),
        ("formats, killed and continued", formats),
        ("verify", verify),
        ("inspect", inspect),
        ("report", report),
        ("exit codes", exit_codes),
        ("watch", watch),
    ] {
        let start = Instant::now();
        let found = step(&windows, &linux).map_err(|error| format!("{what}: {error}"))?;
        println!("{what}: {found} ({:.1} s)", start.elapsed().as_secs_f64());
    }
    Ok(())
}

/// One of the two programs, and a folder of its own with the fixtures. All paths below are relative to it, because messages and JSON
/// repeat them.
struct Runner<'a> {
    exe: PathBuf,
    wine: Option<&'a Prefix>,
    folder: tempfile::TempDir,
}

impl<'a> Runner<'a> {
    fn new(exe: PathBuf, wine: Option<&'a Prefix>) -> Result<Self> {
        let folder = tempfile::tempdir()?;
        fs::copy(root().join("pipeline.toml"), folder.path().join("pipeline.toml"))?;
        fs::create_dir(folder.path().join("fixtures"))?;
        for entry in fs::read_dir(root().join("fixtures"))? {
            let entry = entry?;
            if entry.path().extension() == Some(OsStr::new("vdb")) {
                fs::copy(entry.path(), folder.path().join("fixtures").join(entry.file_name()))?;
            }
        }
        Ok(Self { exe, wine, folder })
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// The program with arguments that are separated by spaces.
    fn command(&self, arguments: &str) -> Command {
        let mut command = match self.wine {
            None => Command::new(&self.exe),
            Some(prefix) => {
                let mut command = prefix.wine();
                command.arg(&self.exe);
                command
            }
        };
        command.current_dir(self.folder.path()).args(arguments.split(' '));
        command.env("VOLPACK_CACHE", "cache");
        command
    }

    fn run(&self, arguments: &str) -> Result<String> {
        output(&mut self.command(arguments))
    }

    fn json(&self, arguments: &str) -> Result<Json> {
        Ok(serde_json::from_str(&self.run(arguments)?)?)
    }

    /// The exit code, where the program may fail.
    fn exit_code(&self, arguments: &str) -> Result<Option<i32>> {
        Ok(self.command(arguments).output()?.status.code())
    }

    /// The packs in a folder.
    fn packs(&self, folder: &str) -> Result<BTreeMap<String, Vec<u8>>> {
        let mut packs = BTreeMap::new();
        for entry in fs::read_dir(self.path(folder))? {
            let entry = entry?;
            let name = entry.file_name().to_string_lossy().into_owned();
            // Packs that are being written, or were when their process was killed, have temporary names.
            if name.ends_with(".volpack") {
                packs.insert(name, fs::read(entry.path())?);
            }
        }
        Ok(packs)
    }
}

/// Compares the packs of both programs in a folder, and returns their number.
fn same_packs(windows: &Runner, linux: &Runner, folder: &str) -> Result<usize> {
    let (theirs, ours) = (windows.packs(folder)?, linux.packs(folder)?);
    let names = ours.keys().chain(theirs.keys());
    let mut different: Vec<_> = names.filter(|name| ours.get(*name) != theirs.get(*name)).collect();
    different.sort();
    different.dedup();
    if different.is_empty() && !ours.is_empty() {
        Ok(ours.len())
    } else {
        Err(format!("{} of {} packs are missing or differ: {different:?}", different.len(), ours.len())
            .into())
    }
}

/// How each asset of a build came to be, such as `built` or `unchanged`.
fn made(build: &Json) -> Vec<&str> {
    build["assets"].as_array().into_iter().flatten().filter_map(|asset| asset["made"].as_str()).collect()
}

fn ensure(holds: bool, what: impl FnOnce() -> String) -> Result<()> {
    if holds { Ok(()) } else { Err(what().into()) }
}

fn manifest(windows: &Runner, linux: &Runner) -> Result<String> {
    for runner in [windows, linux] {
        runner.run("build --verify voxels")?;
    }
    Ok(format!("{} packs of pipeline.toml have the same bytes", same_packs(windows, linux, "out")?))
}

fn cached(windows: &Runner, linux: &Runner) -> Result<String> {
    let again = windows.json("build --verify voxels --json")?;
    ensure(made(&again).iter().all(|how| *how == "unchanged"), || {
        format!("built again: {:?}", made(&again))
    })?;
    fs::remove_dir_all(windows.path("out"))?;
    let copied = windows.json("build --verify voxels --json")?;
    ensure(made(&copied).iter().all(|how| *how == "copied"), || format!("not copied: {:?}", made(&copied)))?;
    same_packs(windows, linux, "out")?;
    Ok(format!("{} packs unchanged, then copied from the cache", made(&copied).len()))
}

/// Every fixture with every setting; on Windows in a build that is killed and one that continues.
fn formats(windows: &Runner, linux: &Runner) -> Result<String> {
    let manifest = manifest_of_fixtures(linux)?;
    for runner in [windows, linux] {
        fs::write(runner.path("formats.toml"), &manifest)?;
        fs::create_dir(runner.path("formats"))?;
    }
    let arguments = "build --manifest formats.toml --verify none --json";
    let expected = linux.command(arguments).output()?;
    let all = linux.packs("formats")?.len();

    let killed = windows.command(arguments).stdout(Stdio::null()).stderr(Stdio::null()).spawn()?;
    let mut killed = EndedWithTheCheck(killed);
    wait_until("a third of the packs", || Ok(windows.packs("formats")?.len() > all / 3))?;
    killed.0.kill()?;
    killed.0.wait()?;
    let before = windows.packs("formats")?.len();
    ensure(before < all, || "the build ended before it was killed".to_owned())?;

    let continued = windows.command(arguments).output()?;
    ensure(continued.status.code() == expected.status.code(), || {
        format!("ends with {} and on Linux with {}", continued.status, expected.status)
    })?;
    let reused =
        made(&serde_json::from_slice(&continued.stdout)?).iter().filter(|how| **how == "unchanged").count();
    ensure(reused >= before, || {
        format!("{before} packs were built, of which {reused} were taken as they are")
    })?;
    let same = same_packs(windows, linux, "formats")?;
    Ok(format!("{same} packs have the same bytes, {reused} of them built before the kill"))
}

/// A manifest that builds every sequence of the fixtures with every setting.
fn manifest_of_fixtures(runner: &Runner) -> Result<String> {
    let mut files: Vec<_> =
        fs::read_dir(runner.path("fixtures"))?.map(|entry| Ok(entry?.path())).collect::<Result<_>>()?;
    files.sort();
    let mut manifest = String::new();
    for sequence in volpack::sequence::sequences(&files) {
        let first = &sequence.files[0];
        let grids: Vec<_> = VdbSummary::read(first, false)?
            .grids
            .into_iter()
            .filter(|grid| grid.obstacle.is_none())
            .map(|grid| grid.name)
            .collect();
        if grids.is_empty() {
            continue;
        }
        let stem = first.file_stem().unwrap_or_default().to_string_lossy();
        let names: Vec<_> = sequence.files.iter().map(|file| relative(runner, file)).collect();
        for (setting, lines) in SETTINGS {
            writeln!(
                manifest,
                "[asset.'{stem}-{setting}']\nframes = {names:?}\ngrids = {grids:?}\nnonfinite = 'zero'\n{lines}\n\
                 output = 'formats/{stem}-{setting}.volpack'"
            )?;
        }
    }
    Ok(manifest)
}

fn relative(runner: &Runner, file: &Path) -> String {
    file.strip_prefix(runner.folder.path()).unwrap_or(file).to_string_lossy().into_owned()
}

fn verify(windows: &Runner, linux: &Runner) -> Result<String> {
    let arguments = "verify out/puff.volpack --level voxels --json";
    let figures = windows.json(arguments)?;
    ensure(figures == linux.json(arguments)?, || format!("other figures than on Linux: {figures}"))?;
    // Without a display wine has no GPU, so the CPU renders the pictures.
    let pictures = windows.json("verify out/tiles.volpack --device cpu --json")?;
    ensure(pictures["ok"] == true, || format!("pictures: {pictures}"))?;
    Ok("the same figures as on Linux; the pictures of the CPU renderer match".to_owned())
}

fn inspect(windows: &Runner, linux: &Runner) -> Result<String> {
    let files =
        ["fixtures/types.vdb --values", "fixtures/maps.vdb", "fixtures/stream.vdb", "out/puff.volpack"];
    for file in files {
        let arguments = format!("inspect --json {file}");
        let (theirs, ours) = (windows.run(&arguments)?, linux.run(&arguments)?);
        ensure(theirs == ours, || format!("{file}: {theirs}\non Linux: {ours}"))?;
    }
    Ok(format!("the same JSON of {} files as on Linux", files.len()))
}

fn report(windows: &Runner, linux: &Runner) -> Result<String> {
    let arguments = "report --asset tiles --no-cheaper --json report.json --html report.html";
    windows.run(arguments)?;
    linux.run(arguments)?;
    let read = |runner: &Runner| -> Result<Json> {
        Ok(serde_json::from_slice(&fs::read(runner.path("report.json"))?)?)
    };
    let (theirs, ours) = (read(windows)?, read(linux)?);
    let page = fs::read_to_string(windows.path("report.html"))?;
    ensure(page.trim_end().ends_with("</html>"), || "the page is not complete".to_owned())?;
    // The others have times, and the device that rendered the pictures.
    for key in ["file", "frames", "reproduce", "summary"] {
        let [theirs, ours] = [&theirs, &ours].map(|report| &report["assets"][0]["pack"][key]);
        ensure(theirs == ours && !ours.is_null(), || format!("{key}: {theirs}, on Linux {ours}"))?;
    }
    Ok(format!("JSON, and a page of {} bytes", page.len()))
}

fn exit_codes(windows: &Runner, linux: &Runner) -> Result<String> {
    let whole = fs::read(windows.path("out/tiles.volpack"))?;
    for runner in [windows, linux] {
        fs::write(runner.path("half.volpack"), &whole[..whole.len() / 2])?;
    }
    let cases = [
        "build --no-such-option",
        "build fixtures/none.vdb -o none.volpack",
        "build fixtures/frustum.vdb -o frustum.volpack",
        "verify half.volpack --level structure",
    ];
    let mut codes = Vec::new();
    for arguments in cases {
        let (theirs, ours) = (windows.exit_code(arguments)?, linux.exit_code(arguments)?);
        ensure(theirs == ours, || format!("{arguments}: {theirs:?}, on Linux {ours:?}"))?;
        codes.push(theirs.unwrap_or(-1).to_string());
    }
    Ok(format!("{}, as on Linux", codes.join(", ")))
}

fn watch(windows: &Runner, linux: &Runner) -> Result<String> {
    let frames = ["fixtures/anim_0001.vdb", "fixtures/anim_0002.vdb"];
    fs::create_dir(windows.path("watched"))?;
    let manifest = "[asset.watched]\nframes = 'watched/*.vdb'\noutput = 'watched.volpack'\ngrid = 'density'\npsnr = 45\n";
    fs::write(windows.path("watch.toml"), manifest)?;
    fs::copy(windows.path(frames[0]), windows.path("watched/anim_0001.vdb"))?;
    let log = windows.path("watch.log");
    let mut command = windows.command("watch --manifest watch.toml --settle 0.3");
    let child = command.stdout(File::create(&log)?).stderr(Stdio::null()).spawn()?;
    let mut child = EndedWithTheCheck(child);
    let said = |text: &str| Ok(fs::read_to_string(&log)?.contains(text));
    wait_until("the first pack", || said("1 frame,"))?;
    fs::copy(windows.path(frames[1]), windows.path("watched/anim_0002.vdb"))?;
    wait_until("a second frame", || said("2 frames,"))?;
    // A frame with other voxels under a name that is already packed.
    fs::copy(windows.path("fixtures/anim_0008.vdb"), windows.path("watched/anim_0002.vdb"))?;
    wait_until("a changed frame", || Ok(fs::read_to_string(&log)?.matches("2 frames,").count() == 2))?;
    child.0.kill()?;
    child.0.wait()?;

    fs::create_dir(linux.path("watched"))?;
    fs::copy(linux.path(frames[0]), linux.path("watched/anim_0001.vdb"))?;
    fs::copy(linux.path("fixtures/anim_0008.vdb"), linux.path("watched/anim_0002.vdb"))?;
    fs::write(linux.path("watch.toml"), manifest)?;
    linux.run("build --manifest watch.toml --verify none")?;
    let pack = |runner: &Runner| fs::read(runner.path("watched.volpack"));
    ensure(pack(windows)? == pack(linux)?, || "the pack differs from a build on Linux".to_owned())?;
    Ok("rebuilt for a new and a changed frame; the pack has the same bytes".to_owned())
}

fn wait_until(what: &str, mut holds: impl FnMut() -> Result<bool>) -> Result<()> {
    let start = Instant::now();
    while start.elapsed() < PATIENCE {
        if holds()? {
            return Ok(());
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    Err(format!("no sign of {what} after {} s", PATIENCE.as_secs()).into())
}

/// A process that does not outlive a check that fails.
struct EndedWithTheCheck(Child);

impl Drop for EndedWithTheCheck {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}
