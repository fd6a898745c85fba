//! Stage 6: where each brick lies in the pages of the codecs' 3-D textures.

use std::ops::Range;

use super::allocate::{Allocation, Coding};
use crate::codec::Codec;
use crate::pack::{Atlas, MAX_TEXELS};

/// Where every brick of a pack lies.
pub struct Layout {
    /// The atlases that have a brick, by their codecs' tags.
    pub atlases: Vec<PlannedAtlas>,
    /// For each grid, the slot of each brick of its pool in its codec's atlas; 0 for constants.
    pub slots: Vec<Vec<u32>>,
}

/// One codec's atlas and what goes where.
pub struct PlannedAtlas {
    /// Its geometry.
    pub atlas: Atlas,
    /// For each slot a brick of its grid's pool or, with [`SHAPE`], one of the grid's shapes.
    texels: Vec<u32>,
    /// Each grid's first slot.
    grids: Vec<u32>,
}

/// The bit of what is no brick.
const SHAPE: u32 = 1 << 31;

impl PlannedAtlas {
    /// What lies in some slots.
    pub fn textures(&self, slots: Range<u32>) -> Vec<Texture> {
        let texture = |slot: u32| {
            let of = match self.texels[slot as usize] {
                shape if shape & SHAPE != 0 => TextureOf::Shape(shape & !SHAPE),
                brick => TextureOf::Brick(brick),
            };
            Texture { grid: self.grids.partition_point(|first| *first <= slot) as u32 - 1, of }
        };
        slots.map(texture).collect()
    }
}

/// What lies in a slot.
#[derive(Clone, Copy, Debug)]
pub struct Texture {
    /// Whose it is.
    pub grid: u32,
    /// A brick of the grid's pool, or one of its shapes.
    pub of: TextureOf,
}

impl Texture {
    /// The brick whose own they are, if they are a brick's.
    pub fn brick(&self) -> Option<u32> {
        match self.of {
            TextureOf::Brick(id) => Some(id),
            TextureOf::Shape(_) => None,
        }
    }
}

/// Whose texels lie in a slot.
#[derive(Clone, Copy, Debug)]
pub enum TextureOf {
    /// One brick's own.
    Brick(u32),
    /// A shape's.
    Shape(u32),
}

/// Gives each brick its place: in the order of the pools, which is that of first use, so that a frame needs few
/// slabs. A shape lies where the first brick that uses it would.
pub fn place(allocations: &[&Allocation]) -> Layout {
    // For each codec what lies in its slots, and the first slot of each grid.
    let mut taken: [(Vec<u32>, Vec<u32>); Codec::WITH_TEXELS.len()] = Default::default();
    let mut slots = Vec::new();
    for allocation in allocations {
        taken.iter_mut().for_each(|(texels, grids)| grids.push(texels.len() as u32));
        let mut put = |codec: Codec, of: u32| {
            let (texels, _) = &mut taken[codec as usize - 1];
            texels.push(of);
            texels.len() as u32 - 1
        };
        let mut shapes: Vec<Option<u32>> = vec![None; allocation.shapes.len()];
        let place = |(id, coding): (usize, &Coding)| match *coding {
            Coding::Empty | Coding::Constant(_) => 0,
            Coding::Own(codec) => put(codec, id as u32),
            Coding::Shared(shape) => *shapes[shape as usize]
                .get_or_insert_with(|| put(allocation.shapes[shape as usize].codec, shape | SHAPE)),
        };
        slots.push(allocation.codings.iter().enumerate().map(place).collect());
    }
    let planned = Codec::WITH_TEXELS.into_iter().zip(taken).map(|(codec, (texels, grids))| PlannedAtlas {
        atlas: plan(codec, texels.len() as u32),
        texels,
        grids,
    });
    Layout { atlases: planned.filter(|a| a.atlas.bricks > 0).collect(), slots }
}

/// Bricks across a page at most.
const MAX_COLUMNS: u32 = MAX_TEXELS / 8;
/// The size that a full slab comes closest to: what the format calls "about 256 KiB".
const SLAB_BYTES: u32 = 256 << 10;

/// Lays out `bricks` bricks so that little of the last slab stays empty: the slabs share them evenly,
/// so at most a brick a row and one a slab is lost.
pub fn plan(codec: Codec, bricks: u32) -> Atlas {
    let layout = codec.layout();
    let slab_bricks = SLAB_BYTES / layout.brick_bytes() as u32;
    let slabs = bricks.div_ceil(slab_bricks);
    let per_slab = if slabs == 0 { 0 } else { bricks.div_ceil(slabs) };
    let rows = per_slab.div_ceil(MAX_COLUMNS).max(1);
    let columns = per_slab.div_ceil(rows).max(1);
    // With evened-out slabs the last ones could be left without a brick.
    let slabs = bricks.div_ceil(columns * rows);
    Atlas { codec, bricks, columns, rows, slabs, page_slabs: MAX_TEXELS / layout.slices as u32 }
}

/// Copies encoded bricks, one after another, to their places in the bytes of a slab. Places that stay
/// empty are zero.
pub fn assemble(atlas: &Atlas, bricks: &[u8]) -> Vec<u8> {
    let layout = atlas.codec.layout();
    let mut slab = vec![0; atlas.slab_bytes()];
    let rows = layout.slices * layout.rows;
    for (i, bytes) in bricks.chunks_exact(layout.row_bytes).enumerate() {
        slab[atlas.row_in_slab(i / rows, i % rows)].copy_from_slice(bytes);
    }
    slab
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bricks_come_back_from_where_they_were_put() {
        for codec in Codec::WITH_TEXELS {
            let atlas = plan(codec, 700);
            let slots = atlas.slots(0);
            let size = codec.layout().brick_bytes();
            let bricks: Vec<u8> = (0..slots.len() * size).map(|i| (i / 7 % 251) as u8).collect();
            let slab = assemble(&atlas, &bricks);
            for place in [0, 1, slots.end / 2, slots.end - 1] {
                assert_eq!(atlas.extract(&slab, place), bricks[place as usize * size..][..size], "{codec:?}");
            }
        }
    }

    #[test]
    fn little_is_lost_to_padding() {
        for codec in Codec::WITH_TEXELS {
            for bricks in [1, 37, 255, 257, 2048, 2049, 3268, 100_000] {
                let atlas = plan(codec, bricks);
                let places = atlas.slabs * atlas.slab_bricks();
                assert!(places >= bricks, "{codec:?} {bricks}");
                assert!(places - bricks <= atlas.slabs * (atlas.rows + 1), "{codec:?} {bricks}: {atlas:?}");
                assert!(atlas.columns <= MAX_COLUMNS && atlas.rows <= MAX_COLUMNS);
                assert!(atlas.slab_bytes() <= SLAB_BYTES as usize);
            }
        }
        assert_eq!(plan(Codec::Bc7, 0).bytes(), 0);
    }
}
