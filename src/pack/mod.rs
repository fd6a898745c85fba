//! The `.volpack` file format: layout, writer, reader, structural checks, decoder.
//!
//! `docs/format.md` is the specification.

mod atlas;
mod check;
mod decode;
mod error;
pub mod layout;
mod plan;
mod provenance;
mod reader;
mod repack;
mod tables;
pub mod tree;
mod writer;

pub use atlas::{Atlas, MAX_TEXELS};
pub use decode::{DecodedBrick, FrameReader, Region};
pub use error::PackError;
pub use plan::plan;
pub use provenance::{Provenance, ProvenanceError, Source};
pub use reader::{Frame, Grid, Pack};
pub use repack::{RepackError, repack};
pub use writer::{FinishedPack, PackWriter, SectionSpec, StoredChunk, compress_chunk};
