//! Builds of several machines, each with a store of its own, that share a bucket.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::{Duration, Instant};

use serde_json::Value as Json;
use volpack::cache::remote::Policy;

use crate::common::animation;
use crate::server::{CEILING, Fault, Server, broken};

const URL: &str = "s3://bucket/volpack";

/// A machine with the animation's frames and an empty store.
struct Machine {
    folder: tempfile::TempDir,
}

/// How a build went.
struct Built {
    json: Json,
    warnings: Vec<String>,
    pack: Vec<u8>,
}

impl Machine {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        for file in animation() {
            fs::copy(&file, folder.path().join(file.file_name().unwrap())).unwrap();
        }
        Self { folder }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn command(&self, server: &Server, args: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_volpack"));
        command.current_dir(self.folder.path()).env("VOLPACK_REMOTE_CACHE", URL);
        command.envs(server.options().map(|(key, value)| (key.to_uppercase(), value)));
        command.args(["build", "anim_*.vdb", "-o", "out.volpack", "--cache", "store", "--verify", "voxels"]);
        command.args(args);
        command
    }

    fn build(&self, server: &Server) -> Built {
        self.finish(self.command(server, &[]).output().unwrap())
    }

    /// What became of a build, which must not fail whatever the remote does.
    fn finish(&self, output: Output) -> Built {
        let stderr = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.success(), "{stderr}");
        let warnings = stderr.lines().filter(|line| line.starts_with("warning")).map(str::to_owned).collect();
        let json = if output.stdout.starts_with(b"{") {
            serde_json::from_slice::<Json>(&output.stdout).unwrap()["assets"][0].take()
        } else {
            Json::Null
        };
        Built { json, warnings, pack: fs::read(self.path("out.volpack")).unwrap() }
    }

    /// The same with its JSON, which leaves no room for warnings.
    fn build_json(&self, server: &Server) -> Built {
        self.finish(self.command(server, &["--json"]).output().unwrap())
    }

    /// The pack of a build that knows nothing.
    fn alone(&self, server: &Server) -> Vec<u8> {
        let output = self.command(server, &["--no-cache"]).output().unwrap();
        self.finish(output).pack
    }

    /// Another first frame.
    fn edit(&self) {
        fs::copy(self.path("anim_0005.vdb"), self.path("anim_0001.vdb")).unwrap();
    }
}

fn objects(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).into_iter().flatten().map(|entry| entry.unwrap().path());
    entries.flat_map(|path| if path.is_dir() { objects(&path) } else { vec![path] }).collect()
}

#[test]
fn what_one_machine_made_another_takes() {
    let server = Server::start();
    let first = Machine::new().build(&server);
    assert_eq!(first.warnings, Vec::<String>::new());
    let other = Machine::new();
    let second = other.build_json(&server);
    assert_eq!(second.json["made"], "copied");
    assert_eq!(second.json["cache"]["verify"], serde_json::json!({ "hits": 1, "misses": 0 }));
    assert!(second.pack == first.pack);
    // Another has one frame of its own, which is the fifth's twin: the blocks of all but that one are there.
    let third = Machine::new();
    third.edit();
    let requests = server.requests();
    let built = third.build_json(&server);
    assert_eq!(built.json["made"], "built");
    let encode = &built.json["cache"]["encode"];
    assert!(encode["hits"].as_u64() >= Some(7), "{encode}");
    assert!(built.pack == third.alone(&server));
    // What is in its own store is not asked for again.
    let requests = server.requests() - requests;
    let before = server.requests();
    assert_eq!(third.build_json(&server).json["made"], "unchanged");
    assert!(server.requests() == before && requests > 0);
}

#[test]
fn damaged_objects_are_made_anew_and_replaced() {
    for map in ["actions", "blobs"] {
        let server = Server::start();
        let first = Machine::new().build(&server);
        let all = objects(&server.folder().join("bucket/volpack").join(map));
        assert!(all.len() > 10, "{all:?}");
        for path in &all {
            let mut bytes = fs::read(path).unwrap();
            let middle = bytes.len() / 2;
            bytes[middle] ^= 1;
            fs::write(path, bytes).unwrap();
        }
        let second = Machine::new().build(&server);
        assert!(second.pack == first.pack);
        let told = |w: &String| w.contains("of the remote cache cannot be used");
        assert!(second.warnings.iter().any(told), "{:?}", second.warnings);
        assert_eq!(Machine::new().build_json(&server).json["made"], "copied");
    }
}

#[test]
fn evicted_blobs_are_made_anew() {
    let server = Server::start();
    let first = Machine::new().build(&server);
    fs::remove_dir_all(server.folder().join("bucket/volpack/blobs")).unwrap();
    let second = Machine::new().build(&server);
    assert!(second.pack == first.pack);
    assert_eq!(second.warnings, Vec::<String>::new());
    assert_eq!(Machine::new().build_json(&server).json["made"], "copied");
}

#[test]
fn two_machines_may_race() {
    let server = Server::start();
    let machines = [Machine::new(), Machine::new()];
    let running = machines.iter().map(|m| {
        let mut command = m.command(&server, &[]);
        command.stdout(std::process::Stdio::null()).stderr(std::process::Stdio::piped()).spawn().unwrap()
    });
    let running: Vec<_> = running.collect();
    let built =
        running.into_iter().zip(&machines).map(|(child, m)| m.finish(child.wait_with_output().unwrap()));
    let built: Vec<Built> = built.collect();
    assert!(built.iter().all(|b| b.warnings.is_empty() && b.pack == built[0].pack));
    let third = Machine::new().build_json(&server);
    assert!(third.json["made"] == "copied" && third.pack == built[0].pack);
}

#[test]
fn a_server_that_goes_away_in_the_middle_fails_no_build() {
    let whole = {
        let server = Server::start();
        let pack = Machine::new().build(&server).pack;
        (pack, server.requests())
    };
    let faults = [Fault::Drop, broken(u32::MAX), Fault::Silent];
    for (i, fault) in faults.into_iter().enumerate() {
        for part in 0..3 {
            let server = Server::start();
            server.set_after(whole.1 * part / 3 + i as u64, fault);
            let start = Instant::now();
            let built = Machine::new().build(&server);
            assert!(built.pack == whole.0, "{fault:?} {part}");
            assert!(
                built.warnings.iter().any(|w| w.contains("given up after 3 failures")),
                "{:?}",
                built.warnings
            );
            assert!(start.elapsed() < CEILING, "{fault:?} {part}");
        }
    }
}

#[test]
fn a_server_that_is_killed_in_the_middle_fails_no_build() {
    let mut server = Server::start();
    let filled = Machine::new();
    let pack = filled.build(&server).pack;
    let machine = Machine::new();
    machine.edit();
    let requests = server.requests();
    let mut command = machine.command(&server, &[]);
    let child =
        command.stdout(std::process::Stdio::null()).stderr(std::process::Stdio::piped()).spawn().unwrap();
    while server.requests() < requests + 10 {
        std::thread::sleep(Duration::from_millis(1));
    }
    server.kill();
    let built = machine.finish(child.wait_with_output().unwrap());
    assert!(built.pack == machine.alone(&server) && built.pack != pack);
}

#[test]
fn what_may_only_be_read_is_not_written() {
    let server = Server::start();
    let machine = Machine::new();
    let output = machine.command(&server, &["--remote-policy", "read"]).output().unwrap();
    assert_eq!(machine.finish(output).warnings, Vec::<String>::new());
    assert_eq!((server.writes(), server.requests() > 0), (0, true));
    // A remote of the library's, to be sure that an empty bucket is no failure.
    assert_eq!(server.remote(Policy::Read).warnings(), Vec::<String>::new());
}

#[test]
fn a_url_without_sense_is_a_warning() {
    let server = Server::start();
    let machine = Machine::new();
    let output = machine.command(&server, &["--remote-cache", "https://example.com/x"]).output().unwrap();
    let built = machine.finish(output);
    assert!(
        built.warnings.len() == 1 && built.warnings[0].contains("s3://bucket/prefix"),
        "{:?}",
        built.warnings
    );
}
