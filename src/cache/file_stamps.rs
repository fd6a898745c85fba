//! Digests of files that were seen before, so that gigabytes are not hashed to find that nothing changed.
//!
//! As git's index does: a file whose size, times and inode are what they were is what it was.

use std::fs::{self, Metadata};
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use serde::{Deserialize, Serialize};

use super::{Cache, artefact, store};

/// A file that was changed this short before it was hashed may be changed again within the same tick of its file
/// system's clock (2 s on FAT), so its digest is not remembered ("racy git").
const TICK: Duration = Duration::from_secs(2);

/// What tells that a file is as it was.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Stamp {
    bytes: u64,
    modified: Duration,
    /// When its metadata were changed, which no tool sets back; zero where the platform does not say.
    changed: (i64, i64),
    inode: u64,
}

#[derive(Serialize, Deserialize)]
struct Remembered {
    stamp: Stamp,
    digest: [u8; 32],
}

impl Stamp {
    /// The stamp of the file at `path`.
    ///
    /// # Errors
    /// When the file cannot be asked.
    pub fn of(path: &Path) -> io::Result<Self> {
        fs::metadata(path).map(|metadata| Self::new(&metadata))
    }

    fn new(metadata: &Metadata) -> Self {
        let modified = metadata.modified().ok().and_then(|t| t.duration_since(UNIX_EPOCH).ok());
        #[cfg(unix)]
        let (changed, inode) = {
            use std::os::unix::fs::MetadataExt;
            ((metadata.ctime(), metadata.ctime_nsec()), metadata.ino())
        };
        #[cfg(not(unix))]
        let (changed, inode) = ((0, 0), 0);
        Self { bytes: metadata.len(), modified: modified.unwrap_or_default(), changed, inode }
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

impl Cache {
    /// The digest that a file had when it had this stamp, if it is remembered.
    pub fn remembered(&self, path: &Path, stamp: &Stamp) -> Option<blake3::Hash> {
        // A stamp that is damaged is as good as none: hashing the file once more is all it costs.
        let bytes = fs::read(self.stamp_path(path)?).ok()?;
        let found: Remembered = artefact::decode(store::unseal(&bytes).ok()?)?;
        (found.stamp == *stamp).then(|| found.digest.into())
    }

    /// Remembers the digest that a file has under a stamp that was [settled](Stamp::is_settled) when it was taken.
    pub fn remember(&self, path: &Path, stamp: &Stamp, digest: &blake3::Hash) {
        let Some(at) = self.stamp_path(path) else { return };
        let remembered = Remembered { stamp: *stamp, digest: *digest.as_bytes() };
        let bytes = store::seal(artefact::encode(&remembered));
        // Nothing is lost with it but a little time, so it is not worth a sync or a warning.
        let _ = fs::create_dir_all(at.parent().unwrap_or(self.folder())).and_then(|()| fs::write(at, bytes));
    }

    fn stamp_path(&self, path: &Path) -> Option<PathBuf> {
        let path = std::path::absolute(path).ok()?;
        Some(self.store.place(store::STAMPS, &blake3::hash(path.as_os_str().as_encoded_bytes())))
    }
}
