//! Stage 8: everything into one `.volpack`.

mod tree;

use std::collections::BTreeSet;
use std::io;
use std::path::Path;

use super::allocate::Allocation;
use super::dedup::{FrameTree, SequenceTree};
use super::quantise::{GridBricks, Outcome, QuantiseError, quantise};
use super::relayout::{self, Layout};
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
    /// Whether its source's values are integers.
    pub is_integer: bool,
    /// Frames per second; 0 when not stated.
    pub fps: f32,
    /// Its frames, in the order of `tree`.
    pub frames: Vec<FrameInput>,
    /// Its nodes and bricks.
    pub tree: SequenceTree,
    /// Its codecs and ranges; `None` while they are being chosen.
    pub allocation: Option<Allocation>,
}

impl GridInput {
    fn allocation(&self) -> &Allocation {
        self.allocation.as_ref().expect("grids are allocated before they are written")
    }
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

/// Writes the pack beside `path`, where its caller puts it once it is verified.
///
/// # Errors
/// [`SerialiseError`]. Nothing is left at `path` that was not there before.
pub fn serialise(
    path: &Path,
    grids: &mut [GridInput],
    provenance: &Provenance,
    zstd_level: Option<i32>,
    mut progress: impl FnMut(u64),
) -> Result<FinishedPack, SerialiseError> {
    let layout = relayout::place(&grids.iter().map(GridInput::allocation).collect::<Vec<_>>());
    if layout.atlases.iter().any(|a| a.bricks >= L3Record::MAX_SLOTS) {
        return Err(too_large(
            &grids[0].name,
            "more distinct bricks of one codec than the 2^27 that a pack holds: use fewer frames".to_owned(),
        ));
    }
    let boxes = grids.iter().map(CellBox::around).collect::<Result<Vec<_>, _>>()?;
    let words = TreeWords::new(grids, &boxes, &layout.atlases);

    let level = zstd_level.unwrap_or(0);
    let names: String = grids.iter().map(|g| g.name.as_str()).collect();
    let frame_count: usize = grids.iter().map(|g| g.frames.len()).sum();
    let provenance = provenance.to_json()?;
    let atlases: Vec<AtlasRecord> = layout.atlases.iter().map(atlas_record).collect();

    let encoding = |kind, codec| encoding::of(kind, codec, zstd_level.is_some());
    let spec = |kind, raw_bytes: usize| SectionSpec {
        kind,
        codec: 0,
        encoding: encoding(kind, 0),
        chunk_bytes: CHUNK_BYTES,
        raw_bytes: raw_bytes as u64,
    };
    // Texels come first, so that which chunks a frame needs is known before the sections of unknown length
    // are: those and the tables hold what encoding cost, and the tree the packing axes that it chose.
    let mut specs: Vec<SectionSpec> = layout
        .atlases
        .iter()
        .map(|atlas| SectionSpec {
            kind: kind::TEXELS,
            codec: atlas.codec as u32,
            encoding: encoding(kind::TEXELS, atlas.codec as u32),
            chunk_bytes: atlas.slab_bytes() as u32,
            raw_bytes: atlas.bytes(),
        })
        .collect();
    let (mut frames, lists) = frame_tables(grids, &frame_slabs(grids, &layout));
    specs.extend([
        spec(kind::GRIDS, grids.len() * size_of::<GridRecord>()),
        spec(kind::NAMES, names.len()),
        spec(kind::ATLASES, size_of_val(&*atlases)),
        spec(kind::FRAME_CHUNKS, size_of_val(&*lists)),
        spec(kind::PROVENANCE, provenance.len()),
        spec(kind::FRAMES, frame_count * size_of::<FrameRecord>()),
        spec(kind::TREE, words.len() * 4),
    ]);

    let mut writer = PackWriter::create(path, specs)?;
    let mut outcomes: Vec<Outcome> = grids.iter().map(GridInput::allocation).map(Outcome::before).collect();
    let mut sources: Vec<GridBricks> = grids
        .iter_mut()
        .filter_map(|g| Some(GridBricks { tree: &mut g.tree, allocation: g.allocation.as_mut()? }))
        .collect();
    let compressed =
        |atlas: &Atlas, slab| compress_chunk(slab, encoding(kind::TEXELS, atlas.codec as u32), level);
    quantise(&layout, &mut sources, &mut outcomes, compressed, |atlas, slab, chunk| {
        if slab == 0 {
            writer.begin()?;
        }
        progress(atlas.slab_bricks().into());
        writer.chunk(&chunk)
    })?;
    set_errors(&mut frames, grids)?;
    writer.section(bytemuck::cast_slice(&grid_records(grids)?), level)?;
    writer.section(names.as_bytes(), level)?;
    writer.section(bytemuck::cast_slice(&atlases), level)?;
    writer.section(bytemuck::cast_slice(&lists), level)?;
    writer.section(&provenance, level)?;
    writer.section(bytemuck::cast_slice(&frames), level)?;
    writer.words(level, |sink| words.write(grids, &layout, &outcomes, sink))?;
    Ok(writer.finish()?)
}

/// Bytes of the tree and its masks.
///
/// # Errors
/// [`SerialiseError::TooLarge`].
pub fn tree_bytes(grids: &[GridInput]) -> Result<u64, SerialiseError> {
    let boxes = grids.iter().map(CellBox::around).collect::<Result<Vec<_>, _>>()?;
    Ok(TreeWords::new(grids, &boxes, &[]).len() as u64 * 4)
}

/// Bytes of tree, masks and texture pages: what a GPU holds.
///
/// # Errors
/// [`SerialiseError::TooLarge`].
pub fn gpu_bytes(grids: &[GridInput]) -> Result<u64, SerialiseError> {
    let layout = relayout::place(&grids.iter().map(GridInput::allocation).collect::<Vec<_>>());
    Ok(tree_bytes(grids)? + layout.atlases.iter().map(Atlas::bytes).sum::<u64>())
}

fn too_large(grid: &str, what: String) -> SerialiseError {
    SerialiseError::TooLarge { grid: grid.to_owned(), what }
}

fn atlas_record(atlas: &Atlas) -> AtlasRecord {
    let Atlas { codec, bricks, columns, rows, slabs, page_slabs } = *atlas;
    AtlasRecord { codec: codec as u32, bricks, columns, rows, slabs, page_slabs }
}

fn grid_records(grids: &[GridInput]) -> io::Result<Vec<GridRecord>> {
    let (mut name_offset, mut first_frame) = (0, 0);
    let record = |g: &GridInput| {
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
            codec_error_l2s: codec_error_l2s(g)?,
        };
        name_offset += record.name_bytes;
        first_frame += record.frames;
        Ok(record)
    };
    grids.iter().map(record).collect()
}

/// For each grid and frame the chunks that its bricks lie in, ascending: the texel sections are the first of the
/// file, and a slab is a chunk.
fn frame_slabs(grids: &[GridInput], layout: &Layout) -> Vec<Vec<Vec<u32>>> {
    let mut first_chunk = [0; Codec::WITH_TEXELS.len() + 1];
    let mut slab_bricks = [1; Codec::WITH_TEXELS.len() + 1];
    let mut chunks = 0;
    for atlas in &layout.atlases {
        first_chunk[atlas.codec as usize] = chunks;
        slab_bricks[atlas.codec as usize] = atlas.slab_bricks();
        chunks += atlas.slabs;
    }
    let of_grid = |(g, grid): (usize, &GridInput)| {
        let chunk = |id: u32| {
            let codec = grid.allocation().codec(id);
            let tag = codec as usize;
            (codec != Codec::Constant).then(|| first_chunk[tag] + layout.slot(g, id) / slab_bricks[tag])
        };
        let of_frame = |frame| grid.tree.frame_bricks(frame).filter_map(chunk).collect::<BTreeSet<u32>>();
        grid.tree.frames.iter().map(|frame| of_frame(frame).into_iter().collect()).collect()
    };
    grids.iter().enumerate().map(of_grid).collect()
}

/// What each codec cost a grid: the root of the squared error of its bricks over all frames, by tag.
fn codec_error_l2s(grid: &GridInput) -> io::Result<[f32; Codec::WITH_TEXELS.len() + 1]> {
    let mut squares = [0.0; Codec::WITH_TEXELS.len() + 1];
    for frame in &grid.tree.frames {
        for (id, square) in squares_of(grid, frame)? {
            squares[grid.allocation().codec(id) as usize] += square;
        }
    }
    squares[Codec::Constant as usize] += grid.allocation().empty_squares.iter().sum::<f64>();
    Ok(squares.map(|s: f64| (s.sqrt() as f32).min(f32::MAX)))
}

/// The squared errors of a frame's bricks.
fn squares_of(grid: &GridInput, frame: &FrameTree) -> io::Result<impl Iterator<Item = (u32, f64)>> {
    let ids: Vec<u32> = grid.tree.frame_bricks(frame).collect();
    let error_l2s = grid.allocation().error_l2s.read(&ids)?;
    Ok(ids.into_iter().zip(error_l2s.into_iter().map(|error_l2| error_l2.powi(2))))
}

/// Fills in what encoding cost each frame.
fn set_errors(frames: &mut [FrameRecord], grids: &[GridInput]) -> io::Result<()> {
    let mut frames = frames.iter_mut();
    for grid in grids {
        let mut empty = grid.allocation().empty_squares.iter();
        for (tree, frame) in grid.tree.frames.iter().zip(&mut frames) {
            let squares: f64 = squares_of(grid, tree)?.map(|(_, square)| square).sum();
            let squares = squares + empty.next().copied().unwrap_or(0.0);
            frame.error_l2 = squares.sqrt();
        }
    }
    Ok(())
}

fn frame_tables(grids: &[GridInput], slabs: &[Vec<Vec<u32>>]) -> (Vec<FrameRecord>, Vec<u32>) {
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
                reserved: 0,
                error_l2: 0.0,
                leaves: frame.stats.leaves,
                active_voxels: frame.stats.active_voxels,
                transform: input.transform,
            });
            lists.extend(slabs);
        }
    }
    (records, lists)
}
