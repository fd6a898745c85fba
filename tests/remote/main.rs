//! The cache's remote tier against a real S3 server on loopback.

#![cfg(feature = "remote")]

mod bucket;
mod builds;
#[path = "../common/mod.rs"]
mod common;
mod server;
