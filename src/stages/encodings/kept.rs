//! Texels in a scratch file, their costs in memory.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom, Write};

use super::Cost;
use crate::codec::Codec;

/// Bytes between two bricks that are read through rather than skipped: a call to the system costs about as much.
const GAP: u64 = 16 << 10;

/// One codec's texels of the bricks of a pool, each once.
pub(super) struct KeptTexels {
    size: u64,
    file: Option<File>,
    /// By brick of the pool: its place among the texels that were kept, and what they cost.
    known: Vec<Option<(u32, Cost)>>,
    /// In the order in which they were kept.
    axes: Vec<u8>,
}

impl KeptTexels {
    pub fn new(codec: Codec) -> Self {
        Self { size: codec.layout().brick_bytes() as u64, file: None, known: Vec::new(), axes: Vec::new() }
    }

    pub fn cost(&self, id: u32) -> Option<Cost> {
        self.known.get(id as usize).copied().flatten().map(|(_, cost)| cost)
    }

    /// Keeps what was made of some bricks.
    pub fn add(&mut self, ids: &[u32], costs: &[Cost], bytes: &[u8], axes: &[u8]) -> io::Result<()> {
        let file = match &mut self.file {
            Some(file) => file,
            none => none.insert(tempfile::tempfile()?),
        };
        file.seek(SeekFrom::End(0))?;
        file.write_all(bytes)?;
        let last = ids.iter().max().map_or(0, |id| *id as usize + 1);
        self.known.resize(self.known.len().max(last), None);
        for ((&id, &cost), place) in ids.iter().zip(costs).zip(self.axes.len() as u32..) {
            self.known[id as usize] = Some((place, cost));
        }
        self.axes.extend(axes);
        Ok(())
    }

    /// The texels of bricks that are known, and their packing axes.
    pub fn read(&mut self, ids: &[u32]) -> io::Result<Vec<(Vec<u8>, u8)>> {
        let place = |id: u32| self.known[id as usize].expect("the codec was tried on the brick").0;
        let places: Vec<u32> = ids.iter().map(|&id| place(id)).collect();
        let at = |place: u32| u64::from(place) * self.size;
        let near = |a: &u32, b: &u32| b > a && at(*b) - at(*a) <= self.size + GAP;
        let mut texels = Vec::with_capacity(ids.len());
        let mut bytes = Vec::new();
        for run in places.chunk_by(near) {
            let (first, last) = (at(run[0]), at(run[run.len() - 1]) + self.size);
            bytes.resize((last - first) as usize, 0);
            let file = self.file.as_mut().expect("texels are in the file");
            file.seek(SeekFrom::Start(first))?;
            file.read_exact(&mut bytes)?;
            texels.extend(run.iter().map(|&place| {
                let from = (u64::from(place) * self.size - first) as usize;
                (bytes[from..from + self.size as usize].to_vec(), self.axes[place as usize])
            }));
        }
        Ok(texels)
    }
}
