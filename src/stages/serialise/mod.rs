//! Stage 8: everything into one `.volpack`.

mod tree;

use std::collections::BTreeSet;
use std::io;
use std::path::Path;

use super::allocate::Allocation;
use super::dedup::{CellRef, FrameTree, Payload, SequenceTree};
use super::quantise::{GridBricks, Outcome, QuantiseError, quantise};
use super::relayout;
use crate::codec::Codec;
use crate::pack::layout::{AtlasRecord, CHUNK_BYTES, FrameRecord, GridRecord, encoding, kind};
use crate::pack::tree::L3Record;
use crate::pack::{Atlas, FinishedPack, PackWriter, Provenance, SectionSpec, compress_chunk};
use crate::vdb::GridClass;
use tree::{CellBox, TreeWords};

/// One grid, ready to be written.
pub struct GridInput {
    /// Its name.
    pub name: String,
    /// What kind of field it holds.
    pub class: GridClass,
    /// Frames per second; 0 when not stated.
    pub fps: f32,
    /// Its frames, in the order of `tree`.
    pub frames: Vec<FrameInput>,
    /// Its nodes and bricks.
    pub tree: SequenceTree,
    /// Its codecs and ranges.
    pub allocation: Allocation,
}

/// What the frame table says of a frame beside what its tree says.
#[derive(Clone, Debug)]
pub struct FrameInput {
    /// Its number.
    pub number: i32,
    /// Its source's place in the provenance.
    pub source: u32,
    /// Index space to world space.
    pub transform: [f64; 16],
}

/// The pack cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum SerialiseError {
    /// Writing failed.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// A value does not fit the codec.
    #[error(transparent)]
    Quantise(#[from] QuantiseError),
    /// Something is larger than the format can address.
    #[error("grid {grid:?}: {what}")]
    TooLarge {
        /// The grid.
        grid: String,
        /// What, and what to do.
        what: String,
    },
}

/// Writes the pack beside `path`, where its caller puts it once it is verified. All grids use the codec of the first.
///
/// # Errors
/// [`SerialiseError`]. Nothing is left at `path` that was not there before.
///
/// # Panics
/// When there is no grid.
pub fn serialise(
    path: &Path,
    grids: &mut [GridInput],
    provenance: &Provenance,
    zstd_level: Option<i32>,
    mut progress: impl FnMut(u64),
) -> Result<FinishedPack, SerialiseError> {
    let codec = grids[0].allocation.codec;
    let bricks: u64 = grids.iter().map(|g| u64::from(g.tree.pool.len())).sum();
    if bricks >= L3Record::MAX_SLOTS.into() {
        return Err(too_large(
            &grids[0].name,
            format!("{bricks} distinct bricks, a pack holds 2^27: use fewer frames"),
        ));
    }
    let atlas = relayout::plan(codec, bricks as u32);
    let boxes = grids.iter().map(CellBox::around).collect::<Result<Vec<_>, _>>()?;
    let first_slots: Vec<u32> =
        grids.iter().scan(0, |next, g| Some(std::mem::replace(next, *next + g.tree.pool.len()))).collect();
    let mut words = TreeWords::build(grids, &boxes, &atlas, &first_slots);

    let plain = if zstd_level.is_some() { encoding::ZSTD } else { encoding::RAW };
    let texel_encoding = match (codec, zstd_level) {
        (_, None) => encoding::RAW,
        (Codec::F16, _) => encoding::ZSTD_SHUFFLE_2,
        (Codec::F32, _) => encoding::ZSTD_SHUFFLE_4,
        _ => encoding::ZSTD,
    };
    let level = zstd_level.unwrap_or(0);

    let names: String = grids.iter().map(|g| g.name.as_str()).collect();
    let slabs: Vec<Vec<Vec<u32>>> =
        grids.iter().zip(&first_slots).map(|(g, &s)| frame_slabs(g, &atlas, s)).collect();
    let list_len: usize = slabs.iter().flatten().map(Vec::len).sum();
    let frame_count: usize = grids.iter().map(|g| g.frames.len()).sum();
    let provenance = serde_json::to_vec_pretty(provenance).map_err(io::Error::from)?;

    let spec = |kind, encoding, raw_bytes: usize| SectionSpec {
        kind,
        codec: 0,
        encoding,
        chunk_bytes: CHUNK_BYTES,
        raw_bytes: raw_bytes as u64,
    };
    let mut specs = vec![
        spec(kind::GRIDS, encoding::RAW, grids.len() * size_of::<GridRecord>()),
        spec(kind::NAMES, encoding::RAW, names.len()),
        spec(kind::ATLASES, encoding::RAW, if atlas.bricks > 0 { size_of::<AtlasRecord>() } else { 0 }),
        spec(kind::FRAME_CHUNKS, plain, list_len * 4),
        spec(kind::PROVENANCE, plain, provenance.len()),
    ];
    let chunks_before: u64 = specs.iter().map(|s| s.raw_bytes.div_ceil(s.chunk_bytes.into())).sum();
    if atlas.bricks > 0 {
        specs.push(SectionSpec {
            kind: kind::TEXELS,
            codec: codec as u32,
            encoding: texel_encoding,
            chunk_bytes: atlas.slab_bytes() as u32,
            raw_bytes: atlas.bytes(),
        });
    }
    // Frames and tree come last: they hold what encoding cost, and the packing axes that it chose.
    specs.push(spec(kind::FRAMES, plain, frame_count * size_of::<FrameRecord>()));
    specs.push(spec(kind::TREE, plain, words.words.len() * 4));

    let (mut frames, lists) = frame_tables(grids, &slabs, chunks_before as u32);
    let mut writer = PackWriter::create(path, specs)?;
    writer.section(bytemuck::cast_slice(&grid_records(grids)), level)?;
    writer.section(names.as_bytes(), level)?;
    if atlas.bricks > 0 {
        writer.section(bytemuck::bytes_of(&atlas_record(&atlas)), level)?;
    } else {
        writer.section(&[], level)?;
    }
    writer.section(bytemuck::cast_slice(&lists), level)?;
    writer.section(&provenance, level)?;

    if atlas.bricks > 0 {
        writer.begin()?;
        let mut sources: Vec<GridBricks> = grids
            .iter_mut()
            .zip(&first_slots)
            .map(|(g, &first_slot)| GridBricks { tree: &mut g.tree, allocation: &g.allocation, first_slot })
            .collect();
        let outcomes = quantise(
            &atlas,
            &mut sources,
            |slab| compress_chunk(slab, texel_encoding, level),
            |chunk| {
                progress(atlas.slab_bricks().into());
                writer.chunk(&chunk)
            },
        )?;
        words.set_axes(grids, &outcomes);
        set_errors(&mut frames, grids, &outcomes);
    }
    writer.section(bytemuck::cast_slice(&frames), level)?;
    writer.section(bytemuck::cast_slice(&words.words), level)?;
    Ok(writer.finish()?)
}

fn too_large(grid: &str, what: String) -> SerialiseError {
    SerialiseError::TooLarge { grid: grid.to_owned(), what }
}

fn atlas_record(atlas: &Atlas) -> AtlasRecord {
    let Atlas { codec, bricks, columns, rows, slabs, page_slabs } = *atlas;
    AtlasRecord { codec: codec as u32, bricks, columns, rows, slabs, page_slabs }
}

fn grid_records(grids: &[GridInput]) -> Vec<GridRecord> {
    let (mut name_offset, mut first_frame) = (0, 0);
    grids
        .iter()
        .map(|g| {
            let active = g.tree.active_range();
            let record = GridRecord {
                name_offset,
                name_bytes: g.name.len() as u32,
                class: g.class as u32,
                first_frame,
                frames: g.frames.len() as u32,
                fps: g.fps,
                active_min: active.map_or(0.0, |r| r.min),
                active_max: active.map_or(0.0, |r| r.max),
            };
            name_offset += record.name_bytes;
            first_frame += record.frames;
            record
        })
        .collect()
}

/// The bricks of the pool that a frame uses, shared ones each time.
fn frame_bricks<'a>(tree: &'a SequenceTree, frame: &'a FrameTree) -> impl Iterator<Item = u32> + 'a {
    let nodes = frame.cells.iter().filter_map(|(_, content)| match content {
        CellRef::Node(node) => Some(&tree.nodes.items()[*node as usize]),
        CellRef::Constant(_) => None,
    });
    let records = nodes.flat_map(|node| node.entries(&tree.runs)).map(|&r| &tree.records[r as usize]);
    records.filter_map(|record| match record.payload {
        Payload::Brick(id) => Some(id),
        Payload::Constant(_) => None,
    })
}

/// The slabs that each frame's bricks lie in, ascending.
fn frame_slabs(grid: &GridInput, atlas: &Atlas, first_slot: u32) -> Vec<Vec<u32>> {
    let slabs = |frame| frame_bricks(&grid.tree, frame).map(|id| (first_slot + id) / atlas.slab_bricks());
    let sorted = |frame| slabs(frame).collect::<BTreeSet<u32>>().into_iter().collect();
    grid.tree.frames.iter().map(sorted).collect()
}

/// Fills in what encoding cost each frame.
fn set_errors(frames: &mut [FrameRecord], grids: &[GridInput], outcomes: &[Outcome]) {
    let mut frames = frames.iter_mut();
    for (grid, outcome) in grids.iter().zip(outcomes) {
        for (tree, frame) in grid.tree.frames.iter().zip(&mut frames) {
            let squares: f64 = frame_bricks(&grid.tree, tree).map(|id| outcome.squares[id as usize]).sum();
            frame.error_norm = (squares.sqrt() as f32).min(f32::MAX);
        }
    }
}

fn frame_tables(
    grids: &[GridInput],
    slabs: &[Vec<Vec<u32>>],
    first_chunk: u32,
) -> (Vec<FrameRecord>, Vec<u32>) {
    let mut records = Vec::new();
    let mut lists: Vec<u32> = Vec::new();
    for (g, (grid, slabs)) in grids.iter().zip(slabs).enumerate() {
        for ((input, frame), slabs) in grid.frames.iter().zip(&grid.tree.frames).zip(slabs) {
            records.push(FrameRecord {
                grid: g as u32,
                number: input.number,
                source: input.source,
                first_chunk: lists.len() as u32,
                chunks: slabs.len() as u32,
                bbox: frame.stats.bbox.to_array(),
                error_norm: 0.0,
                leaves: frame.stats.leaves,
                active_voxels: frame.stats.active_voxels,
                transform: input.transform,
            });
            lists.extend(slabs.iter().map(|slab| first_chunk + slab));
        }
    }
    (records, lists)
}
