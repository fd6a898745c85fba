//! A content-addressed store of what stages made: the second build is instant.
//!
//! Two maps on disk. An *action* says what a stage gives for some inputs: under the [`Key`] of the inputs stands the
//! digest and the length of the result. A *blob* is a result under its own digest. Both are checked on every read, so
//! an entry that is damaged, cut short or of another version is a miss, never a wrong pack. Whoever can write to a store
//! can forge an entry with right digests, and is trusted. Both are written aside, synced and renamed, so any number of
//! processes may share one store without locks.
//!
//! Behind the store may be a remote with the same two maps, which machines share. What the store lacks is looked up there
//! and kept; what is made goes to both.
//!
//! A cache never fails a build. What goes wrong is a warning.

mod artefact;
mod file_stamps;
mod files;
mod key;
mod maintain;
pub mod remote;
mod remote_sync;
mod store;
mod writer;

use std::collections::{BTreeMap, HashSet};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

use schemars::JsonSchema;
use serde::Serialize;
use serde::de::DeserializeOwned;

pub use key::{Key, Namespace};
pub use maintain::{Fault, Removed, Stats, Verified};

use remote::Remote;
use store::{Entry, Map, Store};
use writer::{Content, Writer};

/// The store, and what is to be told of it.
pub struct Cache {
    store: Store,
    writer: Writer,
    remote: Option<Remote>,
    /// What the remote was found to lack, so that it is asked once a build.
    absent: Mutex<HashSet<(Map, [u8; 32])>>,
    uses: Mutex<BTreeMap<&'static str, Uses>>,
    warnings: Mutex<Vec<String>>,
}

/// How often a stage's results were asked for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, JsonSchema)]
pub struct Uses {
    /// They were there.
    pub hits: u64,
    /// They were not.
    pub misses: u64,
}

/// A result's digest and length.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Blob {
    /// BLAKE3 of its bytes.
    pub digest: [u8; 32],
    /// How many there are.
    pub bytes: u64,
}

impl Cache {
    /// Opens the store in a folder, which is made if need be.
    ///
    /// # Errors
    /// When the folder cannot be made.
    pub fn open(folder: &Path) -> io::Result<Self> {
        let store = Store::open(folder)?;
        let writer = Writer::new(store.clone());
        Ok(Self {
            store,
            writer,
            remote: None,
            absent: Mutex::default(),
            uses: Mutex::default(),
            warnings: Mutex::default(),
        })
    }

    /// The platform's folder for caches, with ours in it; `None` where the platform names none.
    pub fn default_folder() -> Option<PathBuf> {
        dirs::cache_dir().map(|folder| folder.join(env!("CARGO_PKG_NAME")))
    }

    /// Where it lies.
    pub fn folder(&self) -> &Path {
        self.store.root()
    }

    /// Where builds may put what does not fit in memory: beside what they keep, which is on a disk wherever the system's own
    /// folder for temporary files may be in memory.
    pub fn scratch_folder(&self) -> PathBuf {
        self.store.aside()
    }

    /// What a stage gave for some inputs, if it is known.
    pub fn get<T: DeserializeOwned>(&self, key: &Key) -> Option<T> {
        let found = self.peek(key);
        self.count(key, found.is_some());
        found
    }

    /// The same for who asks not for its own sake: it counts as no use.
    pub fn peek<T: DeserializeOwned>(&self, key: &Key) -> Option<T> {
        self.blob(key).and_then(|blob| {
            let bytes = self.checked(self.store.read_blob(&blob));
            let bytes = bytes.or_else(|| if key.travels() { self.fetch_blob(&blob) } else { None })?;
            let value = artefact::decode(&bytes);
            if value.is_none() {
                self.warn(format!("an entry of {} is of another version: it is made anew", key.stage()));
            }
            value
        })
    }

    /// Keeps what a stage gave. It may still be on its way to the disk when this returns: see [`Cache::flush`].
    pub fn put<T: Serialize>(&self, key: &Key, value: &T) {
        let bytes = artefact::encode(value);
        let blob = Blob { digest: blake3::hash(&bytes).into(), bytes: bytes.len() as u64 };
        self.upload(key, &blob, Map::Blobs, || Some(bytes.clone()));
        self.keep(key, blob, Content::Bytes(bytes));
    }

    /// Lets a key stand for a result that is kept under another already.
    pub fn put_alias(&self, key: &Key, blob: Blob) {
        let entry = Entry::new(key, blob).to_bytes();
        self.upload(key, &blob, Map::Actions, || Some(entry.clone()));
        self.writer.write(Map::Actions, *key.digest(), Content::Bytes(entry));
    }

    fn keep(&self, key: &Key, blob: Blob, content: Content) {
        self.writer.write(Map::Blobs, blob.digest, content);
        self.put_alias(key, blob);
    }

    /// The digest and length of what a stage gave, without reading it.
    pub fn blob(&self, key: &Key) -> Option<Blob> {
        let entry = self.checked(self.store.read_action(key)).or_else(|| self.fetch_action(key));
        entry.map(|entry| entry.blob)
    }

    /// Whether a stage's result is in the store and as long as it should be. Not its digest: for looking ahead.
    pub fn has(&self, key: &Key) -> bool {
        matches!(self.store.read_action(key), Ok(Some(entry)) if self.store.has_blob(&entry.blob))
    }

    /// Writes what is on its way to the disk, and gives what is to be told since the last time.
    pub fn flush(&self) -> Vec<String> {
        let failed = self.writer.flush();
        lock(&self.absent).clear();
        let mut warnings = std::mem::take(&mut *lock(&self.warnings));
        warnings.extend(self.remote.iter().flat_map(Remote::warnings));
        warnings.extend(failed.map(|e| self.cannot_be_written(&e)));
        warnings
    }

    fn cannot_be_written(&self, error: &io::Error) -> String {
        format!("the cache {} cannot be written: {error}", self.folder().display())
    }

    /// How often each stage's results were asked for since the last time.
    pub fn take_uses(&self) -> BTreeMap<&'static str, Uses> {
        std::mem::take(&mut *lock(&self.uses))
    }

    /// Whether anything was found since then.
    pub fn gave_something(&self) -> bool {
        lock(&self.uses).values().any(|uses| uses.hits > 0)
    }

    /// Counts a result that was, or was not, where it was looked for. [`Cache::get`] does so itself.
    pub fn count(&self, key: &Key, hit: bool) {
        let mut uses = lock(&self.uses);
        let uses = uses.entry(key.stage()).or_default();
        if hit { uses.hits += 1 } else { uses.misses += 1 }
    }

    fn warn(&self, warning: String) {
        lock(&self.warnings).push(warning);
    }

    /// A read's result; one that went wrong is a warning and a miss.
    fn checked<T>(&self, read: Result<Option<T>, store::Unusable>) -> Option<T> {
        read.unwrap_or_else(|e| {
            self.warn(e.to_string());
            None
        })
    }
}

/// A panic elsewhere leaves counters and warnings as good as they were.
fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

#[cfg(test)]
mod tests;
