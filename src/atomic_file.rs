//! What is written aside, to be renamed when it is whole: how it becomes everyone's, and what a killed process leaves.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

use tempfile::NamedTempFile;

/// A file or a folder that could not be made, written or renamed.
#[derive(Debug, thiserror::Error)]
#[error("{}: {source}", path.display())]
pub struct FileError {
    /// Which.
    pub path: PathBuf,
    /// Why.
    pub source: io::Error,
}

type Result<T> = std::result::Result<T, FileError>;

fn failed(path: &Path) -> impl FnOnce(io::Error) -> FileError {
    let path = path.to_owned();
    move |source| FileError { path, source }
}

/// A file that was being written this long ago was left by a process that was killed.
pub(crate) const LEFT_BEHIND: Duration = Duration::from_secs(24 * 3600);

/// Whether a file's name is one that `tempfile` gives behind a prefix.
pub(crate) fn is_temporary(path: &Path, prefix: &str) -> bool {
    let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let is_random = |rest: &str| rest.len() == 6 && rest.chars().all(|c| c.is_ascii_alphanumeric());
    name.strip_prefix(prefix).is_some_and(is_random)
}

/// Writes a file in one step, and makes its folder if need be.
pub(crate) fn write(path: &Path, bytes: &[u8]) -> Result<()> {
    let mut file = beside(path)?;
    file.write_all(bytes).map_err(failed(path))?;
    persist(file, path)
}

/// A file that will be moved to `path`, whose folder is made if need be.
pub(crate) fn beside(path: &Path) -> Result<NamedTempFile> {
    let folder = folder_of(path);
    fs::create_dir_all(folder).map_err(failed(folder))?;
    NamedTempFile::new_in(folder).map_err(failed(path))
}

/// The folder that a file is in.
pub(crate) fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|folder| *folder != Path::new("")).unwrap_or(Path::new("."))
}

/// Moves a finished file to its place, readable by all as other outputs are.
pub(crate) fn persist(file: NamedTempFile, path: &Path) -> Result<()> {
    make_readable(file.as_file()).map_err(failed(path))?;
    file.persist(path).map(drop).map_err(|e| failed(path)(e.error))
}

/// Temporary files are made for their owner alone; what becomes of them is for everyone, as any other output.
pub(crate) fn make_readable(file: &File) -> io::Result<()> {
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        file.set_permissions(fs::Permissions::from_mode(0o644))?;
    }
    let _ = file;
    Ok(())
}
