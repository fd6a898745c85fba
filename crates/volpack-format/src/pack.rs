//! Opens a pack and gives its parts, each checked before it is used.

use std::borrow::Cow;
use std::io::{Read, Seek};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use bytemuck::Pod;
use bytemuck::allocation::zeroed_vec;

use crate::atlas::MAX_TEXELS;
use crate::codec::Codec;
use crate::error::{corrupt, ensure};
use crate::grid::{Frame, Grid};
use crate::layout::{AtlasRecord, Chunk, FrameRecord, GridRecord, Section, encoding, kind};
use crate::pack_bytes::PackBytes;
use crate::tables::{fits_memory, read_tables};
use crate::tree::header;
use crate::{Atlas, PackError, check, zstd};

/// An open pack.
///
/// Opening checks the tables, and that every index in them and in the tree lies inside what it
/// points into. Texel chunks are checked when they are first read. `docs/format.md`, "What a reader checks",
/// numbers the rules.
pub struct Pack {
    path: PathBuf,
    source: PackBytes,
    grids: Vec<Grid>,
    tree: Vec<u32>,
    atlases: Vec<Atlas>,
    sections: Vec<Section>,
    chunks: Vec<Chunk>,
    /// The texel section's place for each of `atlases`.
    texel_sections: Vec<usize>,
    checked: Vec<AtomicBool>,
}

impl Pack {
    /// Opens and checks a pack, which is mapped into memory. Its file must not be written to while it is open; packs are
    /// replaced by renaming.
    ///
    /// # Errors
    /// [`PackError`].
    #[cfg(feature = "mmap")]
    pub fn open(path: &Path) -> Result<Self, PackError> {
        Self::parse(path.to_owned(), PackBytes::map(path)?)
    }

    /// The same for a pack that is in memory.
    ///
    /// # Errors
    /// [`PackError`].
    pub fn from_bytes(bytes: Vec<u8>) -> Result<Self, PackError> {
        Self::parse(PathBuf::from("(in memory)"), PackBytes::Memory(bytes))
    }

    /// The same for a stream, which a pack begins and ends with: a file, or a client of a server that gives parts of one.
    /// Only the tables and the tree are read now, other chunks whenever they are asked for. One is read at a time.
    ///
    /// # Errors
    /// [`PackError`].
    pub fn from_reader(stream: impl Read + Seek + Send + 'static) -> Result<Self, PackError> {
        Self::parse(PathBuf::from("(a stream)"), PackBytes::stream(stream)?)
    }

    /// The grids.
    pub fn grids(&self) -> &[Grid] {
        &self.grids
    }

    /// The tree's words, which a shader binds as they are: see [`crate::tree`].
    pub fn tree(&self) -> &[u32] {
        &self.tree
    }

    /// The texture pages, one entry a codec that is used.
    pub fn atlases(&self) -> &[Atlas] {
        &self.atlases
    }

    /// The sections, those that this reader does not know too, in the order of the file.
    pub fn sections(&self) -> &[Section] {
        &self.sections
    }

    /// The file that it was opened from, for messages.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Where the pack comes from, as the JSON that `docs/format.md` describes, unparsed. It is read when it is asked for,
    /// since no voxel depends on it.
    ///
    /// # Errors
    /// When its bytes are damaged, or would take all memory.
    pub fn provenance_json(&self) -> Result<Vec<u8>, PackError> {
        let section = self.section(kind::PROVENANCE)?;
        ensure(fits_memory(section.raw_bytes, section.stored_bytes), || {
            format!("the provenance claims to unpack to {} bytes", section.raw_bytes) // Rule 14.
        })?;
        self.records(kind::PROVENANCE)
    }

    fn parse(path: PathBuf, source: PackBytes) -> Result<Self, PackError> {
        let (sections, chunks) = read_tables(&source)?;
        let mut pack = Self {
            checked: chunks.iter().map(|_| AtomicBool::new(false)).collect(),
            path,
            source,
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
        check::tree(&pack.tree, &pack.atlases)?;
        pack.grids = pack.read_grids()?;
        check::frames(&pack.grids, |chunk| pack.is_texels(chunk))?;
        check::l1_nodes(&pack.tree, &pack.grids)?;
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
        for chunk in section.chunk_range() {
            let chunk = self.chunk_of(section, chunk)?;
            // The tables were found to agree about lengths.
            let (now, later) = rest.split_at_mut(chunk.len());
            now.copy_from_slice(&chunk);
            rest = later;
        }
        Ok(records)
    }

    /// How many chunks the pack has, of every section.
    pub fn chunk_count(&self) -> usize {
        self.chunks.len()
    }

    /// A chunk's bytes as they were before they were packed, by its place in the chunk table.
    ///
    /// # Errors
    /// When it is damaged, or there is no such chunk.
    pub fn chunk(&self, index: usize) -> Result<Cow<'_, [u8]>, PackError> {
        self.chunk_of(self.section_of(index)?, index)
    }

    /// The section that a chunk belongs to. Sections have the chunks of the table in order, and all of them.
    fn section_of(&self, chunk: usize) -> Result<&Section, PackError> {
        let place = self.sections.partition_point(|section| section.chunk_range().end <= chunk);
        let none = || PackError::Corrupt(format!("there is no chunk {chunk}"));
        self.sections.get(place).ok_or_else(none)
    }

    fn chunk_of(&self, section: &Section, index: usize) -> Result<Cow<'_, [u8]>, PackError> {
        let chunk = &self.chunks[index];
        let stored = self.source.read(chunk.offset, chunk.stored_bytes.into())?;
        // What a stream gives may be something else the next time.
        if !self.source.is_in_memory() || !self.checked[index].load(Ordering::Relaxed) {
            if *blake3::hash(&stored).as_bytes() != chunk.digest {
                // Rule 15.
                return Err(PackError::Digest {
                    what: format!("chunk {index} ({})", kind::name(section.kind)),
                });
            }
            self.checked[index].store(true, Ordering::Relaxed);
        }
        if section.encoding == encoding::RAW || chunk.stored_bytes == chunk.raw_bytes {
            return Ok(stored);
        }
        let raw_bytes = chunk.raw_bytes as usize;
        // Rule 16.
        let raw = zstd::decompress(&stored, raw_bytes)
            .map_err(|what| PackError::Corrupt(format!("chunk {index} does not unpack: {what}")))?;
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
    /// When its chunk is damaged, or there is no such slab.
    pub fn slab(&self, codec: Codec, slab: u32) -> Result<Cow<'_, [u8]>, PackError> {
        match self.slab_chunk(codec, slab) {
            Some(chunk) => self.chunk(chunk),
            None => corrupt(format!("there is no slab {slab} of {}", codec.name())),
        }
    }

    /// Whether there is such a chunk, with texels in it.
    pub(crate) fn is_texels(&self, chunk: u32) -> bool {
        let mut sections = self.texel_sections.iter().map(|&place| &self.sections[place]);
        sections.any(|section| section.chunk_range().contains(&(chunk as usize)))
    }

    /// Bytes of a chunk: decoded, and in the file.
    pub(crate) fn chunk_bytes(&self, chunk: u32) -> (u64, u64) {
        let chunk = &self.chunks[chunk as usize];
        (chunk.raw_bytes.into(), chunk.stored_bytes.into())
    }

    /// The place of a slab's chunk.
    pub(crate) fn slab_chunk(&self, codec: Codec, slab: u32) -> Option<usize> {
        let place = self.atlases.iter().position(|a| a.codec == codec)?;
        let section = &self.sections[self.texel_sections[place]];
        (slab < section.chunks).then_some(section.first_chunk as usize + slab as usize)
    }

    /// The atlas of a codec.
    pub fn atlas(&self, codec: Codec) -> Option<&Atlas> {
        Atlas::of(&self.atlases, codec)
    }

    /// Checks one chunk's digest and decodes it, by its place in the chunk table. Many may be checked at the same time.
    ///
    /// # Errors
    /// When it is damaged, or there is no such chunk.
    pub fn check_chunk(&self, index: usize) -> Result<(), PackError> {
        let section = self.section_of(index)?;
        // Sections of a kind that this reader does not know may be stored in a way that it does not know.
        if !kind::is_known(section.kind) {
            return Ok(());
        }
        self.chunk_of(section, index).map(drop)
    }

    /// The same for every chunk, those that nothing asked for yet too, one after another.
    ///
    /// # Errors
    /// The first chunk that is damaged.
    pub fn check_chunks(&self) -> Result<(), PackError> {
        (0..self.chunk_count()).try_for_each(|index| self.check_chunk(index))
    }

    /// Bytes of the file.
    pub fn file_bytes(&self) -> u64 {
        self.source.len()
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
