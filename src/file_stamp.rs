//! What tells that a file is as it was: as git's index does, a file whose size, times and inode are what they were is
//! taken to be what it was. On Windows the file index stands for the inode. As in git, the device is left out: network
//! drives have another each time they are mounted, and the time of the change tells two files of one path apart.

use std::fs::Metadata;
use std::io;
use std::path::Path;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use serde::{Deserialize, Serialize};

/// A file that was changed this short before it was hashed may be changed again within the same tick of its file
/// system's clock (2 s on FAT), so its digest is not remembered ("racy git").
const TICK: Duration = Duration::from_secs(2);

/// What tells that a file is as it was.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Stamp {
    bytes: u64,
    modified: Duration,
    /// When its metadata were changed, which no tool sets back: seconds and nanoseconds; zero where the platform does not
    /// say.
    changed: (i64, i64),
    /// The inode, or the file index of Windows; zero where the platform does not say.
    inode: u64,
}

impl Stamp {
    /// The stamp of the file at `path`.
    ///
    /// # Errors
    /// When the file cannot be asked.
    pub fn of(path: &Path) -> io::Result<Self> {
        let (metadata, changed, inode) = look(path)?;
        let modified = metadata.modified().ok().and_then(|t| t.duration_since(UNIX_EPOCH).ok());
        Ok(Self { bytes: metadata.len(), modified: modified.unwrap_or_default(), changed, inode })
    }

    /// Length of the file.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Whether the file was left alone for long enough that another change would show. To be asked before the file is
    /// hashed.
    pub fn is_settled(&self) -> bool {
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let (seconds, nanoseconds) = self.changed;
        let changed = Duration::new(seconds.try_into().unwrap_or(0), nanoseconds.try_into().unwrap_or(0));
        self.modified.max(changed) + TICK < now
    }
}

/// A file's metadata, the time of their change and the inode.
#[cfg(unix)]
fn look(path: &Path) -> io::Result<(Metadata, (i64, i64), u64)> {
    use std::os::unix::fs::MetadataExt;
    let metadata = std::fs::metadata(path)?;
    let changed = (metadata.ctime(), metadata.ctime_nsec());
    let inode = metadata.ino();
    Ok((metadata, changed, inode))
}

/// The same of Windows. std has neither the time of the change nor, in stable Rust, the file index.
#[cfg(windows)]
fn look(path: &Path) -> io::Result<(Metadata, (i64, i64), u64)> {
    use std::os::windows::fs::OpenOptionsExt;
    use std::os::windows::io::AsRawHandle;
    use windows_sys::Win32::Storage::FileSystem::{
        BY_HANDLE_FILE_INFORMATION, FILE_BASIC_INFO, FILE_FLAG_BACKUP_SEMANTICS, FILE_READ_ATTRIBUTES,
        FileBasicInfo, GetFileInformationByHandle, GetFileInformationByHandleEx,
    };
    /// From 1601, where Windows begins to count, to 1970, in its ticks of 100 ns.
    const TICKS_TO_1970: i64 = 116_444_736_000_000_000;
    const TICKS: i64 = 10_000_000;

    // This access is granted whoever has the file open; the flag is for folders, as std has it.
    let mut options = std::fs::OpenOptions::new();
    options.access_mode(FILE_READ_ATTRIBUTES).custom_flags(FILE_FLAG_BACKUP_SEMANTICS);
    let file = options.open(path)?;
    let handle = file.as_raw_handle();
    let mut by_handle = BY_HANDLE_FILE_INFORMATION::default();
    let mut basic = FILE_BASIC_INFO::default();
    // SAFETY: the handle is open, and each call fills the structure of the size that is given.
    let (has_index, has_change) = unsafe {
        let size = size_of::<FILE_BASIC_INFO>() as u32;
        (
            GetFileInformationByHandle(handle, &raw mut by_handle) != 0,
            GetFileInformationByHandleEx(handle, FileBasicInfo, (&raw mut basic).cast(), size) != 0,
        )
    };
    // Some file systems know only one of them, and FAT no change.
    let index = u64::from(by_handle.nFileIndexHigh) << 32 | u64::from(by_handle.nFileIndexLow);
    let ticks = basic.ChangeTime - TICKS_TO_1970;
    let changed = (ticks.div_euclid(TICKS), ticks.rem_euclid(TICKS) * 100);
    let is_known = has_change && basic.ChangeTime != 0;
    Ok((file.metadata()?, if is_known { changed } else { (0, 0) }, if has_index { index } else { 0 }))
}

/// The same of a platform that tells neither.
#[cfg(not(any(unix, windows)))]
fn look(path: &Path) -> io::Result<(Metadata, (i64, i64), u64)> {
    Ok((std::fs::metadata(path)?, (0, 0), 0))
}

#[cfg(test)]
mod tests {
    use std::fs::{self, File};

    use super::*;

    #[test]
    fn a_replaced_file_of_the_same_size_and_time_has_another_stamp() {
        let folder = tempfile::tempdir().unwrap();
        let [path, other] = ["a.vdb", "b.vdb"].map(|name| folder.path().join(name));
        let time = SystemTime::now() - Duration::from_secs(100);
        let write = |path: &Path, text: &str| {
            fs::write(path, text).unwrap();
            File::options().write(true).open(path).unwrap().set_modified(time).unwrap();
        };
        write(&path, "one");
        let before = Stamp::of(&path).unwrap();
        assert_eq!(Stamp::of(&path).unwrap(), before);
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_secs() as i64;
        assert!((before.changed.0 - now).abs() < 60, "{before:?}");
        write(&other, "two");
        fs::rename(&other, &path).unwrap();
        let after = Stamp::of(&path).unwrap();
        assert_eq!((after.bytes, after.modified), (before.bytes, before.modified));
        assert_ne!(after.inode, before.inode);
        assert_ne!(after, before);
    }
}
