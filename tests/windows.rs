//! The binary on Windows, where a file that another program has open cannot be replaced.

#![cfg(windows)]

mod common;

use std::fs::{self, File, OpenOptions};
use std::os::windows::fs::OpenOptionsExt;
use std::path::Path;
use std::process::{Command, Output};

use common::{EndedWithTheTest, fixture, wait_until};
use serde_json::Value as Json;

/// `FILE_SHARE_READ`: others may read the file, but neither write nor delete it. Most programs open files like this.
const OTHERS_READ: u32 = 1;
const NOBODY_ELSE: u32 = 0;

const PACK: &str = "packs/fog.volpack";

fn volpack(folder: &Path, args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_volpack"));
    command.env("VOLPACK_CACHE", folder.join("cache")).current_dir(folder).args(args);
    command
}

fn build(folder: &Path, format: &str) -> Output {
    volpack(folder, &["build", "fog.vdb", "-o", PACK, "-f", format, "--verify", "none"]).output().unwrap()
}

/// A folder with a source and a bc7 pack of it.
fn built() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    fs::copy(fixture("fog_half_zip.vdb"), folder.path().join("fog.vdb")).unwrap();
    let output = build(folder.path(), "bc7");
    assert!(output.status.success(), "{output:?}");
    folder
}

fn hold(path: &Path, share_mode: u32) -> File {
    OpenOptions::new().read(true).share_mode(share_mode).open(path).unwrap()
}

/// Checks that a build fails because its output is open, and says so.
fn assert_in_use(output: &Output) {
    let error = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{error}");
    assert!(error.contains("fog.volpack is open in another program: close it there"), "{error}");
}

#[test]
fn a_pack_that_another_program_has_open_stays_and_nothing_is_left_beside_it() {
    let folder = built();
    let pack = folder.path().join(PACK);
    let old = fs::read(&pack).unwrap();

    let held = hold(&pack, OTHERS_READ);
    assert_in_use(&build(folder.path(), "f16"));
    drop(held);
    assert!(fs::read(&pack).unwrap() == old, "the pack has changed");
    let names = |entry: std::io::Result<fs::DirEntry>| entry.unwrap().file_name();
    let left: Vec<_> = fs::read_dir(pack.parent().unwrap()).unwrap().map(names).collect();
    assert_eq!(left, ["fog.volpack"]);

    assert!(build(folder.path(), "f16").status.success());
    assert!(fs::read(&pack).unwrap() != old, "the pack is not replaced although nobody has it open");
}

/// Nobody can tell that an output is not a pack if it cannot be read, so nobody is told to delete it.
#[test]
fn an_output_that_cannot_be_read_is_open_in_another_program() {
    let folder = built();
    let pack = folder.path().join(PACK);
    let old = fs::read(&pack).unwrap();

    let held = hold(&pack, NOBODY_ELSE);
    assert_in_use(&build(folder.path(), "f16"));
    drop(held);
    assert!(fs::read(&pack).unwrap() == old, "the pack has changed");
}

#[test]
fn watch_builds_the_other_packs_and_replaces_an_open_one_once_it_is_closed() {
    let folder = built();
    let at = folder.path();
    let manifest = format!(
        "[asset.fog]\nframes = 'fog.vdb'\noutput = '{PACK}'\nformat = 'f16'\n\
         [asset.other]\nframes = 'fog.vdb'\noutput = 'packs/other.volpack'\nformat = 'f16'\n"
    );
    fs::write(at.join("pipeline.toml"), manifest).unwrap();
    let pack = at.join(PACK);
    let old = fs::read(&pack).unwrap();

    let held = hold(&pack, OTHERS_READ);
    let log = at.join("watch.log");
    let mut watch = volpack(at, &["watch", "--settle", "0.2"]);
    let watch = EndedWithTheTest(watch.stdout(File::create(&log).unwrap()).spawn().unwrap());
    let said = || fs::read_to_string(&log).unwrap();
    wait_until("a message", || said().contains("fog.volpack is open in another program"));
    wait_until("the other pack", || at.join("packs/other.volpack").exists());
    assert!(fs::read(&pack).unwrap() == old, "the pack has changed");
    drop(held);
    wait_until("the new pack", || fs::read(&pack).unwrap() != old);
    drop(watch);
    assert_eq!(said().matches("is open in another program").count(), 1, "{}", said());

    let again = volpack(at, &["build", "--verify", "voxels", "--json"]).output().unwrap();
    let again: Json = serde_json::from_slice(&again.stdout).unwrap();
    for asset in again["assets"].as_array().unwrap() {
        assert_eq!(asset["made"], "unchanged", "{asset}");
    }
}
