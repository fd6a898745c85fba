//! Changes what is behind a pack's digests and makes those anew, as one who forges a pack would.

#![allow(dead_code)] // Each test file uses a part of it.

use std::mem::offset_of;
use std::ops::Range;

use volpack::codec::Codec;
use volpack::pack::layout::{
    AtlasRecord, CHUNK_BYTES, Chunk, FrameRecord, GridRecord, Header, Section, encoding, kind,
};
use volpack::pack::tree::{self, RECORD_WORDS, header};
use volpack::pack::{PackWriter, SectionSpec, compress_chunk};

use super::reseal::reseal;

/// A pack whose chunks are stored as they are. Places are those of bytes in the file, and change with [`Forgery::edit`].
#[derive(Clone)]
pub struct Forgery {
    /// The file.
    pub bytes: Vec<u8>,
    /// Whether [`Forgery::finish`] makes the digests anew.
    pub reseals: bool,
}

impl Forgery {
    pub fn new(bytes: Vec<u8>) -> Self {
        Self { bytes, reseals: true }
    }

    /// The file after all changes.
    pub fn finish(mut self) -> Vec<u8> {
        if self.reseals {
            reseal(&mut self.bytes);
        }
        self.bytes
    }

    pub fn u32(&self, at: usize) -> u32 {
        u32::from_le_bytes(*self.bytes[at..].first_chunk().unwrap())
    }

    pub fn u64(&self, at: usize) -> u64 {
        u64::from_le_bytes(*self.bytes[at..].first_chunk().unwrap())
    }

    /// Writes a number of any size.
    pub fn set(&mut self, at: usize, value: impl bytemuck::Pod) {
        let value = bytemuck::bytes_of(&value);
        self.bytes[at..at + value.len()].copy_from_slice(value);
    }

    /// Changes a bit of a byte.
    pub fn flip(&mut self, at: usize) {
        self.bytes[at] ^= 1;
    }

    /// Changes a word, as long as that does not wrap.
    pub fn add(&mut self, at: usize, change: i32) {
        self.set(at, self.u32(at).checked_add_signed(change).unwrap());
    }

    fn section_entries(&self) -> impl Iterator<Item = usize> + use<> {
        let count = self.u32(offset_of!(Header, sections)) as usize;
        (0..count).map(|i| size_of::<Header>() + i * size_of::<Section>())
    }

    /// The table entry of the first section of a kind.
    pub fn entry(&self, kind: u32) -> usize {
        self.section_entries().find(|at| self.u32(at + offset_of!(Section, kind)) == kind).unwrap()
    }

    /// A section's chunks in the file.
    pub fn section(&self, kind: u32) -> Range<usize> {
        let at = self.entry(kind);
        let start = self.u64(at + offset_of!(Section, offset)) as usize;
        start..start + self.u64(at + offset_of!(Section, stored_bytes)) as usize
    }

    /// The table entry of a section's last chunk.
    pub fn last_chunk(&self, kind: u32) -> usize {
        let at = self.entry(kind);
        let end =
            self.u32(at + offset_of!(Section, first_chunk)) + self.u32(at + offset_of!(Section, chunks));
        let sections = self.u32(offset_of!(Header, sections)) as usize;
        size_of::<Header>() + sections * size_of::<Section>() + (end as usize - 1) * size_of::<Chunk>()
    }

    /// A grid in the grid table.
    pub fn grid(&self, grid: usize) -> usize {
        self.section(kind::GRIDS).start + grid * size_of::<GridRecord>()
    }

    /// A frame in the frame table.
    pub fn frame(&self, frame: usize) -> usize {
        self.section(kind::FRAMES).start + frame * size_of::<FrameRecord>()
    }

    /// An atlas in the atlas table.
    pub fn atlas(&self, atlas: usize) -> usize {
        self.section(kind::ATLASES).start + atlas * size_of::<AtlasRecord>()
    }

    /// A word of the tree.
    pub fn tree(&self, word: usize) -> usize {
        self.section(kind::TREE).start + 4 * word
    }

    /// A word of an area of the tree, which the tree's header says the beginning of.
    pub fn area(&self, header_word: usize, word: usize) -> usize {
        self.tree(self.u32(self.tree(header_word)) as usize + word)
    }

    /// A word of a grid's header in the tree.
    pub fn tree_grid(&self, grid: usize, word: usize) -> usize {
        self.area(header::GRID_AT, grid * tree::GRID_WORDS + word)
    }

    /// A word of the roots of a grid's frames.
    pub fn root(&self, grid: usize, root: usize) -> usize {
        self.tree(self.u32(self.tree_grid(grid, tree::grid::ROOT_AT)) as usize + root)
    }

    /// The records whose codec `is_wanted`.
    pub fn records(&self, is_wanted: impl Fn(Codec) -> bool) -> Vec<usize> {
        let count = self.u32(self.tree(header::RECORDS)) as usize;
        let records = (0..count).map(|i| self.area(header::RECORD_AT, i * RECORD_WORDS));
        records.filter(|&at| is_wanted(Codec::from_tag(self.u32(at) & 7).unwrap())).collect()
    }

    /// Changes the content of the first section of a kind, to any length.
    pub fn edit(&mut self, kind: u32, change: impl FnOnce(&mut Vec<u8>)) {
        self.rebuild(|parts| change(&mut part(parts, kind).content));
    }

    /// Changes which sections there are, and what is in them.
    pub fn rebuild(&mut self, change: impl FnOnce(&mut Vec<Part>)) {
        let mut parts: Vec<Part> = self.section_entries().map(|at| self.part(at)).collect();
        change(&mut parts);
        self.bytes = write(&parts);
    }

    fn part(&self, entry: usize) -> Part {
        let section: Section = bytemuck::pod_read_unaligned(&self.bytes[entry..][..size_of::<Section>()]);
        assert_eq!(section.stored_bytes, section.raw_bytes, "its chunks are stored as they are");
        let content = self.bytes[section.offset as usize..][..section.raw_bytes as usize].to_vec();
        Part {
            kind: section.kind,
            codec: section.codec,
            chunk_bytes: section.chunk_bytes,
            ..Part::new(0, content)
        }
    }

    /// Makes the digests anew now, and leaves what is changed later without.
    pub fn reseal_now(&mut self) {
        reseal(&mut self.bytes);
        self.reseals = false;
    }
}

/// A section that will be written.
#[derive(Clone)]
pub struct Part {
    pub kind: u32,
    pub codec: u32,
    pub encoding: u32,
    pub chunk_bytes: u32,
    pub content: Vec<u8>,
    /// How often the content comes.
    pub times: u32,
}

impl Part {
    /// A section that is stored as it is, in chunks of the usual size.
    pub fn new(kind: u32, content: Vec<u8>) -> Self {
        Self { kind, codec: 0, encoding: encoding::RAW, chunk_bytes: CHUNK_BYTES, content, times: 1 }
    }
}

/// The first section of a kind.
pub fn part(parts: &mut [Part], kind: u32) -> &mut Part {
    parts.iter_mut().find(|part| part.kind == kind).unwrap()
}

/// A pack of these sections, whatever is in them.
fn write(parts: &[Part]) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("forged.volpack");
    let specs = parts.iter().map(|part| SectionSpec {
        kind: part.kind,
        codec: part.codec,
        encoding: part.encoding,
        chunk_bytes: part.chunk_bytes,
        raw_bytes: part.content.len() as u64 * u64::from(part.times),
    });
    let mut writer = PackWriter::create(&path, specs.collect()).unwrap();
    for part in parts {
        let chunks = part.content.chunks(part.chunk_bytes as usize);
        let chunks: Vec<_> =
            chunks.map(|raw| compress_chunk(raw.to_vec(), part.encoding, 1).unwrap()).collect();
        writer.begin().unwrap();
        for _ in 0..part.times {
            chunks.iter().try_for_each(|chunk| writer.chunk(chunk)).unwrap();
        }
    }
    writer.finish().unwrap().persist().unwrap();
    std::fs::read(path).unwrap()
}
