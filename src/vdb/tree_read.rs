//! Reads a tree: its topology by one thread, its leaves' values by all.

use std::collections::HashSet;

use rayon::prelude::*;

use super::block::{Block, BlockLayout, DecodeBuffers};
use super::cursor::Cursor;
use super::grid::GridInfo;
use super::tree::{Internal, LEAVES_IN_BLOCK, Leaves, RootTile, Tree};
use super::value::{Value, ValueType};
use super::{Result, VdbError};
use crate::volume::{BRICK_DIM, BRICK_VOXELS, Coord, L1_DIM, L2_DIM, Mask512, bits};

/// Reads the background of the tree whose first byte is at the cursor.
pub(super) fn read_background<T: Value>(c: &mut Cursor) -> Result<T> {
    let at = c.at();
    let buffers = c.u32("the tree's buffer count")?;
    if buffers != 1 {
        return Err(VdbError::corrupt(at, format!("{buffers} buffers a tree, not 1")));
    }
    Ok(T::from_le(c.take(T::SIZE as u64, "the background value")?))
}

/// Reads the tree whose first byte is at the cursor and leaves the cursor behind its topology: masks
/// and tile values, but no leaf values.
pub(super) fn read_topology<T: Value>(c: &mut Cursor, grid: &GridInfo) -> Result<Tree<T>> {
    let background = read_background(c)?;
    let mut reader = Reader { layout: layout(grid, background), buffers: DecodeBuffers::default() };
    let mut tree = Tree {
        background,
        tiles: Vec::new(),
        l1: Vec::new(),
        l2: Vec::new(),
        leaves: Leaves { origins: Vec::new(), masks: Vec::new(), blocks: Vec::new() },
    };
    let (tiles, children) = (c.u32("the root's tile count")?, c.u32("the root's child count")?);
    let mut seen = HashSet::new();
    for _ in 0..tiles {
        let origin = root_origin(c, &mut seen)?;
        let value = T::from_le(c.take(T::SIZE as u64, "a root tile")?);
        let active = c.u8("a root tile's state")? != 0;
        tree.tiles.push(RootTile { origin, value, active });
    }
    for _ in 0..children {
        let origin = root_origin(c, &mut seen)?;
        reader.l1_node(c, origin, &mut tree)?;
    }
    Ok(tree)
}

fn layout<T>(grid: &GridInfo, background: T) -> BlockLayout<T> {
    BlockLayout { compression: grid.compression, half: grid.half, background }
}

/// Root entries must lie on the 4096 grid and not share a place: everything downstream relies on
/// regions that do not overlap.
fn root_origin(c: &mut Cursor, seen: &mut HashSet<Coord>) -> Result<Coord> {
    let at = c.at();
    let mut origin = Coord::default();
    for v in &mut origin.0 {
        *v = c.i32("a root entry's origin")?;
    }
    if !origin.is_aligned(L1_DIM) {
        return Err(VdbError::corrupt(
            at,
            format!("root entry at {:?}, not a multiple of {L1_DIM}", origin.0),
        ));
    }
    if !seen.insert(origin) {
        return Err(VdbError::corrupt(at, format!("two root entries at {:?}", origin.0)));
    }
    Ok(origin)
}

struct Reader<T> {
    layout: BlockLayout<T>,
    buffers: DecodeBuffers,
}

impl<T: Value> Reader<T> {
    fn l1_node(&mut self, c: &mut Cursor, origin: Coord, tree: &mut Tree<T>) -> Result<()> {
        let node = self.internal(c, origin, 5, tree.l2.len())?;
        for i in bits(&node.children) {
            let origin = origin.offset_by(Coord::child_offset(i, 5, L2_DIM));
            let l2 = self.internal(c, origin, 4, tree.leaves.len())?;
            for i in bits(&l2.children) {
                tree.leaves.masks.push(Mask512::from_bytes(c.array("a leaf's mask")?));
                tree.leaves.origins.push(origin.offset_by(Coord::child_offset(i, 4, BRICK_DIM)));
            }
            tree.l2.push(l2);
        }
        tree.l1.push(node);
        Ok(())
    }

    fn internal(
        &mut self,
        c: &mut Cursor,
        origin: Coord,
        log2: u32,
        first_child: usize,
    ) -> Result<Internal<T>> {
        let count = 1usize << (3 * log2);
        let children = mask(c, count)?;
        let mut active = mask(c, count)?;
        let block = Block::find(c, &self.layout, &active, count)?;
        let mut tiles = vec![T::default(); count].into_boxed_slice();
        block.decode(&self.layout, &active, &mut tiles, &mut self.buffers)?;
        // OpenVDB reads a child that claims to be an active tile too as the node that it is.
        for (active, child) in active.iter_mut().zip(&children) {
            *active &= !child;
        }
        Ok(Internal { origin, children, active, tiles, first_child })
    }
}

fn mask(c: &mut Cursor, count: usize) -> Result<Box<[u64]>> {
    let bytes = c.take(count as u64 / 8, "a node's mask")?;
    Ok(bytes.as_chunks::<8>().0.iter().map(|b| u64::from_le_bytes(*b)).collect())
}

/// Reads the values of `tree`'s leaves, which lie behind its topology.
///
/// A leaf's place is known only when the one before it was walked, so one thread walks all of them
/// (lengths only) and then every thread decodes.
pub(super) fn read_leaves<T: Value>(c: &mut Cursor, grid: &GridInfo, tree: &mut Tree<T>) -> Result<()> {
    if grid.value_type.has_bit_leaves() || grid.value_type == ValueType::PointDataIndex32 {
        return Err(VdbError::Unsupported(format!(
            "the voxels of {} grids are not read",
            grid.value_type.name()
        )));
    }
    let layout = layout(grid, tree.background);
    let mut places = Vec::with_capacity(tree.leaves.len());
    for _ in 0..tree.leaves.len() {
        places.push(c.pos());
        let mask = Mask512::from_bytes(c.array("a leaf's mask")?);
        Block::find(c, &layout, &mask.0, BRICK_VOXELS)?;
    }

    let start = &*c;
    let decode = |buffers: &mut DecodeBuffers, (masks, places): (&mut [Mask512], &[usize])| {
        let mut block = vec![T::default(); masks.len() * BRICK_VOXELS];
        let leaves = block.as_chunks_mut::<BRICK_VOXELS>().0.iter_mut();
        for ((values, mask), &place) in leaves.zip(masks).zip(places) {
            let mut c = start.seek(place);
            // The mask before the values is the one that counts: OpenVDB overwrites the other.
            *mask = Mask512::from_bytes(c.array("a leaf's mask")?);
            let found = Block::find(&mut c, &layout, &mask.0, BRICK_VOXELS)?;
            found.decode(&layout, &mask.0, values, buffers)?;
        }
        Ok(block)
    };
    let masks = tree.leaves.masks.par_chunks_mut(LEAVES_IN_BLOCK);
    let blocks = masks.zip(places.par_chunks(LEAVES_IN_BLOCK)).map_init(DecodeBuffers::default, decode);
    tree.leaves.blocks = blocks.collect::<Result<_>>()?;
    Ok(())
}

/// Moves the cursor behind a grid's leaf values without decoding them, as a file without offsets
/// needs to find its next grid.
pub(super) fn skip_leaves<T: Value>(c: &mut Cursor, grid: &GridInfo, tree: &Tree<T>) -> Result<()> {
    let layout = layout(grid, tree.background);
    for _ in 0..tree.leaves.len() {
        let mask = Mask512::from_bytes(c.array("a leaf's mask")?);
        match grid.value_type {
            // LeafNode<bool>::readBuffers: origin, then the values as a mask.
            ValueType::Bool => {
                c.take(12 + 64, "a bool leaf")?;
            }
            // LeafNode<ValueMask>::readBuffers: origin; the mask is the value.
            ValueType::Mask => {
                c.take(12, "a mask leaf")?;
            }
            _ => {
                Block::find(c, &layout, &mask.0, BRICK_VOXELS)?;
            }
        }
    }
    Ok(())
}
