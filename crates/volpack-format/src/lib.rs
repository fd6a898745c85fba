//! Reads `.volpack` files: sparse volumes and volume sequences, laid out for GPUs.
//!
//! This is everything that a runtime needs, natively and in WebAssembly: it checks a pack, finds what the tree has at a
//! voxel, gives the tree and the texture pages to upload, and decodes bricks to the values that a GPU reads. Packs are made
//! by the tool `volpack`; `docs/format.md` of its repository is the specification.
//!
//! ```
//! use volpack_format::{BRICK_DIM, Coord, Pack, PackError, Region};
//!
//! /// The value of a voxel in a grid's frame.
//! fn voxel(pack: &Pack, grid: usize, frame: usize, at: Coord) -> Result<f32, PackError> {
//!     let frame = pack.frame(grid, frame)?;
//!     Ok(match frame.locate(at).0 {
//!         Region::Background => frame.grid().background,
//!         Region::Constant(constant) => constant.value,
//!         // Voxels of a brick: x slowest, z fastest.
//!         Region::Brick(record) => frame.decode(&record)?.values[at.child_index(3, 1)],
//!     })
//! }
//!
//! # let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/conformance/bc7.volpack");
//! let pack = Pack::from_bytes(std::fs::read(path)?)?;
//! assert_eq!(pack.grids()[0].name, "density");
//! assert_eq!(voxel(&pack, 0, 0, Coord::new(0, 0, 0))?.to_bits(), 0x3eb420f1);
//! assert_eq!(voxel(&pack, 0, 0, Coord::new(-100_000, 5, 70_000))?, 0.0);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! - [`Pack`] opens a pack from bytes, from a stream, or with the feature `mmap` from a file.
//! - [`FrameReader`] goes from coordinates to regions, and from records to voxels.
//! - [`tree`] has the words that a shader walks, [`layout`] the tables' records, [`codec`] the texels.
//!
//! Whatever bytes a pack has, opening and reading it ends with values or with a [`PackError`], in memory that its length
//! bounds.

#![deny(missing_docs)]
#![deny(unsafe_code)]

mod atlas;
mod check;
pub mod codec;
mod coord;
mod error;
mod frame;
mod grid;
mod half;
pub mod layout;
mod mask;
mod pack;
mod pack_bytes;
mod tables;
pub mod tree;
mod value;
mod zstd;

pub use atlas::{Atlas, MAX_TEXELS};
pub use codec::Codec;
pub use coord::{BRICK_DIM, Coord, CoordBox, L1_DIM, L2_DIM, NODE_CHILDREN};
pub use error::PackError;
pub use frame::{DecodedBrick, FrameReader, Region};
pub use grid::{Frame, Grid};
pub use half::Half;
pub use mask::{Mask512, bits};
pub use pack::Pack;
pub use tables::tables_digest;
pub use value::{BRICK_VOXELS, Constant, GridClass, InactiveRule, ValueRange, voxel_size};
