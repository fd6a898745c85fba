//! What earlier builds made of a frame's bricks, put around the encoder cache and the search.
//!
//! One entry for each batch of bricks and trial. An entry grows: what a later build asks for is added to it, and nothing
//! in it is made again.

use std::collections::BTreeSet;
use std::sync::Arc;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::cache::{Cache, Key, Namespace};
use crate::codec::encoder_isa;
use crate::pods;
use crate::stages::allocate::{EarlierOffers, OfferInputs, Offers};
use crate::stages::dedup::SequenceTree;
use crate::stages::encoder_cache::{Batch, EarlierResults, EncoderCache, Memo, Note, Trial, TrialResults};
use crate::volume::ScratchResult;

/// Entries that a remote is asked for together.
const PREFETCHED: usize = 64;

const ENCODE: Namespace = Namespace { name: "encode", version: 2, travels: false };
const BASE: Namespace = Namespace { name: "batch", version: 1, travels: false };
const OFFERS: Namespace = Namespace { name: "share", version: 2, travels: true };

/// Where the results of one grid's frames are kept.
pub struct GridCache {
    /// The store.
    pub cache: Arc<Cache>,
    /// For each frame of the grid, the key of its frame index.
    pub frames: Vec<Key>,
}

/// The entries of one grid's batches.
pub(super) struct CachedBricks {
    cache: Arc<Cache>,
    /// For each batch what stands for the frame, the batch's place in it and all that its results depend on.
    bases: Arc<[Key]>,
    /// For each batch and trial, whether its entry lacks something.
    is_changed: Vec<[bool; Trial::ALL.len()]>,
}

/// The offers of one grid's batches.
pub(super) struct CachedOffers {
    cache: Arc<Cache>,
    bases: Arc<[Key]>,
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
    made: TrialResults,
}

/// What the cache has of a batch.
struct Found {
    trial: Trial,
    /// Bricks of the pool.
    ids: Vec<u32>,
    made: TrialResults,
}

/// Puts the cache around one grid's encoders, and gives what it has for the search.
pub(super) fn wrap(encoders: &mut EncoderCache, grid: GridCache) -> CachedOffers {
    let GridCache { cache, frames } = grid;
    let range = [encoders.sequence.lo, encoders.sequence.span].map(f32::to_bits);
    let base = |batch: &Batch| {
        // The blocks of intel_tex_2, and what is fitted to them, depend on what the machine can do.
        Key::new(&BASE, &(frames[batch.frame].digest(), batch.part, range, encoders.terms(), encoder_isa()))
    };
    let bases: Arc<[Key]> = encoders.batches().iter().map(base).collect();
    let is_changed = vec![Default::default(); bases.len()];
    encoders.reuse(Box::new(CachedBricks { cache: cache.clone(), bases: bases.clone(), is_changed }));
    CachedOffers { cache, bases }
}

impl CachedBricks {
    fn key(&self, batch: usize, trial: Trial) -> Key {
        // Others are made as fast as a network brings their texels.
        let travels = matches!(trial, Trial::Texels(codec) if codec.is_on_demand());
        Key::new(&Namespace { travels, ..ENCODE }, &(self.bases[batch].digest(), trial))
    }

    fn find(
        &self,
        tree: &SequenceTree,
        batches: &[Batch],
        batch: usize,
        trial: Trial,
    ) -> ScratchResult<Option<Found>> {
        let entry = self.cache.get::<Entry>(&self.key(batch, trial));
        let Some(all) = entry.filter(|entry| entry.is_sound(trial)) else { return Ok(None) };
        let wanted: Vec<u32> = batches[batch].ids.clone().collect();
        let (mut ids, mut places) = (Vec::new(), Vec::new());
        for (&id, active) in wanted.iter().zip(tree.pool.active_hashes(&wanted)?) {
            let found = all.places.binary_search(&tree.pool.place(id)).ok();
            if let Some(i) = found.filter(|&i| all.actives[i] == active) {
                ids.push(id);
                places.push(i);
            }
        }
        if places.len() == all.places.len() {
            return Ok(Some(Found { trial, ids, made: all.made }));
        }
        let mut made = TrialResults::default();
        places.into_iter().for_each(|i| push_from(&mut made, &all.made, i, trial));
        Ok(Some(Found { trial, ids, made }))
    }
}

impl EarlierResults for CachedBricks {
    fn load(
        &mut self,
        memo: &mut Memo,
        tree: &SequenceTree,
        batches: &[Batch],
        wanted: &[(usize, Trial)],
    ) -> ScratchResult<()> {
        let find = |&(batch, trial): &(usize, Trial)| self.find(tree, batches, batch, trial);
        for wanted in wanted.chunks(PREFETCHED) {
            self.cache.prefetch(wanted.iter().map(|&(batch, trial)| self.key(batch, trial)));
            let read = |group: &[(usize, Trial)]| -> ScratchResult<Vec<Option<Found>>> {
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
                    let mut found = found?.into_iter().flatten();
                    found.try_for_each(|Found { trial, ids, made }| memo.add(trial, &ids, &made))
                })?;
                if next.is_none() {
                    break;
                }
                found = later;
            }
        }
        Ok(())
    }

    fn note_made(&mut self, batches: &BTreeSet<usize>, trial: Trial) {
        batches.iter().for_each(|&batch| self.is_changed[batch][trial.index()] = true);
    }

    fn save(&mut self, memo: &Memo, tree: &SequenceTree, batches: &[Batch]) -> ScratchResult<()> {
        for (b, batch) in batches.iter().enumerate() {
            for trial in Trial::ALL {
                if !std::mem::take(&mut self.is_changed[b][trial.index()]) {
                    continue;
                }
                let key = self.key(b, trial);
                let known: Vec<u32> = batch.ids.clone().filter(|&id| memo.is_known(trial, id)).collect();
                let entry = Entry {
                    places: known.iter().map(|&id| tree.pool.place(id)).collect(),
                    actives: tree.pool.active_hashes(&known)?,
                    made: memo.made(trial, &known)?,
                };
                // Another build may have asked for other bricks of the frame.
                let others = self.cache.peek::<Entry>(&key).filter(|entry| entry.is_sound(trial));
                self.cache.put(&key, &entry.union(&others.unwrap_or_default(), trial));
            }
        }
        Ok(())
    }
}

impl CachedOffers {
    fn key(&self, inputs: &OfferInputs) -> Key {
        let OfferInputs { around, batch, borrowers, counts, referenced_bricks } = inputs;
        let bases: Vec<&[u8; 32]> = self.bases[around.clone()].iter().map(Key::digest).collect();
        Key::new(&OFFERS, &(bases, batch, borrowers, counts, referenced_bricks))
    }
}

impl EarlierOffers for CachedOffers {
    fn known(&self, comparisons: &[OfferInputs]) -> Vec<Option<Offers>> {
        let keys: Vec<Key> = comparisons.par_iter().map(|inputs| self.key(inputs)).collect();
        self.cache.prefetch(keys.iter().copied());
        keys.par_iter().map(|key| self.cache.get(key)).collect()
    }

    fn keep(&self, comparison: &OfferInputs, offers: &Offers) {
        self.cache.put(&self.key(comparison), offers);
    }
}

fn push_from(made: &mut TrialResults, other: &TrialResults, i: usize, trial: Trial) {
    made.notes.extend_from_slice(&other.notes[i * trial.notes()..][..trial.notes()]);
    made.texels.extend_from_slice(&other.texels[i * trial.texels()..][..trial.texels()]);
}

impl Entry {
    fn is_sound(&self, trial: Trial) -> bool {
        let TrialResults { notes, texels } = &self.made;
        let count = self.places.len();
        let is_axis = |note: &Note| match trial {
            Trial::WithoutTexels => true,
            Trial::Texels(codec) => {
                u8::try_from(note.word).is_ok_and(|axis| codec.codec().axes().contains(&axis))
            }
        };
        [self.actives.len(), notes.len(), texels.len()]
            == [count, count * trial.notes(), count * trial.texels()]
            && self.places.is_sorted_by(|a, b| a < b)
            && notes.iter().all(is_axis)
    }

    /// What is in either; of what is in both, this one's.
    fn union(self, other: &Self, trial: Trial) -> Self {
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
            push_from(&mut union.made, &entry.made, i, trial);
        }
        union
    }
}
