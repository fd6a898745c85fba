//! The parts of a frame in which bricks are kept and compared.

use std::collections::BTreeSet;
use std::ops::Range;

use crate::stages::dedup::SequenceTree;

/// Bricks of a [`Batch`] at most: with 512 bytes of texels each, a megabyte.
pub const BATCH_BRICKS: u32 = 2048;

/// Bricks of one frame that are kept and compared together.
pub struct Batch {
    /// The frame's place in the sequence.
    pub frame: usize,
    /// The batch's place in its frame.
    pub part: u32,
    /// The bricks of the pool that the frame had first and that are in this part of it.
    pub ids: Range<u32>,
}

/// The places of the batches that some bricks, ascending, are in.
pub(super) fn batches_of(batches: &[Batch], ids: &[u32]) -> BTreeSet<usize> {
    ids.iter().map(|id| batches.partition_point(|batch| batch.ids.end <= *id)).collect()
}

/// The batches of a grid, in the order of its pool.
pub(super) fn batches(tree: &SequenceTree) -> Vec<Batch> {
    let mut all = Vec::new();
    for (frame, own) in tree.own_bricks.iter().enumerate() {
        let own: Vec<u32> = own.clone().collect();
        let part = |id: &u32| tree.pool.place(*id) / BATCH_BRICKS;
        for ids in own.chunk_by(|a, b| part(a) == part(b)) {
            all.push(Batch { frame, part: part(&ids[0]), ids: ids[0]..ids[ids.len() - 1] + 1 });
        }
    }
    all
}
