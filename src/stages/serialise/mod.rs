//! Stage 8: everything into one `.volpack`.

mod tree;

use std::collections::BTreeSet;
use std::io;
use std::path::{Path, PathBuf};

use super::allocate::Allocation;
use super::dedup::{FrameTree, SequenceTree};
use super::quantise::EncodedGrid;
use super::relayout::Placement;
use super::select::GridFacts;
use crate::codec::{Codec, SequenceRange};
use crate::error::{Error, Result};
use crate::pack::layout::{AtlasRecord, CHUNK_BYTES, FrameRecord, GridRecord, encoding, kind};
use crate::pack::tree::L3Record;
use crate::pack::{Atlas, FinishedPack, PackWriter, Provenance, SectionSpec, StoredChunk, compress_chunk};
use crate::volume::{ScratchError, ScratchResult};
use tree::{CellBox, TreeWords};

/// One grid that is written.
#[derive(Clone, Copy)]
pub struct GridParts<'a> {
    /// What is said of it.
    pub facts: &'a GridFacts,
    /// Its nodes and bricks.
    pub tree: &'a SequenceTree,
    /// Their codecs and ranges.
    pub allocation: &'a Allocation,
}

/// A pack that is being written, beside the path where its caller puts it once it is verified: nothing is at that path
/// that was not there before.
pub struct Serialiser {
    path: PathBuf,
    writer: PackWriter,
    zstd_level: Option<i32>,
    words: TreeWords,
    names: String,
    atlases: Vec<AtlasRecord>,
    frames: Vec<FrameRecord>,
    chunk_lists: Vec<u32>,
    provenance: Vec<u8>,
}

/// One slab as it lies in the file.
///
/// # Errors
/// When zstd fails.
pub fn compress_slab(atlas: &Atlas, slab: Vec<u8>, zstd_level: Option<i32>) -> io::Result<StoredChunk> {
    let encoding = encoding::of(kind::TEXELS, atlas.codec as u32, zstd_level.is_some());
    compress_chunk(slab, encoding, zstd_level.unwrap_or(0))
}

impl Serialiser {
    /// Begins a pack: what is not known yet is texels, errors and packing axes.
    ///
    /// # Errors
    /// When the file cannot be written, or something is larger than the format can address.
    pub fn begin(
        path: &Path,
        grids: &[GridParts],
        placement: &Placement,
        provenance: &Provenance,
        zstd_level: Option<i32>,
    ) -> Result<Self> {
        if placement.atlases.iter().any(|a| a.bricks >= L3Record::MAX_SLOTS) {
            return Err(too_large(
                &grids[0].facts.name,
                "more distinct bricks of one codec than the 2^27 that a pack holds: use fewer frames",
            ));
        }
        let boxes = boxes(grids.iter().map(|grid| (grid.facts, grid.tree)))?;
        let sequences: Vec<SequenceRange> = grids.iter().map(|grid| grid.allocation.sequence).collect();
        let trees: Vec<&SequenceTree> = grids.iter().map(|grid| grid.tree).collect();
        let words = TreeWords::new(&trees, &boxes, &sequences, &placement.atlases);

        let names: String = grids.iter().map(|grid| grid.facts.name.as_str()).collect();
        let provenance = provenance.to_json().map_err(Error::io(path))?;
        let atlases: Vec<AtlasRecord> = placement.atlases.iter().map(atlas_record).collect();
        let (frames, chunk_lists) = frame_tables(grids, &frame_slabs(grids, placement));

        let encoding = |kind, codec| encoding::of(kind, codec, zstd_level.is_some());
        let spec = |kind, raw_bytes: usize| SectionSpec {
            kind,
            codec: 0,
            encoding: encoding(kind, 0),
            chunk_bytes: CHUNK_BYTES,
            raw_bytes: raw_bytes as u64,
        };
        let texels = |atlas: &Atlas| SectionSpec {
            kind: kind::TEXELS,
            codec: atlas.codec as u32,
            encoding: encoding(kind::TEXELS, atlas.codec as u32),
            chunk_bytes: atlas.slab_bytes() as u32,
            raw_bytes: atlas.bytes(),
        };
        // Texels come first, so that which chunks a frame needs is known before the sections of unknown length
        // are: those and the tables hold what encoding cost, and the tree the packing axes that it chose.
        let mut specs: Vec<SectionSpec> = placement.atlases.iter().map(texels).collect();
        specs.extend([
            spec(kind::GRIDS, grids.len() * size_of::<GridRecord>()),
            spec(kind::NAMES, names.len()),
            spec(kind::ATLASES, size_of_val(&*atlases)),
            spec(kind::FRAME_CHUNKS, size_of_val(&*chunk_lists)),
            spec(kind::PROVENANCE, provenance.len()),
            spec(kind::FRAMES, size_of_val(&*frames)),
            spec(kind::TREE, words.len() * 4),
        ]);
        let writer = PackWriter::create(path, specs).map_err(Error::io(path))?;
        let path = path.to_owned();
        Ok(Self { path, writer, zstd_level, words, names, atlases, frames, chunk_lists, provenance })
    }

    /// Writes the next slab; those of an atlas in order, one atlas after another.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn slab(&mut self, slab: u32, chunk: &StoredChunk) -> Result<()> {
        let begun = if slab == 0 { self.writer.begin() } else { Ok(()) };
        begun.and_then(|()| self.writer.chunk(chunk)).map_err(Error::io(&self.path))
    }

    /// Writes the tables and the tree: the pack is whole then.
    ///
    /// # Errors
    /// When the file cannot be written, or a scratch file cannot be read back.
    pub fn finish(
        mut self,
        grids: &[GridParts],
        placement: &Placement,
        encoded: &[EncodedGrid],
    ) -> Result<FinishedPack> {
        set_errors(&mut self.frames, grids, encoded)?;
        let records = grid_records(grids, encoded)?;
        let level = self.zstd_level.unwrap_or(0);
        let sections: [&[u8]; 6] = [
            bytemuck::cast_slice(&records),
            self.names.as_bytes(),
            bytemuck::cast_slice(&self.atlases),
            bytemuck::cast_slice(&self.chunk_lists),
            &self.provenance,
            bytemuck::cast_slice(&self.frames),
        ];
        for section in sections {
            self.writer.section(section, level).map_err(Error::io(&self.path))?;
        }
        let words = &self.words;
        self.writer
            .words(level, |sink| {
                words.write(grids, placement, encoded, |words| sink(words).map_err(WriteError::Pack))
            })
            .map_err(|error| match error {
                WriteError::Pack(source) => Error::io(&self.path)(source),
                WriteError::Scratch(error) => error.into(),
            })?;
        self.writer.finish().map_err(Error::io(&self.path))
    }
}

/// What can fail while the tree is written.
enum WriteError {
    Pack(io::Error),
    Scratch(ScratchError),
}

impl From<io::Error> for WriteError {
    fn from(error: io::Error) -> Self {
        Self::Pack(error)
    }
}

impl From<ScratchError> for WriteError {
    fn from(error: ScratchError) -> Self {
        Self::Scratch(error)
    }
}

/// Bytes of the tree and its masks.
///
/// # Errors
/// When a grid is larger than the format can address.
pub fn tree_bytes<'a>(grids: impl Iterator<Item = (&'a GridFacts, &'a SequenceTree)> + Clone) -> Result<u64> {
    let boxes = boxes(grids.clone())?;
    let trees: Vec<&SequenceTree> = grids.map(|(_, tree)| tree).collect();
    let sequences = vec![SequenceRange::default(); trees.len()];
    Ok(TreeWords::new(&trees, &boxes, &sequences, &[]).len() as u64 * 4)
}

fn boxes<'a>(grids: impl Iterator<Item = (&'a GridFacts, &'a SequenceTree)>) -> Result<Vec<CellBox>> {
    grids.map(|(facts, tree)| CellBox::around(&facts.name, tree)).collect()
}

fn too_large(grid: &str, what: &str) -> Error {
    Error::Unsupported(format!("grid {grid:?}: {what}"))
}

fn atlas_record(atlas: &Atlas) -> AtlasRecord {
    let Atlas { codec, bricks, columns, rows, slabs, page_slabs } = *atlas;
    AtlasRecord { codec: codec as u32, bricks, columns, rows, slabs, page_slabs }
}

fn grid_records(grids: &[GridParts], encoded: &[EncodedGrid]) -> ScratchResult<Vec<GridRecord>> {
    let (mut name_offset, mut first_frame) = (0, 0);
    let record = |(g, encoded): (&GridParts, &EncodedGrid)| {
        let active = g.tree.active_range();
        let record = GridRecord {
            name_offset,
            name_bytes: g.facts.name.len() as u32,
            class: g.facts.class as u32,
            first_frame,
            frames: g.facts.frames.len() as u32,
            fps: g.facts.fps,
            active_min: active.map_or(0.0, |r| r.min),
            active_max: active.map_or(0.0, |r| r.max),
            codec_error_l2s: codec_error_l2s(g, encoded)?,
        };
        name_offset += record.name_bytes;
        first_frame += record.frames;
        Ok(record)
    };
    grids.iter().zip(encoded).map(record).collect()
}

/// For each grid and frame the chunks that its bricks lie in, ascending: the texel sections are the first of the
/// file, and a slab is a chunk.
fn frame_slabs(grids: &[GridParts], placement: &Placement) -> Vec<Vec<Vec<u32>>> {
    let mut first_chunk = [0; Codec::WITH_TEXELS.len() + 1];
    let mut slab_bricks = [1; Codec::WITH_TEXELS.len() + 1];
    let mut chunks = 0;
    for atlas in &placement.atlases {
        first_chunk[atlas.codec as usize] = chunks;
        slab_bricks[atlas.codec as usize] = atlas.slab_bricks();
        chunks += atlas.slabs;
    }
    let of_grid = |(g, grid): (usize, &GridParts)| {
        let chunk = |id: u32| {
            let codec = grid.allocation.codec(id);
            let tag = codec as usize;
            (codec != Codec::Constant).then(|| first_chunk[tag] + placement.slot(g, id) / slab_bricks[tag])
        };
        let of_frame = |frame| grid.tree.frame_bricks(frame).filter_map(chunk).collect::<BTreeSet<u32>>();
        grid.tree.frames.iter().map(|frame| of_frame(frame).into_iter().collect()).collect()
    };
    grids.iter().enumerate().map(of_grid).collect()
}

/// What each codec cost a grid: the root of the squared error of its bricks over all frames, by tag.
fn codec_error_l2s(grid: &GridParts, encoded: &EncodedGrid) -> ScratchResult<[f32; Codec::COUNT]> {
    let mut squares = [0.0; Codec::COUNT];
    for frame in &grid.tree.frames {
        for (id, square) in squares_of(grid, encoded, frame)? {
            squares[grid.allocation.codec(id) as usize] += square;
        }
    }
    squares[Codec::Constant as usize] += grid.allocation.empty_squares.iter().sum::<f64>();
    Ok(squares.map(|s: f64| (s.sqrt() as f32).min(f32::MAX)))
}

/// The squared errors of a frame's bricks.
fn squares_of(
    grid: &GridParts,
    encoded: &EncodedGrid,
    frame: &FrameTree,
) -> ScratchResult<impl Iterator<Item = (u32, f64)> + use<>> {
    let ids: Vec<u32> = grid.tree.frame_bricks(frame).collect();
    let error_l2s = encoded.error_l2s(grid.allocation, &ids)?;
    Ok(ids.into_iter().zip(error_l2s.into_iter().map(|error_l2| error_l2.powi(2))))
}

/// Fills in what encoding cost each frame.
fn set_errors(frames: &mut [FrameRecord], grids: &[GridParts], encoded: &[EncodedGrid]) -> ScratchResult<()> {
    let mut frames = frames.iter_mut();
    for (grid, encoded) in grids.iter().zip(encoded) {
        let mut empty = grid.allocation.empty_squares.iter();
        for (tree, frame) in grid.tree.frames.iter().zip(&mut frames) {
            let squares: f64 = squares_of(grid, encoded, tree)?.map(|(_, square)| square).sum();
            let squares = squares + empty.next().copied().unwrap_or(0.0);
            frame.error_l2 = squares.sqrt();
        }
    }
    Ok(())
}

fn frame_tables(grids: &[GridParts], slabs: &[Vec<Vec<u32>>]) -> (Vec<FrameRecord>, Vec<u32>) {
    let mut records = Vec::new();
    let mut lists: Vec<u32> = Vec::new();
    for (g, (grid, slabs)) in grids.iter().zip(slabs).enumerate() {
        for ((input, frame), slabs) in grid.facts.frames.iter().zip(&grid.tree.frames).zip(slabs) {
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
