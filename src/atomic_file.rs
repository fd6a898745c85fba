//! What is written aside, to be renamed when it is whole: how it becomes everyone's, and what a killed process leaves.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

use tempfile::NamedTempFile;

/// A file or a folder that could not be made, written or renamed.
#[derive(Debug, thiserror::Error)]
pub enum FileError {
    /// The operating system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file or the folder.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// A file that cannot be replaced while another program has it open.
    #[error("{} is open in another program: close it there, and build again", .0.display())]
    InUse(PathBuf),
}

impl From<FileError> for io::Error {
    fn from(error: FileError) -> Self {
        match error {
            FileError::Io { source, .. } => source,
            FileError::InUse(_) => Self::new(io::ErrorKind::ResourceBusy, error),
        }
    }
}

type Result<T> = std::result::Result<T, FileError>;

fn failed(path: &Path) -> impl FnOnce(io::Error) -> FileError {
    let path = path.to_owned();
    move |source| FileError::Io { path, source }
}

/// Milliseconds before a file that another program has open is tried again: 1.9 s in all. Virus scanners and viewers close
/// a file within that; a program that maps it has to be closed by the user.
const PAUSES: [u64; 6] = [30, 60, 120, 240, 480, 960];

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
    NamedTempFile::new_in(of_any_length(folder)).map_err(failed(path))
}

/// The folder that a file is in.
pub(crate) fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|folder| *folder != Path::new("")).unwrap_or(Path::new("."))
}

/// A folder by a name that Windows takes at any length. std turns long paths into such names itself, but tempfile gives
/// paths to Windows as they are, which refuses those of more than 260 characters. A program's manifest could ask for long
/// paths too, but it counts only where the administrator has allowed them.
pub(crate) fn of_any_length(folder: &Path) -> PathBuf {
    // Some drives, such as RAM disks, have no such name.
    let canonical = if cfg!(windows) { folder.canonicalize().ok() } else { None };
    canonical.unwrap_or_else(|| folder.to_owned())
}

/// Moves a finished file to its place, readable by all as other outputs are.
pub(crate) fn persist(file: NamedTempFile, path: &Path) -> Result<()> {
    make_readable(file.as_file()).map_err(failed(path))?;
    replace(file, path)
}

/// Moves a finished file over whatever is at `path`, in one step. Waits a little for other programs to close that.
pub(crate) fn replace(file: NamedTempFile, path: &Path) -> Result<()> {
    let name = path.file_name().filter(|_| cfg!(windows));
    let place = name.map_or_else(|| path.to_owned(), |name| of_any_length(folder_of(path)).join(name));
    let mut file = Some(file.into_temp_path());
    let moved = patiently(
        &PAUSES,
        |error| keeps_from_replacing(error, path),
        || {
            let temporary = file.take().expect("a failed attempt gives it back");
            temporary.persist(&place).map_err(|e| {
                file = Some(e.path);
                e.error
            })
        },
    );
    moved.map_err(|error| {
        let is_in_use = keeps_from_replacing(&error, path);
        if is_in_use { FileError::InUse(path.to_owned()) } else { failed(path)(error) }
    })
}

/// Tries again after each of the pauses, as long as the error is one that may pass.
fn patiently(
    pauses: &[u64],
    may_pass: impl Fn(&io::Error) -> bool,
    mut attempt: impl FnMut() -> io::Result<()>,
) -> io::Result<()> {
    for pause in pauses {
        match attempt() {
            Err(error) if may_pass(&error) => std::thread::sleep(Duration::from_millis(*pause)),
            done => return done,
        }
    }
    attempt()
}

/// Whether a file cannot be opened or changed since another program has it open or mapped, as only Windows has it.
pub(crate) fn is_in_use(error: &io::Error) -> bool {
    // ERROR_SHARING_VIOLATION, ERROR_LOCK_VIOLATION, ERROR_USER_MAPPED_FILE: std has no kinds for them.
    cfg!(windows) && matches!(error.raw_os_error(), Some(32 | 33 | 1224))
}

/// Whether a file cannot be replaced since another program has it open. MoveFileExW says ERROR_ACCESS_DENIED of a file that
/// is open, but also of a folder and of a file that is read-only.
fn keeps_from_replacing(error: &io::Error, path: &Path) -> bool {
    let is_denied = cfg!(windows) && error.raw_os_error() == Some(5);
    let is_writable_file = || fs::metadata(path).is_ok_and(|m| m.is_file() && !m.permissions().readonly());
    is_in_use(error) || (is_denied && is_writable_file())
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_that_is_in_use_is_tried_again_and_any_other_failure_is_told_at_once() {
        let pauses = [0; 3];
        let sharing_violation = 32;
        let may_pass = |error: &io::Error| error.raw_os_error() == Some(sharing_violation);
        for (failures, code, expected_attempts, ends_well) in
            [(0, 32, 1, true), (3, 32, 4, true), (9, 32, 4, false), (9, 13, 1, false)]
        {
            let mut attempts = 0;
            let result = patiently(&pauses, may_pass, || {
                attempts += 1;
                if attempts > failures { Ok(()) } else { Err(io::Error::from_raw_os_error(code)) }
            });
            assert_eq!((attempts, result.is_ok()), (expected_attempts, ends_well), "{failures} of {code}");
        }
        assert!(PAUSES.iter().sum::<u64>() < 2000);
    }

    #[test]
    fn a_file_that_cannot_be_replaced_stays_and_nothing_is_left_beside_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.volpack");
        fs::create_dir_all(path.join("in it")).unwrap();
        assert!(matches!(write(&path, b"new"), Err(FileError::Io { .. })), "a folder is not in use");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_path_may_be_longer_than_260_characters() {
        let folder = tempfile::tempdir().unwrap();
        let deep = folder.path().join("d".repeat(120)).join("e".repeat(120));
        let path = deep.join("a.volpack");
        assert!(path.as_os_str().len() > 260);
        for bytes in [b"old", b"new"] {
            write(&path, bytes).unwrap();
            assert_eq!(fs::read(&path).unwrap(), bytes);
        }
        assert_eq!(fs::read_dir(&deep).unwrap().count(), 1);
    }

    #[cfg(windows)]
    #[test]
    fn a_file_that_another_program_has_open_is_waited_for() {
        use std::os::windows::fs::OpenOptionsExt;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.volpack");
        write(&path, b"old").unwrap();
        // As most programs open files: no one may write or delete it meanwhile.
        let open = || fs::OpenOptions::new().read(true).share_mode(1).open(&path).unwrap();
        let held = open();
        assert!(matches!(write(&path, b"new"), Err(FileError::InUse(_))));
        drop(held);
        assert_eq!(fs::read(&path).unwrap(), b"old");
        let held = open();
        let closes = std::thread::spawn(move || {
            std::thread::sleep(Duration::from_millis(300));
            drop(held);
        });
        write(&path, b"new").unwrap();
        closes.join().unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"new");
    }
}
