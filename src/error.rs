//! What can go wrong.

use std::path::{Path, PathBuf};

use crate::atomic_file::FileError;
use crate::cancel::Cancelled;
use crate::codec::OutOfRange;
use crate::pack::{Pack, PackError, ProvenanceError};
use crate::vdb::VdbError;
use crate::volume::ScratchError;

/// Everything that a build, an inspection or a verification can fail with.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The operating system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// An output that cannot be replaced while another program has it open.
    #[error("{} is open in another program: close it there, and build again", .0.display())]
    InUse(PathBuf),
    /// An OpenVDB file that cannot be used.
    #[error("{}: {source}", path.display())]
    Vdb {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: VdbError,
    },
    /// A pack that cannot be used.
    #[error("{}: {source}", path.display())]
    Pack {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: PackError,
    },
    /// A pack whose provenance cannot be used, by something that needs it.
    #[error("{}: {source}", path.display())]
    Provenance {
        /// The file.
        path: PathBuf,
        /// What is wrong with its provenance.
        source: ProvenanceError,
    },
    /// A manifest that cannot be used.
    #[error("{}: {message}", path.display())]
    Manifest {
        /// The file.
        path: PathBuf,
        /// What is wrong, with its line.
        message: String,
    },
    /// A request that makes no sense for the files at hand.
    #[error("{0}")]
    Usage(String),
    /// Input that contradicts itself or cannot be packed.
    #[error("{0}")]
    Input(String),
    /// Sound input of a kind that volpack does not pack.
    #[error("{0}")]
    Unsupported(String),
    /// A value that the chosen format cannot hold.
    #[error("grid {grid:?}: {source}")]
    OutOfRange {
        /// The grid.
        grid: String,
        /// The value.
        source: OutOfRange,
    },
    /// A device that failed, or another thing that should not happen.
    #[error("{0}")]
    Other(String),
    /// A source that changed while it was read.
    #[error("{}: the file changed while it was being read: build again when it is complete", .0.display())]
    Changed(PathBuf),
    /// A cache entry with a valid hash but inconsistent content.
    #[error("the cache misled the build: {0}")]
    Misled(String),
    /// The caller cancelled the work.
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
    /// Budgets that were exceeded, a line each.
    #[error("over budget:{0}")]
    Budget(String),
    /// A pack that does not match its source.
    #[error("{0}")]
    Verify(String),
}

impl From<FileError> for Error {
    fn from(error: FileError) -> Self {
        match error {
            FileError::Io { path, source } => Self::Io { path, source },
            FileError::InUse(path) => Self::InUse(path),
        }
    }
}

impl From<ScratchError> for Error {
    fn from(ScratchError { folder, source }: ScratchError) -> Self {
        Self::Io { path: folder, source }
    }
}

/// `Result` with an [`Error`].
pub type Result<T, E = Error> = std::result::Result<T, E>;

impl Error {
    /// Wraps what the operating system said of `path`.
    pub fn io(path: impl Into<PathBuf>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.into();
        move |source| Self::Io { path, source }
    }

    /// Wraps what is wrong with the OpenVDB file at `path`.
    pub fn vdb(path: &Path) -> impl FnOnce(VdbError) -> Self {
        let path = path.to_owned();
        move |source| Self::Vdb { path, source }
    }

    /// Wraps what is wrong with the pack at `path`.
    pub fn pack(path: &Path) -> impl FnOnce(PackError) -> Self {
        let path = path.to_owned();
        move |source| Self::Pack { path, source }
    }

    /// Wraps what is wrong with a pack's provenance.
    pub fn provenance(pack: &Pack) -> impl FnOnce(ProvenanceError) -> Self {
        let path = pack.path().to_owned();
        move |source| Self::Provenance { path, source }
    }
}
