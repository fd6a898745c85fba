//! What was made of the bricks of a grid, in every kind.

use super::spilled::Spilled;
use super::{Kind, Made, Note};
use crate::stages::dedup::SequenceTree;
use crate::volume::ScratchResult;

/// What was made of the bricks of a grid so far.
pub struct Memo {
    kinds: [Spilled; Kind::ALL.len()],
    bricks: usize,
}

impl Memo {
    /// Nothing yet.
    pub(super) fn new(tree: &SequenceTree) -> Self {
        let kinds = Kind::ALL.map(|kind| Spilled::new(&tree.scratch, kind));
        Self { kinds, bricks: tree.pool.len() as usize }
    }

    /// Whether a brick was made in a kind.
    pub fn is_known(&self, kind: Kind, id: u32) -> bool {
        self.kinds[kind.index()].is_known(id)
    }

    /// Adds what was made of some bricks. It can be read after the next [`Memo::flush`].
    ///
    /// # Errors
    /// When the scratch file cannot be written.
    pub fn add(&mut self, kind: Kind, ids: &[u32], made: &Made) -> ScratchResult<()> {
        self.kinds[kind.index()].add(self.bricks, ids, made)
    }

    /// Sees to it that what was added can be read.
    ///
    /// # Errors
    /// When the scratch file cannot be written.
    pub fn flush(&mut self) -> ScratchResult<()> {
        self.kinds.iter_mut().try_for_each(Spilled::flush)
    }

    /// The notes of bricks that are known, [`Kind::notes`] each.
    ///
    /// # Errors
    /// When the scratch file cannot be read back.
    pub fn notes(&self, kind: Kind, ids: &[u32]) -> ScratchResult<Vec<Note>> {
        self.kinds[kind.index()].notes(ids)
    }

    /// All that was made of bricks that are known.
    ///
    /// # Errors
    /// When the scratch file cannot be read back.
    pub fn made(&self, kind: Kind, ids: &[u32]) -> ScratchResult<Made> {
        let kind = &self.kinds[kind.index()];
        Ok(Made { notes: kind.notes(ids)?, texels: kind.texels(ids)? })
    }
}
