//! Writes entries while the build goes on: a sync takes as long as a disk likes.

use std::fs::File;
use std::io;
use std::sync::mpsc::{SyncSender, sync_channel};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;

use super::lock;
use super::store::{Map, Store};

/// Entries that may wait, so that a slow disk slows the build before it fills memory: these many of that many bytes.
const WAITING: usize = 64;
/// Larger ones, such as the frame indices of very large frames, are waited for.
const LARGE: usize = 4 << 20;
/// Entries that are written at a time. They wait for the disk, not for a core, and a journal syncs many at once.
const THREADS: usize = 2;

pub(super) struct Writer {
    store: Store,
    threads: Mutex<Option<Running>>,
    /// The first failure: nothing is lost with an entry but time, so the others are written all the same.
    failed: Arc<Mutex<Option<io::Error>>>,
}

struct Running {
    sender: SyncSender<Waiting>,
    handles: Vec<JoinHandle<()>>,
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
        Self { store, threads: Mutex::default(), failed: Arc::default() }
    }

    /// Takes an entry to be written.
    pub fn write(&self, map: Map, digest: [u8; 32], content: Content) {
        let waiting = Waiting { map, digest, content };
        if matches!(&waiting.content, Content::Bytes(bytes) if bytes.len() > LARGE) {
            return waiting.write(&self.store, &self.failed);
        }
        let sender = lock(&self.threads).get_or_insert_with(|| self.start()).sender.clone();
        // The threads end after the last sender, so someone takes it.
        let _ = sender.send(waiting);
    }

    fn start(&self) -> Running {
        let (sender, receiver) = sync_channel::<Waiting>(WAITING);
        let receiver = Arc::new(Mutex::new(receiver));
        let thread = || {
            let (store, receiver, failed) =
                (self.store.clone(), Arc::clone(&receiver), Arc::clone(&self.failed));
            let next = move || lock(&receiver).recv().ok();
            std::thread::spawn(move || std::iter::from_fn(next).for_each(|w| w.write(&store, &failed)))
        };
        Running { sender, handles: (0..THREADS).map(|_| thread()).collect() }
    }

    /// Waits until all is written; the first failure since the last time, if any.
    pub fn flush(&self) -> Option<io::Error> {
        if let Some(Running { sender, handles }) = lock(&self.threads).take() {
            drop(sender);
            // A thread that panicked has said so, and cost no more than entries.
            handles.into_iter().for_each(|handle| drop(handle.join()));
        }
        lock(&self.failed).take()
    }
}

impl Drop for Writer {
    fn drop(&mut self) {
        self.flush();
    }
}

impl Waiting {
    fn write(self, store: &Store, failed: &Mutex<Option<io::Error>>) {
        let written = match self.content {
            Content::Bytes(bytes) => store.write(self.map, &self.digest, &bytes),
            Content::File(file) => store.write_file(self.map, &self.digest, file),
        };
        if let Err(e) = written {
            lock(failed).get_or_insert(e);
        }
    }
}
