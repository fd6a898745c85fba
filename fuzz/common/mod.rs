//! What `tests/robustness.rs`, `xtask mutate` and the fuzz targets share: the entry points that take any
//! bytes, and the files and mutations that those are tried with.

pub mod entry;
pub mod guard;
pub mod mutate;
pub mod reseal;
pub mod seeds;
