//! What a pack says of a grid and its frames.

use std::ops::Range;

use crate::codec::SequenceRange;
use crate::layout::{FrameRecord, GridRecord};
use crate::{Coord, GridClass, L1_DIM, ValueRange, voxel_size};

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
    pub(crate) fn root_words(&self) -> Range<usize> {
        self.root_at..self.root_at + self.root_count() * self.record.frames as usize
    }

    /// Whether each of its L1 nodes covers a cube that OpenVDB has a root entry for, so that one value may stand for it.
    pub(crate) fn has_whole_roots(&self) -> bool {
        self.cells == [32; 3] && self.origin.is_aligned(L1_DIM)
    }

    /// L1 nodes of a frame.
    pub(crate) fn root_count(&self) -> usize {
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
    pub(crate) fn cell_count(&self) -> usize {
        self.cells.iter().map(|c| *c as usize).product()
    }
}
