//! Coordinates, masks, bricks and frames: the types that flow down the stages.
//!
//! This module knows nothing of OpenVDB files, codecs or packs.

mod blocks;
mod brick;
mod frame;
mod list;
mod pool;
mod scratch;
mod sparse;

pub use blocks::Blocks;
pub use brick::Brick;
pub use frame::{Cell, CellContent, Child, FlatFrame, FrameStats};
pub use list::List;
pub use pool::{BRICKS_IN_FLIGHT, BrickPool, Interner};
pub use scratch::{SCRATCH_SMALL, Scratch, ScratchError, ScratchFolder, ScratchResult};
pub use sparse::SortedMap;
pub use volpack_format::{
    BRICK_DIM, BRICK_VOXELS, CELL_DIM, Constant, Coord, CoordBox, InactiveRule, Mask512, ROOT_DIM,
    ValueRange, bits,
};
