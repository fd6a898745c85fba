//! Sequences on the command line of a benchmark.

use std::error::Error;
use std::path::{Path, PathBuf};

/// Returns a name and the files of a file name or glob. The name of a sequence is that of its folder.
///
/// # Errors
/// When nothing matches.
pub fn named(sequence: &Path) -> Result<(String, Vec<PathBuf>), Box<dyn Error>> {
    let frames = volpack::manifest::expand(&[sequence.to_owned()])?;
    let name =
        if frames.len() == 1 { sequence.file_stem() } else { sequence.parent().and_then(Path::file_name) };
    Ok((name.unwrap_or_default().to_string_lossy().into_owned(), frames))
}
