//! What our reader refuses is what docs/format.md says that a reader checks: each rule of "What a reader checks" is
//! broken alone, with digests that hold. What the page calls reserved or unchecked changes nothing.

mod common;
#[path = "common/forgery.rs"]
mod forgery;
#[path = "../fuzz/common/reseal.rs"]
mod reseal;
#[path = "common/vdb_writer.rs"]
mod vdb_writer;

use std::collections::BTreeSet;
use std::mem::offset_of;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use common::build_verified;
use forgery::{Forgery, Part, part};
use volpack::codec::Codec;
use volpack::pack::layout::{AtlasRecord, Chunk, FrameRecord, GridRecord, Header, Section, encoding, kind};
use volpack::pack::tree::{L3Record, grid, header};
use volpack::pack::{Pack, PackError, Provenance, ProvenanceError, Region};
use volpack::settings::{Format, Settings};
use volpack::volume::{Coord, CoordBox, Mask512};

// Packs of tests/conformance that are not compressed, and what the rules need of them.

/// Masks with every inactive rule; one grid, one frame, one cell.
const LEVEL_SET: &str = "unorm8";
/// Two grids of three frames.
const TWO_GRIDS: &str = "bc7";
/// Constants for roots and cells, several L1 nodes; one grid.
const TILES: &str = "f32";
/// Three atlases.
const ADAPTIVE: &str = "adaptive";
/// An atlas of many slabs.
const SLABS: &str = "slabs";

fn path_of(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("tests/conformance/{name}.volpack"))
}

fn pack(name: &str) -> Forgery {
    Forgery::new(std::fs::read(path_of(name)).unwrap())
}

/// Opens a pack and reads all of it: every chunk, every frame, every brick. Returns constants and voxels.
fn read(bytes: Vec<u8>) -> Result<Vec<(Coord, u32)>, PackError> {
    let pack = Pack::from_bytes(bytes)?;
    pack.check_chunks()?;
    let mut all = Vec::new();
    for (g, grid) in pack.grids().iter().enumerate() {
        for f in 0..grid.frames.len() {
            let frame = pack.frame(g, f)?;
            let mut regions = Vec::new();
            frame.for_each_region(|at, _, region| regions.push((at, region)));
            for (at, region) in regions {
                match region {
                    Region::Background => {}
                    Region::Constant(constant) => all.push((at, constant.value.to_bits())),
                    Region::Brick(record) => {
                        all.extend(frame.decode(&record)?.values.iter().map(|value| (at, value.to_bits())));
                    }
                }
            }
        }
    }
    Ok(all)
}

type Change = fn(&mut Forgery);

/// A rule's number, a pack, how that rule alone is broken there, and what the error says.
type Case = (u32, &'static str, Change, &'static str);

const ENCODING: usize = offset_of!(Section, encoding);
const CHUNK_BYTES: usize = offset_of!(Section, chunk_bytes);
const FIRST_CHUNK: usize = offset_of!(Section, first_chunk);
const CHUNKS: usize = offset_of!(Section, chunks);
const STORED: usize = offset_of!(Section, stored_bytes);
const RAW: usize = offset_of!(Section, raw_bytes);

/// Header, section table and chunk table.
#[rustfmt::skip] // One case a line.
const FILE: &[Case] = &[
    (1, TILES, |p| p.bytes[0] = b'x', "not a volpack"),
    (1, TILES, |p| p.bytes.clear(), "not a volpack"),
    (2, TILES, |p| p.set(offset_of!(Header, major), 2u16), "use a newer volpack"),
    (3, TILES, |p| (p.reseals, _) = (false, p.bytes.pop()), "its header says"),
    (4, TILES, |p| p.set(offset_of!(Header, chunks), u32::MAX), "ends inside its tables"),
    (4, TILES, |p| p.set(offset_of!(Header, sections), u32::MAX), "ends inside its tables"),
    (4, TILES, |p| p.bytes.truncate(63), "ends inside its tables"),
    (5, TILES, |p| (p.reseals, p.bytes[20]) = (false, 1), "the header does not match its digest"),
    (6, TILES, |p| p.add(p.entry(kind::NAMES) + FIRST_CHUNK, 1), "chunks outside the chunk table"),
    (6, TILES, |p| p.add(p.entry(kind::TREE) + CHUNKS, 1), "chunks outside the chunk table"),
    (6, TILES, drop_chunks_of_tree, "chunks of no section"),
    (7, TILES, |p| move_tree(p, |at| at + 4), "does not begin at a multiple of 256"),
    (7, TILES, |p| move_tree(p, |at| at - 256), "overlaps what is before it"),
    (7, TILES, |p| move_tree(p, |_| u64::MAX - 255), "begins behind the end of the file"),
    (8, TILES, wrong_section_digest, "the tree's chunk table does not match its digest"),
    (9, TILES, |p| p.set(p.entry(kind::NAMES) + ENCODING, 4), "unknown encoding 4"),
    (10, TILES, |p| p.set(p.entry(kind::NAMES) + CHUNK_BYTES, 0), "not of 1 to 16777216"),
    (10, TILES, |p| p.set(p.entry(kind::NAMES) + CHUNK_BYTES, (16 << 20) + 1), "not of 1 to 16777216"),
    (10, TILES, |p| p.set(p.entry(kind::NAMES) + CHUNK_BYTES, 6), "name table decodes to 7 bytes"),
    (10, TILES, |p| p.set(p.last_chunk(kind::NAMES) + offset_of!(Chunk, raw_bytes), 0), "decodes to 0 bytes"),
    (10, SLABS, |p| p.add(p.entry(kind::TEXELS) + CHUNK_BYTES, 1), "texels decodes to 768 bytes"),
    (11, TILES, |p| p.add(p.last_chunk(kind::TREE) + offset_of!(Chunk, offset), 4), "not lie where it should"),
    (11, TILES, |p| p.add(p.last_chunk(kind::TREE) + offset_of!(Chunk, stored_bytes), -4), "not lie where it should"),
    (11, TILES, more_stored_than_raw, "does not lie where it should"),
    (11, TILES, |p| p.bytes.truncate(p.section(kind::TREE).end - 4), "ends behind the file"),
    (12, TILES, |p| p.add(p.entry(kind::TREE) + RAW, 4), "not as long as its chunks"),
    (12, TILES, |p| p.add(p.entry(kind::TREE) + STORED, 4), "not as long as its chunks"),
    (13, TILES, |p| p.rebuild(|parts| parts.retain(|part| part.kind != kind::NAMES)), "there is no name table"),
    (13, TILES, |p| p.rebuild(|parts| parts.retain(|part| part.kind != kind::PROVENANCE)), "no provenance"),
    (13, TILES, |p| p.rebuild(|parts| parts.push(Part::new(kind::NAMES, vec![0]))), "more than one name table"),
    (14, TILES, |p| p.rebuild(|parts| make_endless(part(parts, kind::NAMES))), "the tables and the tree claim to unpack"),
    (14, TILES, |p| p.rebuild(|parts| make_texels_endless(parts)), "frame 0 claims to unpack to 285212672 bytes"),
    (15, TILES, |p| damage_unsealed(p, kind::TEXELS), "(texels) does not match its digest"),
    (15, TILES, |p| damage_unsealed(p, kind::TREE), "(tree) does not match its digest"),
    (16, TILES, |p| claim_zstd(p, vec![1; 40], 50), "is not one zstd frame"),
    (16, TILES, |p| claim_zstd(p, zstd(49), 50), "unpacks to 49 bytes, not 50"),
    (16, TILES, |p| claim_zstd(p, zstd(51), 50), "does not unpack"),
    (16, TILES, |p| claim_zstd(p, [zstd(25), zstd(25)].concat(), 50), "is not one zstd frame"),
];

/// Tables, atlases and what the tree says of itself.
#[rustfmt::skip] // One case a line.
const TABLES: &[Case] = &[
    (17, TILES, |p| p.edit(kind::GRIDS, |content| content.push(0)), "grid table is not a whole number"),
    (17, TILES, |p| p.edit(kind::FRAMES, |content| content.push(0)), "frame table is not a whole number"),
    (17, TILES, |p| p.edit(kind::ATLASES, |content| content.push(0)), "atlas table is not a whole number"),
    (17, TILES, |p| p.edit(kind::FRAME_CHUNKS, |content| content.push(0)), "chunk lists is not a whole number"),
    (17, TILES, |p| p.edit(kind::TREE, |content| content.push(0)), "tree is not a whole number"),
    (18, TILES, |p| p.set(p.atlas(0), 0), "unknown codec 0"),
    (18, TILES, |p| p.set(p.atlas(0), 6), "unknown codec 6"),
    (18, ADAPTIVE, |p| p.set(p.atlas(1), p.u32(p.atlas(0))), "two atlases are bc7"),
    (19, TILES, |p| p.set(p.atlas(0) + offset_of!(AtlasRecord, columns), 0), "impossible slabs or pages"),
    (19, TILES, |p| p.set(p.atlas(0) + offset_of!(AtlasRecord, columns), 257), "impossible slabs or pages"),
    (19, TILES, |p| p.set(p.atlas(0) + offset_of!(AtlasRecord, rows), 0), "impossible slabs or pages"),
    (19, TILES, |p| p.set(p.atlas(0) + offset_of!(AtlasRecord, rows), 257), "impossible slabs or pages"),
    (19, TILES, |p| p.set(p.atlas(0) + offset_of!(AtlasRecord, page_slabs), 0), "impossible slabs or pages"),
    (19, TILES, |p| p.set(p.atlas(0) + offset_of!(AtlasRecord, page_slabs), 257), "impossible slabs or pages"),
    (20, TILES, |p| p.set(p.atlas(0) + offset_of!(AtlasRecord, bricks), 9), "more bricks than its slabs"),
    (21, TILES, |p| p.add(p.atlas(0) + offset_of!(AtlasRecord, slabs), 1), "does not fit its texels"),
    (21, TILES, |p| p.add(p.atlas(0) + offset_of!(AtlasRecord, rows), 1), "does not fit its texels"),
    (21, TILES, |p| p.set(p.entry(kind::TEXELS) + offset_of!(Section, codec), 3), "has not one texels section"),
    (21, TILES, |p| p.rebuild(|parts| repeat(parts, kind::TEXELS)), "has not one texels section"),
    (21, TILES, |p| p.rebuild(|parts| parts.push(Part::new(kind::TEXELS, vec![0]))), "texels without an atlas"),
    (22, TILES, |p| p.add(p.tree(header::WORDS), 1), "the tree is not as long as it says"),
    (22, TILES, |p| p.edit(kind::TREE, |content| content.truncate(31 * 4)), "the tree is not as long as it says"),
    (23, TILES, |p| p.set(p.tree(header::GRID_AT), 31), "the tree's grids lie outside it"),
    (23, TILES, |p| p.set(p.tree(header::NODE_AT), 31), "the tree's L2 nodes lie outside it"),
    (23, TILES, |p| p.set(p.tree(header::RECORD_AT), 31), "the tree's L3 records lie outside it"),
    (23, TILES, |p| p.set(p.tree(header::MASK_AT), 31), "the tree's masks lie outside it"),
    (23, TILES, |p| p.set(p.tree(header::CONSTANT_AT), 31), "the tree's constants lie outside it"),
    (23, TILES, |p| p.set(p.tree(header::GRIDS), u32::MAX), "the tree's grids lie outside it"),
    (23, TILES, |p| p.set(p.tree(header::NODES), u32::MAX), "the tree's L2 nodes lie outside it"),
    (23, TILES, |p| p.set(p.tree(header::RECORDS), u32::MAX), "the tree's L3 records lie outside it"),
    (23, TILES, |p| p.set(p.tree(header::MASKS), u32::MAX), "the tree's masks lie outside it"),
    (23, TILES, |p| p.add(p.tree(header::CONSTANTS), 1), "the tree's constants lie outside it"),
    (24, TILES, |p| p.set(p.tree(header::GRIDS), 2), "disagree about the number of grids"),
    (24, TILES, no_grids, "disagree about the number of grids, or there is none"),
    (25, TILES, |p| p.add(p.tree(header::atlas(Codec::F32)), 1), "disagree about f32"),
    (25, TILES, |p| p.add(p.tree(header::atlas(Codec::Bc7)), 1), "disagree about bc7"),
    (26, TILES, |p| set_bits(p, texel_record(p), 7, 6), "unknown codec"),
    (26, TILES, |p| set_bits(p, texel_record(p), 7, Codec::F16 as u32), "its codec has no atlas"),
    (26, TILES, |p| set_bits(p, texel_record(p), !31, 8 << 5), "brick 8 of 8"),
    (27, TILES, |p| set_bits(p, texel_record(p), 3 << 3, 0), "packing axis 0"),
    (27, TWO_GRIDS, |p| set_bits(p, texel_record(p), 3 << 3, 3 << 3), "packing axis 3"),
    (28, LEVEL_SET, |p| set_bits(p, texel_record(p) + 4, L3Record::NO_MASK, p.u32(p.tree(header::MASKS))), "L3 record 0: mask"),
    (28, LEVEL_SET, last_mask_by_sign, "L3 record 0: mask"),
    (28, LEVEL_SET, |p| p.set(texel_record(p) + 4, L3Record::NO_MASK), "an inactive rule without a mask"),
    (29, TILES, |p| set_bits(p, texel_record(p) + 8, 0xffff << 16, 0x7e00 << 16), "extent NaN"),
    (29, TWO_GRIDS, |p| set_bits(p, texel_record(p) + 8, 0xffff << 16, 0x7c00 << 16), "extent inf"),
    (29, TWO_GRIDS, |p| set_bits(p, texel_record(p) + 8, 0xffff << 16, 0xbc00 << 16), "extent -1"),
    (30, TILES, |p| p.add(p.area(header::NODE_AT, 130), 1), "L2 node 0 has wrong ranks"),
    (31, TILES, |p| p.set(p.area(header::NODE_AT, 192), p.u32(p.tree(header::RECORDS))), "children outside the L3 records"),
];

/// Grids, frames, roots and L1 nodes.
#[rustfmt::skip] // One case a line.
const GRIDS: &[Case] = &[
    (32, TILES, |p| p.add(p.grid(0) + offset_of!(GridRecord, name_bytes), 1), "names lie outside their table"),
    (32, TILES, |p| p.set(p.grid(0) + offset_of!(GridRecord, first_frame), u32::MAX), "frames lie outside their table"),
    (32, TILES, |p| p.add(p.frame(0) + offset_of!(FrameRecord, chunks), 1), "chunk lists lie outside their table"),
    (33, TWO_GRIDS, |p| p.add(p.grid(0) + offset_of!(GridRecord, name_bytes), 1), "names overlap"),
    (33, TWO_GRIDS, |p| p.add(p.grid(0) + offset_of!(GridRecord, frames), 1), "frames overlap"),
    (33, TWO_GRIDS, |p| p.add(p.frame(1) + offset_of!(FrameRecord, first_chunk), -1), "chunk lists overlap"),
    (34, TWO_GRIDS, |p| p.add(p.frame(1) + offset_of!(FrameRecord, number), -1), "not ordered by grid and number"),
    (34, TWO_GRIDS, |p| p.add(p.frame(0) + offset_of!(FrameRecord, number), 9), "not ordered by grid and number"),
    (34, TWO_GRIDS, |p| p.add(p.frame(0) + offset_of!(FrameRecord, grid), 1), "not ordered by grid and number"),
    (35, TWO_GRIDS, |p| p.add(p.frame(5) + offset_of!(FrameRecord, grid), 1), "disagree about whose a frame is"),
    (35, TWO_GRIDS, |p| p.add(p.grid(1) + offset_of!(GridRecord, frames), -1), "disagree about whose a frame is"),
    (36, TILES, |p| p.set(p.section(kind::NAMES).start, 0xffu8), "is not UTF-8"),
    (36, TILES, |p| p.set(p.grid(0) + offset_of!(GridRecord, active_min), f32::NAN), "range of active values"),
    (36, TILES, |p| p.set(p.grid(0) + offset_of!(GridRecord, active_max), f32::INFINITY), "range of active values"),
    (36, TILES, |p| p.set(p.grid(0) + offset_of!(GridRecord, active_max), -1.0f32), "range of active values"),
    (37, TILES, |p| p.add(p.tree_grid(0, grid::ORIGIN + 1), 1), "impossible box"),
    (37, TILES, |p| p.add(p.tree_grid(0, grid::ORIGIN + 1), 128), "impossible box"),
    (37, TILES, |p| p.set(p.tree_grid(0, grid::ORIGIN), i32::MAX - 4095), "impossible box"),
    (37, TILES, |p| p.set(p.tree_grid(0, grid::ROOTS), 0), "impossible box"),
    (37, LEVEL_SET, |p| p.set(p.tree_grid(0, grid::CELLS), 0), "impossible box"),
    (37, LEVEL_SET, |p| p.set(p.tree_grid(0, grid::CELLS), 33), "impossible box"),
    (37, LEVEL_SET, |p| p.set(p.tree_grid(0, grid::ROOTS), 2), "impossible box"),
    (37, LEVEL_SET, endless_box, "impossible box"),
    (38, TILES, |p| p.set(p.tree_grid(0, grid::LO), f32::NAN), "impossible lo or span"),
    (38, TILES, |p| p.set(p.tree_grid(0, grid::SPAN), f32::INFINITY), "impossible lo or span"),
    (38, TILES, |p| p.set(p.tree_grid(0, grid::SPAN), 0), "impossible lo or span"),
    (38, TILES, |p| p.set(p.tree_grid(0, grid::SPAN), -1.0f32), "impossible lo or span"),
    (39, TILES, |p| p.add(p.tree_grid(0, grid::FRAMES), 1), "disagree about the frames of grid"),
    (39, TILES, |p| p.set(p.tree_grid(0, grid::ROOT_AT), 31), "roots outside the tree"),
    (39, TILES, |p| p.set(p.tree_grid(0, grid::ROOT_AT), p.u32(p.tree(header::WORDS))), "roots outside the tree"),
    (39, TILES, |p| p.set(p.tree_grid(0, grid::ROOT_AT), u32::MAX), "roots outside the tree"),
    (39, TILES, most_roots, "roots outside the tree"),
    (40, TWO_GRIDS, |p| p.set(p.tree_grid(1, grid::ROOT_AT), p.u32(p.tree_grid(0, grid::ROOT_AT))), "roots overlap"),
    (41, TILES, |p| p.set(p.section(kind::FRAME_CHUNKS).start, 1), "lists chunks that are not texels, or out of order"),
    (41, TILES, |p| p.set(p.section(kind::FRAME_CHUNKS).start, u32::MAX), "lists chunks that are not texels"),
    (41, SLABS, |p| p.add(p.section(kind::FRAME_CHUNKS).start, 1), "or out of order"),
    (41, SLABS, |p| p.add(p.section(kind::FRAME_CHUNKS).start, 2), "or out of order"),
    (42, TILES, |p| p.set(p.frame(0) + offset_of!(FrameRecord, transform) + 40, f64::NAN), "no valid transform"),
    (43, TILES, |p| p.set(p.root(0, 0), CONSTANT | p.u32(p.tree(header::CONSTANTS))), "a root that is no constant"),
    (43, LEVEL_SET, constant_root_of_one_cell, "a root that is no constant"),
    (44, TILES, |p| p.set(p.root(0, 0), 31), "L1 node at word 31: it overlaps"),
    (44, TILES, |p| p.set(p.root(0, 0), p.u32(root_node(p)) + 1), "overlaps what is before it"),
    (44, TILES, |p| p.set(p.root(0, 0), CONSTANT - 1), "lies outside the tree"),
    (44, LEVEL_SET, children_behind_the_tree, "its children lie outside the tree"),
    (45, TILES, |p| p.add(l1_node(p) + 4 * 1024, 1), "wrong ranks"),
    (45, LEVEL_SET, |p| p.add(l1_node(p), 2), "children outside its cells"),
    (46, LEVEL_SET, |p| p.set(l1_node(p) + 8, p.u32(p.tree(header::NODES))), "a child is Node(1)"),
    (46, LEVEL_SET, |p| p.set(l1_node(p) + 8, CONSTANT), "a child is Constant"),
    (47, LEVEL_SET, |p| p.set(p.frame(0) + offset_of!(FrameRecord, chunks), 0), "does not list the chunk of a brick"),
];

/// A link's bit that says that it is a constant.
const CONSTANT: u32 = 1 << 31;

/// The chunk table has the tree's chunks, and no section has.
fn drop_chunks_of_tree(p: &mut Forgery) {
    let entry = p.entry(kind::TREE);
    p.set(entry + CHUNKS, 0);
    p.set(entry + STORED, 0u64);
    p.set(entry + RAW, 0u64);
}

fn move_tree(p: &mut Forgery, to: fn(u64) -> u64) {
    for at in [
        p.entry(kind::TREE) + offset_of!(Section, offset),
        p.last_chunk(kind::TREE) + offset_of!(Chunk, offset),
    ] {
        p.set(at, to(p.u64(at)));
    }
}

/// The header's digest is right, a section's is not.
fn wrong_section_digest(p: &mut Forgery) {
    p.reseal_now();
    p.flip(p.entry(kind::TREE) + offset_of!(Section, digest));
    let tables = p.last_chunk(kind::TREE) + size_of::<Chunk>();
    p.set(offset_of!(Header, digest), [0u8; 32]);
    p.set(offset_of!(Header, digest), *blake3::hash(&p.bytes[..tables]).as_bytes());
}

fn more_stored_than_raw(p: &mut Forgery) {
    let (section, chunk) = (p.entry(kind::NAMES), p.last_chunk(kind::NAMES));
    p.set(section + ENCODING, encoding::ZSTD);
    p.add(section + RAW, -1);
    p.add(chunk + offset_of!(Chunk, raw_bytes), -1);
}

/// 272 MiB in a few KiB.
fn make_endless(part: &mut Part) {
    part.content = vec![0; 16 << 20];
    (part.chunk_bytes, part.times, part.encoding) = (16 << 20, 17, encoding::ZSTD);
}

fn make_texels_endless(parts: &mut [Part]) {
    make_endless(part(parts, kind::TEXELS));
    let atlas = AtlasRecord { codec: 5, bricks: 8, columns: 64, rows: 128, slabs: 17, page_slabs: 1 };
    part(parts, kind::ATLASES).content = bytemuck::bytes_of(&atlas).to_vec();
    let words = bytemuck::cast_slice(&[64u32, 128, 1]);
    part(parts, kind::TREE).content[4 * header::atlas(Codec::F32)..][..12].copy_from_slice(words);
    part(parts, kind::FRAME_CHUNKS).content = (0..17u32).flat_map(u32::to_le_bytes).collect();
    part(parts, kind::FRAMES).content[offset_of!(FrameRecord, chunks)] = 17;
}

fn repeat(parts: &mut Vec<Part>, kind: u32) {
    let again = part(parts, kind).clone();
    parts.push(again);
}

fn damage_unsealed(p: &mut Forgery, kind: u32) {
    p.reseal_now();
    p.flip(p.section(kind).start);
}

/// One zstd frame of so many bytes.
fn zstd(raw: usize) -> Vec<u8> {
    zstd::bulk::compress(&vec![7; raw], 1).unwrap()
}

/// The provenance is these bytes and says that they are `raw` ones packed.
fn claim_zstd(p: &mut Forgery, stored: Vec<u8>, raw: u32) {
    p.edit(kind::PROVENANCE, |content| *content = stored);
    let (section, chunk) = (p.entry(kind::PROVENANCE), p.last_chunk(kind::PROVENANCE));
    p.set(section + ENCODING, encoding::ZSTD);
    p.set(section + RAW, u64::from(raw));
    p.set(chunk + offset_of!(Chunk, raw_bytes), raw);
}

fn no_grids(p: &mut Forgery) {
    p.edit(kind::GRIDS, Vec::clear);
    p.edit(kind::FRAMES, Vec::clear);
    p.set(p.tree(header::GRIDS), 0);
}

/// The first record with texels.
fn texel_record(p: &Forgery) -> usize {
    p.records(|codec| codec != Codec::Constant)[0]
}

fn set_bits(p: &mut Forgery, at: usize, mask: u32, bits: u32) {
    p.set(at, p.u32(at) & !mask | bits);
}

/// Rule 2 needs the mask behind the record's too.
fn last_mask_by_sign(p: &mut Forgery) {
    let last = p.u32(p.tree(header::MASKS)) - 1;
    p.set(texel_record(p) + 4, 2 << 30 | last);
}

fn endless_box(p: &mut Forgery) {
    (0..6).for_each(|word| p.set(p.tree_grid(0, grid::CELLS + word), u32::MAX));
}

/// As many L1 nodes as fit between the ends of an i32.
fn most_roots(p: &mut Forgery) {
    for axis in 0..3 {
        p.set(p.tree_grid(0, grid::ORIGIN + axis), i32::MIN);
        p.set(p.tree_grid(0, grid::ROOTS + axis), 1 << 20);
    }
}

/// The first root that links to an L1 node.
fn root_node(p: &Forgery) -> usize {
    (0..).map(|root| p.root(0, root)).find(|at| (1..CONSTANT).contains(&p.u32(*at))).unwrap()
}

/// The first L1 node.
fn l1_node(p: &Forgery) -> usize {
    p.tree(p.u32(root_node(p)) as usize)
}

fn constant_root_of_one_cell(p: &mut Forgery) {
    // Any word does as a constant's value.
    p.set(p.tree(header::CONSTANT_AT), 32);
    p.set(p.tree(header::CONSTANTS), 1);
    p.set(p.root(0, 0), CONSTANT);
}

/// An L1 node whose mask and ranks are the last two words.
fn children_behind_the_tree(p: &mut Forgery) {
    let words = p.u32(p.tree(header::WORDS));
    p.set(p.root(0, 0), words - 2);
    p.set(p.tree(words as usize - 2), 1);
    p.set(p.tree(words as usize - 1), 0);
}

#[test]
fn each_rule_is_checked() {
    for name in [LEVEL_SET, TWO_GRIDS, TILES, ADAPTIVE, SLABS] {
        assert!(read(pack(name).finish()).is_ok(), "{name} is refused undamaged");
    }
    let mut rules = BTreeSet::new();
    for &(rule, name, forge, why) in [FILE, TABLES, GRIDS].into_iter().flatten() {
        let mut forgery = pack(name);
        forge(&mut forgery);
        let error = read(forgery.finish()).expect_err(why);
        assert!(error.to_string().contains(why), "rule {rule} of {name}, {why:?}: {error}");
        let is_corrupt = matches!(error, PackError::Corrupt(_));
        assert_eq!(is_corrupt, ![1, 2, 3, 5, 8, 15].contains(&rule), "rule {rule}, {why:?}: {error:?}");
        rules.insert(rule);
    }
    let page = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/format.md")).unwrap();
    let (_, chapter) = page.split_once("\n## What a reader checks\n").unwrap();
    let numbers = chapter.lines().filter_map(|line| line.split_once(". ")?.0.parse().ok());
    assert_eq!(rules, numbers.collect(), "the page's rules and those that are tested");
}

/// Fields that the page calls reserved, and what it says that a reader need not check.
#[test]
fn what_is_not_checked_changes_nothing() {
    let ignored: &[(&str, Change)] = &[
        (TILES, |p| p.set(offset_of!(Header, minor), 9u16)),
        (TILES, |p| p.set(offset_of!(Header, reserved), 1)),
        (TILES, |p| p.set(p.entry(kind::NAMES) + offset_of!(Section, codec), 1)),
        (TILES, |p| p.set(p.frame(0) + offset_of!(FrameRecord, reserved), 1)),
        (TILES, |p| p.set(p.tree(11), 1)),
        (TILES, |p| p.set(p.tree(header::atlas(Codec::F32) + 3), 1)),
        (TILES, |p| p.set(p.tree(header::atlas(Codec::Bc7) + 3), 1)),
        (TILES, |p| p.set(p.tree_grid(0, 14), [1u32, 1])),
        (TILES, |p| set_bits(p, p.records(|codec| codec == Codec::Constant)[0], !7, !7)),
        (TILES, |p| p.set(p.section(kind::NAMES).end, 1u8)),
        (TILES, |p| p.bytes.push(1)),
        (SLABS, |p| p.flip(p.section(kind::TEXELS).end - 1)),
        (TILES, |p| p.set(p.grid(0) + offset_of!(GridRecord, class), 77)),
        (TILES, |p| p.set(p.grid(0) + offset_of!(GridRecord, fps), [f32::NAN; 1])),
        (TILES, |p| p.set(p.grid(0) + offset_of!(GridRecord, codec_error_l2s), [f32::NAN; 6])),
        (TILES, |p| p.set(p.frame(0) + offset_of!(FrameRecord, error_l2), f64::NAN)),
        (TILES, |p| p.set(p.frame(0) + offset_of!(FrameRecord, source), u32::MAX)),
        (TILES, |p| p.set(p.frame(0) + offset_of!(FrameRecord, bbox), [i32::MAX, 0, 0, i32::MIN, 0, 0])),
        (TILES, |p| p.edit(kind::PROVENANCE, |content| *content = b"\xff{".to_vec())),
        (TILES, |p| p.edit(kind::PROVENANCE, Vec::clear)),
        (TILES, |p| p.rebuild(|parts| make_endless(part(parts, kind::PROVENANCE)))),
        (TILES, |p| {
            p.rebuild(|parts| parts.push(Part::new(99, vec![1; 100])));
            p.set(p.entry(99) + ENCODING, 77);
        }),
    ];
    for (i, &(name, forge)) in ignored.iter().enumerate() {
        let mut forgery = pack(name);
        forge(&mut forgery);
        let found = read(forgery.finish()).unwrap_or_else(|e| panic!("{name}, change {i}: {e}"));
        assert!(found == read(pack(name).finish()).unwrap(), "{name}, change {i} shows");
    }
}

/// At many voxels, what [`volpack::pack::FrameReader::locate`] names is at every corner of the cube that it names.
fn check_cubes(pack: &Pack) {
    let reader = pack.frame_tree(0, 0);
    let axis = [i32::MIN, -9003, -4097, -4096, -129, -1, 0, 7, 22, 127, 128, 4095, 4096, 8192, i32::MAX];
    for i in 0..axis.len().pow(3) {
        let at = Coord([i / axis.len().pow(2), i / axis.len(), i].map(|i| axis[i % axis.len()]));
        let (region, dim) = reader.locate(at);
        for corner in 0..8 {
            let offset = [0, 1, 2].map(|a| if corner >> a & 1 == 1 { dim - 1 } else { 0 });
            let found = reader.locate(at.align_down(dim).offset_by(offset)).0;
            let (found, expected) = (format!("{found:?}"), format!("{region:?}"));
            assert_eq!(found, expected, "{at:?} in a cube of {dim}, {offset:?} from its corner");
        }
    }
}

/// A pack of two bricks.
fn two_bricks(places: [Coord; 2]) -> Pack {
    let folder = tempfile::tempdir().unwrap();
    let mut source = vdb_writer::GridFile::new("density", "Tree_float_5_4_3", 0.0f32);
    let values = std::array::from_fn(|i| i as f32);
    source.leaves = places.map(|at| (at, (values, Mask512::ALL))).into();
    let path = folder.path().join("two.vdb");
    vdb_writer::write_grid(&path, &source);
    let settings = Settings { encoding: Format::F32.into(), ..Settings::default() };
    let (pack, report) = build_verified(&[path], settings, folder.path());
    assert!(report.ok, "{:?}", report.failures);
    pack
}

#[test]
fn bricks_are_found_however_far_apart_they_lie() {
    // As far as coordinates go, and a tree of 32 MiB that is nearly all zero.
    let ends = [i32::MIN, i32::MAX - 7].map(|x| Coord::new(x, 0, -8));
    let corners = [0, 200 * 4096].map(|at| Coord([at; 3]));
    for places in [ends, corners] {
        let pack = two_bricks(places);
        let reader = pack.frame(0, 0).unwrap();
        let mut regions = Vec::new();
        reader.for_each_region(|at, dim, _| regions.push((at, dim)));
        assert_eq!(regions, places.map(|at| (at, 8)));
        let bounds = CoordBox { min: places[0], max: places[1].offset_by([7; 3]) };
        assert_eq!((reader.bounds(), pack.region_count()), (bounds, 2));
        for at in places {
            assert!(matches!(reader.locate(at), (Region::Brick(_), 8)));
        }
        check_cubes(&pack);
    }
}

#[test]
fn the_cube_around_a_voxel_is_one_region() {
    for name in [LEVEL_SET, TILES, "f16_zstd"] {
        check_cubes(&Pack::open(&path_of(name)).unwrap());
    }
}

fn volpack(args: &[&str], file: &Path) -> Output {
    Command::new(env!("CARGO_BIN_EXE_volpack")).args(args).arg(file).output().unwrap()
}

#[test]
fn a_pack_is_shown_whatever_its_provenance_says_and_verified_only_if_it_is_known() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("forged.volpack");
    let source = common::fixture("levelset_half.vdb");
    type AnyChange = dyn Fn(&mut Forgery);
    let forged = |change: &AnyChange| {
        let mut forgery = pack(LEVEL_SET);
        change(&mut forgery);
        let bytes = forgery.finish();
        std::fs::write(&file, &bytes).unwrap();
        Pack::from_bytes(bytes).unwrap()
    };
    let with = |from: &'static str, to: &'static str| {
        move |p: &mut Forgery| {
            p.edit(kind::PROVENANCE, |content| {
                let json = String::from_utf8(content.clone()).unwrap();
                assert!(json.contains(from), "{json}");
                *content = json.replacen(from, to, 1).into_bytes();
            });
        }
    };
    let no_source = |p: &mut Forgery| p.set(p.frame(0) + offset_of!(FrameRecord, source), 1);
    let endless = |p: &mut Forgery| p.rebuild(|parts| make_endless(part(parts, kind::PROVENANCE)));
    let no_json = |p: &mut Forgery| p.edit(kind::PROVENANCE, |content| *content = vec![0xff; 9]);

    let pack = forged(&with("\"masks\": \"auto\",", ""));
    assert_eq!(
        Provenance::of(&pack).unwrap(),
        Provenance::of(&forged(&|_| {})).unwrap(),
        "a missing setting has its default"
    );
    assert!(
        volpack(&["verify", "--level", "voxels", "--source", source.to_str().unwrap(), "--"], &file)
            .status
            .success()
    );

    let filter = with("\"masks\"", "\"filter\": 1, \"masks\"");
    let cases: [(&AnyChange, i32, &str); 4] = [
        (
            &filter,
            6,
            "the pack was built by volpack 0.1.0 with the setting `filter`, which this volpack does not know",
        ),
        (&no_json, 3, "the pack's provenance is unreadable"),
        (&endless, 3, "the provenance claims to unpack to 285212672 bytes"),
        (&no_source, 3, "frame 0 names source 1 of the pack's provenance, which lists 1"),
    ];
    for (change, code, why) in cases {
        let pack = forged(change);
        let error = match Provenance::of(&pack) {
            Ok(provenance) => provenance.source(&pack.grids()[0].frames[0].record).map(drop).unwrap_err(),
            Err(error) => error,
        };
        assert!(error.to_string().contains(why) && error.is_unsupported() == (code == 6), "{error}");
        let verified =
            volpack(&["verify", "--level", "voxels", "--source", source.to_str().unwrap(), "--"], &file);
        let says = String::from_utf8(verified.stderr).unwrap();
        assert!(says.contains("forged.volpack: ") && says.contains(why), "{says}");
        assert_eq!(verified.status.code(), Some(code), "{says}");
        let inspected = volpack(&["inspect"], &file);
        let says = String::from_utf8(inspected.stdout).unwrap();
        let is_said = !matches!(error, ProvenanceError::NoSource { .. });
        assert!(
            inspected.status.success() && says.contains("surface") && says.contains(why) == is_said,
            "{says}"
        );
        for args in [&["verify", "--level", "structure"][..], &["inspect", "--json"]] {
            assert!(volpack(args, &file).status.success(), "{args:?}");
        }
        let image = folder.path().join("out.png");
        let rendered =
            volpack(&["render", "--device", "cpu", "--size", "16x16", "-o", image.to_str().unwrap()], &file);
        assert!(rendered.status.success(), "{}", String::from_utf8_lossy(&rendered.stderr));
    }
}
