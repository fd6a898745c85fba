//! What was made of bricks: where it lies in memory, the rest in scratch files.

use bytemuck::Zeroable;

use super::trial::{Note, Trial, TrialResults};
use crate::volume::{SCRATCH_SMALL, Scratch, ScratchFolder, ScratchResult};

/// What one trial made of the bricks of a pool, each once: notes and texels.
pub(super) struct Spilled {
    places: Places,
    notes: Scratch,
    texels: Option<Scratch>,
}

/// Where the results of each brick lie, as far as there are any. A trial that nobody asks for keeps none.
enum Places {
    /// At the brick's number; whether they do.
    ByBrick(Vec<bool>),
    /// In the order in which they came, for a trial that is made for some bricks of a frame only: writes with gaps
    /// between them are slow.
    InOrder {
        /// By brick.
        places: Vec<u32>,
        /// How many there are.
        count: u32,
    },
}

const NOWHERE: u32 = u32::MAX;

impl Places {
    fn new(trial: Trial) -> Self {
        match trial {
            Trial::Texels(codec) if codec.is_on_demand() => Self::InOrder { places: Vec::new(), count: 0 },
            _ => Self::ByBrick(Vec::new()),
        }
    }

    fn is_known(&self, id: u32) -> bool {
        match self {
            Self::ByBrick(known) => known.get(id as usize).is_some_and(|known| *known),
            Self::InOrder { places, .. } => places.get(id as usize).is_some_and(|&place| place != NOWHERE),
        }
    }

    /// Where a brick's lie that are there.
    fn of(&self, id: u32) -> u32 {
        match self {
            Self::ByBrick(_) => id,
            Self::InOrder { places, .. } => places[id as usize],
        }
    }

    /// Where a brick's shall lie, of a pool of `bricks`.
    fn take(&mut self, bricks: usize, id: u32) -> u32 {
        match self {
            Self::ByBrick(known) => {
                known.resize(bricks, false);
                known[id as usize] = true;
                id
            }
            Self::InOrder { places, count } => {
                places.resize(bricks, NOWHERE);
                places[id as usize] = *count;
                *count += 1;
                *count - 1
            }
        }
    }
}

impl Spilled {
    /// Nothing yet of a trial.
    pub fn new(scratch: &ScratchFolder, trial: Trial) -> Self {
        Self {
            places: Places::new(trial),
            notes: Scratch::new(scratch, trial.notes() * size_of::<Note>(), SCRATCH_SMALL),
            texels: (trial.texels() > 0).then(|| Scratch::new(scratch, trial.texels(), 0)),
        }
    }

    pub fn is_known(&self, id: u32) -> bool {
        self.places.is_known(id)
    }

    /// Keeps what was made of some bricks of a pool of `bricks`.
    pub fn add(&mut self, bricks: usize, ids: &[u32], made: &TrialResults) -> ScratchResult<()> {
        let places: Vec<u32> = ids.iter().map(|&id| self.places.take(bricks, id)).collect();
        let (mut notes, mut texels) = (bytemuck::cast_slice(&made.notes), &made.texels[..]);
        let put = |scratch: &mut Scratch, places: &[u32], records: &mut &[u8]| {
            let (now, later) = records.split_at(places.len() * scratch.record());
            *records = later;
            scratch.put(places[0], now)
        };
        for places in places.chunk_by(|a, b| *b == a + 1) {
            put(&mut self.notes, places, &mut notes)?;
            self.texels.as_mut().map_or(Ok(()), |scratch| put(scratch, places, &mut texels))?;
        }
        Ok(())
    }

    /// Sees to it that what was added can be read.
    pub fn flush(&mut self) -> ScratchResult<()> {
        self.notes.flush()?;
        self.texels.as_mut().map_or(Ok(()), Scratch::flush)
    }

    fn places(&self, ids: &[u32]) -> Vec<u32> {
        ids.iter().map(|&id| self.places.of(id)).collect()
    }

    /// The notes of bricks that are known, one after another.
    pub fn notes(&self, ids: &[u32]) -> ScratchResult<Vec<Note>> {
        let each = self.notes.record() / size_of::<Note>();
        let mut notes = vec![Note::zeroed(); ids.len() * each];
        let mut next = notes.chunks_exact_mut(each);
        self.notes.read(&self.places(ids), |record| {
            bytemuck::cast_slice_mut(next.next().expect("a record a brick")).copy_from_slice(record);
        })?;
        Ok(notes)
    }

    /// The texels of bricks that are known, one after another.
    pub fn texels(&self, ids: &[u32]) -> ScratchResult<Vec<u8>> {
        let mut texels = Vec::new();
        if let Some(scratch) = &self.texels {
            texels.reserve(ids.len() * scratch.record());
            scratch.read(&self.places(ids), |record| texels.extend_from_slice(record))?;
        }
        Ok(texels)
    }
}
