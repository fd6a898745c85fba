//! Writes entries while the build goes on: a sync takes as long as a disk likes.

use std::io;
use std::sync::Mutex;
use std::sync::mpsc::{SyncSender, sync_channel};
use std::thread::JoinHandle;

use super::lock;
use super::store::{Map, Store};

/// Entries that may wait: a few megabytes each at most, so a slow disk slows the build before it fills memory.
const WAITING: usize = 16;

pub(super) struct Writer {
    store: Store,
    thread: Mutex<Option<Running>>,
}

struct Running {
    sender: SyncSender<Waiting>,
    handle: JoinHandle<io::Result<()>>,
}

struct Waiting {
    map: Map,
    digest: [u8; 32],
    bytes: Vec<u8>,
}

impl Writer {
    pub fn new(store: Store) -> Self {
        Self { store, thread: Mutex::new(None) }
    }

    /// Takes an entry to be written, in the order of the calls.
    pub fn write(&self, map: Map, digest: [u8; 32], bytes: Vec<u8>) {
        let sender =
            lock(&self.thread).get_or_insert_with(|| Running::new(self.store.clone())).sender.clone();
        // A writer that gave up hears of nothing more.
        let _ = sender.send(Waiting { map, digest, bytes });
    }

    /// Waits until all is written; the first failure, if any.
    pub fn flush(&self) -> Option<io::Error> {
        let Running { sender, handle } = lock(&self.thread).take()?;
        drop(sender);
        handle.join().unwrap_or_else(|_| Err(io::Error::other("the writer panicked"))).err()
    }
}

impl Drop for Writer {
    fn drop(&mut self) {
        self.flush();
    }
}

impl Running {
    fn new(store: Store) -> Self {
        let (sender, receiver) = sync_channel::<Waiting>(WAITING);
        let write = move || receiver.iter().try_for_each(|w| store.write(w.map, &w.digest, &w.bytes));
        Self { sender, handle: std::thread::spawn(write) }
    }
}
