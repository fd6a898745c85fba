//! Reader of OpenVDB files: our own, because the one Rust crate for it reads 41 of 93 test files
//! right (`docs/decisions/0001-own-vdb-reader.md`).
//!
//! [`VdbFile::open`] reads the header, every grid's descriptor, metadata and transform, and no
//! voxels. [`VdbFile::read_tree`] then reads one grid; the others are not touched. The format is
//! OpenVDB's `io/Archive`, `io/Compression.h` and the tree nodes' `readTopology` / `readBuffers`,
//! file versions 222 to 225. Later versions are read as 225, with a warning, as OpenVDB reads them.
//!
//! Any byte may be wrong: every length and offset is checked against the file's size before memory
//! is taken for it, and decompression goes into buffers of a size known beforehand.

mod block;
mod blosc;
mod codec;
mod cursor;
mod error;
mod file;
mod grid;
mod other_format;
mod stats;
mod transform;
mod tree;
mod tree_read;
mod value;

pub use error::VdbError;
pub use file::VdbFile;
pub use grid::{GridInfo, find_grid};
pub use half::f16;
pub use other_format::OtherFormat;
pub use stats::{TopologyStats, ValueStats};
pub use transform::Transform;
pub use tree::{Accessor, Internal, LEAVES_IN_BLOCK, Leaves, RootTile, TileAt, Tree, TreeSize};
pub use value::{Scalar, Value, ValueType, with_scalar_type, with_value_type};
pub use volpack_format::{GridClass, voxel_size};

/// `Result` with a [`VdbError`].
pub type Result<T> = std::result::Result<T, VdbError>;
