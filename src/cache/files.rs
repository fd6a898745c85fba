//! Results that are files, such as packs: copied, never read into memory whole.

use std::fs::File;
use std::io::{self, Read, Write};
use std::path::Path;

use super::store::{Entry, Map};
use super::{Blob, Cache, Key};

/// Bytes that are copied and hashed at a time: enough for BLAKE3 to use its widest lanes.
const PIECE: usize = 1 << 20;

impl Cache {
    /// Keeps a file, whose digest is known, as what a stage gave. A file that changes meanwhile is found out when it
    /// is read.
    pub fn put_file(&self, key: &Key, path: &Path, blob: Blob) {
        let copy = || -> io::Result<()> {
            if !self.store.has_blob(&blob) {
                let to = self.store.path(Map::Blobs, &blob.digest);
                let mut from = File::open(path)?;
                self.store.write_aside(&to, |file| io::copy(&mut from, file).map(drop))?;
            }
            self.store.write(Map::Actions, key.digest(), &Entry::new(key, blob).to_bytes())
        };
        if let Err(e) = copy() {
            self.warn(format!("the cache {} cannot be written: {e}", self.folder().display()));
        }
    }

    /// Copies what a stage gave into a file. Where this is false, something else may stand in it.
    ///
    /// # Errors
    /// When `to` cannot be written: that is no matter of the cache.
    pub fn get_file(&self, blob: &Blob, to: &mut File) -> io::Result<bool> {
        let Some(mut from) = self.store.open_blob(blob) else { return Ok(false) };
        let (mut hasher, mut piece) = (blake3::Hasher::new(), vec![0; PIECE]);
        loop {
            let read = match from.read(&mut piece) {
                Ok(0) => break,
                Ok(read) => read,
                Err(_) => return Ok(false),
            };
            hasher.update(&piece[..read]);
            to.write_all(&piece[..read])?;
        }
        let is_whole = hasher.finalize() == blob.digest;
        if !is_whole {
            self.warn(self.store.discard(blob).to_string());
        }
        Ok(is_whole)
    }

    /// Counts a file that was, or was not, where it was looked for.
    pub fn count_file(&self, key: &Key, hit: bool) {
        self.count(key, hit);
    }
}
