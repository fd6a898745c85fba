//! Results that are files, such as packs: copied, never read into memory whole.

use std::fs::File;
use std::io::{self, Read, Write};
use std::path::Path;

use super::writer::Content;
use super::{Blob, Cache, Key, Map};

/// Bytes that are copied and hashed at a time: enough for BLAKE3 to use its widest lanes.
const PIECE: usize = 1 << 20;

impl Cache {
    /// Keeps a file, whose digest is known, as what a stage gave. A file that changes meanwhile is found out when it
    /// is read.
    ///
    /// # Errors
    /// When the file cannot be opened.
    pub fn put_file(&self, key: &Key, path: &Path, blob: Blob) -> io::Result<()> {
        self.upload(key, &blob, Map::Blobs, || std::fs::read(path).ok());
        self.keep(key, blob, Content::File(File::open(path)?));
        Ok(())
    }

    /// Copies what a stage gave into a file. Where this is false, something else may stand in it.
    ///
    /// # Errors
    /// When `to` cannot be written: that is no matter of the cache.
    pub fn get_file(&self, blob: &Blob, to: &mut File) -> io::Result<bool> {
        let Some(mut from) = self.store.open_blob(blob) else {
            let fetched = self.fetch_blob(blob);
            return fetched.map_or(Ok(false), |bytes| to.write_all(&bytes).map(|()| true));
        };
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
}
