//! Stage 6: where each brick lies in the pages of the codecs' 3-D textures.

use super::allocate::{Allocation, Coding};
use crate::codec::Codec;
use crate::pack::{Atlas, plan};

/// Where every brick of a pack lies.
pub struct Placement {
    /// The atlases that have a brick, by their codecs' tags.
    pub atlases: Vec<Atlas>,
    /// For each grid, the slot of each brick of its pool in its codec's atlas; [`NO_SLOT`] for constants.
    slots: Vec<Vec<u32>>,
}

const NO_SLOT: u32 = u32::MAX;

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

/// How far the slots of an atlas were looked through: the grid and the brick to go on from.
#[derive(Clone, Copy, Default)]
pub struct Cursor {
    grid: usize,
    brick: u32,
}

/// Gives each brick its place: in the order of the pools, which is that of first use, so that a frame needs few
/// slabs. Texels that several bricks read lie where the first of those would.
pub fn place(allocations: &[&Allocation]) -> Placement {
    let mut counts = [0; Codec::COUNT];
    let slots = allocations.iter().map(|allocation| slots(allocation, &mut counts)).collect();
    let planned = Codec::WITH_TEXELS.into_iter().map(|codec| plan(codec, counts[codec as usize]));
    Placement { atlases: planned.filter(|atlas| atlas.bricks > 0).collect(), slots }
}

/// The slot of each brick of a grid. `counts` are those that each codec has so far, by its tag.
fn slots(allocation: &Allocation, counts: &mut [u32]) -> Vec<u32> {
    let mut slots = vec![NO_SLOT; allocation.len() as usize];
    let mut of_shapes = vec![NO_SLOT; allocation.shapes.len()];
    for id in 0..allocation.len() {
        let slot = match allocation.coding(id) {
            Coding::Empty | Coding::Constant(_) => continue,
            Coding::Own(_) => &mut slots[id as usize],
            Coding::Borrowed(referenced) => &mut slots[referenced as usize],
            Coding::Clustered(shape) => &mut of_shapes[shape as usize],
        };
        if *slot == NO_SLOT {
            let count = &mut counts[allocation.codec(id) as usize];
            *slot = *count;
            *count += 1;
        }
        slots[id as usize] = *slot;
    }
    slots
}

impl Placement {
    /// Bytes of all pages.
    pub fn bytes(&self) -> u64 {
        self.atlases.iter().map(Atlas::bytes).sum()
    }

    /// The slot of a brick that has texels.
    pub fn slot(&self, grid: usize, brick: u32) -> u32 {
        self.slots[grid][brick as usize]
    }

    /// What lies in a slab of an atlas, slot by slot. Slabs are asked for in order, from a new cursor on.
    pub fn textures(
        &self,
        allocations: &[&Allocation],
        atlas: &Atlas,
        slab: u32,
        cursor: &mut Cursor,
    ) -> Vec<Texture> {
        let slots = atlas.slots(slab);
        let mut textures = Vec::with_capacity(slots.len());
        while textures.len() < slots.len() {
            let Cursor { grid, brick: id } = *cursor;
            if id == allocations[grid].len() {
                *cursor = Cursor { grid: grid + 1, brick: 0 };
                continue;
            }
            cursor.brick += 1;
            // A slot is that of the first brick that has it: those after it only read it.
            let next = slots.start + textures.len() as u32;
            if self.slots[grid][id as usize] == next && allocations[grid].codec(id) == atlas.codec {
                let of = match allocations[grid].coding(id) {
                    Coding::Clustered(shape) => TextureOf::Shape(shape),
                    Coding::Borrowed(referenced) => TextureOf::Brick(referenced),
                    _ => TextureOf::Brick(id),
                };
                textures.push(Texture { grid: grid as u32, of });
            }
        }
        textures
    }
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
}
