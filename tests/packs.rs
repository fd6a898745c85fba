//! Packs of every fixture, against the source and against what OpenVDB says of it.

mod common;
#[path = "common/vdb_writer.rs"]
mod vdb_writer;

use std::collections::BTreeSet;
use std::path::Path;

use common::{animation, build_verified, facts, fixture, fixtures, probes};
use vdb_writer::{GridFile, write_grid};
use volpack::cli::exit_code;
use volpack::codec::Codec;
use volpack::pack::{Pack, Region};
use volpack::pipeline::{Job, Silent, VerifyLevel, build};
use volpack::report::PackSummary;
use volpack::settings::{Format, Integers, Masks, NonFinite, RangeMode, Settings};
use volpack::vdb::{Scalar, ValueType, VdbFile, with_scalar_type};
use volpack::verify::{Sources, VerifyReport, voxels};
use volpack::volume::Coord;

fn settings(grid: &str, format: Format) -> Settings {
    Settings {
        grids: vec![grid.to_owned()],
        encoding: format.into(),
        nonfinite: NonFinite::Zero,
        integers: Integers::Nearest,
        ..Settings::default()
    }
}

/// The value and state of one voxel, as an engine finds it.
fn voxel(pack: &Pack, at: Coord) -> (f32, bool) {
    let frame = pack.frame(0, 0).unwrap();
    match frame.locate(at).0 {
        Region::Background => (pack.grids()[0].background, false),
        Region::Constant(constant) => (constant.value, constant.active),
        Region::Brick(record) => {
            let brick = frame.decode(&record).unwrap();
            let index = at.child_index(3, 1);
            (brick.values[index], brick.active.get(index))
        }
    }
}

/// The value of an integer grid at each active voxel, from the grids of 24 bits that it was split into.
fn joined(pack: &Pack, at: Coord) -> i64 {
    let part = |suffix: &str| {
        let g = pack.grids().iter().position(|grid| grid.name.ends_with(suffix))?;
        let frame = pack.frame(g, 0).unwrap();
        Some(match frame.locate(at).0 {
            Region::Background => pack.grids()[g].background,
            Region::Constant(constant) => constant.value,
            Region::Brick(record) => frame.decode(&record).unwrap().values[at.child_index(3, 1)],
        })
    };
    // A GPU's value is rounded.
    let whole = |suffix: &str| part(suffix).map(|value| value.round() as i64);
    let (low, high) = (whole(".low").unwrap(), whole(".high").unwrap());
    match whole(".middle") {
        None => (high << 24) + low,
        Some(middle) => (high << 48) + (middle << 24) + low,
    }
}

#[test]
fn integers_of_any_size_are_kept_by_halves_or_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = fixture("types.vdb");
    let file = VdbFile::open(&path).unwrap();
    for name in ["count", "ticks"] {
        let keep = Settings { integers: Integers::Keep, ..settings(name, Format::F32) };
        let job =
            Job::new(vec![path.clone()], folder.path().join("x.volpack"), keep.clone(), VerifyLevel::Voxels);
        let error = build(&job, &mut Silent).err().expect("no float holds them");
        assert_eq!(exit_code::of(&error), 3);
        assert!(error.to_string().contains("integers = \"split\""), "{error}");

        for format in [Format::F32, Format::Adaptive] {
            let split = Settings { integers: Integers::Split, encoding: format.into(), ..keep.clone() };
            let (pack, report) = build_verified(std::slice::from_ref(&path), split, folder.path());
            assert!(report.ok, "{name}: {:?}", report.failures);
            assert!(report.all.max_error < 0.5, "{name}: {}", report.all.max_error);
            let grid = file.grids.iter().find(|grid| grid.name == name).unwrap();
            let values: Vec<(Coord, i64)> = with_scalar_type!(&grid.value_type,
                T => {
                    let tree = file.read_tree::<T>(grid).unwrap();
                    let leaf = |leaf: usize| {
                        let (values, origin) = (*tree.leaves.values(leaf), tree.leaves.origins[leaf]);
                        (0..512).map(move |i| (origin.offset_by(Coord::child_offset(i, 3, 1)), values[i].to_integer()))
                    };
                    (0..tree.leaves.len()).flat_map(leaf).collect()
                },
                other => panic!("{} is no integer grid", other.name())
            );
            for (at, value) in values {
                assert_eq!(joined(&pack, at), value, "{name} at {at:?}, {format:?}");
            }
        }
    }
}

/// Labels survive the default settings, and nobody calls exact what is not.
#[test]
fn labels_stay_labels() {
    let folder = tempfile::tempdir().unwrap();
    let label = |voxel: [i32; 3]| (voxel[0] / 3 * 71 + voxel[1] / 5 * 113 + voxel[2] / 2 * 37) % 200;
    let grid =
        GridFile::new("material", "Tree_int32_5_4_3", 0i32).fill([3; 3], |v| (label(v), label(v) != 0));
    let path = folder.path().join("labels.vdb");
    write_grid(&path, &grid);
    let default = Settings { grids: vec!["material".to_owned()], ..Settings::default() };
    let (pack, report) = build_verified(std::slice::from_ref(&path), default.clone(), folder.path());
    assert!(report.ok && report.all.max_error < 0.5, "{:?}", report.failures);
    let frame = pack.frame(0, 0).unwrap();
    frame.for_each_region(|origin, _, region| {
        let Region::Brick(record) = region else { return };
        let spread = frame.spread(&record).unwrap();
        for (i, value) in frame.decode(&record).unwrap().values.iter().enumerate() {
            let source = label(origin.offset_by(Coord::child_offset(i, 3, 1)).0) as f32;
            assert!((value - source).abs() + spread[i] < 0.5, "{value} for {source}");
        }
    });
    // A format that cannot keep them says so.
    let bc7 = Settings { encoding: Format::BC7.into(), ..default.clone() };
    let (_, report) = unverified(&path, bc7.clone(), folder.path());
    assert!(report.failures.iter().any(|why| why.contains("integer")), "{:?}", report.failures);
    let nearest = Settings { integers: Integers::Nearest, ..bc7 };
    let (_, report) = unverified(&path, nearest, folder.path());
    assert!(!report.failures.iter().any(|why| why.contains("integer")), "{:?}", report.failures);
}

/// Where all active values are one, an error is an error, and no PSNR of it is none.
#[test]
fn a_constant_grid_that_is_off_is_not_exact() {
    let folder = tempfile::tempdir().unwrap();
    let grid = GridFile::new("density", "Tree_float_5_4_3", 0.0f32);
    let grid = grid.fill([2; 3], |v| if v[0] < 11 { (0.7, true) } else { (0.0, false) });
    let path = folder.path().join("constant.vdb");
    write_grid(&path, &grid);
    let (_, report) =
        build_verified(std::slice::from_ref(&path), settings("density", Format::F16), folder.path());
    assert!(report.ok && report.active.max_error > 0.0, "{report:?}");
    assert!(report.active.psnr.is_some_and(|db| (60.0..90.0).contains(&db)), "{:?}", report.active);
    assert_eq!(report.grids[0].peak, f64::from(0.7f32));
}

/// Builds without verification, and gives what verification says.
fn unverified(path: &Path, settings: Settings, folder: &Path) -> (Pack, VerifyReport) {
    let frames = vec![path.to_owned()];
    let job = Job::new(frames.clone(), folder.join("unverified.volpack"), settings, VerifyLevel::None);
    build(&job, &mut Silent).unwrap();
    let pack = Pack::open(&job.output).unwrap();
    let report = voxels(&pack, &Sources::find(&pack, &frames).unwrap(), 1, &mut Silent).unwrap();
    (pack, report)
}

/// The largest magnitude of a grid's values, as OpenVDB has it.
fn largest_value(facts: &serde_json::Value) -> f64 {
    ["min", "max"].iter().map(|key| facts[key].as_f64().unwrap_or(0.0).abs()).fold(0.0, f64::max)
}

#[test]
fn f32_packs_say_what_openvdb_says() {
    let folder = tempfile::tempdir().unwrap();
    let mut grids = 0;
    for path in fixtures() {
        let file = VdbFile::open(&path).unwrap();
        for (grid, facts) in file.grids.iter().zip(facts(&path)) {
            if !grid.value_type.is_scalar() || grid.transform.matrix.is_none() {
                continue;
            }
            let (pack, report) =
                build_verified(std::slice::from_ref(&path), settings(&grid.name, Format::F32), folder.path());
            let what = format!("{} {}", path.display(), grid.name);
            assert!(report.ok, "{what}: {:?}", report.failures);
            // What is no float is off by its rounding, and that is no more than half a unit in the last place.
            let rounding = if grid.value_type == ValueType::Float { 0.0 } else { 2f64.powi(-24) };
            let largest = report.all.max_error;
            assert!(largest <= rounding * largest_value(&facts), "{what}: {largest}");
            for (at, expected, expected_active) in probes(&facts) {
                let expected = if expected.is_finite() { expected as f32 } else { 0.0 };
                let (value, active) = voxel(&pack, Coord(at));
                assert_eq!(value.to_bits(), expected.to_bits(), "{what} at {at:?}: {value}, not {expected}");
                assert_eq!(active, expected_active, "{what} at {at:?}");
            }
            grids += 1;
        }
    }
    assert!(grids > 60, "only {grids} grids");
}

#[test]
fn every_format_keeps_its_promise_on_every_fixture() {
    let folder = tempfile::tempdir().unwrap();
    for path in fixtures() {
        for grid in VdbFile::open(&path).unwrap().grids {
            let in_half = !["huge_range", "ticks", "count"].contains(&grid.name.as_str());
            if !grid.value_type.is_scalar() || grid.transform.matrix.is_none() {
                continue;
            }
            for format in [Format::F16, Format::UNORM8, Format::BC4, Format::BC7] {
                // A coarse level set may well flip signs; that is a failure of its own.
                let too_coarse = path.ends_with("levelset_half.vdb") || path.ends_with("levelset_float.vdb");
                if format == Format::F16 && !in_half
                    || too_coarse && matches!(format, Format::BC4 | Format::BC7)
                {
                    continue;
                }
                for masks in [Masks::Auto, Masks::Keep] {
                    let settings = Settings { masks, ..settings(&grid.name, format) };
                    let (_, report) = build_verified(std::slice::from_ref(&path), settings, folder.path());
                    let what = format!("{} {} {format:?} {masks:?}", path.display(), grid.name);
                    // Blocks of noise, and the smallest floats as halves, are hardly more than noise, and said to be.
                    let is_ruined = |why: &String| why.contains("is under 20 dB");
                    if report.failures.iter().all(is_ruined) {
                        continue;
                    }
                    assert!(report.ok, "{what}: {:?}", report.failures);
                    if format == Format::F16 && grid.half {
                        assert_eq!(report.all.max_error, 0.0, "{what}");
                    }
                }
            }
        }
    }
}

#[test]
fn values_past_half_are_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let job = Job::new(
        vec![fixture("degenerate.vdb")],
        folder.path().join("x.volpack"),
        settings("huge_range", Format::F16),
        VerifyLevel::Voxels,
    );
    let error = build(&job, &mut Silent).err().unwrap();
    assert!(error.to_string().contains("huge_range") && error.to_string().contains("f16"), "{error}");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "something was left behind");
}

#[test]
fn what_frames_share_is_stored_once() {
    let folder = tempfile::tempdir().unwrap();
    let (pack, report) = build_verified(&animation(), settings("density", Format::F32), folder.path());
    assert!(report.ok && pack.grids()[0].frames.len() == 8);
    let all = PackSummary::new(&pack);
    assert!(all.unique_bricks < all.bricks, "the animation has a still part");
    // Windows does not replace a pack that is mapped.
    drop(pack);

    // The same file under eight names costs one frame and eight links.
    let still: Vec<_> = (1..=8)
        .map(|n| {
            let copy = folder.path().join(format!("still_{n}.vdb"));
            std::fs::copy(fixture("anim_0008.vdb"), &copy).unwrap();
            copy
        })
        .collect();
    let one =
        PackSummary::new(&build_verified(&still[..1], settings("density", Format::F32), folder.path()).0);
    let eight = PackSummary::new(&build_verified(&still, settings("density", Format::F32), folder.path()).0);
    assert_eq!(eight.bricks, 8 * one.bricks);
    assert_eq!((eight.unique_bricks, eight.texel_bytes), (one.unique_bricks, one.texel_bytes));
    assert_eq!(eight.gpu_bytes - one.gpu_bytes, 7 * 4);
}

#[test]
fn a_frame_lists_the_chunks_of_its_bricks_and_no_others() {
    let folder = tempfile::tempdir().unwrap();
    // 343 bricks of 2 KB a frame are more than two slabs, and no frame has one of another's.
    let noise = |frame: u32| {
        move |voxel: [i32; 3]| {
            let seed = voxel
                .iter()
                .fold(frame + 1, |h, v| (h ^ *v as u32).wrapping_mul(0x9e37_79b1).rotate_left(11));
            (seed as f32 / u32::MAX as f32, true)
        }
    };
    let frame = |frame: u32| {
        let path = folder.path().join(format!("noise_{frame:04}.vdb"));
        write_grid(&path, &GridFile::new("density", "Tree_float_5_4_3", 0.0f32).fill([7; 3], noise(frame)));
        path
    };
    let frames: Vec<_> = (0..3).map(frame).collect();
    let (pack, _) = build_verified(&frames, settings("density", Format::F32), folder.path());
    let atlas = pack.atlas(Codec::F32).unwrap();
    assert!(atlas.slabs > 6, "{atlas:?}");
    for (f, frame) in pack.grids()[0].frames.iter().enumerate() {
        let mut needed = BTreeSet::new();
        pack.frame_tree(0, f).for_each_region(|_, _, region| {
            if let Region::Brick(record) = region {
                needed.insert(record.slot / atlas.slab_bricks());
            }
        });
        // Texels are the first section of a file, and slabs its first chunks.
        assert_eq!(frame.chunks, Vec::from_iter(needed), "frame {f}");
        assert!(frame.chunks.len() <= atlas.slabs as usize / 2, "frame {f} needs {:?}", frame.chunks);
    }
}

#[test]
fn brick_ranges_are_finer_than_the_sequences() {
    let folder = tempfile::tempdir().unwrap();
    let psnr = |range| {
        let settings = Settings { range, ..settings("density", Format::UNORM8) };
        build_verified(&[fixture("fog_half_blosc.vdb")], settings, folder.path()).1.active.psnr.unwrap()
    };
    assert!(psnr(RangeMode::Brick) > psnr(RangeMode::Sequence) + 3.0);
}

#[test]
fn several_grids_keep_their_own_frames_and_ranges() {
    let folder = tempfile::tempdir().unwrap();
    let settings = Settings {
        grids: vec!["temperature".to_owned(), "density".to_owned()],
        encoding: Format::UNORM8.into(),
        fps: Some(24.0),
        ..Settings::default()
    };
    // Frame 99 has no temperature.
    let mut frames = animation();
    let only_density = folder.path().join("anim_0099.vdb");
    std::fs::copy(fixture("fog_half_zip.vdb"), &only_density).unwrap();
    frames.push(only_density);
    let (pack, report) = build_verified(&frames, settings, folder.path());
    assert!(report.ok, "{:?}", report.failures);
    let names: Vec<_> =
        pack.grids().iter().map(|g| (g.name.as_str(), g.frames.len(), g.record.fps)).collect();
    assert_eq!(names, [("temperature", 8, 24.0), ("density", 9, 24.0)]);
    assert_eq!(pack.grids()[1].frames[8].record.number, 99);
    assert_ne!(pack.grids()[0].sequence, pack.grids()[1].sequence);
}

#[test]
fn an_empty_frame_is_a_frame() {
    let folder = tempfile::tempdir().unwrap();
    // The empty grid comes first, in the middle and last.
    let frames: Vec<_> = ["empty", "fog_half_zip", "empty", "anim_0003", "empty"]
        .iter()
        .enumerate()
        .map(|(n, name)| {
            let copy = folder.path().join(format!("frame_{n}.vdb"));
            std::fs::copy(fixture(&format!("{name}.vdb")), &copy).unwrap();
            copy
        })
        .collect();
    let (pack, report) = build_verified(&frames, settings("density", Format::BC7), folder.path());
    assert!(report.ok, "{:?}", report.failures);
    let leaves: Vec<_> = pack.grids()[0].frames.iter().map(|f| f.record.leaves > 0).collect();
    assert_eq!(leaves, [false, true, false, true, false]);
    assert!(pack.grids()[0].frames[0].chunks.is_empty());
}

#[test]
fn the_tree_stays_within_its_budget() {
    let folder = tempfile::tempdir().unwrap();
    for (frames, grid) in [
        (animation(), "density"),
        (vec![fixture("fog_half_blosc.vdb")], "density"),
        (vec![fixture("levelset_float.vdb")], "surface"),
        (vec![fixture("tiles.vdb")], "density"),
        (vec![fixture("negative.vdb")], "density"),
    ] {
        let (pack, _) = build_verified(&frames, settings(grid, Format::UNORM8), folder.path());
        let summary = PackSummary::new(&pack);
        let grid = &pack.grids()[0];
        let cells: u64 = (0..3).map(|a| u64::from(grid.cells[a]) * u64::from(grid.roots[a])).product();
        let frames = grid.frames.len() as u64;
        // The design's budget.
        let budget = 16 * summary.bricks + 1024 * summary.l2_nodes + frames * (64 + cells * 5 / 8);
        assert!(summary.tree_bytes <= budget, "{:?}: {} of {budget}", frames, summary.tree_bytes);
    }
}
