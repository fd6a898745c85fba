//! Packs of every fixture, against the source and against what OpenVDB says of it.

mod common;

use common::{animation, build_verified, facts, fixture, fixtures, probes};
use volpack::codec::Codec;
use volpack::pack::{Pack, Region};
use volpack::report::PackSummary;
use volpack::settings::{Format, Masks, NonFinite, RangeMode, Settings};
use volpack::vdb::VdbFile;
use volpack::volume::Coord;

fn settings(grid: &str, format: Format) -> Settings {
    Settings { grids: vec![grid.to_owned()], format, nonfinite: NonFinite::Zero, ..Settings::default() }
}

/// The value and state of one voxel, as an engine finds it.
fn voxel(pack: &Pack, at: Coord) -> (f32, bool) {
    let frame = pack.frame(0, 0).unwrap();
    match frame.locate(at).0 {
        Region::Background => (pack.grids[0].background, false),
        Region::Constant(constant) => (constant.value, constant.active),
        Region::Brick(record) => {
            let brick = frame.decode(&record).unwrap();
            let index = at.child_index(3, 1);
            (brick.values[index], brick.active.get(index))
        }
    }
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
            assert_eq!((report.active.max_error, report.all.max_error), (0.0, 0.0), "{what}");
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
            for format in [Format::F16, Format::Unorm8, Format::Bc4, Format::Bc7] {
                // A coarse level set may well flip signs; that is a failure of its own.
                let too_coarse = path.ends_with("levelset_half.vdb") || path.ends_with("levelset_float.vdb");
                if format == Format::F16 && !in_half
                    || too_coarse && matches!(format, Format::Bc4 | Format::Bc7)
                {
                    continue;
                }
                for masks in [Masks::Auto, Masks::Keep] {
                    let settings = Settings { masks, ..settings(&grid.name, format) };
                    let (_, report) = build_verified(std::slice::from_ref(&path), settings, folder.path());
                    let what = format!("{} {} {format:?} {masks:?}", path.display(), grid.name);
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
    let job = volpack::pipeline::Job::new(
        vec![fixture("degenerate.vdb")],
        folder.path().join("x.volpack"),
        settings("huge_range", Format::F16),
        volpack::pipeline::VerifyLevel::Voxels,
    );
    let error = volpack::pipeline::build(&job, &mut volpack::pipeline::Silent).err().unwrap();
    assert!(error.to_string().contains("huge_range") && error.to_string().contains("f16"), "{error}");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "something was left behind");
}

#[test]
fn what_frames_share_is_stored_once() {
    let folder = tempfile::tempdir().unwrap();
    let (pack, report) = build_verified(&animation(), settings("density", Format::F32), folder.path());
    assert!(report.ok && pack.grids[0].frames.len() == 8);
    let all = PackSummary::new(&pack);
    assert!(all.unique_bricks < all.bricks, "the animation has a still part");

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
fn a_frame_reads_no_chunks_but_its_own() {
    let folder = tempfile::tempdir().unwrap();
    let (pack, _) = build_verified(&animation(), settings("density", Format::F32), folder.path());
    let chunks: Vec<_> = pack.grids[0].frames.iter().map(|f| f.chunks.len()).collect();
    assert!(
        chunks.iter().all(|n| *n > 0 && *n <= pack.atlas(Codec::F32).unwrap().slabs as usize),
        "{chunks:?}"
    );
    // Decoding with only the listed chunks loaded is what verification did; a frame that listed too
    // few would have failed it.
}

#[test]
fn brick_ranges_are_finer_than_the_sequences() {
    let folder = tempfile::tempdir().unwrap();
    let psnr = |range| {
        let settings = Settings { range, ..settings("density", Format::Unorm8) };
        build_verified(&[fixture("fog_half_blosc.vdb")], settings, folder.path()).1.active.psnr.unwrap()
    };
    assert!(psnr(RangeMode::Brick) > psnr(RangeMode::Sequence) + 3.0);
}

#[test]
fn several_grids_keep_their_own_frames_and_ranges() {
    let folder = tempfile::tempdir().unwrap();
    let settings = Settings {
        grids: vec!["temperature".to_owned(), "density".to_owned()],
        format: Format::Unorm8,
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
    let names: Vec<_> = pack.grids.iter().map(|g| (g.name.as_str(), g.frames.len(), g.record.fps)).collect();
    assert_eq!(names, [("temperature", 8, 24.0), ("density", 9, 24.0)]);
    assert_eq!(pack.grids[1].frames[8].record.number, 99);
    assert_ne!(pack.grids[0].sequence, pack.grids[1].sequence);
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
    let (pack, report) = build_verified(&frames, settings("density", Format::Bc7), folder.path());
    assert!(report.ok, "{:?}", report.failures);
    let leaves: Vec<_> = pack.grids[0].frames.iter().map(|f| f.record.leaves > 0).collect();
    assert_eq!(leaves, [false, true, false, true, false]);
    assert!(pack.grids[0].frames[0].chunks.is_empty());
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
        let (pack, _) = build_verified(&frames, settings(grid, Format::Unorm8), folder.path());
        let summary = PackSummary::new(&pack);
        let grid = &pack.grids[0];
        let cells: u64 = (0..3).map(|a| u64::from(grid.cells[a]) * u64::from(grid.roots[a])).product();
        let frames = grid.frames.len() as u64;
        // The design's budget.
        let budget = 16 * summary.bricks + 1024 * summary.l2_nodes + frames * (64 + cells * 5 / 8);
        assert!(summary.tree_bytes <= budget, "{:?}: {} of {budget}", frames, summary.tree_bytes);
    }
}
