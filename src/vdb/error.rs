//! What can be wrong with an OpenVDB file.

use super::other_format::OtherFormat;

/// The newest version whose layout was checked against OpenVDB's own source.
pub(super) const NEWEST: u32 = 225;

/// Why an OpenVDB file, or one grid of it, could not be read.
#[derive(Debug, thiserror::Error)]
pub enum VdbError {
    /// The operating system refused.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// The magic number is missing.
    #[error("not an OpenVDB file: {0}")]
    NotVdb(OtherFormat),
    /// A file version that is too old.
    #[error(
        "OpenVDB file version {0} is too old, volpack reads 222 and later: \
         open the file with a program that has OpenVDB 12 or older, as Blender 4 has, and save it again"
    )]
    TooOld(u32),
    /// What cannot be read in a file of a version that is not known.
    #[error(
        "{source}: the file's OpenVDB file version {version} is newer than {newest}, the newest that this volpack knows: \
         use a newer volpack, or write the file with an older OpenVDB",
        newest = NEWEST
    )]
    Newer {
        /// The file's version.
        version: u32,
        /// What could not be read.
        source: Box<VdbError>,
    },
    /// The file ends too early, or a length or offset in it points past its end.
    #[error("{what} at byte {at} needs {need} bytes, but only {left} are left")]
    Truncated {
        /// What was being read.
        what: &'static str,
        /// Its position in the file.
        at: u64,
        /// How many bytes it needs.
        need: u64,
        /// How many bytes there are.
        left: u64,
    },
    /// A value in the file contradicts the format.
    #[error("byte {at}: {what}")]
    Corrupt {
        /// Position in the file.
        at: u64,
        /// What is wrong there.
        what: String,
    },
    /// Valid OpenVDB that volpack does not read.
    #[error("{0}")]
    Unsupported(String),
    /// Any of the above, inside a named grid.
    #[error("grid {grid:?}: {source}")]
    Grid {
        /// The grid's display name.
        grid: String,
        /// What is wrong with it.
        source: Box<VdbError>,
    },
}

impl VdbError {
    pub(super) fn corrupt(at: u64, what: impl Into<String>) -> Self {
        Self::Corrupt { at, what: what.into() }
    }

    pub(super) fn in_grid(self, grid: &str) -> Self {
        Self::Grid { grid: grid.to_owned(), source: Box::new(self) }
    }

    /// What is wrong with a file of a version, which may be why.
    pub(super) fn in_version(self, version: u32) -> Self {
        if version > NEWEST && !self.is_io() {
            return Self::Newer { version, source: Box::new(self) };
        }
        self
    }

    fn is_io(&self) -> bool {
        match self {
            Self::Io(_) => true,
            Self::Grid { source, .. } => source.is_io(),
            _ => false,
        }
    }

    /// Whether the file is sound but holds something that volpack does not read.
    pub fn is_unsupported(&self) -> bool {
        match self {
            Self::Unsupported(_) | Self::TooOld(_) | Self::Newer { .. } => true,
            Self::Grid { source, .. } => source.is_unsupported(),
            _ => false,
        }
    }
}
