//! Coordinates, masks, bricks and frames: the types that flow down the stages.
//!
//! This module knows nothing of OpenVDB files, codecs or packs.

mod brick;
mod chunked_vec;
mod frame;
mod pool;
mod scratch;
mod sorted_map;

pub use brick::Brick;
pub use chunked_vec::ChunkedVec;
pub use frame::{Cell, CellContent, Child, FlatFrame, FrameStats};
pub use pool::{BRICKS_IN_FLIGHT, BrickPool, Interner};
pub use scratch::{SCRATCH_SMALL, Scratch, ScratchError, ScratchFolder, ScratchResult};
pub use sorted_map::SortedMap;
pub use volpack_format::{
    BRICK_DIM, BRICK_VOXELS, Constant, Coord, CoordBox, InactiveRule, L1_DIM, L2_DIM, Mask512, NODE_CHILDREN,
    ValueRange, bits,
};
