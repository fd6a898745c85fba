//! What files hold, as people and machines read it.

mod pack;
mod vdb;

pub use pack::{CodecSummary, PackSummary};
pub use vdb::{GridSummary, ValueSummary, VdbSummary};
