//! Counts and sums that OpenVDB's own tools report too, taken from the tree itself.

use rayon::prelude::*;

use super::tree::Tree;
use super::value::{Scalar, Value};
use crate::volume::{BRICK_DIM, Coord, CoordBox, L1_DIM, L2_DIM, Mask512};

/// What the masks of a tree say.
#[derive(Clone, Debug, PartialEq)]
pub struct TopologyStats {
    /// Leaf nodes, whether or not any voxel in them is active.
    pub leaves: u64,
    /// Active voxels in leaves.
    pub active_leaf_voxels: u64,
    /// Active voxels, a tile's counted in full.
    pub active_voxels: u64,
    /// Active tiles of the root, 4096³ each.
    pub root_tiles: u64,
    /// Active tiles of 32³ nodes, 128³ voxels each.
    pub l1_tiles: u64,
    /// Active tiles of 16³ nodes, 8³ voxels each.
    pub l2_tiles: u64,
    /// The active voxels' box.
    pub bbox: CoordBox,
}

/// What the values of a tree say. All over active values, tiles included, as OpenVDB's
/// `tools::minMax` has it.
#[derive(Clone, Debug, PartialEq)]
pub struct ValueStats<T> {
    /// The smallest finite value.
    pub min: Option<T>,
    /// The largest finite value.
    pub max: Option<T>,
    /// The sum of the finite values, a tile's counted for each of its voxels.
    pub sum: f64,
    /// How many values are infinite or not a number, a tile counted once.
    pub nonfinite: u64,
}

const fn volume(dim: i32) -> u64 {
    (dim as u64).pow(3)
}

impl<T: Value> Tree<T> {
    /// The active tiles of every level: value, origin, and voxels along an axis.
    pub fn active_tiles(&self) -> impl Iterator<Item = (T, Coord, i32)> + '_ {
        let root = self.tiles.iter().filter(|t| t.active).map(|t| (t.value, t.origin, L1_DIM));
        let inner = [(&self.l1, 5, L2_DIM), (&self.l2, 4, BRICK_DIM)];
        root.chain(inner.into_iter().flat_map(|(nodes, log2, dim)| {
            nodes.iter().flat_map(move |node| {
                crate::volume::bits(&node.active).map(move |i| {
                    (node.tiles[i], node.origin.offset_by(Coord::child_offset(i, log2, dim)), dim)
                })
            })
        }))
    }

    /// Counts nodes, tiles and voxels.
    pub fn topology_stats(&self) -> TopologyStats {
        let mut bbox = CoordBox::EMPTY;
        let mut tiles = [0u64; 3];
        for (_, origin, dim) in self.active_tiles() {
            tiles[match dim {
                L1_DIM => 0,
                L2_DIM => 1,
                _ => 2,
            }] += 1;
            bbox.union(CoordBox::cube(origin, dim));
        }
        let mut active_leaf_voxels = 0;
        for (&origin, mask) in self.leaves.origins.iter().zip(&self.leaves.masks) {
            active_leaf_voxels += u64::from(mask.count());
            bbox.union(leaf_box(origin, mask));
        }
        let [root_tiles, l1_tiles, l2_tiles] = tiles;
        TopologyStats {
            leaves: self.leaves.len() as u64,
            active_leaf_voxels,
            active_voxels: active_leaf_voxels
                + root_tiles * volume(L1_DIM)
                + l1_tiles * volume(L2_DIM)
                + l2_tiles * volume(BRICK_DIM),
            root_tiles,
            l1_tiles,
            l2_tiles,
            bbox,
        }
    }
}

impl<T: Scalar> Tree<T> {
    /// Sums values. Leaf by leaf in a fixed order, so that the sum does not depend on threads.
    pub fn value_stats(&self) -> ValueStats<T> {
        let of_leaf = |leaf: usize| {
            let (mask, values) = (&self.leaves.masks[leaf], self.leaves.values(leaf));
            let mut stats = ValueStats::EMPTY;
            mask.ones().for_each(|i| stats.add(values[i], 1));
            stats
        };
        let leaves: Vec<ValueStats<T>> = (0..self.leaves.len()).into_par_iter().map(of_leaf).collect();
        let mut stats = ValueStats::EMPTY;
        for leaf in leaves {
            stats.sum += leaf.sum;
            stats.nonfinite += leaf.nonfinite;
            leaf.min.into_iter().chain(leaf.max).for_each(|v| stats.widen(v));
        }
        for (value, _, dim) in self.active_tiles() {
            stats.add(value, volume(dim));
        }
        stats
    }
}

impl<T: Scalar> ValueStats<T> {
    const EMPTY: Self = Self { min: None, max: None, sum: 0.0, nonfinite: 0 };

    fn add(&mut self, value: T, voxels: u64) {
        if value.to_f64().is_finite() {
            self.sum += value.to_f64() * voxels as f64;
            self.widen(value);
        } else {
            self.nonfinite += 1;
        }
    }

    fn widen(&mut self, value: T) {
        if self.min.is_none_or(|min| value < min) {
            self.min = Some(value);
        }
        if self.max.is_none_or(|max| value > max) {
            self.max = Some(value);
        }
    }
}

/// The box of a leaf's active voxels. Word `x` of the mask is the slab at `x`; bit `8 y + z` in it.
fn leaf_box(origin: Coord, mask: &Mask512) -> CoordBox {
    if *mask == Mask512::NONE {
        return CoordBox::EMPTY;
    }
    let any = mask.0.iter().fold(0, |a, w| a | w);
    let z = any.to_le_bytes().iter().fold(0u8, |a, row| a | row);
    let first_last = |on: &dyn Fn(i32) -> bool| {
        let first = (0..BRICK_DIM).find(|&i| on(i)).expect("some voxel is on");
        let last = (0..BRICK_DIM).rfind(|&i| on(i)).expect("some voxel is on");
        (first, last)
    };
    let (x0, x1) = first_last(&|i| mask.0[i as usize] != 0);
    let (y0, y1) = first_last(&|i| any >> (8 * i) & 0xff != 0);
    let (z0, z1) = first_last(&|i| z >> i & 1 != 0);
    CoordBox { min: origin.offset_by([x0, y0, z0]), max: origin.offset_by([x1, y1, z1]) }
}
