//! Which codec each brick gets so that the whole meets what was asked at the least cost.
//!
//! Every brick takes the codec with the least D + λR. One λ serves all bricks of a search, and is found by
//! bisection on a fixed grid of steps; then single bricks are moved from one step's choice to the next one's, most
//! gain per bit first, until the target is just met. A codec that is slow to try counts as one that serves
//! a brick without error until it was tried on it: whoever prefers something else even then never needs it, and whoever
//! chooses it is tried and the search goes on with what was found.

use super::candidate::Candidate;
use super::choices::{BLOCK, Choices, OnDemand, Table, Weighed, costs};
use super::offers::EarlierOffers;
use super::steps::{STEPS_PER_OCTAVE, first_step, lambda};
use super::switches::{Switch, switches};
use super::target::AdaptiveGrid;
use crate::cancel::CancelToken;
use crate::codec::TexelCodec;
use crate::error::Result;
use crate::profile;
use crate::settings::Quality;
use crate::stages::allocate::{Allocation, Coding, windows};
use crate::stages::dedup::{Payload, SequenceTree};
use crate::stages::encoder_cache::{Cost, EncoderCache, Trial};

/// Bricks that a λ this much larger, an octave, would have made coarser may be so where there is room for it.
const SLACK_STEPS: u32 = STEPS_PER_OCTAVE;

/// Sums of squares are sums of rounded figures (2^-24 each); a target is met with this much to spare.
const ROUNDING: f64 = 1.0 - 1e-6;

/// One grid and what is known of it.
pub(super) struct GridSearch<'a> {
    pub(super) tree: &'a mut SequenceTree,
    pub(super) encoders: &'a mut EncoderCache,
    pub(super) earlier: Option<&'a dyn EarlierOffers>,
    pub(super) cancel: CancelToken,
    pub(super) voxel_size: f64,
    pub(super) quality: Quality,
    /// How far the nearest float is from a value of the source at most.
    source_rounding: f64,
    /// Whether nothing would be left of the grid were every brick empty, though it has something to show.
    may_vanish: bool,
    pub(super) table: Table,
    /// The coarsest step that each brick may have, for the sake of the frames it is in.
    pub(super) least_step: Vec<u16>,
    on_demand: OnDemand,
    /// The candidate of bricks that lend their texels.
    pub(super) lends: Vec<Option<Candidate>>,
    active_voxels: u64,
}

impl<'a> GridSearch<'a> {
    pub(super) fn new(grid: AdaptiveGrid<'a>, cancel: CancelToken) -> Result<Self> {
        let tree = grid.tree;
        let mut uses = vec![0; tree.brick_ranges.len()];
        for frame in &tree.frames {
            tree.frame_bricks(frame).for_each(|id| uses[id as usize] += 1);
        }
        let mut records = vec![0; uses.len()];
        for &record in tree.runs.items() {
            if let Payload::Brick(id) = tree.record(record).payload() {
                records[id as usize] += 1;
            }
        }
        let mut search = Self {
            least_step: vec![0; uses.len()],
            on_demand: OnDemand::new(uses.len()),
            lends: vec![None; uses.len()],
            active_voxels: tree.frames.iter().map(|f| f.stats.active_leaf_voxels).sum(),
            voxel_size: grid.voxel_size,
            quality: grid.quality,
            source_rounding: tree.frames.iter().map(|frame| frame.stats.rounding).fold(0.0, f64::max),
            may_vanish: false,
            table: Table::new(&tree.scratch, grid.peak),
            encoders: grid.encoders,
            earlier: grid.earlier,
            cancel,
            tree,
        };
        for ids in windows(uses.len() as u32, BLOCK) {
            let costs = costs(search.encoders, &ids, &search.on_demand)?;
            let choices = |&id: &u32| Choices::new(uses[id as usize], records[id as usize]);
            search.may_vanish |=
                costs.iter().any(|(costs, _)| costs[Candidate::Empty.index()].error_l2 > 0.0);
            search.table.add(ids.iter().map(choices).zip(costs.into_iter().map(|(costs, _)| costs)))?;
        }
        search.may_vanish &= !search.tree.has_constants();
        Ok(search)
    }

    /// Whether a choice leaves nothing of a grid that has something to show: a few bright voxels among many that are 0 may
    /// be less than the error that a PSNR allows.
    fn is_nothing(&self, picks: &[Candidate]) -> bool {
        self.may_vanish && picks.iter().all(|candidate| *candidate == Candidate::Empty)
    }

    /// The squared peaks that `voxels` may err by together at some PSNR, against the nearest floats of their source.
    pub(super) fn allowance(&self, voxels: u64, psnr: f64) -> f64 {
        let allowed = voxels as f64 * 10f64.powf(-psnr / 10.0) * ROUNDING;
        // Were every voxel's float as far from its source as that of the worst, errors would add up to no more than this.
        let rounding = (voxels as f64).sqrt() * self.source_rounding / self.table.peak;
        (allowed.sqrt() - rounding).max(0.0).powi(2)
    }

    /// The PSNR of so many squared peaks.
    pub(super) fn psnr(voxels: u64, squares: f64) -> f64 {
        10.0 * (voxels as f64 / squares).log10()
    }

    /// The candidate that a brick gets at a step.
    pub(super) fn pick(&self, id: u32, weighed: Weighed, step: u32) -> Candidate {
        if let Some(candidate) = self.lends[id as usize] {
            return candidate;
        }
        let step = step.max(self.least_step[id as usize].into());
        if step == 0 {
            // The coarsest there is: no error is too large.
            let possible = |candidate: &Candidate| weighed.distortion(*candidate).is_finite();
            return Candidate::ALL.into_iter().find(possible).unwrap_or(Candidate::EXACT);
        }
        weighed.best(lambda(step))
    }

    pub(super) fn picks(&self, step: u32) -> Result<Vec<Candidate>> {
        Ok(self.table.each(|id, weighed| self.pick(id, weighed, step))?)
    }

    /// The squared error of all frames over active voxels.
    pub(super) fn squares(&self, picks: &[Candidate]) -> Result<f64> {
        Ok(self.table.sum(|id, weighed| weighed.uses() * weighed.active_squares(picks[id as usize]))?)
    }

    /// The same for what is picked at a step.
    fn squares_at(&self, step: u32) -> Result<f64> {
        let squares =
            |id, weighed: Weighed| weighed.uses() * weighed.active_squares(self.pick(id, weighed, step));
        Ok(self.table.sum(squares)?)
    }

    /// Tries what was picked without having been tried. Whether there was any.
    pub(super) fn try_unknown(
        &mut self,
        picks: impl Iterator<Item = (u32, Candidate)>,
        advance: &mut dyn FnMut(u64),
    ) -> Result<bool> {
        let picks: Vec<(u32, Candidate)> =
            picks.filter(|(_, candidate)| candidate.codec().is_some_and(TexelCodec::is_on_demand)).collect();
        let mut is_any = false;
        for (codec, is_tried) in self.on_demand.iter_mut() {
            let candidate = Candidate::Texels(codec);
            let unknown = picks.iter().filter(|(id, pick)| *pick == candidate && !is_tried[*id as usize]);
            let unknown: Vec<u32> = unknown.map(|(id, _)| *id).collect();
            self.encoders.make(self.tree, &unknown, &[Trial::Texels(codec)], &mut *advance)?;
            for ids in unknown.chunks(BLOCK as usize) {
                self.table.weigh(ids, candidate, &self.encoders.costs(ids, codec)?)?;
                ids.iter().for_each(|&id| is_tried[id as usize] = true);
            }
            is_any |= !unknown.is_empty();
        }
        Ok(is_any)
    }

    pub(super) fn at_psnr(
        &mut self,
        psnr: f64,
        floor: f64,
        advance: &mut dyn FnMut(u64),
    ) -> Result<Vec<Candidate>> {
        let (step, alone) = self.at_psnr_with_references(psnr, floor, None, advance)?;
        self.find_references(&alone, step, advance)?;
        let (_, together) = self.at_psnr_with_references(psnr, floor, Some(step), advance)?;
        let bits = |picks: &[Candidate]| self.table.sum(|id, weighed| weighed.bits(picks[id as usize]));
        if bits(&together)? < bits(&alone)? {
            return Ok(together);
        }
        self.forget_references();
        Ok(alone)
    }

    fn at_psnr_with_references(
        &mut self,
        psnr: f64,
        floor: f64,
        mut near: Option<u32>,
        advance: &mut dyn FnMut(u64),
    ) -> Result<(u32, Vec<Candidate>)> {
        let allowed = self.allowance(self.active_voxels, psnr);
        loop {
            let span = profile::span("search");
            let step = first_step(near, |step| {
                Ok(self.squares_at(step)? <= allowed
                    && !(self.may_vanish && self.is_nothing(&self.picks(step)?)))
            })?;
            drop(span);
            near = Some(step);
            let fine = self.picks(step)?;
            if self.try_unknown((0..).zip(fine.iter().copied()), advance)? {
                continue;
            }
            let mut picks = self.picks(step.saturating_sub(1))?;
            let mut squares = self.squares(&picks)?;
            for Switch { brick, squares: [before, after], .. } in switches(0, &self.table, &picks, &fine)? {
                if squares <= allowed {
                    break;
                }
                squares = squares - before + after;
                picks[brick as usize] = fine[brick as usize];
            }
            // Differences were added up; the sum itself decides.
            if self.squares(&picks)? > allowed || self.is_nothing(&picks) {
                picks = fine;
            }
            self.spend_slack(&mut picks, allowed, step)?;
            if !self.raise_frames(&picks, floor, step, advance)? {
                return Ok((step, picks));
            }
        }
    }

    /// The last brick that was made finer may have been a large one: where what it left over suffices for others to be
    /// coarser, they are, least loss for a bit first.
    fn spend_slack(&self, picks: &mut [Candidate], allowed: f64, step: u32) -> Result<()> {
        let coarser = self.picks(step.saturating_sub(SLACK_STEPS))?;
        let (before, mut squares) = (picks.to_vec(), self.squares(picks)?);
        for Switch { brick, squares: [coarse, fine], .. } in
            switches(0, &self.table, &coarser, &before)?.into_iter().rev()
        {
            let more = coarse - fine;
            if squares + more <= allowed {
                squares += more;
                picks[brick as usize] = coarser[brick as usize];
            }
        }
        if self.squares(picks)? > allowed || self.is_nothing(picks) {
            picks.copy_from_slice(&before);
        }
        Ok(())
    }

    pub(super) fn within(&mut self, bound: f64, advance: &mut dyn FnMut(u64)) -> Result<Vec<Candidate>> {
        let bound = (bound - self.source_rounding).max(0.0);
        let fits = |cost: &Cost| cost.error_l2.is_finite() && f64::from(cost.max) <= bound;
        loop {
            let mut picks = Vec::with_capacity(self.table.len() as usize);
            for ids in windows(self.table.len(), BLOCK) {
                let costs = costs(self.encoders, &ids, &self.on_demand)?;
                picks.extend(costs.iter().map(|(costs, _)| {
                    Candidate::ALL
                        .into_iter()
                        .find(|&candidate| fits(&costs[candidate.index()]))
                        .unwrap_or(Candidate::EXACT)
                }));
            }
            if !self.try_unknown((0..).zip(picks.iter().copied()), advance)? {
                return Ok(picks);
            }
        }
    }

    /// The PSNR of all frames together.
    pub(super) fn whole(&self, picks: &[Candidate]) -> Result<f64> {
        Ok(Self::psnr(self.active_voxels, self.squares(picks)?))
    }

    pub(super) fn finish(self, picks: &[Candidate]) -> Result<Allocation> {
        let Self { tree, encoders, on_demand, table, .. } = self;
        let texel_references = table.into_references();
        let mut allocation = Allocation::new(&tree.scratch, encoders);
        for ids in windows(picks.len() as u32, BLOCK) {
            let mut error_l2s = Vec::with_capacity(ids.len());
            for (&id, (costs, value)) in ids.iter().zip(costs(encoders, &ids, &on_demand)?) {
                let candidate = picks[id as usize];
                let (coding, range, error_l2) = match candidate {
                    Candidate::Borrowed => {
                        let reference = texel_references[&id];
                        (Coding::Borrowed(reference.referenced), Some(reference.range), reference.error_l2)
                    }
                    Candidate::Empty => (Coding::Empty, None, costs[candidate.index()].error_l2),
                    Candidate::Constant => (Coding::Constant(value), None, costs[candidate.index()].error_l2),
                    Candidate::Texels(codec) => (Coding::Own(codec), None, costs[candidate.index()].error_l2),
                };
                allocation.push(coding, range);
                error_l2s.push(error_l2);
            }
            allocation.error_l2s.put(ids[0], &error_l2s)?;
        }
        allocation.error_l2s.are_known = true;
        allocation.error_l2s.flush()?;
        let is_empty = |id: u32| picks[id as usize] == Candidate::Empty;
        for frame in &tree.frames {
            let empty: Vec<u32> = tree.frame_bricks(frame).filter(|&id| is_empty(id)).collect();
            let squares = allocation.error_l2s.read(&empty)?.into_iter().map(|error_l2| error_l2.powi(2));
            allocation.empty_squares.push(squares.sum());
        }
        Ok(allocation)
    }
}
