//! What was made of the bricks of a grid, in every trial.

use super::spilled::Spilled;
use super::{Note, Trial, TrialResults};
use crate::stages::dedup::SequenceTree;
use crate::volume::ScratchResult;

/// What was made of the bricks of a grid so far.
pub struct Memo {
    trials: [Spilled; Trial::ALL.len()],
    bricks: usize,
}

impl Memo {
    /// Nothing yet.
    pub(super) fn new(tree: &SequenceTree) -> Self {
        let trials = Trial::ALL.map(|trial| Spilled::new(&tree.scratch, trial));
        Self { trials, bricks: tree.pool.len() as usize }
    }

    /// Whether a brick was made in a trial.
    pub fn is_known(&self, trial: Trial, id: u32) -> bool {
        self.trials[trial.index()].is_known(id)
    }

    /// Adds what was made of some bricks. It can be read after the next [`Memo::flush`].
    ///
    /// # Errors
    /// When the scratch file cannot be written.
    pub fn add(&mut self, trial: Trial, ids: &[u32], made: &TrialResults) -> ScratchResult<()> {
        self.trials[trial.index()].add(self.bricks, ids, made)
    }

    /// Sees to it that what was added can be read.
    ///
    /// # Errors
    /// When the scratch file cannot be written.
    pub fn flush(&mut self) -> ScratchResult<()> {
        self.trials.iter_mut().try_for_each(Spilled::flush)
    }

    /// The notes of bricks that are known, [`Trial::notes`] each.
    ///
    /// # Errors
    /// When the scratch file cannot be read back.
    pub fn notes(&self, trial: Trial, ids: &[u32]) -> ScratchResult<Vec<Note>> {
        self.trials[trial.index()].notes(ids)
    }

    /// All that was made of bricks that are known.
    ///
    /// # Errors
    /// When the scratch file cannot be read back.
    pub fn made(&self, trial: Trial, ids: &[u32]) -> ScratchResult<TrialResults> {
        let trial = &self.trials[trial.index()];
        Ok(TrialResults { notes: trial.notes(ids)?, texels: trial.texels(ids)? })
    }
}
