//! What files hold, as people and machines read it.

pub mod chart;
mod pack;
mod vdb;

pub use pack::{CodecSummary, PackSummary};
pub use vdb::{GridSummary, ValueSummary, VdbSummary};
