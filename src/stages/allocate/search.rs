//! Which codec each brick gets so that the whole meets what was asked at the least cost.
//!
//! Every brick takes the codec with the least D + λR. One λ serves all bricks of a search, and is found by
//! bisection on a fixed grid of steps; then single bricks are moved from one step's choice to the next one's, most
//! gain per bit first, until the target is just met. A codec that is slow to try counts as one that serves
//! a brick without error until it was tried on it: whoever prefers something else even then never needs it, and whoever
//! chooses it is tried and the search goes on with what was found.

use std::sync::LazyLock;

use super::borrow::{TexelReference, texel_references};
use super::candidate::Candidate;
use super::choices::{BLOCK, Choices, OnDemand, Table, Weighed, costs};
use super::target::AdaptiveGrid;
use super::{Allocation, Coding, EarlierOffers, windows};
use crate::cancel::CancelToken;
use crate::codec::TexelCodec;
use crate::error::Result;
use crate::profile;
use crate::settings::Quality;
use crate::stages::dedup::{FrameTree, Payload, SequenceTree};
use crate::stages::encoder_cache::{Cost, EncoderCache, Trial};

/// A step is 1.1 % of λ, under 0.05 dB of PSNR.
const STEPS_PER_OCTAVE: u32 = 64;
/// λ near step 0, in squared peaks a bit: 2^24 times 1,024 bits outweigh the greatest error of a fog's brick (512 squared
/// peaks) in every frame of the longest sequence. Step 0 itself is the coarsest choice whatever its error.
const FIRST_OCTAVE: f64 = 24.0;
/// From this step on λ is 0. The one before has 2^-76: a bit is worth less there than an error past 200 dB.
const LAST_STEP: u32 = 100 * STEPS_PER_OCTAVE;

fn lambda(step: u32) -> f64 {
    static STEPS: LazyLock<Vec<f64>> = LazyLock::new(|| {
        let octave = |step| FIRST_OCTAVE - f64::from(step) / f64::from(STEPS_PER_OCTAVE);
        (0..LAST_STEP).map(|step| octave(step).exp2()).collect()
    });
    STEPS.get(step as usize).copied().unwrap_or(0.0)
}

/// Steps of λ, a quarter of an octave, that are one when it comes to who lends: 0.4 dB.
const LENDING_STEPS: u32 = STEPS_PER_OCTAVE / 4;

/// Bricks that a λ this much larger, an octave, would have made coarser may be so where there is room for it.
const SLACK_STEPS: u32 = STEPS_PER_OCTAVE;

/// Sums of squares are sums of rounded figures (2^-24 each); a target is met with this much to spare.
const ROUNDING: f64 = 1.0 - 1e-6;

/// One grid and what is known of it.
pub(super) struct GridSearch<'a> {
    pub(super) tree: &'a mut SequenceTree,
    encoders: &'a mut EncoderCache,
    earlier: Option<&'a dyn EarlierOffers>,
    cancel: CancelToken,
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
    lends: Vec<Option<Candidate>>,
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
    fn allowance(&self, voxels: u64, psnr: f64) -> f64 {
        let allowed = voxels as f64 * 10f64.powf(-psnr / 10.0) * ROUNDING;
        // Were every voxel's float as far from its source as that of the worst, errors would add up to no more than this.
        let rounding = (voxels as f64).sqrt() * self.source_rounding / self.table.peak;
        (allowed.sqrt() - rounding).max(0.0).powi(2)
    }

    /// The PSNR of so many squared peaks.
    fn psnr(voxels: u64, squares: f64) -> f64 {
        10.0 * (voxels as f64 / squares).log10()
    }

    /// The candidate that a brick gets at a step.
    fn pick(&self, id: u32, weighed: Weighed, step: u32) -> Candidate {
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
            for Switch { brick, squares: [before, after], .. } in switches(0, self, &picks, &fine)? {
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
            switches(0, self, &coarser, &before)?.into_iter().rev()
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

    /// Finds out which bricks had better borrow, were λ what it is at `step` and every brick coded as in `picks`. A brick
    /// lends or borrows, and one that lends keeps the codec it has.
    pub(super) fn find_references(
        &mut self,
        picks: &[Candidate],
        step: u32,
        advance: &mut dyn FnMut(u64),
    ) -> Result<()> {
        // Who is compared with whom does not change with every little more or less of λ: an edited frame leaves what
        // was found for the frames far from it as it is.
        let near = ((step + LENDING_STEPS / 2) / LENDING_STEPS * LENDING_STEPS).min(LAST_STEP);
        let mut compared = self.picks(near)?;
        while self.try_unknown((0..).zip(compared.iter().copied()), advance)? {
            compared = self.picks(near)?;
        }
        // Who may borrow, and of those who has texels that others can use.
        let whole: Vec<bool> = (0..picks.len() as u32).map(|id| self.encoders.is_whole(id)).collect();
        let borrows = |id: u32| whole[id as usize] && compared[id as usize] != Candidate::Empty;
        let lends =
            |id: u32| compared[id as usize].codec().filter(|codec| borrows(id) && codec.keeps_texels());
        let (table, least_step) = (&self.table, &self.least_step);
        let gain = |id: u32, weighed: Weighed, reference: &TexelReference| {
            let lambda = lambda(step.max(least_step[id as usize].into()));
            let own = picks[id as usize];
            let own = weighed.distortion(own) + lambda * weighed.bits(own);
            own - weighed.borrowed(reference) - lambda * weighed.bits(Candidate::Borrowed)
        };
        // A fifth of the bricks has an offer worth taking.
        let mut order: Vec<(f64, u32, TexelReference)> = Vec::new();
        let (earlier, cancel) = (self.earlier, &self.cancel);
        texel_references(
            self.encoders,
            self.tree,
            borrows,
            lends,
            earlier,
            cancel,
            |ids, texel_references| {
                for ((&id, choices), texel_references) in
                    ids.iter().zip(&table.read(ids)?).zip(texel_references)
                {
                    let as_compared = |reference: &TexelReference| {
                        picks[reference.referenced as usize] == compared[reference.referenced as usize]
                    };
                    let weighed = table.weighed(id, choices);
                    let offers = texel_references.into_iter().filter(as_compared);
                    let offers = offers.map(|reference| (gain(id, weighed, &reference), id, reference));
                    order.extend(offers.filter(|(gain, ..)| *gain > 0.0));
                }
                Ok(())
            },
        )?;
        order.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        for (_, id, reference) in order {
            let (referenced, table) = (reference.referenced, &mut self.table);
            if table.reference(id).is_none()
                && self.lends[id as usize].is_none()
                && table.reference(referenced).is_none()
            {
                table.add_reference(id, reference);
                self.lends[referenced as usize] = Some(picks[referenced as usize]);
            }
        }
        Ok(())
    }

    pub(super) fn forget_references(&mut self) {
        self.table.forget_references();
        self.lends.fill(None);
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

    /// Ends every texel reference that some bricks, ascending, are part of: they are to become finer, and their texels others.
    fn call_in_references(&mut self, bricks: &[u32]) {
        for &id in bricks {
            self.lends[id as usize] = None;
        }
        let lends = &self.lends;
        self.table.keep_references(|id, reference| {
            lends[reference.referenced as usize].is_some() && bricks.binary_search(&id).is_err()
        });
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

/// The first step, of 0 to [`LAST_STEP`], that meets what every finer one meets too; the last if none does. Near a step
/// that is known to be close by it is found in fewer looks.
pub(super) fn first_step(near: Option<u32>, mut meets: impl FnMut(u32) -> Result<bool>) -> Result<u32> {
    let (mut low, mut high) = (0, LAST_STEP);
    if let Some(near) = near {
        let (mut at, mut stride) = (near, 1);
        let is_down = meets(near)?;
        if is_down {
            high = near
        } else {
            low = near + 1
        }
        while low < high {
            at = if is_down { at.saturating_sub(stride).max(low) } else { (at + stride).min(high - 1) };
            stride *= 2;
            let met = meets(at)?;
            if met {
                high = at
            } else {
                low = at + 1
            }
            if met != is_down {
                break;
            }
        }
    }
    while low < high {
        let middle = (low + high) / 2;
        if meets(middle)? {
            high = middle;
        } else {
            low = middle + 1;
        }
    }
    Ok(low)
}

/// One brick's move to a finer codec.
pub(super) struct Switch {
    pub grid: u32,
    pub brick: u32,
    /// Squared peaks less for each bit more.
    pub gain: f64,
    /// Its squared error over active voxels of all frames, before and after.
    squares: [f64; 2],
}

/// The bricks in which two steps of a grid differ, most gain for a bit first.
pub(super) fn switches(
    grid: u32,
    search: &GridSearch,
    coarse: &[Candidate],
    fine: &[Candidate],
) -> Result<Vec<Switch>> {
    let differ: Vec<u32> =
        (0..).zip(coarse.iter().zip(fine)).filter(|(_, (a, b))| a != b).map(|(id, _)| id).collect();
    let mut switches = Vec::with_capacity(differ.len());
    for ids in differ.chunks(BLOCK as usize) {
        for (&brick, choices) in ids.iter().zip(&search.table.read(ids)?) {
            let weighed = search.table.weighed(brick, choices);
            let (from, to) = (coarse[brick as usize], fine[brick as usize]);
            let less = weighed.distortion(from) - weighed.distortion(to);
            switches.push(Switch {
                grid,
                brick,
                gain: less / (weighed.bits(to) - weighed.bits(from)),
                squares: [from, to].map(|candidate| weighed.uses() * weighed.active_squares(candidate)),
            });
        }
    }
    switches.sort_by(|a, b| b.gain.total_cmp(&a.gain).then(a.brick.cmp(&b.brick)));
    Ok(switches)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_step_is_found_from_anywhere() {
        let ends = [0, 1, 2, 700, 3_199, 3_200, LAST_STEP - 1, LAST_STEP];
        for (first, near) in ends.into_iter().flat_map(|first| ends.map(|near| (first, near))) {
            for near in [None, Some(near)] {
                let mut looks = 0;
                let found = first_step(near, |step| {
                    looks += 1;
                    Ok(step >= first)
                });
                assert_eq!(found.unwrap(), first, "{near:?}");
                // Twice a bisection's at most, and next to none where it is close by.
                assert!(looks <= if near.is_some_and(|near| near.abs_diff(first) <= 1) { 4 } else { 26 });
            }
        }
    }
}
