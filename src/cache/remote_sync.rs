//! What the store lacks and a remote may have, and what goes there.

use std::time::Duration;

use rayon::prelude::*;

use super::remote::{Map, Remote, Wanted};
use super::store::{ACTION_BYTES, Entry};
use super::{Blob, Cache, Key, lock};

/// Bytes of an entry that may travel: it is in memory while it does.
const MOST: u64 = 256 << 20;
/// Bytes of blobs that are fetched at a time, at most but for a single larger one.
const GROUP: u64 = 64 << 20;
/// Uploads that are waited for at the end of a run: 35 MB on a line of 10 Mbit/s.
const UPLOADS_MAY_TAKE: Duration = Duration::from_secs(30);

/// Whether a blob is small enough for a remote.
fn may_travel(blob: &Blob) -> bool {
    blob.bytes <= MOST
}

impl Cache {
    /// Looks up in a remote what is not in the store, and sends it what is made.
    pub fn with_remote(mut self, remote: Remote) -> Self {
        self.remote = Some(remote);
        self
    }

    /// Brings what stages gave for some inputs into the store, as far as a remote has it. Asking for many at once takes
    /// as long as for one.
    pub fn prefetch(&self, keys: impl IntoIterator<Item = Key>) {
        if self.remote.is_none() {
            return;
        }
        let (known, unknown): (Vec<_>, Vec<_>) = keys
            .into_iter()
            .filter(Key::travels)
            .map(|key| (key, self.checked(self.store.read_action(&key))))
            .partition(|(_, e)| e.is_some());
        let unknown: Vec<Key> = unknown.into_iter().map(|(key, _)| key).collect();
        let fetched = self.fetch_actions(&unknown);
        let mut blobs: Vec<Blob> =
            known.into_iter().filter_map(|(_, entry)| entry).chain(fetched).map(|entry| entry.blob).collect();
        blobs.retain(|blob| !self.store.has_blob(blob));
        blobs.sort_by_key(|blob| blob.digest);
        blobs.dedup();
        while !blobs.is_empty() {
            let mut bytes = 0;
            let fits = |blob: &&Blob| {
                bytes += blob.bytes;
                bytes <= GROUP
            };
            let group = blobs.iter().take_while(fits).count().max(1);
            self.fetch_blobs(&blobs.drain(..group).collect::<Vec<_>>());
        }
    }

    /// Waits for uploads, but not forever: tells now and then how many are left, and goes on while the answer is true.
    /// Gives what is to be told since the last time.
    pub fn finish(&self, left: impl FnMut(u64) -> bool) -> Vec<String> {
        self.remote.as_ref().map(|remote| remote.finish(UPLOADS_MAY_TAKE, left)).unwrap_or_default()
    }

    /// Entries on their way to the remote.
    pub fn waiting(&self) -> u64 {
        self.remote.as_ref().map_or(0, Remote::waiting)
    }

    /// The action of a key, if the remote has it.
    pub(super) fn fetch_action(&self, key: &Key) -> Option<Entry> {
        if key.travels() { self.fetch_actions(&[*key]).pop() } else { None }
    }

    /// The actions of those keys, which travel, that the remote has.
    fn fetch_actions(&self, keys: &[Key]) -> Vec<Entry> {
        let wanted = |key: &Key| Wanted { digest: *key.digest(), limit: ACTION_BYTES as u64 };
        let fetched = self.fetch(Map::Actions, keys, wanted, Entry::of);
        fetched.into_iter().map(|(entry, _)| entry).collect()
    }

    /// A blob's bytes, if the remote has them.
    pub(super) fn fetch_blob(&self, blob: &Blob) -> Option<Vec<u8>> {
        self.fetch_blobs(&[*blob]).pop().map(|((), bytes)| bytes)
    }

    /// Those blobs that the remote has.
    fn fetch_blobs(&self, blobs: &[Blob]) -> Vec<((), Vec<u8>)> {
        let blobs: Vec<Blob> = blobs.iter().filter(|blob| may_travel(blob)).copied().collect();
        let wanted = |blob: &Blob| Wanted { digest: blob.digest, limit: blob.bytes };
        self.fetch(Map::Blobs, &blobs, wanted, Blob::check)
    }

    /// Looks up what is not known to be absent, checks it and keeps it in the store.
    fn fetch<N: Sync, T: Send>(
        &self,
        map: Map,
        names: &[N],
        wanted: impl Fn(&N) -> Wanted,
        check: impl Fn(&N, &[u8]) -> Result<T, &'static str> + Sync,
    ) -> Vec<(T, Vec<u8>)> {
        let Some(remote) = &self.remote else { return Vec::new() };
        let asked = names.iter().map(|name| (name, wanted(name)));
        let (names, asked): (Vec<&N>, Vec<Wanted>) =
            asked.filter(|(_, wanted)| !lock(&self.absent).contains(&(map, wanted.digest))).unzip();
        let answers = remote.get_many(map, &asked);
        let keep = |((name, wanted), answer): ((&&N, &Wanted), Option<Vec<u8>>)| {
            let checked = answer.map(|bytes| check(name, &bytes).map(|value| (value, bytes))).transpose();
            let checked = checked.unwrap_or_else(|why| {
                remote.distrust(wanted.digest);
                let name = blake3::Hash::from(wanted.digest).to_hex();
                let entry = format!("{}/{name} of the remote cache", map.folder());
                self.warn(format!("{entry} cannot be used, it is made anew: {why}"));
                None
            });
            match &checked {
                None => {
                    lock(&self.absent).insert((map, wanted.digest));
                }
                Some((_, bytes)) => {
                    if let Err(e) = self.store.write(map, &wanted.digest, bytes) {
                        self.warn(self.cannot_be_written(&e));
                    }
                }
            }
            checked
        };
        names.par_iter().zip(&asked).zip(answers).filter_map(keep).collect()
    }

    /// Sends a part of an entry to the remote, if that takes any: the action, or the blob.
    pub(super) fn upload(&self, key: &Key, blob: &Blob, map: Map, bytes: impl FnOnce() -> Option<Vec<u8>>) {
        let is_wanted = |remote: &&Remote| key.travels() && may_travel(blob) && remote.is_written();
        if let Some(remote) = self.remote.as_ref().filter(is_wanted)
            && let Some(bytes) = bytes()
        {
            let digest = if map == Map::Actions { *key.digest() } else { blob.digest };
            remote.put(map, digest, bytes);
        }
    }
}
