//! The floor that no frame of a sequence falls below.

use super::candidate::Candidate;
use super::search::GridSearch;
use super::steps::{LAST_STEP, first_step};
use crate::error::Result;
use crate::stages::dedup::FrameTree;

impl GridSearch<'_> {
    /// The squared error of one frame over active voxels.
    fn frame_squares(&self, frame: &FrameTree, picks: &[Candidate]) -> Result<f64> {
        let bricks: Vec<u32> = self.tree.frame_bricks(frame).collect();
        let choices = self.table.read(&bricks)?;
        let square = |(&id, choices)| self.table.weighed(id, choices).active_squares(picks[id as usize]);
        Ok(bricks.iter().zip(&choices).map(square).sum())
    }

    /// The PSNR of the worst frame.
    pub(super) fn worst_frame(&self, picks: &[Candidate]) -> Result<f64> {
        let mut worst = f64::INFINITY;
        for frame in &self.tree.frames {
            let db = Self::psnr(frame.stats.active_leaf_voxels, self.frame_squares(frame, picks)?);
            // Where there is no error, or no voxel to err, there is no worst.
            if db.is_finite() {
                worst = worst.min(db);
            }
        }
        Ok(worst)
    }

    /// Binds the bricks of every frame below `floor` to the step at which it would reach it alone, and at least to the
    /// one after `current`, which was not enough. Whether there was such a frame.
    pub(super) fn raise_frames(
        &mut self,
        picks: &[Candidate],
        floor: f64,
        current: u32,
        advance: &mut dyn FnMut(u64),
    ) -> Result<bool> {
        // All are judged before texel references are called in for the sake of some.
        let mut low: Vec<(usize, f64)> = Vec::new();
        for (f, frame) in self.tree.frames.iter().enumerate() {
            let allowed = self.allowance(frame.stats.active_leaf_voxels, floor);
            let rises = |id: u32| u32::from(self.least_step[id as usize]) < LAST_STEP;
            // What no step meets is met as nearly as the last one does.
            if self.frame_squares(frame, picks)? > allowed && self.tree.frame_bricks(frame).any(rises) {
                low.push((f, allowed));
            }
        }
        for &(frame, allowed) in &low {
            let bricks: Vec<u32> = self.tree.frame_bricks(&self.tree.frames[frame]).collect();
            let mut unique = bricks.clone();
            unique.sort_unstable();
            unique.dedup();
            self.call_in_references(&unique);
            let step = loop {
                let (choices, table) = (self.table.read(&bricks)?, &self.table);
                let weighed =
                    || bricks.iter().zip(&choices).map(|(&id, choices)| (id, table.weighed(id, choices)));
                let squares = |step| -> f64 {
                    weighed().map(|(id, weighed)| weighed.active_squares(self.pick(id, weighed, step))).sum()
                };
                let step = first_step(None, |step| Ok(squares(step) <= allowed))?;
                let mut picked: Vec<_> =
                    weighed().map(|(id, weighed)| (id, self.pick(id, weighed, step))).collect();
                picked.sort_unstable_by_key(|(id, _)| *id);
                picked.dedup_by_key(|(id, _)| *id);
                if !self.try_unknown(picked.into_iter(), advance)? {
                    break step;
                }
            };
            // Picks keep the error of all voxels small, floors are about that of active ones: a step may look enough
            // that is not.
            let least = |id: &u32| u32::from(self.least_step[*id as usize]);
            let grows = unique.iter().any(|id| step > least(id).max(current));
            let step = if grows {
                step
            } else {
                (unique.iter().map(least).max().unwrap_or(0).max(current) + 1).min(LAST_STEP)
            };
            for id in unique {
                let least = &mut self.least_step[id as usize];
                *least = (*least).max(step as u16);
            }
        }
        Ok(!low.is_empty())
    }
}
