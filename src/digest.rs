//! What tells one file from another: a digest of its bytes.

use std::fs::File;
use std::path::Path;

use crate::error::{Error, Result};

/// BLAKE3 of a file's bytes, and how many there are.
///
/// # Errors
/// When the file cannot be read.
pub fn digest(path: &Path) -> Result<(blake3::Hash, u64)> {
    let mut hasher = blake3::Hasher::new();
    File::open(path).and_then(|file| hasher.update_reader(file).map(drop)).map_err(Error::io(path))?;
    Ok((hasher.finalize(), hasher.count()))
}
