//! The fixed-layout records of a pack, little-endian, as `docs/format.md` has them.

use std::ops::Range;

use bytemuck::{Pod, Zeroable};

#[cfg(target_endian = "big")]
compile_error!("packs are little-endian and are read in place");

/// The first eight bytes: a byte that is not text, the name, and a line end that text modes break.
pub const MAGIC: [u8; 8] = *b"\x89VOLPK\r\n";
/// The format's version, frozen on 2026-11-22: what it says stays so (`tests/format_v1.rs`). Additions raise `minor`.
pub const VERSION: u16 = 1;
/// Sections begin at a multiple of this, which suits every copy from a mapped file to a GPU.
pub const ALIGNMENT: u64 = 256;
/// Raw bytes of a chunk in a section that has no slabs.
pub const CHUNK_BYTES: u32 = 256 << 10;

/// The first 64 bytes. [`Section`]s follow, then [`Chunk`]s.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub struct Header {
    /// [`MAGIC`].
    pub magic: [u8; 8],
    /// [`VERSION`]. A reader refuses any other.
    pub major: u16,
    /// Additions that an older reader may ignore.
    pub minor: u16,
    /// Sections in the table.
    pub sections: u32,
    /// Chunks in the table.
    pub chunks: u32,
    /// Zero.
    pub reserved: u32,
    /// Bytes of the whole file.
    pub file_bytes: u64,
    /// BLAKE3 of header, sections and chunks, with these 32 bytes zero.
    pub digest: [u8; 32],
}

/// One section of the file: a run of chunks.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub struct Section {
    /// What it is: one of the [`kind`]s. Unknown ones are skipped.
    pub kind: u32,
    /// The codec tag of a texel section, else 0.
    pub codec: u32,
    /// How its chunks are stored: one of the [`encoding`]s.
    pub encoding: u32,
    /// Raw bytes of each chunk but the last.
    pub chunk_bytes: u32,
    /// Its first chunk in the table.
    pub first_chunk: u32,
    /// How many chunks it has.
    pub chunks: u32,
    /// Where its first chunk begins in the file; the others follow without gaps.
    pub offset: u64,
    /// Bytes of its chunks in the file.
    pub stored_bytes: u64,
    /// Bytes of its chunks decoded.
    pub raw_bytes: u64,
    /// BLAKE3 of its entries in the chunk table.
    pub digest: [u8; 32],
}

impl Section {
    /// Its chunks, by their places in the chunk table.
    pub fn chunk_range(&self) -> Range<usize> {
        self.first_chunk as usize..self.first_chunk as usize + self.chunks as usize
    }
}

/// One chunk: the unit of reading, checking and decompression.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub struct Chunk {
    /// Where it begins in the file.
    pub offset: u64,
    /// Bytes in the file. Equal to `raw_bytes` for a chunk that did not shrink and is stored raw.
    pub stored_bytes: u32,
    /// Bytes decoded.
    pub raw_bytes: u32,
    /// BLAKE3 of the stored bytes.
    pub digest: [u8; 32],
}

/// Values of [`Section::kind`].
#[allow(missing_docs)] // docs/format.md has a chapter for each.
pub mod kind {
    pub const GRIDS: u32 = 1;
    pub const FRAMES: u32 = 2;
    pub const NAMES: u32 = 3;
    pub const ATLASES: u32 = 4;
    pub const FRAME_CHUNKS: u32 = 5;
    pub const TREE: u32 = 6;
    pub const TEXELS: u32 = 7;
    pub const PROVENANCE: u32 = 8;

    /// The kinds that a pack has exactly one section of.
    pub const ALONE: [u32; 7] = [GRIDS, FRAMES, NAMES, ATLASES, FRAME_CHUNKS, TREE, PROVENANCE];
    /// Those of them that are read when a pack is opened.
    pub const READ_BY_OPEN: [u32; 6] = [GRIDS, FRAMES, NAMES, ATLASES, FRAME_CHUNKS, TREE];

    /// Whether this version of the format has a meaning for it.
    pub fn is_known(kind: u32) -> bool {
        (GRIDS..=PROVENANCE).contains(&kind)
    }

    /// A kind's name for messages.
    pub fn name(kind: u32) -> &'static str {
        const NAMES: [&str; 9] = [
            "unknown section",
            "grid table",
            "frame table",
            "name table",
            "atlas table",
            "frame chunk lists",
            "tree",
            "texels",
            "provenance",
        ];
        NAMES.get(kind as usize).copied().unwrap_or(NAMES[0])
    }
}

/// Values of [`Section::encoding`].
pub mod encoding {
    /// As it is.
    pub const RAW: u32 = 0;
    /// A zstd frame a chunk.
    pub const ZSTD: u32 = 1;
    /// First bytes of all 2-byte words, then second bytes; then zstd.
    pub const ZSTD_SHUFFLE_2: u32 = 2;
    /// The same for 4-byte words.
    pub const ZSTD_SHUFFLE_4: u32 = 3;

    /// How a section is stored in a pack that uses zstd, or does not.
    pub fn of(kind: u32, codec: u32, zstd: bool) -> u32 {
        use crate::codec::Codec;
        match (kind, Codec::from_tag(codec).map(Codec::word_bytes)) {
            _ if !zstd => RAW,
            // So short that they stay readable in a hex dump.
            (super::kind::GRIDS | super::kind::NAMES | super::kind::ATLASES, _) => RAW,
            (super::kind::TEXELS, Some(2)) => ZSTD_SHUFFLE_2,
            (super::kind::TEXELS, Some(4)) => ZSTD_SHUFFLE_4,
            _ => ZSTD,
        }
    }

    /// Bytes of the words whose bytes are gathered; 1 for none.
    pub fn shuffle_width(encoding: u32) -> usize {
        match encoding {
            ZSTD_SHUFFLE_2 => 2,
            ZSTD_SHUFFLE_4 => 4,
            _ => 1,
        }
    }
}

/// One grid of the pack.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub struct GridRecord {
    /// Where its name begins in the name table.
    pub name_offset: u32,
    /// Bytes of its name.
    pub name_bytes: u32,
    /// 0 unknown, 1 level set, 2 fog volume, 3 staggered.
    pub class: u32,
    /// Its first frame in the frame table.
    pub first_frame: u32,
    /// How many frames it has.
    pub frames: u32,
    /// Frames per second; 0 when not stated.
    pub fps: f32,
    /// The least active value of the source.
    pub active_min: f32,
    /// The greatest active value of the source.
    pub active_max: f32,
    /// What each codec cost, by tag: the root of the sum of squared errors over every voxel of its
    /// bricks that no rule gives, over all frames.
    pub codec_error_l2s: [f32; 6],
}

/// One frame of one grid.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub struct FrameRecord {
    /// Its grid.
    pub grid: u32,
    /// Its number, from the source's file name.
    pub number: i32,
    /// Its source file in the provenance's list.
    pub source: u32,
    /// Where its chunks begin in the frame chunk lists.
    pub first_chunk: u32,
    /// How many texel chunks it needs.
    pub chunks: u32,
    /// The active voxels' box: minimum, then maximum, inclusive. Empty if a minimum is above.
    pub bbox: [i32; 6],
    /// Zero.
    pub reserved: u32,
    /// What encoding cost: the root of the sum of squared errors over every voxel of the frame's bricks that no
    /// rule gives, and of bricks that became background.
    pub error_l2: f64,
    /// Leaves of the source's tree.
    pub leaves: u64,
    /// Active voxels of the source, tiles in full.
    pub active_voxels: u64,
    /// Index space to world space, row-major, row vectors (`world = index · M`).
    pub transform: [f64; 16],
}

/// The pages of one codec's texture.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub struct AtlasRecord {
    /// Codec tag.
    pub codec: u32,
    /// Bricks in it.
    pub bricks: u32,
    /// Bricks across a slab.
    pub columns: u32,
    /// Bricks down a slab.
    pub rows: u32,
    /// Slabs in all pages.
    pub slabs: u32,
    /// Slabs in a page, but for the last.
    pub page_slabs: u32,
}

const _: () = {
    assert!(size_of::<Header>() == 64);
    assert!(size_of::<Section>() == 80);
    assert!(size_of::<Chunk>() == 48);
    assert!(size_of::<GridRecord>() == 56);
    assert!(size_of::<FrameRecord>() == 200);
    assert!(size_of::<AtlasRecord>() == 24);
};
