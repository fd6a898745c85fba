//! What several tests need: fixtures, what OpenVDB says of them, and quick builds.

#![allow(dead_code)] // Each test file uses a part of it.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Child;
use std::time::{Duration, Instant};

use serde_json::Value as Json;
use volpack::pack::Pack;
use volpack::pipeline::{Job, Silent, VerifyLevel, build};
use volpack::render::gpu::Gpu;
use volpack::settings::Settings;
use volpack::verify::VerifyReport;

/// A file of the fixtures' folder.
pub fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures").join(name)
}

/// Every OpenVDB fixture, sorted by name.
pub fn fixtures() -> Vec<PathBuf> {
    let mut files: Vec<_> = std::fs::read_dir(fixture(""))
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|e| e == "vdb"))
        .collect();
    files.sort();
    assert!(files.len() > 30, "the fixtures are missing");
    files
}

/// The eight frames of the animation.
pub fn animation() -> Vec<PathBuf> {
    (1..=8).map(|n| fixture(&format!("anim_{n:04}.vdb"))).collect()
}

/// Says that a test is skipped for want of something. Standard error itself, since the harness keeps what passing tests
/// print to itself.
///
/// # Panics
/// When `VOLPACK_REQUIRE_` and what is wanted is set, as where CI runs: there nothing is skipped.
pub fn skip(wanted: &str, why: &str) {
    let test = std::thread::current().name().unwrap_or("a test").to_owned();
    assert!(std::env::var_os(format!("VOLPACK_REQUIRE_{wanted}")).is_none(), "{test}: {why}");
    std::io::stderr().write_all(format!("skipped: {test}: {why}\n").as_bytes()).unwrap();
}

/// The device of tests that need one; they are skipped where there is none.
pub fn gpu() -> Option<&'static Gpu> {
    Gpu::shared().map_err(|e| skip("GPU", &e.to_string())).ok()
}

/// What OpenVDB says of each grid of a file.
pub fn facts(path: &Path) -> Vec<Json> {
    let text = std::fs::read_to_string(path.with_extension("json")).unwrap();
    serde_json::from_str::<Json>(&text).unwrap()["grids"].as_array().unwrap().clone()
}

/// One of the voxels that OpenVDB was asked for: where, value, active.
pub fn probes(facts: &Json) -> impl Iterator<Item = ([i32; 3], f64, bool)> + '_ {
    facts["probes"].as_array().unwrap().iter().map(|probe| {
        let at = std::array::from_fn(|a| probe[a].as_i64().unwrap() as i32);
        let bits = u64::from_str_radix(probe[3].as_str().unwrap(), 16).unwrap();
        (at, f64::from_bits(bits), probe[4].as_bool().unwrap())
    })
}

/// Builds a pack of `frames` in a folder that the caller keeps, and compares every voxel.
pub fn build_verified(frames: &[PathBuf], settings: Settings, folder: &Path) -> (Pack, VerifyReport) {
    let output = folder.join("test.volpack");
    let job = Job::new(frames.to_vec(), output, settings, VerifyLevel::Voxels);
    let outcome = build(&job, &mut Silent).unwrap_or_else(|e| panic!("{frames:?}: {e}"));
    (Pack::open(&job.output).unwrap(), outcome.verification.unwrap())
}

/// Waits until a condition holds.
///
/// # Panics
/// When it does not within two minutes, which is enough for a busy machine.
pub fn wait_until(what: &str, holds: impl Fn() -> bool) {
    let end = Instant::now() + Duration::from_secs(120);
    while !holds() {
        assert!(Instant::now() < end, "waited for {what} in vain");
        std::thread::sleep(Duration::from_millis(100));
    }
}

/// A process that does not outlive a test that fails.
pub struct EndedWithTheTest(pub Child);

impl Drop for EndedWithTheTest {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}
