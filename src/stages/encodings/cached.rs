//! What earlier builds made of a frame's bricks.
//!
//! One entry for each batch (a frame's bricks, at most [`BATCH_BRICKS`] of them) and kind. An entry grows: what a later
//! build asks for is added to it, and nothing in it is made again.

use std::collections::BTreeSet;
use std::io;
use std::ops::Range;
use std::sync::Arc;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::{Encodings, KeptCodec, Kind, Made, Note, Terms};
use crate::cache::{Cache, Key, Stage, pods};
use crate::codec::{SequenceRange, encoder_isa};
use crate::stages::dedup::SequenceTree;

/// Bricks of a batch: with 512 bytes of texels each, an entry of a megabyte.
pub const BATCH_BRICKS: u32 = 2048;

/// Entries that a remote is asked for together.
const PREFETCHED: usize = 64;

const STAGE: Stage = Stage { name: "encode", version: 2, travels: false };
const BASE: Stage = Stage { name: "batch", version: 1, travels: false };

/// Where the results of one grid's frames are kept.
#[derive(Clone)]
pub struct GridCache {
    /// The store.
    pub cache: Arc<Cache>,
    /// For each frame of the grid, the key of its frame index.
    pub frames: Vec<Key>,
}

/// Some bricks of one frame.
pub struct Batch {
    /// What stands for the frame, the batch's place in it and all that its encodings depend on; `None` where nothing is
    /// cached.
    pub base: Option<Key>,
    /// The bricks of the pool that the frame had first and that are in this part of it.
    pub ids: Range<u32>,
    /// Whether the entries of each kind were looked for, and whether they lack something.
    states: [State; Kind::ALL.len()],
}

#[derive(Clone, Copy, Default)]
struct State {
    is_loaded: bool,
    is_changed: bool,
}

/// The batches of a grid, in the order of its pool.
pub(super) struct Batches {
    pub all: Vec<Batch>,
    cache: Option<GridCache>,
}

/// What lies in the cache: bricks by their places in the frame, ascending.
#[derive(Default, Serialize, Deserialize)]
struct Entry {
    #[serde(with = "pods")]
    places: Vec<u32>,
    /// Hashes of their active masks: a brick without a mask of its own stands for bricks of other frames too, and what
    /// is active in any of them counts.
    #[serde(with = "pods")]
    actives: Vec<u64>,
    made: Made,
}

/// What the cache has of a batch.
struct Found {
    kind: Kind,
    /// Bricks of the pool.
    ids: Vec<u32>,
    made: Made,
}

impl Batch {
    fn key(&self, kind: Kind) -> Option<Key> {
        // The other codecs are made as fast as a network brings their texels.
        let stage = Stage { travels: kind == Kind::Texels(KeptCodec::Bc7), ..STAGE };
        self.base.map(|base| Key::new(&stage, &(base.digest(), kind)))
    }

    fn find(&self, tree: &SequenceTree, cache: &Cache, kind: Kind) -> io::Result<Option<Found>> {
        let entry = self.key(kind).and_then(|key| cache.get::<Entry>(&key));
        let Some(all) = entry.filter(|entry| entry.is_sound(kind)) else { return Ok(None) };
        let wanted: Vec<u32> = self.ids.clone().collect();
        let (mut ids, mut places) = (Vec::new(), Vec::new());
        for (&id, active) in wanted.iter().zip(tree.pool.active_hashes(&wanted)?) {
            let found = all.places.binary_search(&tree.pool.place(id)).ok();
            if let Some(i) = found.filter(|&i| all.actives[i] == active) {
                ids.push(id);
                places.push(i);
            }
        }
        if places.len() == all.places.len() {
            return Ok(Some(Found { kind, ids, made: all.made }));
        }
        let mut made = Made::default();
        places.into_iter().for_each(|i| made.push_from(&all.made, i, kind));
        Ok(Some(Found { kind, ids, made }))
    }
}

impl Batches {
    pub fn new(
        tree: &SequenceTree,
        cache: Option<GridCache>,
        sequence: &SequenceRange,
        terms: &Terms,
    ) -> Self {
        let mut all = Vec::new();
        for (frame, own) in tree.own_bricks.iter().enumerate() {
            let own: Vec<u32> = own.clone().collect();
            let part = |id: &u32| tree.pool.place(*id) / BATCH_BRICKS;
            for ids in own.chunk_by(|a, b| part(a) == part(b)) {
                let base = cache.as_ref().map(|cache| {
                    let frame_index = cache.frames[frame].digest();
                    let range = [sequence.lo, sequence.span].map(f32::to_bits);
                    // The blocks of intel_tex_2, and what is fitted to them, depend on what the machine can do.
                    Key::new(&BASE, &(frame_index, part(&ids[0]), range, terms, encoder_isa()))
                });
                all.push(Batch { base, ids: ids[0]..ids[ids.len() - 1] + 1, states: Default::default() });
            }
        }
        Self { all, cache }
    }

    /// The batches that some bricks, ascending, are in.
    fn of(&self, ids: &[u32]) -> BTreeSet<usize> {
        ids.iter().map(|id| self.all.partition_point(|batch| batch.ids.end <= *id)).collect()
    }

    /// Notes that bricks were made that the cache does not have.
    pub fn mark(&mut self, ids: &[u32], kind: Kind) {
        if self.cache.is_some() {
            self.of(ids).into_iter().for_each(|b| self.all[b].states[kind.index()].is_changed = true);
        }
    }
}

impl Made {
    fn push_from(&mut self, other: &Self, i: usize, kind: Kind) {
        self.notes.extend_from_slice(&other.notes[i * kind.notes()..][..kind.notes()]);
        self.texels.extend_from_slice(&other.texels[i * kind.texels()..][..kind.texels()]);
    }
}

impl Entry {
    fn is_sound(&self, kind: Kind) -> bool {
        let Made { notes, texels } = &self.made;
        let count = self.places.len();
        let is_axis = |note: &Note| match kind {
            Kind::Plain => true,
            Kind::Texels(KeptCodec::Bc7) => note.word <= 2,
            Kind::Texels(_) => note.word == 2,
        };
        [self.actives.len(), notes.len(), texels.len()]
            == [count, count * kind.notes(), count * kind.texels()]
            && self.places.is_sorted_by(|a, b| a < b)
            && notes.iter().all(is_axis)
    }

    /// What is in either; of what is in both, this one's.
    fn union(self, other: &Self, kind: Kind) -> Self {
        let of = |entry| move |(i, &place): (usize, &u32)| (place, entry, i);
        let (own, others) = (self.places.iter().enumerate(), other.places.iter().enumerate());
        let mut all: Vec<(u32, &Self, usize)> = own.map(of(&self)).chain(others.map(of(other))).collect();
        // Stable: of two for one place, this one's is the first.
        all.sort_by_key(|(place, ..)| *place);
        all.dedup_by_key(|(place, ..)| *place);
        let mut union = Self::default();
        for (place, entry, i) in all {
            union.places.push(place);
            union.actives.push(entry.actives[i]);
            union.made.push_from(&entry.made, i, kind);
        }
        union
    }
}

impl Encodings {
    /// The cache, if there is one.
    pub fn cache(&self) -> Option<&Cache> {
        self.batches.cache.as_ref().map(|c| &*c.cache)
    }

    /// The parts in which bricks are cached, in the order of the pool.
    pub fn batches(&self) -> &[Batch] {
        &self.batches.all
    }

    /// Takes from the cache what it has of the batches that some bricks, ascending, are in.
    pub(super) fn load(&mut self, tree: &SequenceTree, ids: &[u32], kinds: &[Kind]) -> io::Result<()> {
        let Some(GridCache { cache, .. }) = self.batches.cache.clone() else { return Ok(()) };
        let mut wanted = Vec::new();
        for batch in self.batches.of(ids) {
            for &kind in kinds {
                let state = &mut self.batches.all[batch].states[kind.index()];
                if !std::mem::replace(&mut state.is_loaded, true) {
                    wanted.push((batch, kind));
                }
            }
        }
        let Self { batches, kept, rules, .. } = self;
        let batches = &batches.all;
        let key = |&(batch, kind): &(usize, Kind)| batches[batch].key(kind);
        let find = |&(batch, kind): &(usize, Kind)| batches[batch].find(tree, &cache, kind);
        for wanted in wanted.chunks(PREFETCHED) {
            cache.prefetch(wanted.iter().filter_map(key));
            let read = |group: &[(usize, Kind)]| -> io::Result<Vec<Option<Found>>> {
                group.par_iter().map(find).collect()
            };
            let mut groups = wanted.chunks(2 * rayon::current_num_threads());
            let mut found = read(groups.next().unwrap_or_default());
            loop {
                // The next ones are read while these are put away.
                let (next, mut later) = (groups.next(), Ok(Vec::new()));
                rayon::in_place_scope(|scope| {
                    let later = &mut later;
                    if let Some(next) = next {
                        scope.spawn(move |_| *later = read(next));
                    }
                    found?.into_iter().flatten().try_for_each(|Found { kind, ids, made }| {
                        kept[kind.index()].add(rules.len(), &ids, &made)
                    })
                })?;
                if next.is_none() {
                    break;
                }
                found = later;
            }
        }
        self.flush()
    }

    /// Keeps what was made and the cache does not have yet.
    ///
    /// # Errors
    /// When the scratch file cannot be read back.
    pub fn save(&mut self, tree: &SequenceTree) -> io::Result<()> {
        let Some(GridCache { cache, .. }) = self.batches.cache.clone() else { return Ok(()) };
        for b in 0..self.batches.all.len() {
            for kind in Kind::ALL {
                let batch = &mut self.batches.all[b];
                if !std::mem::take(&mut batch.states[kind.index()].is_changed) {
                    continue;
                }
                let (ids, key) = (batch.ids.clone(), batch.key(kind).expect("what is cached has a key"));
                let known: Vec<u32> = ids.filter(|&id| self.kept(kind).is_known(id)).collect();
                let entry = self.entry(tree, &known, kind)?;
                // Another build may have asked for other bricks of the frame.
                let others = cache.peek::<Entry>(&key).filter(|entry| entry.is_sound(kind));
                cache.put(&key, &entry.union(&others.unwrap_or_default(), kind));
            }
        }
        self.saved = std::time::Instant::now();
        Ok(())
    }

    fn entry(&self, tree: &SequenceTree, ids: &[u32], kind: Kind) -> io::Result<Entry> {
        let kept = self.kept(kind);
        Ok(Entry {
            places: ids.iter().map(|&id| tree.pool.place(id)).collect(),
            actives: tree.pool.active_hashes(ids)?,
            made: Made { notes: kept.notes(ids)?, texels: kept.texels(ids)? },
        })
    }
}
