//! Why a GPU cannot trace: with the wgpu tracer and without.

use super::scene::TraceError;
use crate::pack::PackError;

/// Why a GPU cannot trace a pack.
#[derive(Debug, thiserror::Error)]
pub enum GpuError {
    /// No Vulkan, Metal or Direct3D 12 answers, or none that can trace.
    #[error("{0}")]
    Unavailable(String),
    /// The adapter lacks something.
    #[error("{adapter} {what}")]
    Lacks {
        /// Its name.
        adapter: String,
        /// What it lacks.
        what: String,
    },
    /// The device failed.
    #[error("the GPU failed: {0}")]
    Failed(String),
    /// The pack is damaged.
    #[error(transparent)]
    Pack(#[from] PackError),
    /// No tracer can trace the frame.
    #[error(transparent)]
    Trace(#[from] TraceError),
}
