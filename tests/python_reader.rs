//! An independent reader of the format, written in Python from docs/format.md alone
//! (`tests/volpack_reader.py`), sees the same voxels.

mod common;

use std::path::Path;
use std::process::Command;

use common::{animation, build_verified, fixture, skip};
use serde_json::{Value as Json, json};
use volpack::pack::{Pack, Region};
use volpack::settings::{Format, Settings};

/// What the Python reader prints of a frame, from our own reader.
fn ours(pack: &Pack, grid: usize, frame: usize) -> Json {
    let reader = pack.frame(grid, frame).unwrap();
    let (mut voxels, mut active, mut crc) = (0u64, 0u64, flate2::Crc::new());
    let mut constants = [0, 0];
    reader.for_each_region(|_, dim, region| match region {
        Region::Brick(record) => {
            let brick = reader.decode(&record).unwrap();
            voxels += 512;
            active += u64::from(brick.active.count());
            for (v, value) in brick.values.iter().enumerate() {
                crc.update(&value.to_le_bytes());
                crc.update(&[u8::from(brick.active.get(v))]);
            }
        }
        _ => constants[usize::from(dim == 128)] += 1,
    });
    json!({
        "grid": pack.grids()[grid].name,
        "frame": pack.grids()[grid].frames[frame].record.number,
        "voxels": voxels,
        "active": active,
        "crc32": format!("{:08x}", crc.sum()),
        "constants": constants,
    })
}

#[test]
fn a_reader_written_from_the_specification_sees_the_same_voxels() {
    if Command::new("python3").arg("--version").output().is_err() {
        skip("PYTHON", "there is no python3");
        return;
    }
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/volpack_reader.py");
    let folder = tempfile::tempdir().unwrap();
    let cases = [
        (animation(), vec!["density", "temperature"]),
        (vec![fixture("levelset_float.vdb")], vec!["surface"]),
        (vec![fixture("tiles.vdb")], vec!["density"]),
        (vec![fixture("negative.vdb")], vec!["density"]),
        (vec![fixture("inactive_float.vdb")], vec!["density"]),
    ];
    for (frames, grids) in cases {
        for format in Format::ALL {
            // Python has no zstd of its own.
            let grids = grids.iter().map(|g| (*g).to_owned()).collect();
            let settings = Settings { grids, encoding: format.into(), zstd: 0, ..Settings::default() };
            let (pack, _) = build_verified(&frames, settings, folder.path());
            let output = Command::new("python3")
                .arg(&script)
                .arg(folder.path().join("test.volpack"))
                .output()
                .unwrap();
            assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
            let text = String::from_utf8(output.stdout).unwrap();
            let mut theirs = text.lines().map(|line| serde_json::from_str::<Json>(line).unwrap());
            for grid in 0..pack.grids().len() {
                for frame in 0..pack.grids()[grid].frames.len() {
                    assert_eq!(theirs.next().unwrap(), ours(&pack, grid, frame), "{frames:?} {format:?}");
                }
            }
            assert!(theirs.next().is_none());
        }
    }
}
