//! Maps a pack and gives its parts, each checked before it is used.

use std::borrow::Cow;
use std::fs::File;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use bytemuck::Pod;
use bytemuck::allocation::zeroed_vec;
use memmap2::Mmap;

use super::atlas::{Atlas, MAX_TEXELS};
use super::error::{corrupt, ensure};
use super::layout::{AtlasRecord, Chunk, FrameRecord, GridRecord, Section, encoding, kind};
use super::tables::{chunk_range, fits_memory, read_tables};
use super::tree::header;
use super::{PackError, Provenance, ProvenanceError, check};
use crate::codec::{Codec, SequenceRange};
use crate::vdb::{GridClass, voxel_size};
use crate::volume::{Coord, ROOT_DIM, ValueRange};

/// An open pack.
///
/// Opening checks the tables, and that every index in them and in the tree lies inside what it
/// points into. Texel chunks are checked when they are first read. `docs/format.md`, "What a reader checks",
/// numbers the rules.
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
    /// The words of the tree that link to its frames' L1 nodes.
    pub(super) fn root_words(&self) -> Range<usize> {
        self.root_at..self.root_at + self.root_count() * self.record.frames as usize
    }

    /// Whether each of its L1 nodes covers a cube that OpenVDB has a root entry for, so that one value may stand for it.
    pub(super) fn has_whole_roots(&self) -> bool {
        self.cells == [32; 3] && self.origin.is_aligned(ROOT_DIM)
    }

    /// L1 nodes of a frame.
    pub(super) fn root_count(&self) -> usize {
        self.roots.iter().map(|r| *r as usize).product()
    }

    /// Whether its zero is a surface.
    pub fn is_level_set(&self) -> bool {
        self.record.class == GridClass::LevelSet as u32
    }

    /// What errors are measured against: see [`ValueRange::peak`].
    pub fn peak(&self) -> f64 {
        let active = ValueRange { min: self.record.active_min, max: self.record.active_max };
        let has_active = self.frames.iter().any(|frame| frame.record.active_voxels > 0);
        ValueRange::peak(has_active.then_some(active), self.background)
    }

    /// The smallest side of a voxel in any frame, in world units.
    pub fn voxel_size(&self) -> f64 {
        self.frames.iter().map(|frame| voxel_size(&frame.record.transform)).fold(f64::INFINITY, f64::min)
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
        let section = self.section(kind::PROVENANCE)?;
        ensure(fits_memory(section.raw_bytes, section.stored_bytes), || {
            format!("the provenance claims to unpack to {} bytes", section.raw_bytes) // Rule 14.
        })?;
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
        pack.check_sections()?;
        pack.read_atlases()?;
        pack.tree = pack.records(kind::TREE)?;
        check::tree(&pack)?;
        pack.grids = pack.read_grids()?;
        check::frames(&pack)?;
        check::l1_nodes(&pack)?;
        Ok(pack)
    }

    /// Rules 13 and 14.
    fn check_sections(&self) -> Result<(), PackError> {
        for kind in kind::ALONE {
            self.section(kind)?;
        }
        let read_now = || self.sections.iter().filter(|s| kind::READ_BY_OPEN.contains(&s.kind));
        let sum = |bytes: fn(&Section) -> u64| read_now().map(bytes).fold(0, u64::saturating_add);
        let raw_bytes = sum(|section| section.raw_bytes);
        ensure(fits_memory(raw_bytes, sum(|section| section.stored_bytes)), || {
            format!("the tables and the tree claim to unpack to {raw_bytes} bytes")
        })
    }

    /// Reads the atlases and finds the texels of each: rules 18 to 21.
    fn read_atlases(&mut self) -> Result<(), PackError> {
        for record in self.records::<AtlasRecord>(kind::ATLASES)? {
            let AtlasRecord { codec: tag, bricks, columns, rows, slabs, page_slabs } = record;
            let Some(codec) = Codec::from_tag(tag).filter(|c| *c != Codec::Constant) else {
                return corrupt(format!("an atlas has the unknown codec {tag}"));
            };
            let name = codec.name();
            ensure(self.atlas(codec).is_none(), || format!("two atlases are {name}"))?;
            let atlas = Atlas { codec, bricks, columns, rows, slabs, page_slabs };
            let page_slices = u64::from(page_slabs) * codec.layout().slices as u64;
            let is_slab = (1..=256).contains(&columns) && (1..=256).contains(&rows);
            ensure(is_slab && (1..=MAX_TEXELS.into()).contains(&page_slices), || {
                format!("the {name} atlas has impossible slabs or pages")
            })?;
            ensure(u64::from(bricks) <= u64::from(slabs) * u64::from(atlas.slab_bricks()), || {
                format!("the {name} atlas has more bricks than its slabs")
            })?;
            let of_codec = |section: &Section| section.kind == kind::TEXELS && section.codec == tag;
            let mut sections = self.sections.iter().enumerate().filter(|(_, s)| of_codec(s));
            let (Some((place, section)), None) = (sections.next(), sections.next()) else {
                return corrupt(format!("the {name} atlas has not one texels section"));
            };
            ensure(
                section.chunk_bytes as usize == atlas.slab_bytes() && section.raw_bytes == atlas.bytes(),
                || format!("the {name} atlas does not fit its texels"),
            )?;
            self.atlases.push(atlas);
            self.texel_sections.push(place);
        }
        let texels = self.sections.iter().filter(|s| s.kind == kind::TEXELS).count();
        ensure(texels == self.atlases.len(), || "there are texels without an atlas".to_owned())
    }

    /// Reads grids and frames: rules 24 and 32 to 40.
    fn read_grids(&self) -> Result<Vec<Grid>, PackError> {
        let records: Vec<GridRecord> = self.records(kind::GRIDS)?;
        let frames: Vec<FrameRecord> = self.records(kind::FRAMES)?;
        let lists: Vec<u32> = self.records(kind::FRAME_CHUNKS)?;
        let names: Vec<u8> = self.records(kind::NAMES)?;
        ensure(!records.is_empty() && records.len() == self.tree[header::GRIDS] as usize, || {
            "the grid table and the tree disagree about the number of grids, or there is none".to_owned()
        })?;
        let names_of = records.iter().map(|r| check::range(r.name_offset, r.name_bytes));
        let frames_of = records.iter().map(|r| check::range(r.first_frame, r.frames));
        let lists_of = frames.iter().map(|f| check::range(f.first_chunk, f.chunks));
        check::parts(names_of.clone(), names.len(), "the grids' names")?;
        check::parts(frames_of.clone(), frames.len(), "the grids' frames")?;
        check::parts(lists_of, lists.len(), "the frames' chunk lists")?;
        check::frame_order(&records, &frames)?;

        let mut grids = Vec::with_capacity(records.len());
        for ((record, name), own) in records.iter().zip(names_of).zip(frames_of) {
            let g = grids.len();
            let Ok(name) = std::str::from_utf8(&names[name]) else {
                return corrupt(format!("the name of grid {g} is not UTF-8"));
            };
            let mut grid = check::grid(&self.tree, g, *record, name)?;
            grid.frames.extend(frames[own].iter().map(|record| Frame {
                chunks: lists[check::range(record.first_chunk, record.chunks)].to_vec(),
                record: *record,
            }));
            grids.push(grid);
        }
        let roots = grids.iter().map(Grid::root_words);
        check::parts(roots, self.tree.len(), "the frames' roots")?;
        Ok(grids)
    }

    /// The only section of a kind: rule 13.
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
        // Rule 17.
        ensure(section.raw_bytes.is_multiple_of(size_of::<T>() as u64), || {
            format!("the {} is not a whole number of entries", kind::name(kind))
        })?;
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
                // Rule 15.
                return Err(PackError::Digest {
                    what: format!("chunk {index} ({})", kind::name(section.kind)),
                });
            }
            self.checked[index].store(true, Ordering::Relaxed);
        }
        if section.encoding == encoding::RAW || chunk.stored_bytes == chunk.raw_bytes {
            return Ok(Cow::Borrowed(stored));
        }
        // Rule 16. zstd's own decoder takes several frames too, which other readers do not.
        let frame = zstd::zstd_safe::find_frame_compressed_size(stored);
        ensure(frame.is_ok_and(|bytes| bytes == stored.len()), || {
            format!("chunk {index} does not unpack: it is not one zstd frame")
        })?;
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

    /// The texels section that a chunk belongs to.
    pub(super) fn texels_of(&self, chunk: u32) -> Option<&Section> {
        let sections = self.texel_sections.iter().map(|&place| &self.sections[place]);
        sections.into_iter().find(|section| chunk_range(section).contains(&(chunk as usize)))
    }

    /// Bytes of a chunk: decoded, and in the file.
    pub(super) fn chunk_bytes(&self, chunk: u32) -> (u64, u64) {
        let chunk = &self.chunks[chunk as usize];
        (chunk.raw_bytes.into(), chunk.stored_bytes.into())
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
        let known = self.sections.par_iter().filter(|s| kind::is_known(s.kind));
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
