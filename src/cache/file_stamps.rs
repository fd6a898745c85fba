//! Digests of files that were seen before, so that gigabytes are not hashed to find that nothing changed.

use std::fs;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::{Cache, artefact, store};
use crate::file_stamp::Stamp;

#[derive(Serialize, Deserialize)]
struct Remembered {
    stamp: Stamp,
    digest: [u8; 32],
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
