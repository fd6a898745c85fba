//! Maps a pack and gives its parts, each checked before it is used.

use std::borrow::Cow;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use bytemuck::Pod;
use bytemuck::allocation::zeroed_vec;
use memmap2::Mmap;

use super::atlas::Atlas;
use super::error::corrupt;
use super::layout::{AtlasRecord, Chunk, FrameRecord, GridRecord, Section, encoding, kind};
use super::tables::{chunk_range, read_tables};
use super::{PackError, Provenance, ProvenanceError, check};
use crate::codec::{Codec, SequenceRange};
use crate::volume::Coord;

/// A section that is read whole may not grow more than this in decoding, so that a small file cannot
/// take all memory. Trees shrink 2 to 10 times.
const MAX_EXPANSION: u64 = 512;
/// Sections up to this size are read whatever they were packed to.
const SMALL_SECTION: u64 = 1 << 24;

/// An open pack.
///
/// Opening checks the tables, and that every index in them and in the tree lies inside what it
/// points into. Texel chunks are checked when they are first read.
pub struct Pack {
    path: PathBuf,
    bytes: Bytes,
    /// The grids.
    pub grids: Vec<Grid>,
    /// The tree's words.
    pub tree: Vec<u32>,
    /// The texture pages, one entry a codec that is used.
    pub atlases: Vec<Atlas>,
    pub(super) sections: Vec<Section>,
    chunks: Vec<Chunk>,
    /// The texel section's place for each of `atlases`.
    texel_sections: Vec<usize>,
    checked: Vec<AtomicBool>,
}

enum Bytes {
    Mapped(Mmap),
    Memory(Vec<u8>),
}

impl std::ops::Deref for Bytes {
    type Target = [u8];
    fn deref(&self) -> &[u8] {
        match self {
            Self::Mapped(map) => map,
            Self::Memory(bytes) => bytes,
        }
    }
}

/// One grid of a pack.
#[derive(Clone, Debug)]
pub struct Grid {
    /// Its name.
    pub name: String,
    /// Its entry in the grid table.
    pub record: GridRecord,
    /// Its frames.
    pub frames: Vec<Frame>,
    /// The value outside everything.
    pub background: f32,
    /// The range that brick ranges are fractions of.
    pub sequence: SequenceRange,
    /// The smallest corner of what its L1 nodes cover.
    pub origin: Coord,
    /// 128³ cells of an L1 node, an axis.
    pub cells: [u32; 3],
    /// L1 nodes of a frame, an axis.
    pub roots: [u32; 3],
    /// The word of the tree at which its frames' roots begin.
    pub root_at: usize,
}

/// One frame of a grid.
#[derive(Clone, Debug)]
pub struct Frame {
    /// Its entry in the frame table.
    pub record: FrameRecord,
    /// The texel chunks that it needs, by their place in the chunk table.
    pub chunks: Vec<u32>,
}

impl Grid {
    /// L1 nodes of a frame.
    pub(super) fn root_count(&self) -> usize {
        self.roots.iter().map(|r| *r as usize).product()
    }

    /// 128³ cells of an L1 node.
    pub(super) fn cell_count(&self) -> usize {
        self.cells.iter().map(|c| *c as usize).product()
    }
}

impl Pack {
    /// Opens and checks a pack.
    ///
    /// # Errors
    /// [`PackError`].
    pub fn open(path: &Path) -> Result<Self, PackError> {
        let file = File::open(path)?;
        // SAFETY: the map is only read. Another process that cuts the file short while it is mapped
        // can kill this one with SIGBUS; packs are replaced by renaming, never written in place.
        let map = unsafe { Mmap::map(&file)? };
        Self::parse(path.to_owned(), Bytes::Mapped(map))
    }

    /// The same for a pack that is in memory.
    ///
    /// # Errors
    /// [`PackError`].
    pub fn from_bytes(bytes: Vec<u8>) -> Result<Self, PackError> {
        Self::parse(PathBuf::from("(in memory)"), Bytes::Memory(bytes))
    }

    /// The file that it was opened from, for messages.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Where the pack comes from. It is read when it is asked for, since no voxel depends on it.
    ///
    /// # Errors
    /// [`ProvenanceError`].
    pub fn provenance(&self) -> Result<Provenance, ProvenanceError> {
        Provenance::from_json(&self.records(kind::PROVENANCE)?)
    }

    fn parse(path: PathBuf, bytes: Bytes) -> Result<Self, PackError> {
        let (sections, chunks) = read_tables(&bytes)?;
        let mut pack = Self {
            checked: chunks.iter().map(|_| AtomicBool::new(false)).collect(),
            path,
            bytes,
            grids: Vec::new(),
            tree: Vec::new(),
            atlases: Vec::new(),
            sections,
            chunks,
            texel_sections: Vec::new(),
        };
        pack.tree = pack.records(kind::TREE)?;
        pack.section(kind::PROVENANCE)?;
        for record in pack.records::<AtlasRecord>(kind::ATLASES)? {
            let (atlas, section) = pack.read_atlas(&record)?;
            pack.atlases.push(atlas);
            pack.texel_sections.push(section);
        }
        check::tree(&pack)?;
        pack.grids = pack.read_grids()?;
        check::grids(&pack)?;
        Ok(pack)
    }

    fn read_atlas(&self, record: &AtlasRecord) -> Result<(Atlas, usize), PackError> {
        let Some(codec) = Codec::from_tag(record.codec).filter(|c| *c != Codec::Constant) else {
            return corrupt(format!("an atlas has the unknown codec {}", record.codec));
        };
        if self.atlases.iter().any(|a| a.codec == codec) {
            return corrupt(format!("two atlases are {}", codec.name()));
        }
        let &AtlasRecord { bricks, columns, rows, slabs, page_slabs, .. } = record;
        let section = self.sections.iter().position(|s| s.kind == kind::TEXELS && s.codec == record.codec);
        let Some(section) = section else {
            return corrupt(format!("there are no texels for the {} atlas", codec.name()));
        };
        let atlas = Atlas { codec, bricks, columns, rows, slabs, page_slabs };
        let fits = (1..=256).contains(&columns)
            && (1..=256).contains(&rows)
            && page_slabs > 0
            && page_slabs as usize * codec.layout().slices <= super::MAX_TEXELS as usize
            && u64::from(bricks) <= u64::from(slabs) * u64::from(atlas.slab_bricks());
        let s = &self.sections[section];
        if !fits
            || s.chunk_bytes as usize != atlas.slab_bytes()
            || s.raw_bytes != atlas.bytes()
            || s.chunks != slabs
        {
            return corrupt(format!("the {} atlas does not fit its texels", codec.name()));
        }
        Ok((atlas, section))
    }

    fn read_grids(&self) -> Result<Vec<Grid>, PackError> {
        let records: Vec<GridRecord> = self.records(kind::GRIDS)?;
        let frames: Vec<FrameRecord> = self.records(kind::FRAMES)?;
        let lists: Vec<u32> = self.records(kind::FRAME_CHUNKS)?;
        let names: Vec<u8> = self.records(kind::NAMES)?;
        if records.len() != self.tree[super::tree::header::GRIDS] as usize {
            return corrupt("the grid table and the tree disagree about the number of grids");
        }
        // Names and lists lie end to end. Were the same bytes to serve many, a small file could take all
        // memory.
        let name_bytes: u64 = records.iter().map(|r| u64::from(r.name_bytes)).sum();
        let list_words: u64 = frames.iter().map(|f| u64::from(f.chunks)).sum();
        if name_bytes > names.len() as u64 || list_words > lists.len() as u64 {
            return corrupt("the grids' names or the frames' chunk lists overlap");
        }
        let mut out = Vec::with_capacity(records.len());
        for (g, record) in records.iter().enumerate() {
            let name = slice(&names, record.name_offset, record.name_bytes)
                .and_then(|name| std::str::from_utf8(name).ok())
                .ok_or_else(|| PackError::Corrupt(format!("grid {g} has no valid name")))?;
            let entries = slice(&frames, record.first_frame, record.frames).ok_or_else(|| {
                PackError::Corrupt(format!("grid {name:?} has frames outside the frame table"))
            })?;
            let mut grid = super::check::grid_header(&self.tree, g, *record, name)?;
            for frame in entries {
                let chunks = slice(&lists, frame.first_chunk, frame.chunks).ok_or_else(|| {
                    PackError::Corrupt(format!("grid {name:?} frame {} has no chunk list", frame.number))
                })?;
                if frame.grid as usize != g {
                    return corrupt(format!("grid {name:?} frame {} is not its own", frame.number));
                }
                grid.frames.push(Frame { record: *frame, chunks: chunks.to_vec() });
            }
            out.push(grid);
        }
        Ok(out)
    }

    /// The only section of a kind.
    fn section(&self, kind: u32) -> Result<&Section, PackError> {
        let mut of_kind = self.sections.iter().filter(|s| s.kind == kind);
        match (of_kind.next(), of_kind.next()) {
            (Some(section), None) => Ok(section),
            (None, _) => corrupt(format!("there is no {}", kind::name(kind))),
            _ => corrupt(format!("there is more than one {}", kind::name(kind))),
        }
    }

    /// The entries of a section; bytes behind the last whole one are an error.
    fn records<T: Pod>(&self, kind: u32) -> Result<Vec<T>, PackError> {
        let section = self.section(kind)?;
        if section.raw_bytes > SMALL_SECTION && section.raw_bytes / MAX_EXPANSION > section.stored_bytes {
            return corrupt(format!(
                "the {} claims to unpack to {} bytes",
                kind::name(kind),
                section.raw_bytes
            ));
        }
        if !section.raw_bytes.is_multiple_of(size_of::<T>() as u64) {
            return corrupt(format!("the {} is not a whole number of entries", kind::name(kind)));
        }
        let mut records: Vec<T> = zeroed_vec(section.raw_bytes as usize / size_of::<T>());
        let mut rest: &mut [u8] = bytemuck::cast_slice_mut(&mut records);
        for chunk in chunk_range(section) {
            let chunk = self.chunk(section, chunk)?;
            // The tables were found to agree about lengths.
            let (now, later) = rest.split_at_mut(chunk.len());
            now.copy_from_slice(&chunk);
            rest = later;
        }
        Ok(records)
    }

    /// A chunk's bytes as they were before they were packed.
    pub(super) fn chunk(&self, section: &Section, index: usize) -> Result<Cow<'_, [u8]>, PackError> {
        let chunk = &self.chunks[index];
        let stored = &self.bytes[chunk.offset as usize..][..chunk.stored_bytes as usize];
        if !self.checked[index].load(Ordering::Relaxed) {
            if *blake3::hash(stored).as_bytes() != chunk.digest {
                return Err(PackError::Digest {
                    what: format!("chunk {index} ({})", kind::name(section.kind)),
                });
            }
            self.checked[index].store(true, Ordering::Relaxed);
        }
        if section.encoding == encoding::RAW || chunk.stored_bytes == chunk.raw_bytes {
            return Ok(Cow::Borrowed(stored));
        }
        let raw_bytes = chunk.raw_bytes as usize;
        let raw = zstd::bulk::decompress(stored, raw_bytes)
            .map_err(|e| PackError::Corrupt(format!("chunk {index} does not unpack: {e}")))?;
        if raw.len() != raw_bytes {
            return corrupt(format!("chunk {index} unpacks to {} bytes, not {raw_bytes}", raw.len()));
        }
        Ok(Cow::Owned(match encoding::shuffle_width(section.encoding) {
            1 => raw,
            width => unshuffle(&raw, width),
        }))
    }

    /// The bytes of a slab, as they are uploaded.
    ///
    /// # Errors
    /// When its chunk is damaged.
    ///
    /// # Panics
    /// When there is no such slab.
    pub fn slab(&self, codec: Codec, slab: u32) -> Result<Cow<'_, [u8]>, PackError> {
        let (section, chunk) = self.slab_chunk(codec, slab).expect("the slab exists");
        self.chunk(section, chunk)
    }

    /// The texel section of a codec and the place of a slab's chunk.
    pub(super) fn slab_chunk(&self, codec: Codec, slab: u32) -> Option<(&Section, usize)> {
        let place = self.atlases.iter().position(|a| a.codec == codec)?;
        let section = &self.sections[self.texel_sections[place]];
        (slab < section.chunks).then_some((section, section.first_chunk as usize + slab as usize))
    }

    /// The atlas of a codec.
    pub fn atlas(&self, codec: Codec) -> Option<&Atlas> {
        self.atlases.iter().find(|a| a.codec == codec)
    }

    /// Checks every chunk's digest and decodes each, those that nothing asked for yet too.
    ///
    /// # Errors
    /// The first chunk that is damaged.
    pub fn check_chunks(&self) -> Result<(), PackError> {
        use rayon::prelude::*;
        // Sections of a kind that this reader does not know may be stored in a way that it does not know.
        let known = self.sections.par_iter().filter(|s| s.kind <= kind::PROVENANCE);
        known.try_for_each(|section| {
            chunk_range(section).into_par_iter().try_for_each(|index| self.chunk(section, index).map(drop))
        })
    }

    /// Bytes of the file.
    pub fn file_bytes(&self) -> u64 {
        self.bytes.len() as u64
    }

    /// Those of them that texels take.
    pub fn stored_texel_bytes(&self) -> u64 {
        self.sections.iter().filter(|s| s.kind == kind::TEXELS).map(|s| s.stored_bytes).sum()
    }

    /// How many chunks there are, texels and all.
    pub(super) fn chunk_count(&self) -> usize {
        self.chunks.len()
    }
}

fn slice<T>(all: &[T], first: u32, count: u32) -> Option<&[T]> {
    let first = first as usize;
    all.get(first..first.checked_add(count as usize)?)
}

fn unshuffle(bytes: &[u8], width: usize) -> Vec<u8> {
    let words = bytes.len() / width;
    let mut out = vec![0; bytes.len()];
    for plane in 0..width {
        let source = &bytes[plane * words..(plane + 1) * words];
        for (word, byte) in out.chunks_exact_mut(width).zip(source) {
            word[plane] = *byte;
        }
    }
    out[words * width..].copy_from_slice(&bytes[words * width..]);
    out
}
