//! Damaged files are refused with an error that says why; none panics, however it is damaged.
//!
//! A bounded run of what `xtask mutate` does at length and the targets in `fuzz/` do without end.

use std::mem::offset_of;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use volpack::pack::layout::{FrameRecord, kind};
use volpack::pack::{Pack, PackError, Region};
use volpack::report::PackSummary;
use volpack::vdb::{OtherFormat, VdbError, VdbFile};

#[path = "../fuzz/common/mod.rs"]
mod common;
#[path = "common/forgery.rs"]
mod forgery;

use common::mutate::{Case, pack_case, vdb_case};
use common::seeds::Seed;
use common::{entry, guard, reseal, seeds};
use forgery::Forgery;

const CASES: u64 = 1500;
const SEED: u64 = 7;
/// One case takes milliseconds; a loop over a count that nobody checked takes for ever.
const LIMIT: Duration = Duration::from_secs(10);

fn fixtures() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures")
}

fn packs() -> Vec<Seed> {
    let folder = tempfile::tempdir().unwrap();
    seeds::build_packs(&fixtures(), folder.path()).unwrap();
    seeds::packs(folder.path()).unwrap()
}

/// Tries `CASES` damaged files and fails with the numbers of those that panic or take too long.
fn try_all(seeds: &[Seed], case: impl Fn(&[Seed], u64, u64) -> Case, entry: impl Fn(Vec<u8>) -> bool) {
    for seed in seeds {
        assert!(entry(seed.bytes.clone()), "{} is refused undamaged", seed.name);
    }
    let mut failures = Vec::new();
    let mut accepted = 0;
    for number in 0..CASES {
        let Case { name, bytes } = case(seeds, SEED, number);
        let start = Instant::now();
        match guard::guarded(|| entry(bytes)) {
            Ok(sound) => accepted += u64::from(sound),
            Err(panic) => failures.push(format!("seed {SEED} case {number} ({name}): {panic}")),
        }
        if start.elapsed() > LIMIT {
            failures.push(format!("seed {SEED} case {number} ({name}) took {:?}", start.elapsed()));
        }
    }
    assert!(failures.is_empty(), "{} failures:\n{}", failures.len(), failures.join("\n"));
    // Were every case refused, or none, the damage would not be where it matters.
    assert!((CASES / 50..CASES * 4 / 5).contains(&accepted), "{accepted} of {CASES} were accepted");
}

#[test]
fn damaged_vdb_files_do_not_panic() {
    try_all(&seeds::vdbs(&fixtures()).unwrap(), vdb_case, entry::vdb);
}

#[test]
fn damaged_packs_do_not_panic() {
    try_all(&packs(), pack_case, entry::pack);
}

fn vdb_error(bytes: &[u8]) -> VdbError {
    VdbFile::from_bytes(bytes.to_vec()).expect_err("the file is damaged")
}

fn in_grid(error: VdbError) -> VdbError {
    match error {
        VdbError::Grid { source, .. } => *source,
        other => panic!("not in a grid: {other}"),
    }
}

#[test]
fn a_damaged_vdb_says_what_is_wrong() {
    let sound = std::fs::read(fixtures().join("fog_float_blosc.vdb")).unwrap();
    let with = |at: usize, word: u32| {
        let mut bytes = sound.clone();
        bytes[at..at + 4].copy_from_slice(&word.to_le_bytes());
        vdb_error(&bytes)
    };
    assert!(matches!(vdb_error(&[]), VdbError::NotVdb(OtherFormat::Empty)));
    assert!(matches!(with(0, 0), VdbError::NotVdb(OtherFormat::Unknown)));
    assert!(matches!(with(8, 221), VdbError::TooOld(221)));
    // Magic number, version, library version and offsets flag are 21 bytes, then the UUID.
    assert!(matches!(vdb_error(&sound[..40]), VdbError::Truncated { what: "the file's UUID", at: 21, .. }));
    // The file has no metadata: its grid count and the first grid's name follow.
    assert!(matches!(with(57, u32::MAX), VdbError::Truncated { .. } | VdbError::Corrupt { .. }));
    for (at, word, why) in [(61, u32::MAX, "negative"), (65, u32::MAX, "name claims 4294967295 bytes")] {
        let error = with(at as usize, word);
        let says = |what: &str| what.contains(why);
        assert!(
            matches!(&error, VdbError::Corrupt { at: place, what } if *place == at && says(what)),
            "{error}"
        );
    }
    let cut = in_grid(vdb_error(&sound[..sound.len() - 1]));
    assert!(matches!(&cut, VdbError::Corrupt { what, .. } if what.contains("lie outside")), "{cut}");
}

#[test]
fn a_damaged_tree_says_what_is_wrong() {
    let sound = std::fs::read(fixtures().join("fog_float_none.vdb")).unwrap();
    let file = VdbFile::from_bytes(sound.clone()).unwrap();
    assert!(file.read_tree::<f32>(&file.grids[0]).is_ok());
    // The last leaf's values end the file: its mask, how its inactive values are stored, 512 floats.
    let mode = sound.len() - 512 * 4 - 1;
    let mut bytes = sound;
    bytes[mode] = 7;
    let file = VdbFile::from_bytes(bytes).unwrap();
    let error = in_grid(file.read_tree::<f32>(&file.grids[0]).err().unwrap());
    assert!(matches!(&error, VdbError::Corrupt { what, .. } if what.contains("mode 7")), "{error}");
}

fn pack_error(bytes: &[u8]) -> PackError {
    match Pack::from_bytes(bytes.to_vec()) {
        Ok(_) => panic!("the pack is damaged"),
        Err(error) => error,
    }
}

#[test]
fn a_damaged_pack_says_what_is_wrong() {
    let packs = packs();
    let seed = |name: &str| packs.iter().find(|p| p.name == name).unwrap();
    let sound = &seed("levelset_half_unorm8_0").bytes;
    let with = |at: usize, bytes: &[u8]| {
        let mut damaged = sound.clone();
        damaged[at..at + bytes.len()].copy_from_slice(bytes);
        damaged
    };
    assert!(matches!(pack_error(&[]), PackError::NotPack));
    assert!(matches!(pack_error(&with(0, b"x")), PackError::NotPack));
    assert!(matches!(pack_error(&with(8, &7u16.to_le_bytes())), PackError::Version(7)));
    let len = sound.len() as u64;
    assert!(matches!(
        pack_error(&sound[..sound.len() / 2]),
        PackError::Length { have, says } if have == len / 2 && says == len
    ));
    let mut cut = sound[..sound.len() / 2].to_vec();
    reseal::reseal(&mut cut);
    let error = pack_error(&cut);
    assert!(matches!(&error, PackError::Corrupt(what) if what.contains("ends behind the file")), "{error}");
    // A reserved word of the header, which only its digest guards.
    let error = pack_error(&with(20, &[1]));
    assert!(matches!(&error, PackError::Digest { what } if what == "the header"), "{error}");

    // One texel byte: found when its chunk is first read, and not by opening.
    let texels = Forgery::new(sound.clone()).section(kind::TEXELS);
    let damaged = with(texels.start, &[sound[texels.start] ^ 1]);
    let pack = Pack::from_bytes(damaged).unwrap();
    for error in [pack.check_chunks().err(), pack.frame(0, 0).err()] {
        let error = error.expect("a texel is wrong");
        assert!(matches!(&error, PackError::Digest { what } if what.contains("texels")), "{error}");
    }
}

#[test]
fn a_summary_takes_any_count_of_leaves() {
    let packs = packs();
    let mut pack = Forgery::new(packs.iter().find(|p| p.name == "anim_f32_0").unwrap().bytes.clone());
    for frame in 0..6 {
        pack.set(pack.frame(frame) + offset_of!(FrameRecord, leaves), u64::MAX / 2 + 1);
    }
    let summary = PackSummary::new(&Pack::from_bytes(pack.finish()).unwrap());
    assert_eq!(summary.source_leaves, u64::MAX);
}

#[test]
fn regions_are_counted_as_they_are_visited() {
    for seed in packs() {
        let pack = Pack::from_bytes(seed.bytes).unwrap();
        let mut visited = 0;
        for (g, grid) in pack.grids().iter().enumerate() {
            for f in 0..grid.frames.len() {
                let count = |_, _, region| visited += u64::from(matches!(region, Region::Brick(_)));
                pack.frame_tree(g, f).for_each_region(count);
            }
        }
        assert!(visited > 0);
        assert_eq!(pack.region_count(), visited, "{}", seed.name);
    }
}
