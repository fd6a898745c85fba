//! Inputs that are unlike the fixtures: other flags, versions and types, files that are no OpenVDB files, folders of
//! sequences.

mod common;
#[path = "common/vdb_writer.rs"]
mod vdb_writer;

use std::path::Path;
use std::process::{Command, Output};

use bytemuck::Pod;
use half::f16;
use serde_json::Value as Json;
use vdb_writer::{BLOSC, GridFile, Part, file, one_grid, write_grid};
use volpack::manifest::{Manifest, expand};
use volpack::pack::Pack;
use volpack::vdb::{VdbError, VdbFile};

const FLOAT: &str = "Tree_float_5_4_3";

/// A grid of eight leaves with values that halves have too.
fn ramp(name: &str, tree_type: &str) -> GridFile<f32> {
    GridFile::new(name, tree_type, 0.0).fill([2, 2, 2], |[x, y, z]| ((x + y + z) as f32 / 8.0, x > 0))
}

/// The same from its numbers in eighths, for grids of any type.
fn typed<V: Pod>(name: &str, tree_type: &str, value: impl Fn(i32) -> V) -> GridFile<V> {
    GridFile::new(name, tree_type, value(0)).fill([2, 2, 2], |[x, y, z]| (value(x + y + z), x > 0))
}

fn halves(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|v| f16::from_f32(*v).to_le_bytes()).collect()
}

fn volpack(folder: &Path, args: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_volpack"));
    command.env("VOLPACK_CACHE", folder.join("cache")).current_dir(folder).args(args).output().unwrap()
}

fn stdout(output: &Output) -> String {
    assert!(output.status.success(), "{output:?}");
    String::from_utf8(output.stdout.clone()).unwrap()
}

/// Builds a pack of files in a folder without pictures.
fn build(folder: &Path, args: &[&str]) -> Output {
    volpack(folder, &[&["build", "-o", "out.volpack", "--verify", "voxels"], args].concat())
}

/// The exit code and what was said.
fn told(output: &Output) -> (i32, String) {
    (output.status.code().unwrap(), String::from_utf8(output.stderr.clone()).unwrap())
}

fn frames(folder: &Path) -> Vec<i32> {
    let pack = Pack::open(&folder.join("out.volpack")).unwrap();
    pack.grids()[0].frames.iter().map(|frame| frame.record.number).collect()
}

#[test]
fn metadata_says_whether_values_are_halves() {
    let read = |tree_type: &str, flag: Option<bool>, are_halves: bool| {
        let mut grid = ramp("density", tree_type);
        grid.flags.extend(flag.map(|flag| ("is_saved_as_half_float".to_owned(), flag)));
        grid.stored = if are_halves { halves } else { grid.stored };
        let file = VdbFile::from_bytes(one_grid(&grid)).unwrap();
        file.read_tree::<f32>(&file.grids[0]).map(|tree| tree.leaves.blocks.concat())
    };
    let suffix = "Tree_float_5_4_3_HalfFloat";
    let expected = read(FLOAT, None, false).unwrap();
    assert_eq!(expected[511], 21.0 / 8.0);
    for (tree_type, flag, are_halves) in [
        (suffix, Some(true), true),
        (FLOAT, Some(true), true),
        (suffix, Some(false), false),
        // OpenVDB forgets the suffix when it reads the metadata.
        (suffix, None, false),
    ] {
        assert_eq!(read(tree_type, flag, are_halves).unwrap(), expected, "{tree_type} {flag:?}");
    }
    for (tree_type, flag, are_halves) in [(suffix, Some(true), false), (FLOAT, None, true)] {
        assert!(read(tree_type, flag, are_halves).is_err(), "{tree_type} {flag:?}");
    }
}

#[test]
fn bytes_behind_a_grid_are_an_error() {
    let mut grid = ramp("density", FLOAT);
    grid.left_over = vec![0; 5];
    let file_of = |has_offsets| VdbFile::from_bytes(file(224, has_offsets, &[grid.part()])).unwrap();
    let error = |file: VdbFile| file.read_tree::<f32>(&file.grids[0]).err().map(|e| e.to_string());
    let said = error(file_of(true)).unwrap();
    assert!(said.contains("\"density\"") && said.contains(" 5 bytes are left over"), "{said}");
    // A stream goes on behind its last grid as it likes.
    assert_eq!(error(file_of(false)), None);
}

#[test]
fn a_grid_of_halves_is_packed_as_it_is() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    for flag in [false, true] {
        let mut grid = typed("density", "Tree_half_5_4_3", |eighths| f16::from_f32(eighths as f32 / 8.0));
        grid.flags.push(("is_saved_as_half_float".to_owned(), flag));
        std::fs::write(at.join("half.vdb"), file(225, true, &[grid.part()])).unwrap();
        let shown = stdout(&volpack(at, &["inspect", "--values", "half.vdb"]));
        assert!(shown.contains("density: half, unknown") && shown.contains("0.125 to 5.625"), "{shown}");
        stdout(&build(at, &["half.vdb", "-f", "f16"]));
        let pack = Pack::open(&at.join("out.volpack")).unwrap();
        assert_eq!(pack.grids()[0].record.active_max, 5.625);
    }
}

#[test]
fn later_versions_are_read_with_a_warning() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let bytes = file(226, true, &[ramp("density", FLOAT).part()]);
    for name in ["a_1.vdb", "a_2.vdb", "a_3.vdb"] {
        std::fs::write(at.join(name), &bytes).unwrap();
    }
    assert!(stdout(&volpack(at, &["inspect", "a_1.vdb"])).contains("226 is newer than 225"));
    let json: Json = serde_json::from_str(&stdout(&volpack(at, &["inspect", "--json", "a_1.vdb"]))).unwrap();
    assert!(json["warnings"][0].as_str().unwrap().contains("226"), "{json}");
    let output = build(at, &["a_1.vdb", "a_2.vdb", "a_3.vdb"]);
    let (code, warning) = told(&output);
    assert!(
        code == 0 && warning.contains("a_1.vdb and 2 other files: OpenVDB file version 226"),
        "{warning}"
    );

    for damaged in [&bytes[..60], &bytes[..bytes.len() - 1]] {
        let error = VdbFile::from_bytes(damaged.to_vec()).unwrap_err();
        let said = error.to_string();
        assert!(error.is_unsupported() && said.contains("226 is newer than 225"), "{said}");
    }
    let mode = bytes.len() - 512 * 4 - 1;
    let file = VdbFile::from_bytes([&bytes[..mode], &[7], &bytes[mode + 1..]].concat()).unwrap();
    let said = file.read_tree::<f32>(&file.grids[0]).err().unwrap().to_string();
    assert!(said.contains("mode 7") && said.contains("newer volpack"), "{said}");

    std::fs::write(at.join("old.vdb"), vdb_writer::file(221, true, &[])).unwrap();
    let (code, said) = told(&volpack(at, &["inspect", "old.vdb"]));
    assert!(code == 6 && said.contains("221") && said.contains("OpenVDB 12 or older"), "{code} {said}");
}

fn unknown_tree() -> Part {
    ("wide".to_owned(), "Tree_float_3_3_3".to_owned(), ramp("wide", FLOAT).part().2)
}

#[test]
fn an_unknown_tree_hides_no_other_grid() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let parts = [unknown_tree(), ramp("heat", FLOAT).part()];
    std::fs::write(at.join("a.vdb"), file(224, true, &parts)).unwrap();
    let shown = stdout(&volpack(at, &["inspect", "--values", "a.vdb"]));
    assert!(shown.contains("wide: Tree_float_3_3_3") && shown.contains("cannot be packed: it is"), "{shown}");
    assert!(shown.contains("heat: float") && shown.contains("0.125 to 5.625"), "{shown}");
    let json: Json = serde_json::from_str(&stdout(&volpack(at, &["inspect", "--json", "a.vdb"]))).unwrap();
    let [wide, heat] = [&json["grids"][0], &json["grids"][1]];
    assert!(
        wide["packable"] == false && wide["obstacle"].is_string() && wide.get("leaves").is_none(),
        "{json}"
    );
    assert!(heat["packable"] == true && heat["obstacle"].is_null() && heat["leaves"] == 8, "{json}");
    stdout(&build(at, &["a.vdb"]));
    let (code, said) = told(&build(at, &["a.vdb", "-g", "wide"]));
    assert!(code == 6 && said.contains("Tree_float_3_3_3") && said.contains("choose from heat"), "{said}");

    // Where nothing says where it ends, the grids before it are there.
    let parts = [ramp("heat", FLOAT).part(), unknown_tree(), ramp("lost", FLOAT).part()];
    std::fs::write(at.join("a.vdb"), file(224, false, &parts)).unwrap();
    let (code, warning) = told(&build(at, &["a.vdb"]));
    assert!(
        code == 0 && warning.contains("1 grid is not found") && warning.contains("\"wide\""),
        "{warning}"
    );
}

#[test]
fn the_codec_that_is_not_read_is_named() {
    let error_of = |header: [u8; 4]| {
        let mut grid = GridFile::new("density", FLOAT, 0.0f32).fill([1, 1, 1], |_| (1.0, true));
        grid.compression = BLOSC;
        grid.stored = |_| Vec::new();
        // A container of 24 bytes that unpacks to 2,048 in one block: its offset, and a stream of no bytes.
        let container = [2048u32, 2048, 24, 20, 0].iter().flat_map(|word| word.to_le_bytes());
        let container: Vec<u8> = header.into_iter().chain(container).collect();
        grid.left_over = [&(container.len() as i64).to_le_bytes()[..], &container].concat();
        let file = VdbFile::from_bytes(one_grid(&grid)).unwrap();
        match file.read_tree::<f32>(&file.grids[0]).err().unwrap() {
            VdbError::Grid { source, .. } => *source,
            other => other,
        }
    };
    for (header, what) in [
        ([2, 1, 0x01, 4], "BloscLZ"),
        ([2, 1, 0xe1, 4], "codec 7"),
        ([2, 2, 0x81, 4], "Zstd in format 2"),
        ([3, 1, 0x21, 4], "format 3"),
        ([2, 1, 0x28, 4], "format 2"),
    ] {
        let error = error_of(header);
        assert!(matches!(&error, VdbError::Unsupported(said) if said.contains(what)), "{what}: {error}");
    }
    for codec in 1..=4 {
        let error = error_of([2, 1, codec << 5, 4]);
        assert!(matches!(&error, VdbError::Corrupt { .. }), "codec {codec}: {error}");
    }
}

#[test]
fn what_is_no_openvdb_file_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let beginnings: [(&[u8], &str); 13] = [
        (b"", "empty"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 123\n", "`git lfs pull`"),
        (b"NanoVDB0\0\0\0\0", "NanoVDB"),
        (b"NanoVDB1\0\0\0\0", "NanoVDB"),
        (b"NanoVDB2\0\0\0\0", "nanovdb_convert"),
        (b"\x1f\x8b\x08\0\0\0", "gunzip"),
        (b"PK\x03\x04\x14\0\0\0", "ZIP"),
        (b"\x28\xb5\x2f\xfd\x04\0", "unzstd"),
        (b"\xef\xbb\xbf \n<!DOCTYPE html><html>", "web page"),
        (b"<?xml version=\"1.0\"?><Error>AccessDenied \xc3\xa4 and so on and so forth and on", "web page"),
        (b"404: Not Found", "text file"),
        (b"\x89VOLPK\r\n\0\0\0\0", "volume pack"),
        (b"\0\0\0\0\0\0\0\0", "magic number"),
    ];
    for (i, (bytes, what)) in beginnings.into_iter().enumerate() {
        std::fs::write(at.join("smoke_0001.vdb"), bytes).unwrap();
        let (code, said) = told(&build(at, &["smoke_0001.vdb"]));
        assert!(code == 3 && said.contains("smoke_0001.vdb: ") && said.contains(what), "{i} {code} {said}");
    }
    std::fs::create_dir(at.join("shots.vdb")).unwrap();
    for args in [&["build", "shots.vdb", "-o", "x.volpack"][..], &["inspect", "shots.vdb"]] {
        let (code, said) = told(&volpack(at, args));
        assert!(code == 3 && said.contains("shots.vdb: ") && said.contains("folder"), "{code} {said}");
    }
}

#[test]
fn a_background_that_is_no_number_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    for background in [f32::NAN, f32::INFINITY] {
        write_grid(&at.join("a.vdb"), &GridFile { background, ..ramp("density", FLOAT) });
        let (code, said) = told(&build(at, &["a.vdb"]));
        let parts = ["a.vdb", "background", &background.to_string(), "--nonfinite zero"];
        assert!(code == 3 && parts.iter().all(|part| said.contains(part)), "{code} {said}");
        stdout(&build(at, &["a.vdb", "--nonfinite", "zero"]));
    }
}

#[test]
fn what_cannot_be_packed_is_unsupported() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    write_grid(&at.join("v.vdb"), &typed("velocity", "Tree_vec3s_5_4_3", |v| [v as f32; 3]));
    std::fs::write(at.join("none.vdb"), file(224, true, &[])).unwrap();
    std::fs::write(at.join("pipeline.toml"), "[asset.a]\nframes = 'v.vdb'\n").unwrap();
    for (args, code) in [
        (&["build", "v.vdb", "-o", "x.volpack"][..], 6),
        (&["build", "v.vdb", "-o", "x.volpack", "-g", "velocity"], 6),
        (&["build", "none.vdb", "-o", "x.volpack"], 6),
        (&["build"], 6),
        (&["build", "v.vdb", "-o", "x.volpack", "-g", "density"], 2),
    ] {
        let (found, said) = told(&volpack(at, args));
        assert!(found == code && said.contains(".vdb: "), "{args:?}: {found} {said}");
    }
}

#[test]
fn frames_are_in_the_order_of_time() {
    for (names, numbers) in [
        (["smoke_-0002", "smoke_-0001", "smoke_0000"], [-2, -1, 0]),
        (["smoke.0001.50", "smoke.0001.75", "smoke.0002.00"], [150, 175, 200]),
        (["smoke_9_v2", "smoke_10_v2", "smoke_11_v2"], [9, 10, 11]),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let files = names.map(|name| format!("{name}.vdb"));
        files.iter().for_each(|file| write_grid(&folder.path().join(file), &ramp("density", FLOAT)));
        stdout(&build(folder.path(), &[&files[2], &files[0], &files[1], "--strict"]));
        assert_eq!(frames(folder.path()), numbers);
    }
}

#[test]
fn what_init_writes_builds() {
    let folder = tempfile::tempdir().unwrap();
    let shots = folder.path().join("shots [1]");
    let at = |name: &str| shots.join(format!("{name}.vdb"));
    std::fs::create_dir_all(shots.join("liquid")).unwrap();
    for name in [
        "smoke_-1_v2",
        "smoke_0_v2",
        "smoke_10_v2",
        "smoke_0_v1",
        "fire.1.5",
        "fire.2",
        "twice_1",
        "twice_01",
    ] {
        write_grid(&at(name), &ramp("density", FLOAT));
    }
    let liquid = |frame: i32, grid: &str| {
        let velocity = typed("velocity", "Tree_vec3s_5_4_3", |v| [v as f32; 3]);
        let parts =
            [velocity.part(), ramp("pressure", FLOAT).part(), ramp(grid, FLOAT).of_class("level set").part()];
        std::fs::write(at(&format!("liquid/{grid}_{frame}")), file(224, true, &parts)).unwrap();
    };
    (1..=2).for_each(|frame| ["phi", "surface"].iter().for_each(|grid| liquid(frame, grid)));
    write_grid(&at("points"), &typed("velocity", "Tree_vec3s_5_4_3", |v| [v as f32; 3]));
    std::fs::copy(common::fixture("frustum.vdb"), at("camera")).unwrap();
    write_grid(&at("nan_1"), &GridFile { background: f32::NAN, ..ramp("density", FLOAT) });
    write_grid(&at("cut_1"), &ramp("density", FLOAT));
    std::fs::write(at("cut_2"), "").unwrap();

    let output = volpack(folder.path(), &["init", "shots [1]"]);
    stdout(&output);
    let text = std::fs::read_to_string(shots.join("pipeline.toml")).unwrap();
    for (asset, why) in [
        ("points", "vec3s"),
        ("camera", "NonlinearFrustumMap"),
        ("cut", "it is empty"),
        ("nan", "the background NaN"),
        ("twice", "both frame 1"),
    ] {
        let lines: Vec<&str> = text.lines().collect();
        let line = lines.iter().position(|line| *line == format!("# [asset.{asset}]")).unwrap();
        assert!(
            lines[line - 1].starts_with("# Left out: ") && lines[line - 1].contains(why),
            "{}",
            lines[line - 1]
        );
    }
    let manifest = Manifest::read(&shots.join("pipeline.toml")).unwrap();
    let assets: Vec<_> = manifest
        .assets
        .iter()
        .map(|(name, asset)| {
            (name.as_str(), expand(&asset.frames).unwrap().len(), asset.settings.grids.join(" "))
        })
        .collect();
    let expected = [
        ("fire", 2, ""),
        ("phi", 2, "phi"),
        ("smoke_0_v1", 1, ""),
        ("smoke_v2", 3, ""),
        ("surface", 2, "surface"),
    ];
    assert_eq!(assets, expected.map(|(name, files, grids)| (name, files, grids.to_owned())));
    stdout(&volpack(folder.path(), &["build", "-m", "shots [1]/pipeline.toml", "--verify", "voxels"]));
    // A glob on the command line finds the folder too.
    stdout(&build(folder.path(), &["shots [1]/smoke_*_v2.vdb"]));
    assert_eq!(frames(folder.path()), [-1, 0, 10]);

    std::fs::create_dir(folder.path().join("points")).unwrap();
    std::fs::copy(at("points"), folder.path().join("points/a.vdb")).unwrap();
    let (code, said) = told(&volpack(folder.path(), &["init", "points"]));
    assert!(
        code == 6 && said.contains("vec3s") && !folder.path().join("points/pipeline.toml").exists(),
        "{code} {said}"
    );
}
