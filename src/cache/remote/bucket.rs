//! The maps in a bucket of an S3-compatible store, Google Cloud Storage or Azure. It never fails a build: whatever goes
//! wrong is a miss or a dropped write, and is told once.

use std::collections::HashSet;
use std::future::Future;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use futures_util::{StreamExt, stream};
use object_store::Error::{PermissionDenied, Unauthenticated};
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt};
use tokio::runtime::{Builder, Handle, Runtime};
use tokio::sync::{Semaphore, watch};
use tokio::time::error::Elapsed;
use tokio::time::{Instant, timeout, timeout_at};
use url::Url;

use super::connect::{ANSWER_TIMEOUT, cause_of, connect, is_missing};
use super::{Map, Policy, Wanted};
use crate::cache::lock;

/// Failures in a row after which the remote is given up: one may be chance, three are a server that is gone.
const GIVE_UP_AFTER: u32 = 3;
/// The slowest transfer worth waiting for, in bytes per second and object: with all [`CONCURRENT_LOOKUPS`] at once it is a
/// 16 Mbit/s line, below which a remote is of little use.
const SLOWEST_BYTES_PER_SECOND: u64 = 64 << 10;
/// Reads in flight, over all threads: enough to hide a round trip of 100 ms behind 300 answers per second.
const CONCURRENT_LOOKUPS: usize = 32;
/// Uploads in flight: nobody waits for them, so they leave most of the line to the reads.
const CONCURRENT_UPLOADS: usize = 8;
/// Bytes that may wait for their upload; the memory that a slow line may cost.
const QUEUE_BYTES: usize = 64 << 20;
/// How often the end tells what is left.
const REPORT_INTERVAL: Duration = Duration::from_millis(100);
/// What an upload takes of the queue at least, for its own bookkeeping: so tiny entries are bounded, too.
const LEAST_QUEUED_BYTES: usize = 4 << 10;

/// A bucket that several machines share as a cache.
///
/// The bytes come back as the server gave them: checking them is up to the caller. The credentials must allow
/// listing the bucket, since S3 answers "forbidden" instead of "not found" without it.
pub struct Remote {
    /// Gone only while dropping.
    runtime: Option<Runtime>,
    handle: Handle,
    policy: Policy,
    shared: Arc<Shared>,
}

/// What the uploads in the background share with the callers.
struct Shared {
    store: Box<dyn ObjectStore>,
    /// The URL without a password.
    name: String,
    health: watch::Sender<Health>,
    lookups: Semaphore,
    uploads: Semaphore,
    /// The bytes that are free in the queue.
    queue: Arc<Semaphore>,
    /// Entries that were to be written and are not (yet).
    unsent: AtomicU64,
    /// Blobs whose bytes are not what their names say: to be written although they are there.
    distrusted: Mutex<HashSet<[u8; 32]>>,
}

/// How the server has been doing.
#[derive(Default)]
struct Health {
    failures: u64,
    in_a_row: u32,
    last: String,
    /// Why nothing may be written.
    refusal: Option<String>,
    /// Whether giving up, and the refusal, were told.
    told: [bool; 2],
}

impl Health {
    fn given_up(&self) -> bool {
        self.in_a_row >= GIVE_UP_AFTER
    }

    /// Takes in how an attempt ended; whether the remote is given up by that.
    fn note(&mut self, failure: Option<&String>) -> bool {
        match failure {
            // Final: stragglers change nothing.
            _ if self.given_up() => return false,
            None => self.in_a_row = 0,
            Some(failure) => {
                self.failures += 1;
                self.in_a_row += 1;
                self.last.clone_from(failure);
            }
        }
        self.given_up()
    }
}

impl Remote {
    /// Opens the remote at `url`: `s3://bucket/prefix`, `gs://bucket/prefix`, `az://container/prefix` and the like.
    /// Credentials, endpoint and other options are read from the environment (`AWS_*`, `GOOGLE_*`, `AZURE_*`).
    /// Nothing is sent yet, so only a URL or an option that makes no sense is an error.
    pub fn open(url: &str, policy: Policy) -> Result<Self, String> {
        Self::open_with(url, policy, &[])
    }

    /// As [`Remote::open`], with options that override the environment, named as there but in lower case.
    pub fn open_with(url: &str, policy: Policy, options: &[(&str, &str)]) -> Result<Self, String> {
        let url = Url::parse(url).map_err(|error| format!("the remote cache's URL: {error}"))?;
        let mut name = url.clone();
        // Fails only for URLs without a host, which are refused below.
        let _ = name.set_password(None);
        name.set_query(None);
        let refused = |error: String| format!("the remote cache {name}: {error}");
        let store = connect(&url, options).map_err(refused)?;
        // Two threads: what takes time on them is TLS and hashing, and the cores are the build's.
        let runtime = Builder::new_multi_thread().worker_threads(2).enable_all().build();
        let runtime = runtime.map_err(|error| refused(error.to_string()))?;
        let shared = Shared {
            store,
            name: name.to_string(),
            health: watch::Sender::default(),
            lookups: Semaphore::new(CONCURRENT_LOOKUPS),
            uploads: Semaphore::new(CONCURRENT_UPLOADS),
            queue: Arc::new(Semaphore::new(QUEUE_BYTES)),
            unsent: AtomicU64::new(0),
            distrusted: Mutex::default(),
        };
        Ok(Self {
            handle: runtime.handle().clone(),
            runtime: Some(runtime),
            policy,
            shared: Arc::new(shared),
        })
    }

    /// Looks up many entries at once. The answers are in the same order; `None` is what is not there, is longer than
    /// its limit, or could not be had. Not to be called from asynchronous code.
    pub fn get_many(&self, map: Map, wanted: &[Wanted]) -> Vec<Option<Vec<u8>>> {
        let shared = &*self.shared;
        let lookup = |wanted: &Wanted| {
            let (path, limit) = (object_path(map, &wanted.digest), wanted.limit);
            async move { shared.attempt(&shared.lookups, shared.download(&path, limit)).await.flatten() }
        };
        self.handle.block_on(stream::iter(wanted).map(lookup).buffered(CONCURRENT_LOOKUPS).collect())
    }

    /// Says that a blob's bytes are not what its name says, so that it is written once more although it is there.
    pub fn distrust(&self, digest: [u8; 32]) {
        lock(&self.shared.distrusted).insert(digest);
    }

    /// Whether entries are uploaded at all.
    pub fn is_written(&self) -> bool {
        let health = self.shared.health.borrow();
        self.policy == Policy::ReadWrite && health.refusal.is_none()
    }

    /// Queues a write and returns at once. It is dropped if the remote may only be read or was given up, or if more
    /// than 64 MiB would be waiting.
    pub fn put(&self, map: Map, digest: [u8; 32], bytes: Vec<u8>) {
        if !self.is_written() {
            return;
        }
        self.shared.unsent.fetch_add(1, Ordering::Relaxed);
        // An entry longer than the queue takes all of it, rather than never being uploaded.
        let size = bytes.len().clamp(LEAST_QUEUED_BYTES, QUEUE_BYTES) as u32;
        let Ok(room) = self.shared.queue.clone().try_acquire_many_owned(size) else { return };
        let shared = self.shared.clone();
        self.handle.spawn(async move {
            let upload = shared.upload(map, digest, bytes);
            if shared.attempt(&shared.uploads, upload).await.is_some() {
                shared.unsent.fetch_sub(1, Ordering::Relaxed);
            }
            drop(room);
        });
    }

    /// Entries that were to be written and may still be.
    pub fn waiting(&self) -> u64 {
        if self.shared.health.borrow().given_up() { 0 } else { self.unsent() }
    }

    fn unsent(&self) -> u64 {
        self.shared.unsent.load(Ordering::Relaxed)
    }

    /// What went wrong since the last time, one line each.
    pub fn warnings(&self) -> Vec<String> {
        let name = &self.shared.name;
        let mut lines = Vec::new();
        self.shared.health.send_if_modified(|health| {
            let given_up = health.given_up();
            if given_up && !health.told[0] {
                lines.push(format!(
                    "the remote cache {name} was given up after {} failures in a row: {}",
                    health.in_a_row, health.last
                ));
            } else if !given_up && health.failures > 0 {
                lines.push(format!(
                    "{} requests to the remote cache {name} failed, the last one: {}",
                    health.failures, health.last
                ));
            }
            if let Some(refusal) = health.refusal.as_ref().filter(|_| !health.told[1]) {
                lines.push(format!(
                    "the remote cache {name} may not be written (--remote-policy read does not try to): {refusal}"
                ));
            }
            health.failures = 0;
            health.told = [given_up, health.refusal.is_some()];
            // Nobody needs to be woken for it.
            false
        });
        lines
    }

    /// Waits for the queued writes, but not longer than `at_most`: tells now and then how many are left, and goes on
    /// while the answer is true. Gives what went wrong since the last time, one line each.
    pub fn finish(&self, at_most: Duration, mut left: impl FnMut(u64) -> bool) -> Vec<String> {
        let shared = &*self.shared;
        self.handle.block_on(async {
            let end = Instant::now() + at_most;
            // The queue is empty when all of it can be had. When the time is over, what waits stays unsent.
            let empty = shared.queue.acquire_many(QUEUE_BYTES as u32);
            tokio::pin!(empty);
            while Instant::now() < end {
                let step = end.min(Instant::now() + REPORT_INTERVAL);
                if timeout_at(step, &mut empty).await.is_ok() || !left(self.unsent()) {
                    break;
                }
            }
        });
        let mut lines = self.warnings();
        let unsent = self.unsent();
        if unsent > 0 && self.is_written() {
            lines.push(format!("{unsent} entries were not uploaded to the remote cache {}", shared.name));
        }
        lines
    }
}

impl Drop for Remote {
    fn drop(&mut self) {
        // Not waiting for what is in flight: a build that is over must not hang on its cache.
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}

impl Shared {
    /// Does `work` once one of `slots` is free. `None` if it failed or the remote is given up, even if that happens
    /// in the middle of it.
    async fn attempt<T, W>(&self, slots: &Semaphore, work: W) -> Option<T>
    where
        W: Future<Output = Result<T, String>>,
    {
        let mut health = self.health.subscribe();
        let result = tokio::select! {
            biased;
            _ = health.wait_for(Health::given_up) => return None,
            result = async {
                let _slot = slots.acquire().await;
                work.await
            } => result,
        };
        self.health.send_if_modified(|health| health.note(result.as_ref().err()));
        result.ok()
    }

    /// How long the next answer may take.
    fn answer_timeout(&self) -> Duration {
        ANSWER_TIMEOUT / (1 << self.health.borrow().in_a_row)
    }

    /// The bytes at `path`; `None` if there are none or more than `limit`.
    async fn download(&self, path: &Path, limit: u64) -> Result<Option<Vec<u8>>, String> {
        let answer_timeout = self.answer_timeout();
        let started = Instant::now();
        let object = match timeout(answer_timeout, self.store.get(path)).await.map_err(no_answer)? {
            Ok(object) if object.meta.size <= limit => object,
            Ok(_) => return Ok(None),
            Err(error) if is_missing(&error) => return Ok(None),
            Err(error) => return Err(cause_of(error)),
        };
        let mut bytes = Vec::new();
        let mut chunks = object.into_stream();
        loop {
            // Bytes buy time at the slowest rate, but never more than that timeout at once: so neither a server
            // that stalls nor one that drips is waited for.
            let deadline =
                (started + answer_timeout + transfer_time(bytes.len())).min(Instant::now() + answer_timeout);
            match timeout_at(deadline, chunks.next()).await.map_err(no_answer)? {
                None => return Ok(Some(bytes)),
                Some(chunk) => bytes.extend_from_slice(&chunk.map_err(cause_of)?),
            }
            // Whatever the server said of its length.
            if bytes.len() as u64 > limit {
                return Ok(None);
            }
        }
    }

    async fn upload(&self, map: Map, digest: [u8; 32], bytes: Vec<u8>) -> Result<(), String> {
        let path = object_path(map, &digest);
        let is_replaced = map == Map::Actions || lock(&self.distrusted).contains(&digest);
        let deadline = self.answer_timeout() + transfer_time(bytes.len());
        let work = async {
            // A blob's name is its content, so one of the right length is the same. This asks first, since a
            // conditional write would send the bytes before it is refused, and not every server knows it.
            if !is_replaced {
                match self.store.head(&path).await {
                    Ok(there) if there.size == bytes.len() as u64 => return Ok(()),
                    Err(error) if !is_missing(&error) => return Err(error),
                    _ => {}
                }
            }
            self.store.put(&path, bytes.into()).await.map(drop)
        };
        match timeout(deadline, work).await.map_err(no_answer)? {
            // Credentials that may only read are no failure of the server: lookups go on.
            Err(error @ (PermissionDenied { .. } | Unauthenticated { .. })) => {
                self.health.send_modify(|health| health.refusal = Some(cause_of(error)));
                Ok(())
            }
            result => result.map_err(cause_of),
        }
    }
}

/// How long `bytes` take at the slowest rate.
fn transfer_time(bytes: usize) -> Duration {
    Duration::from_millis(bytes as u64 * 1000 / SLOWEST_BYTES_PER_SECOND)
}

/// Where an entry is below the prefix: as on disk.
fn object_path(map: Map, digest: &[u8; 32]) -> Path {
    let hex = blake3::Hash::from(*digest).to_hex();
    Path::from(format!("{}/{}/{}", map.folder(), &hex[..2], &hex[2..]))
}

fn no_answer(_: Elapsed) -> String {
    "no answer, or too slow a one".into()
}
