//! What can be wrong with an OpenVDB file.

/// Why an OpenVDB file, or one grid of it, could not be read.
#[derive(Debug, thiserror::Error)]
pub enum VdbError {
    /// The operating system refused.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// The magic number is missing.
    #[error("not an OpenVDB file: it does not begin with OpenVDB's magic number")]
    NotVdb,
    /// A file version outside 222 to 225.
    #[error(
        "OpenVDB file version {0} is not supported, only 222 to 225: \
         open the file in a current Houdini, Blender or vdb_tool and save it again"
    )]
    Version(u32),
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

    /// Whether the file is sound but holds something that volpack does not read.
    pub fn is_unsupported(&self) -> bool {
        match self {
            Self::Unsupported(_) | Self::Version(_) => true,
            Self::Grid { source, .. } => source.is_unsupported(),
            _ => false,
        }
    }
}
