//! What can be wrong with a pack.

/// Why a pack could not be read.
#[derive(Debug, thiserror::Error)]
pub enum PackError {
    /// The operating system refused.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// The magic number is missing.
    #[error("not a volpack: it does not begin with the format's magic number")]
    NotPack,
    /// Another version of the format.
    #[error("pack format version {0}, this volpack reads version {known}: {advice}", known = super::layout::VERSION,
        advice = if *.0 > super::layout::VERSION { "use a newer volpack" } else { "build the pack again" })]
    Version(u16),
    /// The file is shorter or longer than it says.
    #[error("the file has {have} bytes, its header says {says}: it was cut off or overwritten")]
    Length {
        /// What the file has.
        have: u64,
        /// What the header says.
        says: u64,
    },
    /// Bytes that do not match their digest.
    #[error("{what} does not match its digest: the file is damaged")]
    Digest {
        /// Which bytes.
        what: String,
    },
    /// Digests hold, but a value contradicts the format.
    #[error("{0}")]
    Corrupt(String),
}

impl PackError {
    /// Whether the file is sound but newer than this reader.
    pub fn is_unsupported(&self) -> bool {
        matches!(self, Self::Version(_))
    }
}

/// The error for a value that contradicts the format.
pub(super) fn corrupt<T>(what: impl Into<String>) -> Result<T, PackError> {
    Err(PackError::Corrupt(what.into()))
}

/// An error if a rule of the format does not hold.
pub(super) fn ensure(holds: bool, what: impl FnOnce() -> String) -> Result<(), PackError> {
    if holds { Ok(()) } else { corrupt(what()) }
}
