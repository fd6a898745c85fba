//! Sequences as benchmarks are given them.

use std::error::Error;
use std::path::{Path, PathBuf};

/// The files of a file name or glob, and what to call them: a sequence goes by its folder's name.
///
/// # Errors
/// When nothing matches.
pub fn named(sequence: &Path) -> Result<(String, Vec<PathBuf>), Box<dyn Error>> {
    let frames = volpack::manifest::expand(&[sequence.to_owned()])?;
    let name =
        if frames.len() == 1 { sequence.file_stem() } else { sequence.parent().and_then(Path::file_name) };
    Ok((name.unwrap_or_default().to_string_lossy().into_owned(), frames))
}
