//! Coordinates, masks, bricks and frames: the types that flow down the stages.
//!
//! This room knows nothing of OpenVDB files, codecs or packs.

mod blocks;
mod brick;
mod coord;
mod frame;
mod list;
mod mask;
mod pool;
mod scratch;
mod sparse;

pub use blocks::Blocks;
pub use brick::{BRICK_VOXELS, Brick, InactiveRule};
pub use coord::{BRICK_DIM, CELL_DIM, Coord, CoordBox, ROOT_DIM};
pub use frame::{Cell, CellContent, Child, Constant, FlatFrame, FrameStats, ValueRange};
pub use list::List;
pub use mask::{Mask512, bits};
pub use pool::{BRICKS_IN_FLIGHT, BrickPool, Interner};
pub use scratch::{SCRATCH_SMALL, Scratch, ScratchError, ScratchFolder, ScratchResult};
pub use sparse::SortedMap;
