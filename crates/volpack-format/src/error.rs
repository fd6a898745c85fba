//! What can be wrong with a pack.

use std::fmt;

use crate::layout::VERSION;

/// Why a pack could not be read.
#[derive(Debug)]
pub enum PackError {
    /// The operating system refused, or the stream did.
    Io(std::io::Error),
    /// The magic number is missing.
    NotPack,
    /// Another version of the format.
    Version(u16),
    /// The file is shorter or longer than it says.
    Length {
        /// What the file has.
        have: u64,
        /// What the header says.
        says: u64,
    },
    /// Bytes that do not match their digest.
    Digest {
        /// Which bytes.
        what: String,
    },
    /// Digests hold, but a value contradicts the format. Also what is asked for something that the pack does not have.
    Corrupt(String),
}

impl fmt::Display for PackError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Io(error) => error.fmt(f),
            Self::NotPack => f.write_str("not a volpack: it does not begin with the format's magic number"),
            Self::Version(version) => {
                let newer = *version > VERSION;
                let advice = if newer { "use a newer volpack" } else { "build the pack again" };
                write!(f, "pack format version {version}, this volpack reads version {VERSION}: {advice}")
            }
            Self::Length { have, says } => {
                write!(f, "the file has {have} bytes, its header says {says}: it was cut off or overwritten")
            }
            Self::Digest { what } => write!(f, "{what} does not match its digest: the file is damaged"),
            Self::Corrupt(what) => f.write_str(what),
        }
    }
}

impl std::error::Error for PackError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            // Its own message is all that is said of it, so what is behind it comes next.
            Self::Io(error) => error.source(),
            _ => None,
        }
    }
}

impl From<std::io::Error> for PackError {
    fn from(error: std::io::Error) -> Self {
        Self::Io(error)
    }
}

impl PackError {
    /// Whether the file is sound but newer than this reader.
    pub fn is_unsupported(&self) -> bool {
        matches!(self, Self::Version(_))
    }
}

/// The error for a value that contradicts the format.
pub(crate) fn corrupt<T>(what: impl Into<String>) -> Result<T, PackError> {
    Err(PackError::Corrupt(what.into()))
}

/// An error if a rule of the format does not hold.
pub(crate) fn ensure(holds: bool, what: impl FnOnce() -> String) -> Result<(), PackError> {
    if holds { Ok(()) } else { corrupt(what()) }
}
