//! The `.volpack` file format: writer and provenance. The crate [`volpack_format`] reads it.
//!
//! `docs/format.md` is the specification.

mod chunks;
mod plan;
mod provenance;
mod repack;
mod writer;

pub use chunks::check_chunks;
pub use plan::plan;
pub use provenance::{Provenance, ProvenanceError, Source};
pub use repack::{RepackError, repack};
pub use volpack_format::{
    Atlas, DecodedBrick, Frame, FrameReader, Grid, MAX_TEXELS, Pack, PackError, Region, layout, tree,
};
pub use writer::{FinishedPack, PackWriter, SectionSpec, StoredChunk, compress_chunk};
