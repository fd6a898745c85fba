//! A grid's tree as OpenVDB has it: a root over 32³ nodes over 16³ nodes over 8³ leaves.

use std::collections::HashMap;
use std::ops::Range;

use crate::volume::{BRICK_DIM, BRICK_VOXELS, Coord, L1_DIM, L2_DIM, Mask512};

/// One grid's voxels and tiles.
///
/// Nodes lie level by level in the file's depth-first order, so the children of one node are
/// neighbours and a node names only its first.
pub struct Tree<T> {
    /// The value outside everything below.
    pub background: T,
    /// Constant 4096³ regions.
    pub tiles: Vec<RootTile<T>>,
    /// L1 nodes: 32³ children of 128³ voxels each.
    pub l1: Vec<Internal<T>>,
    /// L2 nodes: 16³ children of 8³ voxels each.
    pub l2: Vec<Internal<T>>,
    /// 8³ voxel leaves.
    pub leaves: Leaves<T>,
}

/// What a tree takes.
#[derive(Clone, Copy, Debug, Default)]
pub struct TreeSize {
    /// How many leaves it has.
    pub leaves: u64,
    /// Bytes of memory while it is read, those of its part of the file among them.
    pub bytes: u64,
}

impl TreeSize {
    pub(super) fn of<T>(tree: &Tree<T>, in_file: Range<u64>) -> Self {
        let leaves = tree.leaves.len() as u64;
        let value = size_of::<T>() as u64;
        // A value and two bits for each child.
        let children = tree.l1.iter().chain(&tree.l2).map(|node| node.tiles.len() as u64).sum::<u64>();
        let nodes = children * value + children / 4;
        let leaf = size_of::<Coord>() as u64 + size_of::<Mask512>() as u64 + BRICK_VOXELS as u64 * value;
        Self { leaves, bytes: in_file.end - in_file.start + nodes + leaves * leaf }
    }
}

/// A constant 4096³ region.
#[derive(Clone, Copy, Debug)]
pub struct RootTile<T> {
    /// Smallest corner, a multiple of 4096.
    pub origin: Coord,
    /// The value of every voxel inside.
    pub value: T,
    /// Whether they are active.
    pub active: bool,
}

/// An L1 or L2 node. `N` children: 32768 or 4096.
pub struct Internal<T> {
    /// Smallest corner.
    pub origin: Coord,
    /// One bit a child: is it a node?
    pub children: Box<[u64]>,
    /// One bit a child: is it an active tile?
    pub active: Box<[u64]>,
    /// The value of each child that is a tile; unspecified for nodes.
    pub tiles: Box<[T]>,
    /// Index of the first child one level down; the others follow it in the order of their bits.
    pub first_child: usize,
}

impl<T> Internal<T> {
    /// Whether child `index` is a node.
    pub fn is_child(&self, index: usize) -> bool {
        bit(&self.children, index)
    }

    /// Whether child `index` is an active tile.
    pub fn is_active(&self, index: usize) -> bool {
        bit(&self.active, index)
    }

    /// The indices of the children that are tiles.
    pub fn tile_indices(&self) -> impl Iterator<Item = usize> + '_ {
        (0..self.tiles.len()).filter(|&i| !self.is_child(i))
    }

    /// How many children come before child `index`.
    fn rank(&self, index: usize) -> usize {
        let word = index >> 6;
        let before: u32 = self.children[..word].iter().map(|w| w.count_ones()).sum();
        (before + (self.children[word] & ((1 << (index & 63)) - 1)).count_ones()) as usize
    }
}

fn bit(words: &[u64], index: usize) -> bool {
    words[index >> 6] >> (index & 63) & 1 != 0
}

/// Leaves that a thread decodes and whose values lie together: 96 KB of floats, about 75 µs. Arrays from 128 KB on are mapped
/// and cleared by the system each time anew.
pub const LEAVES_IN_BLOCK: usize = 48;

/// The leaves of a tree, as three parallel arrays.
pub struct Leaves<T> {
    /// Smallest corner of each leaf.
    pub origins: Vec<Coord>,
    /// Which voxels are active.
    pub masks: Vec<Mask512>,
    /// 512 values a leaf, x slowest, z fastest, of [`LEAVES_IN_BLOCK`] leaves each. Empty when only the topology was
    /// read.
    pub blocks: Vec<Vec<T>>,
}

impl<T> Leaves<T> {
    /// How many leaves there are.
    pub fn len(&self) -> usize {
        self.origins.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.origins.is_empty()
    }

    /// Leaf `index`'s 512 values.
    pub fn values(&self, index: usize) -> &[T; BRICK_VOXELS] {
        &self.blocks[index / LEAVES_IN_BLOCK].as_chunks().0[index % LEAVES_IN_BLOCK]
    }
}

/// Looks up single voxels.
pub struct Accessor<'a, T> {
    tree: &'a Tree<T>,
    roots: HashMap<Coord, Root>,
}

/// A tile that a voxel is in.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TileAt<T> {
    /// The value of every voxel inside.
    pub value: T,
    /// Whether they are active.
    pub active: bool,
    /// Voxels along an axis.
    pub dim: i32,
}

enum Found<T> {
    Tile(TileAt<T>),
    Leaf(usize),
}

impl<T> Found<T> {
    fn tile(value: T, active: bool, dim: i32) -> Self {
        Self::Tile(TileAt { value, active, dim })
    }
}

enum Root {
    Tile(usize),
    Node(usize),
}

impl<'a, T: Copy> Accessor<'a, T> {
    /// Indexes the tree's root.
    pub fn new(tree: &'a Tree<T>) -> Self {
        let tiles = tree.tiles.iter().enumerate().map(|(i, t)| (t.origin, Root::Tile(i)));
        let nodes = tree.l1.iter().enumerate().map(|(i, n)| (n.origin, Root::Node(i)));
        Self { tree, roots: tiles.chain(nodes).collect() }
    }

    /// The value and active state of the voxel at `at`.
    pub fn get(&self, at: Coord) -> (T, bool) {
        match self.find(at) {
            Found::Tile(tile) => (tile.value, tile.active),
            Found::Leaf(leaf) => {
                let voxel = at.child_index(3, 1);
                (self.tree.leaves.values(leaf)[voxel], self.tree.leaves.masks[leaf].get(voxel))
            }
        }
    }

    /// The tile around `at`, which outside of everything is background; `None` in a leaf.
    pub fn tile(&self, at: Coord) -> Option<TileAt<T>> {
        match self.find(at) {
            Found::Tile(tile) => Some(tile),
            Found::Leaf(_) => None,
        }
    }

    fn find(&self, at: Coord) -> Found<T> {
        let tree = self.tree;
        let l1 = match self.roots.get(&at.align_down(L1_DIM)) {
            None => return Found::tile(tree.background, false, L1_DIM),
            Some(&Root::Tile(i)) => return Found::tile(tree.tiles[i].value, tree.tiles[i].active, L1_DIM),
            Some(&Root::Node(i)) => &tree.l1[i],
        };
        let index = at.child_index(5, L2_DIM);
        if !l1.is_child(index) {
            return Found::tile(l1.tiles[index], l1.is_active(index), L2_DIM);
        }
        let l2 = &tree.l2[l1.first_child + l1.rank(index)];
        let index = at.child_index(4, BRICK_DIM);
        if !l2.is_child(index) {
            return Found::tile(l2.tiles[index], l2.is_active(index), BRICK_DIM);
        }
        Found::Leaf(l2.first_child + l2.rank(index))
    }
}
