//! The cache: never another pack, and as little work as possible.

mod common;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::Arc;
use std::time::Duration;

use common::{EndedWithTheTest, animation, fixture, wait_until};
use serde_json::Value as Json;
use volpack::cache::Cache;
use volpack::pipeline::{Job, Made, Outcome, Progress, Silent, VerifyLevel, build};
use volpack::settings::{
    Clustering, Encoding, ErrorBound, Format, Masks, NonFinite, Quality, RangeMode, Settings, TexelCodec,
};

/// A folder with a cache and the frames of an animation that may be edited.
struct Shop {
    folder: tempfile::TempDir,
    cache: Arc<Cache>,
}

impl Shop {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let cache = Arc::new(Cache::open(&folder.path().join("cache")).unwrap());
        for file in animation() {
            fs::copy(&file, folder.path().join(file.file_name().unwrap())).unwrap();
        }
        Self { folder, cache }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn frames(&self) -> Vec<PathBuf> {
        animation().iter().map(|file| self.path(&file.file_name().unwrap().to_string_lossy())).collect()
    }

    fn job(&self, frames: &[PathBuf], settings: &Settings) -> Job {
        let output = self.path("cached.volpack");
        let mut job = Job::new(frames.to_vec(), output, settings.clone(), VerifyLevel::None);
        job.cache = Some(Arc::clone(&self.cache));
        job
    }

    fn build(&self, frames: &[PathBuf], settings: &Settings) -> Outcome {
        build(&self.job(frames, settings), &mut Silent).unwrap()
    }

    /// Builds with the cache as it is, and compares with a build without.
    fn build_and_compare(&self, frames: &[PathBuf], settings: &Settings) -> Outcome {
        let outcome = self.build(frames, settings);
        let alone =
            Job::new(frames.to_vec(), self.path("alone.volpack"), settings.clone(), VerifyLevel::None);
        build(&alone, &mut Silent).unwrap();
        let same = fs::read(self.path("cached.volpack")).unwrap() == fs::read(&alone.output).unwrap();
        assert!(same, "{settings:?} of {} frames: {:?}", frames.len(), outcome.cache);
        outcome
    }
}

/// The files under a folder.
fn files(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).into_iter().flatten().map(|entry| entry.unwrap().path());
    let mut files: Vec<PathBuf> =
        entries.flat_map(|p| if p.is_dir() { files(&p) } else { vec![p] }).collect();
    files.sort();
    files
}

fn of_quality(quality: Quality) -> Settings {
    Settings { grids: vec!["density".to_owned()], encoding: quality.into(), ..Settings::default() }
}

fn of_format(format: Format) -> Settings {
    Settings { encoding: format.into(), ..of_quality(Quality::default()) }
}

fn clustered(clustering: Clustering) -> Encoding {
    Encoding::Uniform { codec: TexelCodec::BC7, clustering: Some(clustering) }
}

/// Settings that share parts of each other's work in every way.
fn variety() -> Vec<Settings> {
    let psnr = |db| of_quality(Quality::Psnr(db));
    vec![
        psnr(45.0),
        psnr(60.0),
        psnr(30.0),
        psnr(46.0),
        Settings {
            encoding: Encoding::Adaptive { quality: Quality::Psnr(50.0), min_frame_psnr: Some(50.0) },
            ..psnr(50.0)
        },
        of_quality(Quality::MaxError(ErrorBound::of_range(0.01))),
        of_quality(Quality::Size(60_000)),
        Settings { grids: vec!["density".to_owned(), "temperature".to_owned()], ..psnr(45.0) },
        Settings { range: RangeMode::Sequence, ..psnr(40.0) },
        Settings { masks: Masks::Keep, ..psnr(45.0) },
        Settings { zstd: 0, ..psnr(45.0) },
        Settings { zstd: 19, ..psnr(46.0) },
        Settings { nonfinite: NonFinite::Zero, ..psnr(45.0) },
        Settings { fps: Some(24.0), ..psnr(45.0) },
        of_format(Format::BC7),
        of_format(Format::BC4),
        of_format(Format::UNORM8),
        of_format(Format::F16),
        Settings { zstd: 7, ..of_format(Format::F16) },
        of_format(Format::F32),
        Settings {
            encoding: clustered(Clustering { clusters: 8, ..Clustering::default() }),
            ..of_format(Format::BC7)
        },
    ]
}

#[test]
fn no_order_of_builds_changes_a_pack() {
    for reverse in [false, true] {
        let shop = Shop::new();
        let mut order = variety();
        if reverse {
            order.reverse();
        }
        for settings in &order {
            shop.build_and_compare(&shop.frames(), settings);
        }
        // What was built first is what it was.
        let again = shop.build_and_compare(&shop.frames(), &order[0]);
        assert_eq!(again.made, Made::Copied);
        assert!(shop.cache.verify().unwrap().is_sound());
    }
}

#[test]
fn no_choice_of_frames_changes_a_pack() {
    let shop = Shop::new();
    let frames = shop.frames();
    // The first of two frames that share bricks has them: who that is depends on who else is there.
    for choice in [&frames[..], &frames[3..], &frames[..5], &frames[2..3], &frames[..]] {
        for settings in [&variety()[0], &variety()[5], &of_format(Format::BC7)] {
            shop.build_and_compare(choice, settings);
        }
    }
    // Frames trade places, so that each brick has another home.
    fs::copy(fixture("anim_0006.vdb"), shop.path("anim_0001.vdb")).unwrap();
    fs::copy(fixture("anim_0001.vdb"), shop.path("anim_0006.vdb")).unwrap();
    for settings in variety() {
        shop.build_and_compare(&frames, &settings);
    }
}

#[test]
fn level_sets_and_backgrounds_come_out_the_same() {
    let shop = Shop::new();
    for (name, grid) in [
        ("levelset_float", "surface"),
        ("negative", "density"),
        ("adversarial", "negative_background"),
        ("tiles", "density"),
        ("inactive_float", "density"),
    ] {
        let frames = [fixture(&format!("{name}.vdb"))];
        for db in [40.0, 50.0, 40.5] {
            let settings = Settings { grids: vec![grid.to_owned()], ..of_quality(Quality::Psnr(db)) };
            shop.build_and_compare(&frames, &settings);
        }
    }
}

#[test]
fn what_did_not_change_is_not_made_again() {
    let shop = Shop::new();
    let (mut frames, settings) = (shop.frames(), of_quality(Quality::Psnr(45.0)));
    let late = frames.remove(3);
    let cold = shop.build(&frames, &settings);
    assert_eq!((cold.made, cold.cache["outline"].misses), (Made::Built, 7));
    let again = shop.build(&frames, &settings);
    assert_eq!(again.made, Made::Unchanged);
    let level = shop.build(&frames, &Settings { zstd: 9, ..settings.clone() });
    assert_eq!(level.made, Made::Repacked);
    assert!(!level.cache.contains_key("outline"), "no stage ran");
    fs::remove_file(shop.path("cached.volpack")).unwrap();
    assert_eq!(shop.build(&frames, &settings).made, Made::Copied);

    // Entries are counted by the batch: what this one asks for beside is added to them.
    let coarser = shop.build(&frames, &of_quality(Quality::Psnr(44.9)));
    assert_eq!((coarser.made, coarser.cache["outline"].misses), (Made::Built, 0));
    assert_eq!(coarser.cache["encode"].misses, 0, "{:?}", coarser.cache);

    frames.insert(3, late);
    let more = shop.build_and_compare(&frames, &settings);
    assert_eq!(more.cache["outline"].misses, 1);
    // Of each frame's four kinds.
    assert_eq!((more.cache["encode"].hits, more.cache["encode"].misses), (28, 4), "{:?}", more.cache);
}

#[test]
fn a_verification_is_made_once_and_failures_each_time() {
    let shop = Shop::new();
    let verified = |settings: &Settings, frames: &[PathBuf]| {
        let mut job = shop.job(frames, settings);
        job.verify = VerifyLevel::Voxels;
        build(&job, &mut Silent).unwrap()
    };
    let settings = of_quality(Quality::Psnr(45.0));
    let first = verified(&settings, &shop.frames());
    let second = verified(&settings, &shop.frames());
    assert_eq!((first.was_verified, second.was_verified), (false, true));
    let json = |outcome: &Outcome| serde_json::to_value(&outcome.verification).unwrap();
    assert_eq!(json(&first), json(&second));

    // One shape for all bricks of a level set flips signs.
    let encoding = clustered(Clustering { clusters: 1, variance: 1.0, ..Clustering::default() });
    let flips = Settings { grids: vec!["surface".to_owned()], encoding, ..Settings::default() };
    for _ in 0..2 {
        let outcome = verified(&flips, &[fixture("levelset_half.vdb")]);
        assert!(!outcome.was_verified && !outcome.verification.unwrap().ok);
    }
}

/// Keeps warnings.
#[derive(Default)]
struct Warnings(Vec<String>);

impl Progress for Warnings {
    fn warn(&mut self, warning: &str) {
        self.0.push(warning.to_owned());
    }
}

#[test]
fn damage_is_a_warning_and_never_another_pack() {
    let shop = Shop::new();
    let (frames, settings) = (shop.frames(), of_quality(Quality::Psnr(45.0)));
    shop.build(&frames, &settings);
    let output = shop.path("cached.volpack");
    let expected = fs::read(&output).unwrap();
    let folders = ["actions", "blobs"].map(|name| shop.path("cache").join(name));
    let all: Vec<PathBuf> = folders.iter().flat_map(|folder| files(folder)).collect();
    let is_pack = |bytes: &[u8]| bytes.starts_with(b"vpcache") && bytes[8..12] == *b"pack";
    let pack_digest = blake3::hash(&expected).to_hex();
    for (i, damaged) in all.iter().enumerate() {
        // The pack would hide what is wrong below it.
        for file in files(&folders[0]) {
            if is_pack(&fs::read(&file).unwrap()) && file != *damaged {
                fs::remove_file(file).unwrap();
            }
        }
        let mut bytes = fs::read(damaged).unwrap_or_default();
        match i % 3 {
            0 => bytes.truncate(bytes.len() / 2),
            1 => bytes.push(0),
            _ => bytes.iter_mut().skip(20).step_by(50).for_each(|b| *b ^= 4),
        }
        fs::write(damaged, bytes).unwrap();
        fs::remove_file(&output).unwrap();
        let mut warnings = Warnings::default();
        build(&shop.job(&frames, &settings), &mut warnings).unwrap();
        assert!(fs::read(&output).unwrap() == expected, "{}", damaged.display());
        // Of the pack itself nothing is read once its action is gone.
        let is_pack_blob = damaged.ends_with(&pack_digest[2..]);
        let names_it =
            |warning: &String| warning.contains(&*damaged.to_string_lossy()) && warning.contains("made anew");
        assert!(is_pack_blob || warnings.0.iter().any(names_it), "{}: {:?}", damaged.display(), warnings.0);
    }
    // A pack of the right length is found out when it is read, which no build above did after it was damaged.
    fs::remove_file(&output).unwrap();
    shop.build(&frames, &settings);
    assert!(fs::read(&output).unwrap() == expected);
    assert!(shop.cache.verify().unwrap().is_sound(), "what was damaged is mended");
}

/// Whoever can write to a store can put anything under any key, with every digest right. Verification finds it.
#[test]
fn an_entry_that_is_anothers_misleads_nobody() {
    let shop = Shop::new();
    let (frames, settings) = (shop.frames(), of_quality(Quality::Psnr(45.0)));
    let job = Job { verify: VerifyLevel::Voxels, ..shop.job(&frames, &settings) };
    build(&job, &mut Silent).unwrap();
    let expected = fs::read(&job.output).unwrap();
    let actions = files(&shop.path("cache").join("actions"));
    let stage = |bytes: &[u8]| String::from_utf8_lossy(&bytes[8..24]).trim_end_matches('\0').to_owned();
    let kept: Vec<Vec<u8>> = actions.iter().map(|file| fs::read(file).unwrap()).collect();
    let mut told = 0;
    for (i, bytes) in kept.iter().enumerate() {
        // What another entry of the same stage says, or of any other: its digest is over the stage's name too.
        for other in [kept.iter().rfind(|o| stage(o) == stage(bytes) && *o != bytes), kept.first()] {
            let Some(other) = other else { continue };
            let mut forged = other.clone();
            forged[8..24].copy_from_slice(&bytes[8..24]);
            let (body, digest) = forged.split_at_mut(64);
            digest.copy_from_slice(blake3::hash(body).as_bytes());
            fs::write(&actions[i], &forged).unwrap();
            let is_pack = stage(bytes).starts_with("pack");
            for (file, was) in actions.iter().zip(&kept) {
                // The pack would hide what is wrong below it, and its verification that of another pack.
                if !is_pack && stage(was).starts_with("pack")
                    || stage(was) == "verify" && stage(bytes) != "verify"
                {
                    let _ = fs::remove_file(file);
                }
            }
            fs::remove_file(&job.output).unwrap();
            let mut warnings = Warnings::default();
            let outcome = build(&job, &mut warnings).unwrap();
            assert!(outcome.verification.unwrap().ok, "{}", stage(bytes));
            assert!(fs::read(&job.output).unwrap() == expected, "{}: {:?}", stage(bytes), warnings.0);
            told += usize::from(!warnings.0.is_empty());
            for (file, was) in actions.iter().zip(&kept) {
                fs::write(file, was).unwrap();
            }
        }
    }
    assert!(told > kept.len() / 4, "a word is said about what was forged: {told} of {}", kept.len());
}

#[test]
fn one_damaged_entry_is_named() {
    let shop = Shop::new();
    let (frames, settings) = (shop.frames(), of_quality(Quality::Psnr(45.0)));
    shop.build(&frames, &settings);
    for file in files(&shop.path("cache").join("blobs")) {
        fs::write(file, "damaged").unwrap();
    }
    fs::remove_file(shop.path("cached.volpack")).unwrap();
    let mut warnings = Warnings::default();
    build(&shop.job(&frames, &settings), &mut warnings).unwrap();
    assert!(warnings.0.len() > 8, "{:?}", warnings.0);
    assert!(warnings.0.iter().all(|w| w.contains("blobs") && w.contains("made anew")), "{:?}", warnings.0);
}

fn volpack(folder: &Path, args: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_volpack"));
    command.env("VOLPACK_CACHE", folder.join("cache")).current_dir(folder).args(args).output().unwrap()
}

fn stdout(output: &Output) -> String {
    assert!(output.status.success(), "{output:?}");
    String::from_utf8(output.stdout.clone()).unwrap()
}

const MANIFEST: &str = "[asset.puff]\nframes = 'anim_*.vdb'\ngrid = 'density'\noutput = 'puff.volpack'\n";

#[test]
fn a_build_is_explained() {
    let shop = Shop::new();
    let folder = shop.folder.path();
    fs::write(shop.path("pipeline.toml"), MANIFEST).unwrap();
    let explain = || stdout(&volpack(folder, &["explain", "puff"]));
    assert!(explain().contains("puff.volpack does not exist"));
    stdout(&volpack(folder, &["build", "--verify", "voxels"]));
    assert!(explain().contains("verify"), "pictures were not looked at");
    stdout(&volpack(folder, &["build", "--device", "auto"]));
    assert_eq!(explain(), "puff: up to date\n");

    fs::copy(fixture("anim_0002.vdb"), shop.path("anim_0003.vdb")).unwrap();
    fs::remove_file(shop.path("anim_0008.vdb")).unwrap();
    fs::copy(fixture("fog_half_blosc.vdb"), shop.path("anim_0009.vdb")).unwrap();
    fs::write(shop.path("pipeline.toml"), format!("{MANIFEST}psnr = 50\n")).unwrap();
    let text = explain();
    for line in [
        "quality changed from psnr 55 (level sets: max-error 0.05 voxels) to psnr 50",
        "anim_0003.vdb changed",
        "anim_0009.vdb added",
        "anim_0008.vdb removed",
        // What frame 3 is now, frame 2 was before.
        "flatten    1 of 8 frames: anim_0009.vdb",
    ] {
        assert!(text.contains(line), "{line}: {text}");
    }
    let json: Json = serde_json::from_str(&stdout(&volpack(folder, &["explain", "--json"]))).unwrap();
    assert_eq!(json[0]["explanation"]["stages"][0]["stage"], "flatten");
}

/// CI machines have no GPU: what the CPU tracer verified there holds until there is one.
#[test]
fn a_verification_without_a_device_is_kept_until_there_is_one() {
    let shop = Shop::new();
    let folder = shop.folder.path();
    fs::write(shop.path("pipeline.toml"), MANIFEST).unwrap();
    let run = |args: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_volpack"));
        command.env("VOLPACK_CACHE", folder.join("cache")).current_dir(folder).args(args);
        // No driver is where Vulkan's loader is told to look.
        command.env("VK_DRIVER_FILES", "/nowhere").env("VK_ICD_FILENAMES", "/nowhere").output().unwrap()
    };
    let first = stdout(&run(&["build"]));
    assert!(first.contains("rendered on the CPU only: no Vulkan device found"), "{first}");
    assert_eq!(stdout(&run(&["explain"])), "puff: up to date\n");
    let again: Json = serde_json::from_str(&stdout(&run(&["build", "--json"]))).unwrap();
    assert_eq!(again["assets"][0]["cache"]["verify"], serde_json::json!({ "hits": 1, "misses": 0 }));
    if common::gpu().is_some() {
        assert!(stdout(&volpack(folder, &["explain"])).contains("with this device"));
        assert!(!stdout(&volpack(folder, &["build"])).contains("rendered on the CPU only"));
    }
}

#[test]
fn the_cache_is_looked_after() {
    let shop = Shop::new();
    let folder = shop.folder.path();
    fs::write(shop.path("pipeline.toml"), MANIFEST).unwrap();
    let json = |args: &[&str]| -> Json { serde_json::from_str(&stdout(&volpack(folder, args))).unwrap() };
    let bytes = || json(&["cache", "stats", "--json"])["stats"]["bytes"].as_u64().unwrap();
    stdout(&volpack(folder, &["build", "--verify", "none", "--no-cache"]));
    assert_eq!(bytes(), 0);
    stdout(&volpack(folder, &["build", "--verify", "none"]));
    let all = bytes();
    assert!(all > 50_000, "{all}");
    assert_eq!(json(&["cache", "verify", "--json"])["ok"], true);
    assert_eq!(json(&["cache", "gc", "--max-age", "1d", "--json"])["files"], 0);
    json(&["cache", "gc", "--max-size", "40kB", "--json"]);
    assert!(bytes() <= 40_000);
    stdout(&volpack(folder, &["build", "--verify", "none"]));

    let blob = files(&shop.path("cache").join("blobs")).pop().unwrap();
    fs::write(&blob, "damaged").unwrap();
    let verified = volpack(folder, &["cache", "verify"]);
    assert_eq!(verified.status.code(), Some(3));
    assert!(String::from_utf8_lossy(&verified.stderr).contains(&*blob.to_string_lossy()));
    stdout(&volpack(folder, &["cache", "verify"]));
    // What is not the cache's own stays.
    fs::write(shop.path("cache").join("mine.txt"), "mine").unwrap();
    stdout(&volpack(folder, &["cache", "clear"]));
    assert_eq!(bytes(), 0);
    assert!(shop.path("cache").join("mine.txt").exists());
    assert_eq!(volpack(folder, &["cache", "gc"]).status.code(), Some(2), "gc of what?");
}

#[test]
fn a_cache_that_cannot_be_is_a_warning() {
    let shop = Shop::new();
    fs::write(shop.path("pipeline.toml"), MANIFEST).unwrap();
    fs::write(shop.path("file"), "").unwrap();
    let output = volpack(shop.folder.path(), &["build", "--verify", "none", "--cache", "file/cache"]);
    assert!(stdout(&output).contains("puff.volpack"));
    assert!(String::from_utf8_lossy(&output.stderr).contains("going on without a cache"));
}

#[test]
fn processes_share_a_store() {
    let shop = Shop::new();
    let args = |process: usize| {
        let psnr = ["45", "50", "55", "60"][process % 4];
        ["build", "anim_*.vdb", "--verify", "none", "--grid", "density", "--psnr", psnr, "-o"]
            .map(str::to_owned)
    };
    let start = |process: usize, output: &str, cache: &str| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_volpack"));
        command.args(args(process)).arg(output).args(["--cache", cache]).current_dir(shop.folder.path());
        command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap()
    };
    let running: Vec<_> = (0..8).map(|p| start(p, &format!("{p}.volpack"), "cache")).collect();
    for (process, child) in running.into_iter().enumerate() {
        let output = child.wait_with_output().unwrap();
        assert!(output.status.success(), "{output:?}");
        let alone = format!("alone-{process}.volpack");
        let apart = start(process, &alone, &format!("cache-{process}")).wait_with_output().unwrap();
        assert!(apart.status.success(), "{apart:?}");
        let same = fs::read(shop.path(&format!("{process}.volpack"))).unwrap()
            == fs::read(shop.path(&alone)).unwrap();
        assert!(same, "process {process}");
    }
    assert!(shop.cache.verify().unwrap().is_sound());
}

#[test]
fn killed_builds_leave_a_cache_that_goes_on() {
    let shop = Shop::new();
    let settings = of_quality(Quality::Psnr(45.0));
    for milliseconds in [1, 5, 10, 20, 40, 80, 120] {
        let mut child = Command::new(env!("CARGO_BIN_EXE_volpack"))
            .args(["build", "anim_*.vdb", "--verify", "none", "--grid", "density", "-o", "killed.volpack"])
            .args(["--cache", "cache"])
            .current_dir(shop.folder.path())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        std::thread::sleep(Duration::from_millis(milliseconds));
        child.kill().unwrap();
        child.wait().unwrap();
        shop.build_and_compare(&shop.frames(), &settings);
    }
}

#[test]
fn a_watch_builds_what_lands_and_ctrl_c_ends_it() {
    let shop = Shop::new();
    let folder = shop.folder.path();
    fs::write(shop.path("pipeline.toml"), MANIFEST.replace("anim_", "in/anim_")).unwrap();
    fs::create_dir(shop.path("in")).unwrap();
    let log = shop.path("log");
    let child = Command::new(env!("CARGO_BIN_EXE_volpack"))
        .args(["watch", "--settle", "0.3", "--cache", "cache"])
        .current_dir(folder)
        .stdout(fs::File::create(&log).unwrap())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let mut child = EndedWithTheTest(child);
    let said = |text: &str| fs::read_to_string(&log).unwrap().contains(text);
    wait_until("a word about what it waits for", || said("waiting"));
    let whole = fs::read(fixture("anim_0001.vdb")).unwrap();
    // The first half stays as it is for longer than it takes to settle.
    fs::write(shop.path("in/anim_0001.vdb"), &whole[..whole.len() / 2]).unwrap();
    std::thread::sleep(Duration::from_millis(1000));
    assert!(!said("kept the last good pack"), "a half-written file is waited for");
    fs::write(shop.path("in/anim_0001.vdb"), &whole).unwrap();
    wait_until("the first pack", || said("1 frame,"));
    fs::copy(fixture("anim_0002.vdb"), shop.path("in/anim_0002.vdb")).unwrap();
    wait_until("the second pack", || said("2 frames,"));
    let good = fs::read(shop.path("puff.volpack")).unwrap();
    fs::copy(fixture("frustum.vdb"), shop.path("in/anim_0003.vdb")).unwrap();
    wait_until("an error", || said("kept the last good pack"));
    assert!(fs::read(shop.path("puff.volpack")).unwrap() == good);

    // Windows sends Ctrl-C to all programs of a console at once, and so to the tests too.
    if cfg!(unix) {
        // The shell's own: a program of that name is not on every machine.
        let kill = format!("kill -INT {}", child.0.id());
        assert!(Command::new("sh").args(["-c", &kill]).status().unwrap().success());
        assert!(child.0.wait().unwrap().success());
    }
}
