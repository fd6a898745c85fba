//! Writes entries while the build goes on: a sync takes as long as a disk likes.

use std::fs::File;
use std::io;
use std::sync::mpsc::{SyncSender, sync_channel};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;

use super::lock;
use super::store::{Map, Store};

/// Entries that may wait: a megabyte each at most, so a slow disk slows the build before it fills memory.
const WAITING: usize = 64;
/// Entries that are written at a time. They wait for the disk, not for a core, and a journal syncs many at once.
const THREADS: usize = 2;

pub(super) struct Writer {
    store: Store,
    thread: Mutex<Option<Running>>,
}

struct Running {
    sender: SyncSender<Waiting>,
    threads: Vec<JoinHandle<io::Result<()>>>,
}

struct Waiting {
    map: Map,
    digest: [u8; 32],
    content: Content,
}

/// What is to be written.
pub(super) enum Content {
    Bytes(Vec<u8>),
    /// All of an open file, which may be renamed meanwhile.
    File(File),
}

impl Writer {
    pub fn new(store: Store) -> Self {
        Self { store, thread: Mutex::new(None) }
    }

    /// Takes an entry to be written.
    pub fn write(&self, map: Map, digest: [u8; 32], content: Content) {
        let sender = lock(&self.thread).get_or_insert_with(|| Running::new(&self.store)).sender.clone();
        // A writer that gave up hears of nothing more.
        let _ = sender.send(Waiting { map, digest, content });
    }

    /// Waits until all is written; the first failure, if any.
    pub fn flush(&self) -> Option<io::Error> {
        let Running { sender, threads } = lock(&self.thread).take()?;
        drop(sender);
        let join = |thread: JoinHandle<io::Result<()>>| {
            thread.join().unwrap_or_else(|_| Err(io::Error::other("the writer panicked"))).err()
        };
        // All of them are waited for.
        threads.into_iter().map(join).collect::<Vec<_>>().into_iter().flatten().next()
    }
}

impl Drop for Writer {
    fn drop(&mut self) {
        self.flush();
    }
}

impl Running {
    fn new(store: &Store) -> Self {
        let (sender, receiver) = sync_channel::<Waiting>(WAITING);
        let receiver = Arc::new(Mutex::new(receiver));
        let thread = || {
            let (store, receiver) = (store.clone(), Arc::clone(&receiver));
            let next = move || lock(&receiver).recv().ok();
            std::thread::spawn(move || {
                std::iter::from_fn(next).try_for_each(|w| store.write(w.map, &w.digest, w.content))
            })
        };
        Self { sender, threads: (0..THREADS).map(|_| thread()).collect() }
    }
}
