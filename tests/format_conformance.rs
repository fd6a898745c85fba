//! The packs in `tests/conformance` and what readers have to find in them: ours, the Python reader, and for lossless
//! packs OpenVDB's own values.
//!
//! `cargo test --test format_conformance -- --ignored` makes them anew. Version 1 of the format is frozen, so that is for
//! packs that are added.

mod common;
#[path = "common/forgery.rs"]
mod forgery;
#[path = "../fuzz/common/reseal.rs"]
mod reseal;

use std::collections::{BTreeSet, HashMap};
use std::path::{Path, PathBuf};
use std::process::Command;

use bytemuck::allocation::pod_collect_to_vec;
use common::{build_verified, facts, fixture, probes};
use forgery::{Forgery, part};
use serde::{Deserialize, Serialize};
use volpack::codec::Codec;
use volpack::pack::layout::{AtlasRecord, FrameRecord, kind};
use volpack::pack::tree::{L3Record, header};
use volpack::pack::{Atlas, Pack, Region};
use volpack::settings::{Clustering, Encoding, Format, Quality, Settings, TexelCodec};
use volpack::vdb::{Accessor, Scalar, VdbFile, with_scalar_type};
use volpack::volume::{BRICK_DIM, Coord, CoordBox, L2_DIM};

/// What a pack is made of.
struct Case {
    name: &'static str,
    sources: &'static [&'static str],
    settings: Settings,
    /// What no build gives.
    change: fn(&Pack, &mut Forgery),
}

fn cases() -> Vec<Case> {
    let settings = |grids: &[&str], format: Format, zstd| Settings {
        grids: grids.iter().map(|grid| (*grid).to_owned()).collect(),
        encoding: format.into(),
        zstd,
        ..Settings::default()
    };
    let both = &["density", "temperature"];
    let shapes = &["scaled_copies", "flat_bricks", "two_values", "negative_copies", "negative_background"];
    let case = |name, sources, settings| Case { name, sources, settings, change: |_, _| {} };
    let anim = &["anim_0001", "anim_0002", "anim_0003"];
    vec![
        case("f32", &["tiles"], settings(&[], Format::F32, 0)),
        case("f16", &["inactive_half"], settings(&[], Format::F16, 0)),
        case("unorm8", &["levelset_half"], settings(&[], Format::UNORM8, 0)),
        case("bc4", anim, settings(both, Format::BC4, 0)),
        case("bc7", anim, settings(both, Format::BC7, 0)),
        Case { change: use_every_mode, ..case("bc7_modes", &["anim_0001"], settings(&[], Format::BC7, 0)) },
        Case { change: use_small_slabs, ..case("slabs", anim, settings(both, Format::BC7, 0)) },
        case(
            "adaptive",
            &["adversarial"],
            Settings { encoding: Quality::Psnr(60.0).into(), ..settings(shapes, Format::Adaptive, 0) },
        ),
        case(
            "kmeans",
            &["anim_0003", "anim_0004", "anim_0005", "anim_0006"],
            Settings {
                encoding: Encoding::Uniform {
                    codec: TexelCodec::BC7,
                    clustering: Some(Clustering { clusters: 4, ..Clustering::default() }),
                },
                ..settings(&["density"], Format::BC7, 0)
            },
        ),
        case("f32_zstd", &["inactive_float"], settings(&[], Format::F32, 3)),
        case("f16_zstd", &["negative"], settings(&[], Format::F16, 3)),
    ]
}

/// What is expected of one pack.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Expectation {
    pack: String,
    sources: Vec<String>,
    frames: Vec<Frame>,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Frame {
    grid: String,
    frame: i32,
    boxes: Vec<Voxels>,
    /// x, y, z, the bits of the value, and whether it is active.
    voxels: Vec<(i32, i32, i32, String, bool)>,
}

/// All voxels of a box.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Voxels {
    min: Coord,
    max: Coord,
    #[serde(default)]
    crc32: String,
    #[serde(default)]
    active: u64,
}

impl Expectation {
    /// The same places with what `reader` gives for those of each frame: value, and whether it is active.
    fn fill<R: FnMut(Coord) -> (f32, bool)>(&self, reader: impl Fn(&Frame) -> R) -> Self {
        let mut filled = self.clone();
        for frame in &mut filled.frames {
            let mut voxel = reader(frame);
            for (x, y, z, bits, active) in &mut frame.voxels {
                let value;
                (value, *active) = voxel(Coord::new(*x, *y, *z));
                *bits = format!("{:08x}", value.to_bits());
            }
            for voxels in &mut frame.boxes {
                let mut crc = flate2::Crc::new();
                voxels.active = 0;
                for at in inside(voxels.min, voxels.max) {
                    let (value, active) = voxel(at);
                    crc.update(&value.to_le_bytes());
                    crc.update(&[active.into()]);
                    voxels.active += u64::from(active);
                }
                voxels.crc32 = format!("{:08x}", crc.sum());
            }
        }
        filled
    }

    fn read(name: &str) -> Self {
        serde_json::from_slice(&std::fs::read(file(name, "json")).unwrap()).unwrap()
    }
}

/// Every voxel of a box, x slowest.
fn inside(min: Coord, max: Coord) -> impl Iterator<Item = Coord> {
    let [x, y, z] = std::array::from_fn(|a| min.0[a]..=max.0[a]);
    x.flat_map(move |x| {
        let z = z.clone();
        y.clone().flat_map(move |y| z.clone().map(move |z| Coord::new(x, y, z)))
    })
}

fn file(name: &str, extension: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/conformance").join(format!("{name}.{extension}"))
}

/// What our reader finds at each voxel of a frame.
fn our_reader<'a>(pack: &'a Pack, frame: &Frame) -> impl FnMut(Coord) -> (f32, bool) + use<'a> {
    let g = pack.grids().iter().position(|grid| grid.name == frame.grid).unwrap();
    let f = pack.grids()[g].frames.iter().position(|f| f.record.number == frame.frame).unwrap();
    let reader = pack.frame(g, f).unwrap();
    let mut bricks = HashMap::new();
    move |at| match reader.locate(at).0 {
        Region::Background => (reader.grid().background, false),
        Region::Constant(constant) => (constant.value, constant.active),
        Region::Brick(record) => {
            let brick =
                bricks.entry(at.align_down(BRICK_DIM)).or_insert_with(|| reader.decode(&record).unwrap());
            let index = at.child_index(3, 1);
            (brick.values[index], brick.active.get(index))
        }
    }
}

/// Whether the Python reader can be asked: there may be no Python.
fn python() -> bool {
    let is_there = Command::new("python3").arg("--version").output().is_ok();
    assert!(is_there || std::env::var_os("VOLPACK_REQUIRE_PYTHON").is_none(), "python3 is missing");
    is_there
}

/// What the Python reader finds, as it prints it; `None` if it has no zstd and needs it.
fn seen_by_python(pack: &Path, wanted: &Path) -> Option<String> {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/volpack_reader.py");
    let output = Command::new("python3").arg(script).arg(pack).arg(wanted).output().unwrap();
    let error = String::from_utf8_lossy(&output.stderr);
    if error.contains("pip install zstandard") {
        return None;
    }
    assert!(output.status.success(), "{}: {error}", pack.display());
    Some(String::from_utf8(output.stdout).unwrap())
}

#[test]
fn readers_find_what_is_expected() {
    let has_python = python();
    for Case { name, .. } in cases() {
        let expected = Expectation::read(name);
        let pack = Pack::open(&file(name, "volpack")).unwrap();
        pack.check_chunks().unwrap();
        let ours = expected.fill(|frame| our_reader(&pack, frame));
        assert!(ours == expected, "{name}: our reader finds other voxels");
        let theirs =
            if has_python { seen_by_python(&file(name, "volpack"), &file(name, "json")) } else { None };
        if let Some(theirs) = theirs {
            let theirs: Expectation = serde_json::from_str(&theirs).unwrap();
            assert!(theirs == expected, "{name}: the Python reader finds other voxels");
        }
    }
}

/// Packs of f32, and of f16 where its values are halves, have what OpenVDB says their sources have.
#[test]
fn lossless_expectations_are_openvdbs() {
    for Case { name, sources, .. } in cases().into_iter().filter(|case| case.name.starts_with('f')) {
        let (expected, path) = (Expectation::read(name), fixture(&format!("{}.vdb", sources[0])));
        let vdb = VdbFile::open(&path).unwrap();
        let [frame] = &expected.frames[..] else { panic!("{name} has one frame") };
        for (at, value, active) in probes(&facts(&path)[0]) {
            let [x, y, z] = at;
            let probe = (x, y, z, format!("{:08x}", (value as f32).to_bits()), active);
            assert!(frame.voxels.contains(&probe), "{name} lacks {probe:?}");
        }
        // OpenVDB was asked for a few voxels, so the others are those of its file.
        with_scalar_type!(&vdb.grids[0].value_type,
            T => {
                let tree = vdb.read_tree::<T>(&vdb.grids[0]).unwrap();
                let source = Accessor::new(&tree);
                let from_source = expected.fill(|_| |at| {
                    let (value, active) = source.get(at);
                    (Scalar::to_f32(value), active)
                });
                assert!(from_source == expected, "{name}: the source has other voxels");
            },
            other => panic!("{name} is {}", other.name())
        );
    }
}

/// What some pack has of each kind of thing that a reader may get wrong.
#[test]
fn everything_that_the_format_has_is_in_some_pack() {
    let mut seen = BTreeSet::new();
    for Case { name, .. } in cases() {
        let bytes = std::fs::read(file(name, "volpack")).unwrap();
        assert!(bytes.len() < 30_000, "{name} is large");
        let pack = Pack::from_bytes(bytes.clone()).unwrap();
        let mut say = |what: &str| seen.insert(what.to_owned());
        let sections = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
        for section in bytes[64..].chunks_exact(80).take(sections) {
            say(&format!("encoding {}", section[8]));
        }
        let numbers = pack.grids().iter().map(|grid| grid.frames.len());
        for (what, holds) in [
            ("several grids", pack.grids().len() > 1),
            ("several frames", numbers.max() > Some(1)),
            ("several roots", pack.grids().iter().any(|grid| grid.roots != [1; 3])),
            ("several cells", pack.grids().iter().any(|grid| grid.cells != [1; 3] && grid.cells != [32; 3])),
            ("a background that is not 0", pack.grids().iter().any(|grid| grid.background != 0.0)),
            ("several pages", pack.atlases().iter().any(|atlas| atlas.slabs > atlas.page_slabs)),
            ("several rows", pack.atlases().iter().any(|atlas| atlas.rows > 1 && atlas.columns > 1)),
        ] {
            holds.then(|| say(what));
        }
        let slabs = pack.atlas(Codec::Bc7).map_or(0, |atlas| atlas.slabs);
        for block in (0..slabs).flat_map(|slab| pack.slab(Codec::Bc7, slab).unwrap().into_owned()).step_by(16)
        {
            say(&format!("mode {}", block.trailing_zeros()));
        }
        for (g, grid) in pack.grids().iter().enumerate() {
            let mut slots = BTreeSet::new();
            for f in 0..grid.frames.len() {
                let mut of_frame = Vec::new();
                pack.frame_tree(g, f).for_each_region(|at, dim, region| match region {
                    Region::Brick(record) => of_frame.push((at, record)),
                    Region::Constant(constant) => {
                        say(&format!("a constant of {dim}, active {}", constant.active));
                    }
                    Region::Background => {}
                });
                for (at, L3Record { codec, axis, mask, rule, slot, word2 }) in of_frame {
                    say(&format!("{} along {axis}", codec.name()));
                    say(&format!("rule {} with a mask: {}", rule as u8, mask.is_some()));
                    (at.0.iter().min() < Some(&0)).then(|| say("a brick at negative coordinates"));
                    let shared = codec != Codec::Constant
                        && slots.iter().any(|&(c, s, w)| (c, s) == (codec, slot) && w != word2);
                    slots.insert((codec, slot, word2));
                    shared.then(|| say("texels shared by bricks of other ranges"));
                }
            }
        }
    }
    let expected = [
        "encoding 0",
        "encoding 1",
        "encoding 2",
        "encoding 3",
        "several grids",
        "several frames",
        "several roots",
        "several pages",
        "several rows",
        "a background that is not 0",
        "a brick at negative coordinates",
        "texels shared by bricks of other ranges",
        "bc7 along 0",
        "bc7 along 1",
        "constant along 0",
        "rule 0 with a mask: true",
        "rule 1 with a mask: true",
        "rule 2 with a mask: true",
        "rule 3 with a mask: true",
        "rule 3 with a mask: false",
        "a constant of 128, active true",
        "a constant of 128, active false",
        "a constant of 4096, active true",
        "a constant of 4096, active false",
    ];
    let modes = (0..8).map(|mode| format!("mode {mode}"));
    let codecs = Codec::WITH_TEXELS.map(|codec| format!("{} along 2", codec.name()));
    let expected = expected.map(str::to_owned).into_iter().chain(codecs).chain(modes);
    let missing: Vec<_> = expected.filter(|what| !seen.contains(what)).collect();
    assert!(missing.is_empty(), "no pack has {missing:?}, but {seen:?}");
}

/// Makes packs, and expectations by the Python reader, which shares no code with ours.
#[test]
#[ignore = "version 1 of the format is frozen: for packs that are added"]
fn bless() {
    assert!(python(), "expectations are made by the Python reader");
    let folder = tempfile::tempdir().unwrap();
    for Case { name, sources, settings, change } in cases() {
        let zstd = settings.zstd;
        let sources: Vec<PathBuf> = sources.iter().map(|name| fixture(&format!("{name}.vdb"))).collect();
        let build = |zstd| {
            let (pack, report) =
                build_verified(&sources, Settings { zstd, ..settings.clone() }, folder.path());
            assert!(report.ok, "{name}: {:?}", report.failures);
            (pack, std::fs::read(folder.path().join("test.volpack")).unwrap())
        };
        let (pack, bytes) = build(zstd);
        let mut forgery = Forgery::new(bytes);
        change(&pack, &mut forgery);
        std::fs::write(file(name, "volpack"), forgery.finish()).unwrap();
        let wanted = Expectation {
            pack: format!("{name}.volpack"),
            sources: sources
                .iter()
                .map(|path| format!("fixtures/{}", path.file_name().unwrap().display()))
                .collect(),
            frames: frames(&pack, &sources),
        };
        std::fs::write(file(name, "json"), serde_json::to_vec(&wanted).unwrap()).unwrap();
        // Python without zstd reads the same pack raw.
        build(0);
        let raw = if zstd == 0 { file(name, "volpack") } else { folder.path().join("test.volpack") };
        let seen = seen_by_python(&raw, &file(name, "json")).expect("the pack is raw");
        std::fs::write(file(name, "json"), seen).unwrap();
    }
}

/// The voxels and boxes to ask for: those that OpenVDB was asked for, two corners of the first brick of each kind, just
/// outside it, and all bricks cell by cell.
fn frames(pack: &Pack, sources: &[PathBuf]) -> Vec<Frame> {
    let mut frames = Vec::new();
    for (g, grid) in pack.grids().iter().enumerate() {
        for (f, frame) in grid.frames.iter().enumerate() {
            let of_source = facts(&sources[frame.record.source as usize]);
            let facts = of_source.iter().find(|facts| facts["name"] == *grid.name).unwrap();
            let mut wanted: Vec<Coord> = probes(facts).map(|(at, ..)| Coord(at)).collect();
            let (mut kinds, mut boxes) = (BTreeSet::new(), Vec::<(Coord, CoordBox)>::new());
            pack.frame_tree(g, f).for_each_region(|at, dim, region| {
                let Region::Brick(record) = region else {
                    wanted.extend([at, at.offset_by([dim - 1; 3])]);
                    return;
                };
                if kinds.insert((record.codec, record.axis, record.rule as u8, record.mask.is_some())) {
                    let corners = [[0, 0, 0], [7, 7, 7], [0, 3, 6], [5, 0, 2], [8, 0, 0], [-1, -1, -1]];
                    wanted.extend(corners.map(|corner| at.offset_by(corner)));
                }
                let (cell, brick) = (at.align_down(L2_DIM), CoordBox::cube(at, BRICK_DIM));
                match boxes.iter_mut().find(|(of, _)| *of == cell) {
                    Some((_, bounds)) => bounds.union(brick),
                    None => boxes.push((cell, brick)),
                }
            });
            wanted.sort_unstable();
            wanted.dedup();
            let voxels = |CoordBox { min, max }| Voxels { min, max, crc32: String::new(), active: 0 };
            frames.push(Frame {
                grid: grid.name.clone(),
                frame: frame.record.number,
                boxes: boxes.into_iter().map(|(_, bounds)| voxels(bounds)).collect(),
                voxels: wanted.iter().map(|at| (at.0[0], at.0[1], at.0[2], String::new(), false)).collect(),
            });
        }
    }
    frames
}

/// The same pack with slabs of 2 × 3 bricks, two to a page: writers may choose any, and small packs have one slab else.
fn use_small_slabs(pack: &Pack, forgery: &mut Forgery) {
    let [old] = pack.atlases()[..] else { panic!("one atlas") };
    let (columns, rows, page_slabs) = (2, 3, 2);
    let slabs = old.bricks.div_ceil(columns * rows);
    let new = Atlas { columns, rows, slabs, page_slabs, ..old };
    let layout = old.codec.layout();
    forgery.rebuild(|parts| {
        let section = part(parts, kind::TEXELS);
        section.chunk_bytes = new.slab_bytes() as u32;
        let mut texels = vec![0; new.bytes() as usize];
        for slot in 0..old.bricks {
            let slab = &section.content[(slot / old.slab_bricks()) as usize * old.slab_bytes()..];
            let brick = old.extract(slab, slot % old.slab_bricks());
            let slab = &mut texels[(slot / new.slab_bricks()) as usize * new.slab_bytes()..];
            for (row, bytes) in brick.chunks_exact(layout.row_bytes).enumerate() {
                slab[new.row_in_slab((slot % new.slab_bricks()) as usize, row)].copy_from_slice(bytes);
            }
        }
        section.content = texels;
        // Texels are the first section, so a slab's number is its chunk's.
        let mut lists: Vec<Vec<u32>> = Vec::new();
        for (g, grid) in pack.grids().iter().enumerate() {
            for f in 0..grid.frames.len() {
                let mut slabs = BTreeSet::new();
                pack.frame_tree(g, f).for_each_region(|_, _, region| {
                    if let Region::Brick(record) = region
                        && record.codec == new.codec
                    {
                        slabs.insert(record.slot / new.slab_bricks());
                    }
                });
                lists.push(slabs.into_iter().collect());
            }
        }
        part(parts, kind::FRAME_CHUNKS).content = bytemuck::cast_slice(&lists.concat()).to_vec();
        let mut frames: Vec<FrameRecord> = pod_collect_to_vec(&part(parts, kind::FRAMES).content);
        let mut first_chunk = 0;
        for (frame, list) in frames.iter_mut().zip(&lists) {
            (frame.first_chunk, frame.chunks) = (first_chunk, list.len() as u32);
            first_chunk += frame.chunks;
        }
        part(parts, kind::FRAMES).content = bytemuck::cast_slice(&frames).to_vec();
        let record =
            AtlasRecord { codec: old.codec as u32, bricks: old.bricks, columns, rows, slabs, page_slabs };
        part(parts, kind::ATLASES).content = bytemuck::bytes_of(&record).to_vec();
        part(parts, kind::TREE).content[4 * header::atlas(new.codec)..][..12]
            .copy_from_slice(bytemuck::cast_slice(&[columns, rows, page_slabs]));
    });
}

/// The same pack with other texels: blocks of every mode of BC7, of which the encoder uses four. Their other bits are those
/// of a small generator (xorshift64).
fn use_every_mode(_: &Pack, forgery: &mut Forgery) {
    let mut bits = 0x9e37_79b9_7f4a_7c15u64;
    forgery.edit(kind::TEXELS, |texels| {
        for (i, block) in texels.chunks_exact_mut(16).enumerate() {
            for byte in block.iter_mut() {
                bits ^= bits << 13;
                bits ^= bits >> 7;
                bits ^= bits << 17;
                *byte = (bits >> 32) as u8;
            }
            // A mode is the number of zeros below the lowest bit that is on.
            let mode = i % 8;
            block[0] = (block[0] as u16 >> (mode + 1) << (mode + 1) | 1 << mode) as u8;
        }
    });
}
