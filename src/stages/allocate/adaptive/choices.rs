//! What each candidate comes to for a brick, and what is exact of it.

use std::collections::HashMap;

use bytemuck::{Pod, Zeroable};
use rayon::prelude::*;

use super::candidate::{Candidate, PerCandidate};
use super::offers::TexelReference;
use crate::codec::TexelCodec;
use crate::stages::encoder_cache::{Cost, EncoderCache, Trial};
use crate::volume::{SCRATCH_SMALL, Scratch, ScratchFolder, ScratchResult};

/// An L3 record is three words.
pub(super) const RECORD_BITS: u32 = 96;

/// What the candidates come to that have a cost of their own, in squared peaks: half as wide as costs are, since all of a
/// sequence's are looked at in every pass of a search. They serve to choose between candidates; what a chosen one costs is
/// read from the encoders.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Choices {
    /// Over all users and over all the voxels that texels give.
    distortion: [f32; Candidate::WITH_OWN_ERROR],
    /// Over active voxels.
    active_squares: [f32; Candidate::WITH_OWN_ERROR],
    /// How often the brick is used over all frames.
    uses: u32,
    /// How many L3 records it has: one in every run that it is in.
    records: u32,
}

impl Choices {
    /// Nothing costs anything yet.
    pub fn new(uses: u32, records: u32) -> Self {
        Self { uses, records, ..Self::zeroed() }
    }

    /// Notes what a candidate comes to.
    fn set(&mut self, candidate: Candidate, cost: Cost, peak: f64) {
        let Some(i) = candidate.own_error_index() else { return };
        // What is infinite is out of the question, so nothing else may be.
        let narrow = |v: f64| if v.is_infinite() { f32::INFINITY } else { (v as f32).min(f32::MAX) };
        self.distortion[i] = narrow(in_peaks(cost.error_l2, peak) * f64::from(self.uses));
        self.active_squares[i] = narrow(in_peaks(cost.active_error_l2, peak));
    }
}

/// What the candidates come to for one brick, its texel reference among them.
#[derive(Clone, Copy)]
pub(super) struct Weighed<'a> {
    choices: &'a Choices,
    reference: Option<&'a TexelReference>,
    table: &'a Table,
}

impl Weighed<'_> {
    /// How often the brick is used over all frames.
    pub fn uses(&self) -> f64 {
        self.choices.uses.into()
    }

    /// The error in squared peaks, over all users and over all the voxels that the texels give. That of a codec that
    /// was not tried is none.
    pub fn distortion(&self, candidate: Candidate) -> f64 {
        match candidate {
            Candidate::Borrowed => self.reference.map_or(f64::INFINITY, |reference| self.borrowed(reference)),
            candidate => candidate.own_error_index().map_or(0.0, |i| self.choices.distortion[i].into()),
        }
    }

    /// The same with some texel reference.
    pub fn borrowed(&self, reference: &TexelReference) -> f64 {
        in_peaks(reference.error_l2, self.table.peak) * self.uses()
    }

    /// The error for one user, over active voxels.
    pub fn active_squares(&self, candidate: Candidate) -> f64 {
        match candidate {
            Candidate::Borrowed => self
                .reference
                .map_or(f64::INFINITY, |reference| in_peaks(reference.active_error_l2, self.table.peak)),
            candidate => candidate.own_error_index().map_or(0.0, |i| self.choices.active_squares[i].into()),
        }
    }

    /// The bits of the texels and of all records.
    pub fn bits(&self, candidate: Candidate) -> f64 {
        let records = if candidate == Candidate::Empty { 0 } else { self.choices.records };
        self.table.texel_bits[candidate.index()] + f64::from(RECORD_BITS) * f64::from(records)
    }

    /// The candidate with the least D + λR; of equals the one of fewest bits.
    pub fn best(&self, lambda: f64) -> Candidate {
        let (mut best, mut least) = (Candidate::EXACT, f64::INFINITY);
        for candidate in Candidate::ALL {
            let cost = self.distortion(candidate) + lambda * self.bits(candidate);
            if cost < least {
                (best, least) = (candidate, cost);
            }
        }
        best
    }
}

/// An error in squared peaks.
fn in_peaks(error_l2: f64, peak: f64) -> f64 {
    (error_l2 / peak) * (error_l2 / peak)
}

/// Bricks that are looked at together: what a thread reads of the table at a time.
pub(super) const BLOCK: u32 = 1024;

/// What every candidate comes to for every brick. A long sequence's table is in scratch, and passes over it read it anew.
pub(super) struct Table {
    /// What errors are measured against.
    pub peak: f64,
    /// Of each candidate; looked up more than anything else.
    texel_bits: PerCandidate<f64>,
    bricks: u32,
    choices: Scratch,
    /// What bricks borrow, and which of them do.
    texel_references: HashMap<u32, TexelReference>,
    has_reference: Vec<bool>,
}

impl Table {
    /// Of no brick yet.
    pub fn new(scratch: &ScratchFolder, peak: f64) -> Self {
        let choices = Scratch::new(scratch, size_of::<Choices>(), SCRATCH_SMALL);
        let texel_bits = Candidate::ALL.map(|candidate| candidate.texel_bits().into());
        Self {
            peak,
            texel_bits,
            bricks: 0,
            choices,
            texel_references: HashMap::new(),
            has_reference: Vec::new(),
        }
    }

    /// Adds the next bricks, and what the candidates come to for them.
    ///
    /// # Errors
    /// When the scratch file cannot be written.
    pub fn add(&mut self, bricks: impl Iterator<Item = (Choices, PerCandidate<Cost>)>) -> ScratchResult<()> {
        for (mut choices, costs) in bricks {
            Candidate::ALL
                .into_iter()
                .for_each(|candidate| choices.set(candidate, costs[candidate.index()], self.peak));
            self.choices.put(self.bricks, bytemuck::bytes_of(&choices))?;
            self.bricks += 1;
        }
        self.has_reference.resize(self.bricks as usize, false);
        self.choices.flush()
    }

    /// Notes what a candidate comes to for some bricks, ascending.
    ///
    /// # Errors
    /// When the scratch file fails.
    pub fn weigh(&mut self, ids: &[u32], candidate: Candidate, costs: &[Cost]) -> ScratchResult<()> {
        let mut costs = costs.iter();
        self.choices.update(ids, |record| {
            let mut choices: Choices = bytemuck::pod_read_unaligned(record);
            choices.set(candidate, *costs.next().expect("a cost a brick"), self.peak);
            record.copy_from_slice(bytemuck::bytes_of(&choices));
        })
    }

    /// How many bricks there are.
    pub fn len(&self) -> u32 {
        self.bricks
    }

    /// What was noted of some bricks.
    ///
    /// # Errors
    /// When the scratch file cannot be read back.
    pub fn read(&self, ids: &[u32]) -> ScratchResult<Vec<Choices>> {
        self.choices.read_as(ids)
    }

    /// What was noted of a brick and what it borrows.
    pub fn weighed<'a>(&'a self, id: u32, choices: &'a Choices) -> Weighed<'a> {
        Weighed { choices, reference: self.reference(id), table: self }
    }

    /// Looks at every brick, on all cores. Blocks come in order.
    fn blocks<T: Send>(&self, look: impl Fn(&[u32], &[Choices]) -> T + Sync) -> ScratchResult<Vec<T>> {
        let blocks = (0..self.bricks.div_ceil(BLOCK)).into_par_iter();
        let block = |block: u32| {
            let ids: Vec<u32> = (block * BLOCK..(block * BLOCK + BLOCK).min(self.bricks)).collect();
            Ok(look(&ids, &self.read(&ids)?))
        };
        blocks.map(block).collect()
    }

    /// Something of every brick, by its number.
    ///
    /// # Errors
    /// When the scratch file cannot be read back.
    pub fn each<T: Send>(&self, of: impl Fn(u32, Weighed) -> T + Sync) -> ScratchResult<Vec<T>> {
        let look = |ids: &[u32], choices: &[Choices]| -> Vec<T> {
            ids.iter().zip(choices).map(|(&id, choices)| of(id, self.weighed(id, choices))).collect()
        };
        Ok(self.blocks(look)?.into_iter().flatten().collect())
    }

    /// The sum of something over every brick, by the same steps on any number of threads.
    ///
    /// # Errors
    /// When the scratch file cannot be read back.
    pub fn sum(&self, of: impl Fn(u32, Weighed) -> f64 + Sync) -> ScratchResult<f64> {
        let look = |ids: &[u32], choices: &[Choices]| -> f64 {
            ids.iter().zip(choices).map(|(&id, choices)| of(id, self.weighed(id, choices))).sum()
        };
        Ok(self.blocks(look)?.into_iter().sum())
    }

    /// What a brick borrows.
    pub fn reference(&self, id: u32) -> Option<&TexelReference> {
        // Most have none, and a look at a flag is less than one into a map.
        if self.has_reference[id as usize] { self.texel_references.get(&id) } else { None }
    }

    /// Gives a brick a texel reference.
    pub fn add_reference(&mut self, id: u32, reference: TexelReference) {
        self.texel_references.insert(id, reference);
        self.has_reference[id as usize] = true;
    }

    /// Ends all texel references but some.
    pub fn keep_references(&mut self, is_kept: impl Fn(u32, &TexelReference) -> bool) {
        self.texel_references.retain(|&id, reference| is_kept(id, reference));
        self.has_reference.fill(false);
        self.texel_references.keys().for_each(|&id| self.has_reference[id as usize] = true);
    }

    /// Ends all texel references.
    pub fn forget_references(&mut self) {
        self.keep_references(|_, _| false);
    }

    /// All texel references.
    pub fn into_references(self) -> HashMap<u32, TexelReference> {
        self.texel_references
    }
}

/// The bricks that a search has tried each codec on that is [tried on demand](TexelCodec::is_on_demand). A cache may know of
/// more, but what it knows by chance must not lead the search elsewhere.
pub(super) struct OnDemand(Vec<(TexelCodec, Vec<bool>)>);

impl OnDemand {
    /// None yet, of so many bricks.
    pub fn new(bricks: usize) -> Self {
        let codecs = TexelCodec::ALL.into_iter().filter(|codec| codec.is_on_demand());
        Self(codecs.map(|codec| (codec, vec![false; bricks])).collect())
    }

    /// For each of the codecs whether it was tried on each brick.
    pub fn iter(&self) -> impl Iterator<Item = (TexelCodec, &[bool])> {
        self.0.iter().map(|(codec, is_tried)| (*codec, &is_tried[..]))
    }

    /// The same, to note more of them.
    pub fn iter_mut(&mut self) -> impl Iterator<Item = (TexelCodec, &mut [bool])> {
        self.0.iter_mut().map(|(codec, is_tried)| (*codec, &mut is_tried[..]))
    }
}

/// What every brick is tried as before anything is chosen.
pub(super) fn tried_at_once() -> Vec<Trial> {
    let codecs = TexelCodec::ALL.into_iter().filter(|codec| codec.keeps_texels() && !codec.is_on_demand());
    [Trial::WithoutTexels].into_iter().chain(codecs.map(Trial::Texels)).collect()
}

/// What candidates do to some bricks, and [`Candidate::Constant`]'s values. What was not tried costs nothing, and texel
/// references are not among it.
pub(super) fn costs(
    encoders: &EncoderCache,
    ids: &[u32],
    on_demand: &OnDemand,
) -> ScratchResult<Vec<(PerCandidate<Cost>, f32)>> {
    let mut all = Vec::with_capacity(ids.len());
    for plain in encoders.plain(ids)? {
        let mut costs = [Cost::NONE; Candidate::ALL.len()];
        costs[Candidate::Empty.index()] = plain.empty;
        costs[Candidate::Constant.index()] = plain.constant;
        costs[Candidate::Borrowed.index()] = Cost::IMPOSSIBLE;
        for (codec, cost) in TexelCodec::ERROR_ONLY.into_iter().zip(plain.error_only) {
            costs[Candidate::Texels(codec).index()] = cost;
        }
        all.push((costs, plain.value));
    }
    for trial in tried_at_once() {
        let Trial::Texels(codec) = trial else { continue };
        for ((costs, _), cost) in all.iter_mut().zip(encoders.costs(ids, codec)?) {
            costs[Candidate::Texels(codec).index()] = cost;
        }
    }
    for (codec, is_tried) in on_demand.iter() {
        let tried = || (0..ids.len()).filter(|&i| is_tried[ids[i] as usize]);
        let tried_ids: Vec<u32> = tried().map(|i| ids[i]).collect();
        for (i, cost) in tried().zip(encoders.costs(&tried_ids, codec)?) {
            all[i].0[Candidate::Texels(codec).index()] = cost;
        }
    }
    Ok(all)
}
