//! Faults that digests cannot tell, because whoever made them made the digests too: verification has to.

mod common;
#[path = "../fuzz/common/reseal.rs"]
mod reseal;

use std::mem::offset_of;
use std::path::{Path, PathBuf};

use common::{build_verified, fixture};
use reseal::reseal;
use volpack::codec::Codec;
use volpack::pack::layout::{FrameRecord, GridRecord, Header, Section, kind};
use volpack::pack::tree::{NODE_WORDS, RECORD_WORDS, grid, header};
use volpack::pack::{Pack, Region};
use volpack::settings::{Format, Settings};
use volpack::verify::{Sources, voxels};

/// A pack in memory whose sections lie in it as they are.
struct Victim {
    bytes: Vec<u8>,
    sources: Vec<PathBuf>,
}

impl Victim {
    fn new(name: &str, grid: &str, format: Format, folder: &Path) -> Self {
        Self::of(vec![fixture(name)], grid, format, folder)
    }

    fn of(sources: Vec<PathBuf>, grid: &str, format: Format, folder: &Path) -> Self {
        let settings = Settings {
            grids: vec![grid.to_owned()],
            encoding: format.into(),
            zstd: 0,
            ..Settings::default()
        };
        let (_, report) = build_verified(&sources, settings, folder);
        assert!(report.ok);
        let victim = Self { bytes: std::fs::read(folder.join("test.volpack")).unwrap(), sources };
        assert_eq!(victim.verdict(|_| {}), None, "resealing alone changes nothing");
        victim
    }

    /// Where a section's bytes begin.
    fn section(bytes: &[u8], wanted: u32) -> usize {
        let header: Header = bytemuck::pod_read_unaligned(&bytes[..64]);
        let sections = bytes[64..].chunks_exact(80).take(header.sections as usize);
        let found = sections.map(bytemuck::pod_read_unaligned::<Section>).find(|s| s.kind == wanted);
        found.unwrap().offset as usize
    }

    /// What is said of the pack after `damage`, with its digests made anew; `None` if it passes.
    fn verdict(&self, damage: impl FnOnce(&mut [u8])) -> Option<String> {
        let mut bytes = self.bytes.clone();
        damage(&mut bytes);
        reseal(&mut bytes);
        let pack = match Pack::from_bytes(bytes) {
            Ok(pack) => pack,
            Err(e) => return Some(e.to_string()),
        };
        pack.check_chunks().expect("the digests are right");
        let sources = Sources::find(&pack, &self.sources).unwrap();
        let report = voxels(&pack, &sources, 1, &mut volpack::progress::Silent).unwrap();
        report.failures.first().cloned()
    }

    /// Changes words of the tree.
    fn tree(&self, damage: impl FnOnce(&mut [u32])) -> Option<String> {
        self.verdict(|bytes| {
            let at = Self::section(bytes, kind::TREE);
            let len = u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
            let mut words: Vec<u32> = bytemuck::allocation::pod_collect_to_vec(&bytes[at..at + len * 4]);
            damage(&mut words);
            bytes[at..at + len * 4].copy_from_slice(bytemuck::cast_slice(&words));
        })
    }
}

/// The first words of the records that have texels.
fn records(words: &[u32]) -> Vec<usize> {
    let at = words[header::RECORD_AT] as usize;
    let records = (0..words[header::RECORDS] as usize).map(|i| at + i * RECORD_WORDS);
    records.filter(|&r| words[r] & 7 != Codec::Constant as u32).collect()
}

#[test]
fn changed_texels_are_found_in_every_format() {
    let folder = tempfile::tempdir().unwrap();
    for format in Format::ALL {
        let victim = Victim::new("fog_half_zip.vdb", "density", format, folder.path());
        let before = values(&victim.bytes);
        let mut changed = 0;
        for place in (0..1600).step_by(67) {
            let mut now = Vec::new();
            let found = victim.verdict(|bytes| {
                bytes[Victim::section(bytes, kind::TEXELS) + place] ^= 0x10;
                let mut sealed = bytes.to_vec();
                reseal(&mut sealed);
                now = values(&sealed);
            });
            // An index of a block of one colour says nothing, and is no fault.
            assert_eq!(found.is_some(), now != before, "{format:?} byte {place}");
            changed += u32::from(now != before);
        }
        assert!(changed >= 4, "{format:?}: only {changed} of 24 changes changed a value");
    }
}

/// Every value that a pack's bricks have.
fn values(bytes: &[u8]) -> Vec<u32> {
    let pack = Pack::from_bytes(bytes.to_vec()).unwrap();
    let frame = pack.frame(0, 0).unwrap();
    let mut values = Vec::new();
    frame.for_each_region(|_, _, region| {
        if let Region::Brick(record) = region {
            values.extend(frame.decode(&record).unwrap().values.iter().map(|v| v.to_bits()));
        }
    });
    values
}

#[test]
fn swapped_bricks_wrong_axes_and_wrong_ranks_are_found() {
    let folder = tempfile::tempdir().unwrap();
    let victim = Victim::new("fog_half_zip.vdb", "density", Format::BC7, folder.path());
    let swapped = victim.tree(|words| {
        let r = records(words);
        let (a, b) = (words[r[3]], words[r[10]]);
        words[r[3]] = a & 0x1f | b & !0x1f;
        words[r[10]] = b & 0x1f | a & !0x1f;
    });
    assert!(swapped.unwrap().contains("error"), "a swapped slot");
    let turned = victim.tree(|words| {
        let r = records(words)[7];
        let axis = (words[r] >> 3 & 3) + 1;
        words[r] = (words[r] & !(3 << 3)) | ((axis % 3) << 3);
    });
    assert!(turned.is_some(), "a wrong axis");
    let miscounted = victim.tree(|words| words[words[header::NODE_AT] as usize + 130] += 1);
    assert!(miscounted.unwrap().contains("ranks"), "a wrong rank");
    let moved = victim.tree(|words| {
        let first = words[header::NODE_AT] as usize + NODE_WORDS - 1;
        words[first] = words[first].wrapping_add(1);
    });
    assert!(moved.is_some(), "a node that begins a record late");
}

#[test]
fn wrong_inactive_rules_and_masks_are_found() {
    let folder = tempfile::tempdir().unwrap();
    let victim = Victim::new("levelset_half.vdb", "surface", Format::UNORM8, folder.path());
    let rule = victim.tree(|words| {
        // From "background" to "minus background".
        let r = records(words).into_iter().find(|r| words[r + 1] >> 30 == 0).unwrap();
        words[r + 1] |= 1 << 30;
    });
    assert!(rule.is_some(), "a wrong rule");
    let mask = victim.tree(|words| words[words[header::MASK_AT] as usize] ^= 1 << 9);
    assert!(mask.is_some(), "a wrong mask");
    let background = victim.tree(|words| {
        let at = words[header::GRID_AT] as usize + 11;
        words[at] = 0.25f32.to_bits();
    });
    assert!(background.unwrap().contains("background"), "a wrong background");
}

#[test]
fn an_error_norm_that_is_no_number_passes_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let victim = Victim::new("fog_half_zip.vdb", "density", Format::BC7, folder.path());
    for error_l2 in [f64::NAN, f64::INFINITY, 0.0] {
        let found = victim.verdict(|bytes| {
            let at = Victim::section(bytes, kind::FRAMES) + offset_of!(FrameRecord, error_l2);
            bytes[at..at + 8].copy_from_slice(&error_l2.to_le_bytes());
        });
        assert!(found.is_some_and(|found| found.contains("the encoder left")), "{error_l2}");
    }
}

/// Tables are of use to engines, and nothing in a picture or a voxel gives their entries away.
#[test]
fn tables_that_say_another_thing_are_found() {
    let folder = tempfile::tempdir().unwrap();
    let sources = vec![fixture("anim_0001.vdb"), fixture("anim_0002.vdb")];
    let victim = Victim::of(sources, "density", Format::UNORM8, folder.path());
    let changed = |section: u32, at: usize, to: [u8; 4]| {
        victim.verdict(|bytes| {
            let at = Victim::section(bytes, section) + at;
            assert_ne!(bytes[at..at + 4], to);
            bytes[at..at + 4].copy_from_slice(&to);
        })
    };
    let grid = |at, to| changed(kind::GRIDS, at, to);
    let class = grid(offset_of!(GridRecord, class), 1u32.to_le_bytes());
    assert!(class.is_some_and(|found| found.contains("class")), "a wrong class");
    let fps = grid(offset_of!(GridRecord, fps), 24f32.to_le_bytes());
    assert!(fps.is_some_and(|found| found.contains("frames per second")), "a wrong frame rate");
    let least = grid(offset_of!(GridRecord, active_min), (-1f32).to_le_bytes());
    assert!(least.is_some_and(|found| found.contains("active values")), "a wrong range");
    let cost = grid(offset_of!(GridRecord, codec_error_l2s) + 4 * Codec::Unorm8 as usize, 0f32.to_le_bytes());
    assert!(cost.is_some_and(|found| found.contains("unorm8")), "a wrong cost");
    let number = changed(kind::FRAMES, offset_of!(FrameRecord, number), 0i32.to_le_bytes());
    assert!(number.is_some_and(|found| found.contains("frame 0")), "a wrong number");

    let missing = victim.verdict(|bytes| {
        let grids = Victim::section(bytes, kind::GRIDS) + offset_of!(GridRecord, frames);
        bytes[grids..grids + 4].copy_from_slice(&1u32.to_le_bytes());
        let tree = Victim::section(bytes, kind::TREE);
        let grid_at = u32::from_le_bytes(bytes[tree + 8..tree + 12].try_into().unwrap()) as usize;
        let frames = tree + 4 * (grid_at + grid::FRAMES);
        bytes[frames..frames + 4].copy_from_slice(&1u32.to_le_bytes());
    });
    assert!(missing.is_some(), "a frame that is missing");
}
