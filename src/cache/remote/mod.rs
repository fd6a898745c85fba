//! The remote tier: the same two maps as on disk, in a bucket that several machines share. The feature `remote` has it.

#[cfg(feature = "remote")]
mod bucket;
#[cfg(feature = "remote")]
mod connect;
#[cfg(not(feature = "remote"))]
mod none;

#[cfg(feature = "remote")]
pub use bucket::Remote;
#[cfg(not(feature = "remote"))]
pub use none::Remote;

pub use super::store::Map;

/// What may be done with a remote.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default, clap::ValueEnum)]
pub enum Policy {
    /// Entries are only looked up
    Read,
    /// What had to be made is uploaded as well
    #[default]
    ReadWrite,
}

/// An entry that is looked up.
#[derive(Clone, Copy, Debug)]
pub struct Wanted {
    /// Its place in the map.
    pub digest: [u8; 32],
    /// Bytes that it may have at most.
    pub limit: u64,
}
