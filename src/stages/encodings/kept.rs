//! What was made of bricks: where it lies in memory, the rest in scratch files.

use std::io;

use bytemuck::{Pod, Zeroable};

use super::Cost;
use crate::volume::Scratch;

/// A [`Cost`], and something more of what it is the cost of.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Note {
    norm: f64,
    active_norm: f64,
    max: f32,
    pub word: u32,
}

impl Note {
    pub fn new(cost: Cost, word: u32) -> Self {
        Self { norm: cost.norm, active_norm: cost.active_norm, max: cost.max, word }
    }

    pub fn cost(&self) -> Cost {
        Cost { norm: self.norm, active_norm: self.active_norm, max: self.max }
    }
}

/// One kind of result for the bricks of a pool, each once: `N` notes a brick, and texels.
pub(super) struct Kept<const N: usize> {
    /// By brick of the pool: its place among those that are kept. They lie in the order in which they came, since BC7
    /// is kept for some bricks of a frame only, and writes with gaps between them are slow.
    places: Vec<u32>,
    /// How many are kept.
    count: u32,
    notes: Scratch,
    texels: Option<Scratch>,
}

const NOWHERE: u32 = u32::MAX;

impl<const N: usize> Kept<N> {
    /// Nothing yet, of a pool of that many bricks, with that many bytes of texels each.
    pub fn new(texels: usize) -> Self {
        let texels = (texels > 0).then(|| Scratch::new(texels));
        Self { places: Vec::new(), count: 0, notes: Scratch::new(N * size_of::<Note>()), texels }
    }

    pub fn is_known(&self, id: u32) -> bool {
        self.places.get(id as usize).is_some_and(|&place| place != NOWHERE)
    }

    /// Keeps what was made of some bricks of a pool of `bricks`.
    pub fn add(&mut self, bricks: usize, ids: &[u32], notes: &[[Note; N]], texels: &[u8]) -> io::Result<()> {
        // None are kept of a kind that nobody asks for.
        self.places.resize(bricks, NOWHERE);
        for (&id, place) in ids.iter().zip(self.count..) {
            self.places[id as usize] = place;
        }
        self.notes.put(self.count, bytemuck::cast_slice(notes.as_flattened()))?;
        if let Some(scratch) = &mut self.texels {
            scratch.put(self.count, texels)?;
        }
        self.count += ids.len() as u32;
        Ok(())
    }

    /// Sees to it that what was added can be read.
    pub fn flush(&mut self) -> io::Result<()> {
        self.notes.flush()?;
        self.texels.as_mut().map_or(Ok(()), Scratch::flush)
    }

    fn places(&self, ids: &[u32]) -> Vec<u32> {
        ids.iter().map(|&id| self.places[id as usize]).collect()
    }

    /// The notes of bricks that are known.
    pub fn notes(&self, ids: &[u32]) -> io::Result<Vec<[Note; N]>> {
        let mut notes = Vec::with_capacity(ids.len());
        self.notes.read(&self.places(ids), |record| {
            let mut each = [Note::zeroed(); N];
            bytemuck::cast_slice_mut(&mut each).copy_from_slice(record);
            notes.push(each);
        })?;
        Ok(notes)
    }

    /// The texels of bricks that are known, one after another.
    pub fn texels(&self, ids: &[u32]) -> io::Result<Vec<u8>> {
        let mut texels = Vec::new();
        if let Some(scratch) = &self.texels {
            texels.reserve(ids.len() * scratch.record());
            scratch.read(&self.places(ids), |record| texels.extend_from_slice(record))?;
        }
        Ok(texels)
    }
}
