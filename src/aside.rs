//! What is written aside, to be renamed when it is whole: how it becomes everyone's, and what a killed process leaves.

use std::fs::File;
use std::io;
use std::path::Path;
use std::time::Duration;

/// A file that was being written this long ago was left by a process that was killed.
pub(crate) const LEFT_BEHIND: Duration = Duration::from_secs(24 * 3600);

/// Whether a file's name is one that `tempfile` gives behind a prefix.
pub(crate) fn is_temporary(path: &Path, prefix: &str) -> bool {
    let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let is_random = |rest: &str| rest.len() == 6 && rest.chars().all(|c| c.is_ascii_alphanumeric());
    name.strip_prefix(prefix).is_some_and(is_random)
}

/// Temporary files are made for their owner alone; what becomes of them is for everyone, as any other output.
pub(crate) fn make_readable(file: &File) -> io::Result<()> {
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        file.set_permissions(std::fs::Permissions::from_mode(0o644))?;
    }
    let _ = file;
    Ok(())
}
