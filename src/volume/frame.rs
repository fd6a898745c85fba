//! One grid of one frame, flattened: constant regions and bricks by 128³ cell.

use serde::{Deserialize, Serialize};

use super::{BRICK_DIM, Brick, ChunkedVec, Constant, Coord, CoordBox, ValueRange};

/// What stands at one of an L2 node's 4096 places.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub enum Child {
    /// A constant 8³ region.
    Constant(Constant),
    /// The brick at this place of [`FlatFrame::bricks`].
    Brick(u32),
}

/// What fills a 128³ cell.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub enum CellContent {
    /// One value.
    Constant(Constant),
    /// Children by their place (x slowest, z fastest), ascending; places that are not named are
    /// inactive background.
    Node(Vec<(u16, Child)>),
}

/// A 128³ cell that is not all background.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Cell {
    /// Smallest corner, a multiple of 128.
    pub origin: Coord,
    /// What fills it.
    pub content: CellContent,
}

/// Counts of one frame, taken from the source before anything is simplified.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct FrameStats {
    /// Leaves of the source tree.
    pub leaves: u64,
    /// Active voxels, tiles in full.
    pub active_voxels: u64,
    /// Active voxels of leaves: what PSNR is measured over.
    pub active_leaf_voxels: u64,
    /// The active voxels' box.
    pub bbox: CoordBox,
    /// The range of active values, tiles included.
    pub active_range: Option<ValueRange>,
    /// Values that were infinite or not a number.
    pub nonfinite: u64,
    /// How far the nearest `f32` is from a value at most: 0 for floats and halves, and for integers up to 2^24.
    pub rounding: f64,
}

impl FlatFrame {
    /// The smallest corner of each of its bricks.
    pub fn brick_origins(&self) -> Vec<Coord> {
        let mut origins = Vec::new();
        for cell in &self.cells {
            let CellContent::Node(children) = &cell.content else { continue };
            let bricks = children.iter().filter(|(_, child)| matches!(child, Child::Brick(_)));
            origins.extend(
                bricks.map(|(place, _)| {
                    cell.origin.offset_by(Coord::child_offset((*place).into(), 4, BRICK_DIM))
                }),
            );
        }
        origins
    }
}

/// One grid of one frame in absolute index coordinates.
#[derive(Clone)]
pub struct FlatFrame {
    /// Constant 4096³ regions.
    pub roots: Vec<(Coord, Constant)>,
    /// The cells that are not all background, ascending by origin.
    pub cells: Vec<Cell>,
    /// The bricks that the cells name, in the order in which they name them.
    pub bricks: ChunkedVec<Brick>,
    /// The source's counts.
    pub stats: FrameStats,
}
