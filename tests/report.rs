//! Reports and budgets, through the binary.

mod common;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::LazyLock;

use common::fixture;
use serde_json::Value as Json;

/// A folder with a manifest of two assets, and limits if any are given.
fn shop(budget: &str, of_puff: &str) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    write_manifest(folder.path(), budget, "psnr = 45", of_puff);
    folder
}

fn write_manifest(folder: &Path, budget: &str, quality: &str, of_puff: &str) {
    let (puff, ball) = (fixture("anim_*.vdb"), fixture("levelset_half.vdb"));
    let text = format!(
        "[budget]\n{budget}\n[asset.puff]\nframes = '{}'\n{quality}\n[asset.puff.budget]\n{of_puff}\n\
         [asset.ball]\nframes = '{}'\nformat = 'unorm8'\n",
        puff.display(),
        ball.display()
    );
    fs::write(folder.join("pipeline.toml"), text).unwrap();
}

fn volpack(folder: &Path, args: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_volpack"));
    // One for all tests: what is built does not depend on it, and most build the same.
    static CACHE: LazyLock<PathBuf> = LazyLock::new(|| {
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("report-cache");
        // What an earlier volpack made says nothing of this one.
        let _ = fs::remove_dir_all(&folder);
        folder
    });
    command.current_dir(folder).env("VOLPACK_CACHE", &*CACHE);
    command.args(args).output().unwrap()
}

/// Runs a report with its JSON; the exit code, the JSON, and what was said on standard error.
fn report(folder: &Path, args: &[&str]) -> (i32, Json, String) {
    let output = volpack(folder, &[&["report", "--json", "r.json", "-q", "--no-cheaper"], args].concat());
    let json =
        serde_json::from_slice(&fs::read(folder.join("r.json")).unwrap_or_default()).unwrap_or_default();
    (output.status.code().unwrap(), json, String::from_utf8(output.stderr).unwrap())
}

#[test]
fn json_is_as_its_schema_says_and_the_schema_is_documented() {
    let folder = shop("gpu_size = 1", "");
    let output = volpack(folder.path(), &["report", "--json", "r.json", "--html", "r.html", "-q"]);
    assert_eq!(output.status.code(), Some(5));
    let json: Json = serde_json::from_slice(&fs::read(folder.path().join("r.json")).unwrap()).unwrap();
    let schema: Json =
        serde_json::from_slice(&volpack(folder.path(), &["report", "--schema"]).stdout).unwrap();
    let validator = jsonschema::validator_for(&schema).unwrap();
    let errors: Vec<String> = validator.iter_errors(&json).map(|e| e.to_string()).collect();
    assert_eq!(errors, Vec::<String>::new());
    let mut wrong = json.clone();
    wrong["assets"][0]["pack"]["figures"]["gpu_bytes"] = "many".into();
    assert!(!validator.is_valid(&wrong));
    let documented = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/report.schema.json");
    let documented: Json = serde_json::from_slice(&fs::read(documented).unwrap()).unwrap();
    assert!(documented == schema, "write it anew: volpack report --schema > docs/report.schema.json");

    assert_eq!(json["assets"][1]["name"], "puff");
    let puff = &json["assets"][1]["pack"];
    assert!(puff["cheaper"]["figures"]["gpu_bytes"].as_u64() < puff["figures"]["gpu_bytes"].as_u64());
    assert_eq!(puff["cheaper"]["setting"], "psnr = 42");
    let bins: u64 = puff["verification"]["grids"][0]["histogram"]
        .as_array()
        .unwrap()
        .iter()
        .filter_map(Json::as_u64)
        .sum();
    assert_eq!(Some(bins), puff["verification"]["grids"][0]["active"]["voxels"].as_u64());
    let new: u64 =
        puff["frames"].as_array().unwrap().iter().filter_map(|f| f["new_texel_bytes"].as_u64()).sum();
    let texels: u64 =
        puff["summary"]["codecs"].as_object().unwrap().values().filter_map(|c| c["bytes"].as_u64()).sum();
    // Pages are filled up to whole slabs.
    assert!(new > 0 && new <= texels, "{new} {texels}");

    assert_eq!(puff["file"], "puff.volpack");
    let manifest = folder.path().join("pipeline.toml");
    let (_, json, _) = report(folder.path(), &["-m", manifest.to_str().unwrap(), "--asset", "ball"]);
    assert_eq!(json["assets"][0]["pack"]["file"], "ball.volpack", "relative to the manifest");
}

#[test]
fn every_limit_that_is_past_is_told_with_what_would_meet_it() {
    let cases = [
        ("gpu_size = '1kB'", "puff: gpu_size: ", "no size meets it: tree and masks take 7.6"),
        ("gpu_size = '12kB'", "puff: gpu_size: ", "try `size = 12000` instead of `psnr`"),
        ("file_size = '7kB'", "puff: file_size: ", "` instead of `psnr`"),
        ("tree_share = '1%'", "puff: tree_share: ", "a larger tree_share"),
        ("min_psnr = 50", "puff: min_psnr: 4", "dB is below the 50 dB minimum; use `psnr = 50`"),
        ("max_error = '0.1%'", "puff: max_error: ", "use `max_error = \"0.001\"` instead of `psnr`"),
        ("max_flip = 0.00001", "puff: max_flip: 0.0", "; try `psnr = "),
        ("build_seconds = 0.000001", "puff: build_seconds: ", " exceeds the 0 ms limit"),
    ];
    for (limit, start, remedy) in cases {
        let folder = shop("", limit);
        for command in ["build", "report"] {
            let mut args = vec![command, "--asset", "puff", "-q"];
            args.extend((command == "report").then_some("--no-cheaper"));
            let output = volpack(folder.path(), &args);
            let said = String::from_utf8(output.stderr).unwrap();
            assert_eq!(output.status.code(), Some(5), "{command} {limit}: {said}");
            let lines: Vec<&str> = said.lines().filter(|line| line.starts_with("  ")).collect();
            assert_eq!(lines.len(), 1, "{said}");
            assert!(lines[0].trim().starts_with(start) && lines[0].contains(remedy), "{command}: {said}");
        }
        assert!(folder.path().join("puff.volpack").exists(), "a sound pack is written all the same");
    }
    for limit in ["gpu_size = 100", "file_size = 100", "build_seconds = 0.000001"] {
        let (code, json, said) = report(shop(limit, "").path(), &[]);
        assert_eq!((code, json["ok"].as_bool()), (5, Some(false)));
        assert!(said.contains("  all assets: ") && said.lines().count() == 2, "{said}");
    }
    // One asset is not all of them.
    let folder = shop("gpu_size = 100", "");
    assert_eq!(report(folder.path(), &["--asset", "puff"]).0, 0);
}

#[test]
fn what_is_said_to_meet_a_limit_meets_it() {
    let limits =
        ["gpu_size = 12000", "file_size = 7000", "min_psnr = 52", "max_error = '1%'", "max_flip = 0.003"];
    for limit in limits {
        let folder = shop("", limit);
        let (code, json, said) = report(folder.path(), &["--asset", "puff"]);
        assert_eq!(code, 5, "{limit}: {said}");
        let remedy = json["breaches"][0]["remedy"].as_str().unwrap();
        let setting = remedy.split('`').nth(1).unwrap();
        write_manifest(folder.path(), "", setting, limit);
        let (code, _, said) = report(folder.path(), &["--asset", "puff"]);
        assert_eq!(code, 0, "{limit} with {remedy}: {said}");
    }
}

#[test]
fn a_limit_on_what_was_not_measured_is_past() {
    for (limit, line) in [
        ("min_psnr = 10", "min_psnr: the pack was not compared with its source; build with --verify voxels"),
        (
            "max_error = 0.5",
            "max_error: the pack was not compared with its source; build with --verify voxels",
        ),
        ("max_flip = 0.5", "max_flip: no pictures were compared; build with --verify all"),
    ] {
        let folder = shop("", limit);
        let output = volpack(folder.path(), &["build", "-q", "--verify", "structure"]);
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.code() == Some(5) && said.contains(line), "{said}");
    }
}

#[test]
fn changes_are_told_against_a_baseline() {
    let folder = shop("max_growth = '5%'\nmax_psnr_loss = 0.5", "");
    assert_eq!(report(folder.path(), &[]).0, 0);
    fs::rename(folder.path().join("r.json"), folder.path().join("old.json")).unwrap();
    let baseline = &["--baseline", "old.json", "--markdown", "r.md"];
    let (code, json, _) = report(folder.path(), baseline);
    assert_eq!((code, &json["assets"][1]["pack"]["change"]["gpu_bytes"]), (0, &0.0.into()));
    assert!(fs::read_to_string(folder.path().join("r.md")).unwrap().contains("| GPU unchanged, unchanged |"));

    write_manifest(folder.path(), "max_growth = '5%'\nmax_psnr_loss = 0.5", "psnr = 55", "");
    let (code, _, said) = report(folder.path(), baseline);
    assert!(code == 5 && said.contains("puff: max_growth: the size on the GPU grew by "), "{said}");
    assert!(fs::read_to_string(folder.path().join("r.md")).unwrap().contains("| GPU ↑ "));

    write_manifest(folder.path(), "max_growth = '5%'\nmax_psnr_loss = 0.5", "psnr = 40", "");
    let (code, _, said) = report(folder.path(), baseline);
    assert!(
        code == 5
            && said.contains("loses more than 0.5 dB against the baseline's 45.22 dB; use `psnr = 44.72`"),
        "{said}"
    );
    assert!(!said.contains("max_growth"), "{said}");

    fs::write(folder.path().join("old.json"), "{\"version\": 99}").unwrap();
    let (code, _, said) = report(folder.path(), baseline);
    assert!(code == 3 && said.contains("a report of version 99, not 1"), "{said}");
    fs::write(folder.path().join("old.json"), "[1, 2").unwrap();
    assert_eq!(report(folder.path(), baseline).0, 3);
}

#[test]
fn one_bad_asset_is_reported_among_the_others() {
    let folder = shop("", "");
    let manifest = fs::read_to_string(folder.path().join("pipeline.toml")).unwrap();
    let more = "[asset.\"a|b <i>\"]\nframes = 'none_*.vdb'\n";
    fs::write(folder.path().join("pipeline.toml"), manifest + more).unwrap();
    let outputs = ["--html", "out/r.html", "--markdown", "r.md", "--junit", "r.xml", "--format", "github"];
    let output = volpack(folder.path(), &[&["report", "--no-cheaper", "-q"], &outputs[..]].concat());
    assert_eq!(output.status.code(), Some(3));
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(said.starts_with("::error title=a|b <i>::none_*.vdb: no file matches\n"), "{said}");
    let read = |name: &str| fs::read_to_string(folder.path().join(name)).unwrap();
    let (html, markdown, junit) = (read("out/r.html"), read("r.md"), read("r.xml"));
    assert!(markdown.contains("| ❌ a\\|b &lt;i\\> | not built |"), "{markdown}");
    assert!(html.contains("a|b &#60;i&#62;") && !html.contains("a|b <i>"));
    assert!(junit.contains("errors=\"1\"") && junit.contains("none_*.vdb: no file matches"), "{junit}");
    for text in [html, markdown, junit] {
        assert!(!text.contains('\x1b'), "files have no colours");
    }
}

#[test]
fn a_cheaper_setting_that_cannot_be_reached_fails_nothing() {
    let folder = tempfile::tempdir().unwrap();
    // The least that can be reached where no frame may be ruined, as the error for less names it.
    write_manifest(folder.path(), "", "min_frame_psnr = 25\nsize = 1", "");
    let output = volpack(folder.path(), &["build", "-q", "--asset", "puff"]);
    let said = String::from_utf8(output.stderr).unwrap();
    let least = said.split_once("the least is ").and_then(|(_, rest)| rest.split_once(':')).unwrap().0;
    write_manifest(folder.path(), "", &format!("min_frame_psnr = 25\nsize = {least}"), "");
    let output = volpack(folder.path(), &["report", "--json", "r.json", "-q", "--asset", "puff"]);
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!((output.status.code(), &*said), (Some(0), ""));
    let json: Json = serde_json::from_slice(&fs::read(folder.path().join("r.json")).unwrap()).unwrap();
    assert!(json["assets"][0]["pack"]["cheaper"].is_null() && json["ok"] == true);
}

#[test]
fn what_fails_does_not_hide_what_is_over_budget() {
    let folder = shop("", "min_psnr = 50");
    let manifest = fs::read_to_string(folder.path().join("pipeline.toml")).unwrap();
    let more = "[asset.x]\nframes = 'none_*.vdb'\n[asset.y]\nframes = 'nor_*.vdb'\n";
    fs::write(folder.path().join("pipeline.toml"), manifest + more).unwrap();
    for args in [&["build", "-q"][..], &["report", "-q", "--no-cheaper"]] {
        let output = volpack(folder.path(), args);
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(3), "{said}");
        for line in ["none_*.vdb: no file matches", "nor_*.vdb: no file matches", "puff: min_psnr: "] {
            assert!(said.matches(line).count() == 1, "{said}");
        }
    }
}

#[test]
fn finished_packs_are_reported_with_and_without_their_sources() {
    let folder = shop("", "");
    assert!(volpack(folder.path(), &["build", "-q"]).status.success());
    fs::create_dir(folder.path().join("other")).unwrap();
    fs::copy(folder.path().join("puff.volpack"), folder.path().join("other/ball.volpack")).unwrap();
    let packs = ["ball.volpack", "puff.volpack", "other/ball.volpack", "--html", "r.html"];
    let (code, json, said) = report(folder.path(), &packs);
    assert_eq!(code, 0, "{said}");
    assert_eq!(
        (&json["assets"][0]["name"], &json["assets"][2]["name"]),
        (&"ball".into(), &"other/ball".into())
    );
    assert_eq!(json["assets"][0]["pack"]["figures"]["compared"], false);
    let html = fs::read_to_string(folder.path().join("r.html")).unwrap();
    assert!(html.contains("3 were not compared with their sources") && html.contains("not compared"));
    let source = fixture("levelset_half.vdb");
    let (code, json, said) = report(folder.path(), &["ball.volpack", "--source", source.to_str().unwrap()]);
    assert_eq!((code, &json["assets"][0]["pack"]["figures"]["compared"]), (0, &true.into()), "{said}");
    fs::write(folder.path().join("puff.volpack"), b"not a pack").unwrap();
    let (code, json, _) = report(folder.path(), &["ball.volpack", "puff.volpack"]);
    assert!(code == 3 && json["assets"][1]["error"].is_string() && json["assets"][0]["error"].is_null());
}
