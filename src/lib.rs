//! volpack
pub mod codec;
pub mod vdb;
pub mod volume;
