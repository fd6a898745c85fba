//! The pages of one codec's texture: how slots, slabs and texels correspond.

use std::ops::Range;

use crate::codec::Codec;

/// Texels a page may have along an axis: the least that WebGPU promises for 3-D textures.
pub const MAX_TEXELS: u32 = 2048;

/// The pages of one codec's texture.
///
/// Bricks fill *slabs*: one brick deep, `columns` across and `rows` down. A slab is a contiguous range
/// of a page's slices, so it is at once the unit of upload and one chunk of the file. A page is a
/// stack of slabs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Atlas {
    /// The codec of every brick in it.
    pub codec: Codec,
    /// How many bricks there are.
    pub bricks: u32,
    /// Bricks across a slab (x).
    pub columns: u32,
    /// Bricks down a slab (y).
    pub rows: u32,
    /// Slabs in all pages together.
    pub slabs: u32,
    /// Slabs in a page, but for the last page, which has what is left.
    pub page_slabs: u32,
}

impl Atlas {
    /// The one of a codec.
    pub fn of(atlases: &[Self], codec: Codec) -> Option<&Self> {
        atlases.iter().find(|atlas| atlas.codec == codec)
    }

    /// Bricks in a full slab.
    pub fn slab_bricks(&self) -> u32 {
        self.columns * self.rows
    }

    /// Bytes of a slab.
    pub fn slab_bytes(&self) -> usize {
        self.slab_bricks() as usize * self.codec.layout().brick_bytes()
    }

    /// Bytes of all pages.
    pub fn bytes(&self) -> u64 {
        u64::from(self.slabs) * self.slab_bytes() as u64
    }

    /// The slots of the bricks in a slab.
    pub fn slots(&self, slab: u32) -> Range<u32> {
        let start = slab.saturating_mul(self.slab_bricks()).min(self.bricks);
        start..start.saturating_add(self.slab_bricks()).min(self.bricks)
    }

    /// Copies one brick's bytes out of a slab.
    ///
    /// # Panics
    /// When the slab is too short to have that place.
    pub fn extract(&self, slab: &[u8], place: u32) -> Vec<u8> {
        let layout = self.codec.layout();
        let mut brick = Vec::with_capacity(layout.brick_bytes());
        for row in 0..layout.slices * layout.rows {
            brick.extend_from_slice(&slab[self.row_in_slab(place as usize, row)]);
        }
        brick
    }

    /// Where row `row` (slice by slice) of the brick at `place` lies in its slab.
    pub fn row_in_slab(&self, place: usize, row: usize) -> Range<usize> {
        let layout = self.codec.layout();
        let (columns, rows) = (self.columns as usize, self.rows as usize);
        let (slice, row) = (row / layout.rows, row % layout.rows);
        let (column, down) = (place % columns, place / columns);
        let start = ((slice * rows + down) * layout.rows + row) * columns + column;
        start * layout.row_bytes..(start + 1) * layout.row_bytes
    }
}
