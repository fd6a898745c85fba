//! Which codec each brick gets so that the whole meets what was asked at the least cost.
//!
//! Every brick takes the codec with the least D + λR. One λ serves all bricks of a search, and is found by
//! bisection on a fixed grid of steps; then single bricks are moved from one step's choice to the next one's, most
//! gain per bit first, until the target is just met. BC7 is dear to try, so a brick that it has not been tried on
//! counts as one that it serves without error: whoever prefers something else even then never needs it, and whoever
//! chooses it is tried and the search goes on with what was found.

use std::io;

use rayon::prelude::*;

use super::share::{Loan, loans};
use super::trial::{ConstantAim, Cost, Rung, Trials};
use super::{AllocateError, Allocation, Coding, Shape};
use crate::codec::Codec;
use crate::pack::tree::NODE_WORDS;
use crate::settings::{FRAME_MARGIN_DB, Quality, RangeMode};
use crate::stages::dedup::{Payload, SequenceTree};
use crate::stages::relayout;

/// One grid to be allocated.
pub struct AdaptiveGrid<'a> {
    /// Its nodes and bricks.
    pub tree: &'a mut SequenceTree,
    /// Level sets: voxels further from the surface than this must not change sides.
    pub sign_matters: Option<f64>,
    /// A voxel's smallest side.
    pub voxel_size: f64,
}

/// What a pack is asked for.
#[derive(Clone, Copy, Debug)]
pub struct Target {
    /// The whole.
    pub quality: Quality,
    /// The PSNR that no frame falls below; 6 dB below the whole's where none is given.
    pub min_frame_psnr: Option<f64>,
    /// What texels are fractions of.
    pub range: RangeMode,
    /// Bytes of tree and masks, which no codec changes.
    pub fixed_bytes: u64,
}

/// A step is 1.1 % of λ, under 0.05 dB of PSNR.
const STEPS_PER_OCTAVE: u32 = 64;
/// λ of step 0, in squared peaks a bit: 2^24 times 1,024 bits outweigh the greatest error of a brick (512 squared
/// peaks) in every frame of the longest sequence.
const FIRST_OCTAVE: f64 = 24.0;
/// The last step with a λ above 0 has 2^-76: 16 bits of error a brick weigh more there than one texel bit, past 200 dB.
const LAST_STEP: u32 = 100 * STEPS_PER_OCTAVE;

fn lambda(step: u32) -> f64 {
    if step >= LAST_STEP {
        0.0
    } else {
        (FIRST_OCTAVE - f64::from(step) / f64::from(STEPS_PER_OCTAVE)).exp2()
    }
}

/// An L3 record is three words.
const RECORD_BITS: u32 = 96;

/// Sums of squares are sums of rounded roots; a target is met with this much to spare.
const ROUNDING: f64 = 1.0 - 1e-6;

/// Gives each brick of each grid its codec. `advance` hears of bricks that BC7 was tried on.
///
/// # Errors
/// [`AllocateError`].
pub fn adaptive(
    grids: &mut [AdaptiveGrid],
    target: &Target,
    advance: &mut dyn FnMut(u64),
) -> Result<Vec<Allocation>, AllocateError> {
    let aim = match target.quality {
        Quality::MaxError(_) => ConstantAim::Max,
        _ => ConstantAim::Squares,
    };
    let mut searches = Vec::new();
    for (i, grid) in grids.iter_mut().enumerate() {
        let ranges = Allocation::ranges(grid.tree, target.range).ok_or(AllocateError::TooWide { grid: i })?;
        let trials = Trials::new(grid.tree, ranges, aim, grid.sign_matters)?;
        searches.push(GridSearch::new(grid, trials));
    }
    let picks = match target.quality {
        Quality::Psnr(db) => {
            let floor = target.min_frame_psnr.unwrap_or(db - FRAME_MARGIN_DB);
            searches.iter_mut().map(|s| s.at_psnr(db, floor, advance)).collect::<io::Result<_>>()?
        }
        Quality::MaxError(bound) => {
            let within = |s: &mut GridSearch| s.within(bound.absolute(s.peak, s.voxel_size), advance);
            searches.iter_mut().map(within).collect::<io::Result<_>>()?
        }
        Quality::BitsPerVoxel(bits) => {
            let leaves = |s: &GridSearch| s.tree.frames.iter().map(|f| f.stats.leaves).sum::<u64>();
            let voxels = 512 * searches.iter().map(leaves).sum::<u64>();
            at_size(&mut searches, (bits * voxels as f64 / 8.0) as u64, target, advance)?
        }
        Quality::Size(bytes) => at_size(&mut searches, bytes, target, advance)?,
    };
    let each = searches.into_iter().zip(picks);
    Ok(each.map(|(search, picks)| search.finish(&picks)).collect::<io::Result<_>>()?)
}

/// One grid and what is known of it.
struct GridSearch<'a> {
    tree: &'a mut SequenceTree,
    trials: Trials,
    voxel_size: f64,
    /// How often each brick is used over all frames.
    uses: Vec<u32>,
    /// How many L3 records each brick has: one in every run that it is in.
    records: Vec<u32>,
    /// The coarsest step that each brick may have, for the sake of the frames it is in.
    least_step: Vec<u32>,
    /// What each brick may borrow.
    loans: Vec<Option<Loan>>,
    /// The rung of bricks that lend their texels.
    lends: Vec<Option<Rung>>,
    /// Maximum less minimum of active values.
    peak: f64,
    active_voxels: u64,
}

impl<'a> GridSearch<'a> {
    fn new(grid: &'a mut AdaptiveGrid, trials: Trials) -> Self {
        let tree: &mut SequenceTree = grid.tree;
        let mut uses = vec![0; tree.brick_ranges.len()];
        for frame in &tree.frames {
            tree.frame_bricks(frame).for_each(|id| uses[id as usize] += 1);
        }
        let mut records = vec![0; uses.len()];
        for &record in tree.runs.items() {
            if let Payload::Brick(id) = tree.records[record as usize].payload {
                records[id as usize] += 1;
            }
        }
        let peak = tree.active_range().map_or(0.0, |r| f64::from(r.max) - f64::from(r.min));
        Self {
            least_step: vec![0; uses.len()],
            loans: vec![None; uses.len()],
            lends: vec![None; uses.len()],
            peak,
            active_voxels: tree.frames.iter().map(|f| f.stats.active_leaf_voxels).sum(),
            voxel_size: grid.voxel_size,
            uses,
            records,
            trials,
            tree,
        }
    }

    /// The squared error that `voxels` may have together at some PSNR.
    fn allowance(&self, voxels: u64, psnr: f64) -> f64 {
        voxels as f64 * self.peak * self.peak * 10f64.powf(-psnr / 10.0) * ROUNDING
    }

    fn psnr(&self, voxels: u64, squares: f64) -> f64 {
        10.0 * (voxels as f64 * self.peak * self.peak / squares).log10()
    }

    /// The cost of a codec that was not tried is none.
    fn cost(&self, brick: usize, rung: Rung) -> Cost {
        match rung {
            Rung::Borrowed => self.loans[brick].map_or(Cost::IMPOSSIBLE, |loan| loan.cost),
            rung => self.trials.cost(brick, rung).unwrap_or(Cost::NONE),
        }
    }

    /// A brick's error in squared peaks, over all its users and over all the voxels that its texels give.
    fn distortion(&self, brick: usize, rung: Rung) -> f64 {
        self.in_peaks(brick, self.cost(brick, rung).norm)
    }

    fn in_peaks(&self, brick: usize, norm: f64) -> f64 {
        // Where all active values are the same, nothing but no error will do.
        let peak = if self.peak > 0.0 { self.peak } else { f64::MIN_POSITIVE };
        if norm == 0.0 { 0.0 } else { f64::from(self.uses[brick]) * (norm / peak) * (norm / peak) }
    }

    fn active_squares(&self, brick: usize, rung: Rung) -> f64 {
        f64::from(self.cost(brick, rung).active_norm).powi(2)
    }

    /// The bits of a brick's texels and of all its records.
    fn bits(&self, brick: usize, rung: Rung) -> f64 {
        let texels = 8 * rung.codec().layout().brick_bytes() as u32;
        let records = if rung == Rung::Empty { 0 } else { RECORD_BITS * self.records[brick] };
        f64::from(texels + records)
    }

    /// The rung with the least D + λR; of equals the cheapest.
    fn pick(&self, brick: usize, step: u32) -> Rung {
        if let Some(rung) = self.lends[brick] {
            return rung;
        }
        let lambda = lambda(step.max(self.least_step[brick]));
        let cost = |rung: Rung| self.distortion(brick, rung) + lambda * self.bits(brick, rung);
        let cheapest = Rung::ALL.into_iter().map(|rung| (rung, cost(rung)));
        cheapest.reduce(|best, next| if next.1 < best.1 { next } else { best }).expect("there are rungs").0
    }

    fn picks(&self, step: u32) -> Vec<Rung> {
        (0..self.uses.len()).into_par_iter().map(|brick| self.pick(brick, step)).collect()
    }

    /// The squared error of all frames over active voxels, summed in the order of the bricks.
    fn squares(&self, picks: &[Rung]) -> f64 {
        let each = picks.iter().enumerate();
        each.map(|(brick, &rung)| f64::from(self.uses[brick]) * self.active_squares(brick, rung)).sum()
    }

    /// Tries what was picked without having been tried. Whether there was any.
    fn try_unknown(
        &mut self,
        picks: impl Iterator<Item = (u32, Rung)>,
        advance: &mut dyn FnMut(u64),
    ) -> io::Result<bool> {
        let unknown =
            picks.filter(|&(id, rung)| rung == Rung::Bc7 && self.trials.cost(id as usize, rung).is_none());
        let unknown: Vec<u32> = unknown.map(|(id, _)| id).collect();
        self.trials.try_bc7(self.tree, &unknown, advance)?;
        Ok(!unknown.is_empty())
    }

    fn at_psnr(&mut self, psnr: f64, floor: f64, advance: &mut dyn FnMut(u64)) -> io::Result<Vec<Rung>> {
        let (step, alone) = self.at_psnr_with_loans(psnr, floor, advance)?;
        self.find_loans(&alone, step)?;
        let (_, together) = self.at_psnr_with_loans(psnr, floor, advance)?;
        let bits =
            |picks: &[Rung]| (0..).zip(picks).map(|(brick, &rung)| self.bits(brick, rung)).sum::<f64>();
        if bits(&together) < bits(&alone) {
            return Ok(together);
        }
        self.forget_loans();
        Ok(alone)
    }

    fn at_psnr_with_loans(
        &mut self,
        psnr: f64,
        floor: f64,
        advance: &mut dyn FnMut(u64),
    ) -> io::Result<(u32, Vec<Rung>)> {
        let allowed = self.allowance(self.active_voxels, psnr);
        loop {
            let step = first_step(|step| self.squares(&self.picks(step)) <= allowed);
            let fine = self.picks(step);
            if self.try_unknown((0..).zip(fine.iter().copied()), advance)? {
                continue;
            }
            let mut picks = self.picks(step.saturating_sub(1));
            let mut squares = self.squares(&picks);
            for switch in switches(0, self, &picks, &fine) {
                if squares <= allowed {
                    break;
                }
                let (brick, uses) = (switch.brick, f64::from(self.uses[switch.brick]));
                squares -= uses * self.active_squares(brick, picks[brick]);
                squares += uses * self.active_squares(brick, switch.to);
                picks[brick] = switch.to;
            }
            // Differences were added up; the sum itself decides.
            if self.squares(&picks) > allowed {
                picks = fine;
            }
            if !self.raise_frames(&picks, floor, advance)? {
                return Ok((step, picks));
            }
        }
    }

    /// Finds out which bricks had better borrow, were λ what it is at `step`. A brick lends or borrows, and one that
    /// lends keeps the codec it has.
    fn find_loans(&mut self, picks: &[Rung], step: u32) -> io::Result<()> {
        let whole = |id: &u32| self.trials.is_whole(*id as usize) && picks[*id as usize] != Rung::Empty;
        let borrowers: Vec<u32> = (0..picks.len() as u32).filter(whole).collect();
        let lends = |&id: &u32| {
            let rung = picks[id as usize];
            matches!(rung, Rung::Bc7 | Rung::Bc4 | Rung::Unorm8).then_some((id, rung))
        };
        let lenders: Vec<(u32, Rung)> = borrowers.iter().filter_map(lends).collect();
        let offers = loans(&mut self.trials, self.tree, &borrowers, &lenders)?;
        let gain = |id: u32, loan: &Loan| {
            let brick = id as usize;
            let lambda = lambda(step.max(self.least_step[brick]));
            let own = self.distortion(brick, picks[brick]) + lambda * self.bits(brick, picks[brick]);
            own - self.in_peaks(brick, loan.cost.norm) - lambda * self.bits(brick, Rung::Borrowed)
        };
        let mut order: Vec<(f64, u32, Loan)> = borrowers
            .iter()
            .zip(&offers)
            .flat_map(|(&id, offers)| offers.iter().map(move |loan| (id, *loan)))
            .map(|(id, loan)| (gain(id, &loan), id, loan))
            .filter(|(gain, ..)| *gain > 0.0)
            .collect();
        order.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        for (_, id, loan) in order {
            let (id, lender) = (id as usize, loan.lender as usize);
            if self.loans[id].is_none() && self.lends[id].is_none() && self.loans[lender].is_none() {
                self.loans[id] = Some(loan);
                self.lends[lender] = Some(picks[lender]);
            }
        }
        Ok(())
    }

    fn forget_loans(&mut self) {
        self.loans.fill(None);
        self.lends.fill(None);
    }

    fn within(&mut self, bound: f64, advance: &mut dyn FnMut(u64)) -> io::Result<Vec<Rung>> {
        loop {
            let fits = |brick, rung| f64::from(self.cost(brick, rung).max) <= bound;
            let cheapest = |brick| Rung::ALL.into_iter().find(|&r| fits(brick, r)).unwrap_or(Rung::F32);
            let picks: Vec<Rung> = (0..self.uses.len()).map(cheapest).collect();
            if !self.try_unknown((0..).zip(picks.iter().copied()), advance)? {
                return Ok(picks);
            }
        }
    }

    /// The PSNR of all frames together.
    fn whole(&self, picks: &[Rung]) -> f64 {
        self.psnr(self.active_voxels, self.squares(picks))
    }

    /// That of the worst frame.
    fn worst_frame(&self, picks: &[Rung]) -> f64 {
        let frames = self.tree.frames.iter().map(|frame| {
            let square = |id: u32| self.active_squares(id as usize, picks[id as usize]);
            self.psnr(frame.stats.active_leaf_voxels, self.tree.frame_bricks(frame).map(square).sum())
        });
        // Where there is no error, or no voxel to err, there is no worst.
        frames.filter(|db| db.is_finite()).fold(f64::INFINITY, f64::min)
    }

    /// Binds the bricks of every frame below `floor` to the step at which it would reach it alone. Whether
    /// there was such a frame.
    fn raise_frames(&mut self, picks: &[Rung], floor: f64, advance: &mut dyn FnMut(u64)) -> io::Result<bool> {
        let mut raised = false;
        for frame in 0..self.tree.frames.len() {
            let allowed = self.allowance(self.tree.frames[frame].stats.active_leaf_voxels, floor);
            let bricks: Vec<u32> = self.tree.frame_bricks(&self.tree.frames[frame]).collect();
            let squares = |search: &Self, pick: &dyn Fn(usize) -> Rung| -> f64 {
                bricks.iter().map(|&id| search.active_squares(id as usize, pick(id as usize))).sum()
            };
            // What no step meets is met as nearly as the last one does.
            let bound = bricks.iter().all(|&id| self.least_step[id as usize] == LAST_STEP);
            if bound || squares(self, &|brick| picks[brick]) <= allowed {
                continue;
            }
            raised = true;
            let mut unique = bricks.clone();
            unique.sort_unstable();
            unique.dedup();
            self.call_in_loans(&unique);
            let step = loop {
                let step = first_step(|step| squares(self, &|brick| self.pick(brick, step)) <= allowed);
                let picked: Vec<_> = unique.iter().map(|&id| (id, self.pick(id as usize, step))).collect();
                if !self.try_unknown(picked.into_iter(), advance)? {
                    break step;
                }
            };
            for id in unique {
                let least = &mut self.least_step[id as usize];
                *least = step.max(*least);
            }
        }
        Ok(raised)
    }

    /// Ends every loan that some bricks are part of: they are to become finer, and their texels others.
    fn call_in_loans(&mut self, bricks: &[u32]) {
        for &id in bricks {
            self.loans[id as usize] = None;
            self.lends[id as usize] = None;
        }
        let lends = &self.lends;
        let ended = |loan: &Loan| lends[loan.lender as usize].is_none();
        self.loans.iter_mut().filter(|loan| loan.as_ref().is_some_and(ended)).for_each(|loan| *loan = None);
    }

    fn finish(mut self, picks: &[Rung]) -> io::Result<Allocation> {
        let mut allocation = Allocation::new(self.trials.sequence, self.trials.ranges.clone(), Coding::Empty);
        for (brick, &rung) in picks.iter().enumerate() {
            allocation.norms[brick] = self.cost(brick, rung).norm;
            allocation.codings[brick] = match rung {
                Rung::Empty => Coding::Empty,
                Rung::Constant => Coding::Constant(self.trials.constants[brick]),
                Rung::Borrowed => continue,
                rung => Coding::Own(rung.codec()),
            };
        }
        for brick in (0..picks.len()).filter(|&brick| picks[brick] == Rung::Borrowed) {
            let loan = self.loans[brick].expect("who borrows has a loan");
            allocation.ranges[brick] = loan.range;
            let lender = loan.lender as usize;
            allocation.codings[brick] = match allocation.codings[lender] {
                Coding::Own(codec) => {
                    let (bytes, axis) = self.trials.texels_of(self.tree, loan.lender, codec)?;
                    allocation.shapes.push(Shape { codec, bytes, axis });
                    allocation.codings[lender] = Coding::Shared(allocation.shapes.len() as u32 - 1);
                    allocation.codings[lender]
                }
                shared => shared,
            };
        }
        allocation.tighten(self.tree);
        let is_empty = |id: u32| picks[id as usize] == Rung::Empty;
        let square = |id: u32| allocation.norms[id as usize].powi(2);
        let frames = self.tree.frames.iter();
        allocation.empty_squares =
            frames.map(|f| self.tree.frame_bricks(f).filter(|&id| is_empty(id)).map(square).sum()).collect();
        self.tree.prune(is_empty);
        allocation.kept = Some(self.trials.kept);
        Ok(allocation)
    }
}

/// The first step, of 0 to [`LAST_STEP`], that meets what every finer one meets too; the last if none does.
fn first_step(meets: impl Fn(u32) -> bool) -> u32 {
    let (mut low, mut high) = (0, LAST_STEP);
    while low < high {
        let middle = (low + high) / 2;
        if meets(middle) {
            high = middle;
        } else {
            low = middle + 1;
        }
    }
    low
}

/// One brick's move to a finer codec.
struct Switch {
    grid: usize,
    brick: usize,
    to: Rung,
    /// Squared peaks less for each bit more.
    gain: f64,
}

/// The bricks in which two steps of a grid differ, most gain for a bit first.
fn switches(grid: usize, search: &GridSearch, coarse: &[Rung], fine: &[Rung]) -> Vec<Switch> {
    let differ = (0..coarse.len()).filter(|&brick| coarse[brick] != fine[brick]);
    let mut switches: Vec<Switch> = differ
        .map(|brick| {
            let (from, to) = (coarse[brick], fine[brick]);
            let less = search.distortion(brick, from) - search.distortion(brick, to);
            Switch { grid, brick, to, gain: less / (search.bits(brick, to) - search.bits(brick, from)) }
        })
        .collect();
    switches.sort_by(|a, b| b.gain.total_cmp(&a.gain).then(a.brick.cmp(&b.brick)));
    switches
}

/// The finest choice that takes at most `limit` bytes, with one λ for all grids; the coarsest if none does.
fn at_size(
    searches: &mut [GridSearch],
    limit: u64,
    target: &Target,
    advance: &mut dyn FnMut(u64),
) -> io::Result<Vec<Vec<Rung>>> {
    let fixed = target.fixed_bytes;
    let floors = match target.min_frame_psnr {
        Some(floor) => vec![floor; searches.len()],
        None => floors_at_size(searches, limit, fixed, advance)?,
    };
    let (step, alone) = at_size_above(searches, limit, fixed, &floors, advance)?;
    let squares = |searches: &[GridSearch], picks: &[Vec<Rung>]| -> f64 {
        let of_grid = |(s, picks): (&GridSearch, &Vec<Rung>)| {
            s.squares(picks) / (s.peak * s.peak).max(f64::MIN_POSITIVE)
        };
        searches.iter().zip(picks).map(of_grid).sum()
    };
    for (search, picks) in searches.iter_mut().zip(&alone) {
        search.find_loans(picks, step)?;
    }
    let (_, together) = at_size_above(searches, limit, fixed, &floors, advance)?;
    if squares(searches, &together) < squares(searches, &alone) && bytes(searches, &together, fixed) <= limit
    {
        return Ok(together);
    }
    searches.iter_mut().for_each(GridSearch::forget_loans);
    Ok(alone)
}

/// Halvings of the way between the frames' worst PSNR and what they would have to reach.
const FLOOR_HALVINGS: u32 = 6;

/// The floors of each grid's frames at which none is further below the whole than [`FRAME_MARGIN_DB`]. What the worst
/// frames gain the others lose, so the whole falls as a floor rises: it is searched for between where the worst frame
/// is without one and where it would have to be if the whole stayed.
fn floors_at_size(
    searches: &mut [GridSearch],
    limit: u64,
    fixed: u64,
    advance: &mut dyn FnMut(u64),
) -> io::Result<Vec<f64>> {
    let none = vec![f64::NEG_INFINITY; searches.len()];
    let (_, free) = at_size_above(searches, limit, fixed, &none, advance)?;
    let ends: Vec<(f64, f64)> =
        searches.iter().zip(&free).map(|(s, p)| (s.worst_frame(p), s.whole(p) - FRAME_MARGIN_DB)).collect();
    if ends.iter().all(|(worst, wanted)| worst >= wanted) {
        return Ok(none);
    }
    let floors = |part: f64| -> Vec<f64> {
        let between = |&(worst, wanted): &(f64, f64)| worst + part * (wanted - worst);
        ends.iter().map(|e| if e.0 >= e.1 { f64::NEG_INFINITY } else { between(e) }).collect()
    };
    let (mut low, mut high, mut best, mut best_is_even) = (0.0, 1.0, none, false);
    for _ in 0..FLOOR_HALVINGS {
        let middle = f64::midpoint(low, high);
        let (_, picks) = at_size_above(searches, limit, fixed, &floors(middle), advance)?;
        let even = |(s, p): (&GridSearch, &Vec<Rung>)| s.worst_frame(p) >= s.whole(p) - FRAME_MARGIN_DB;
        let is_even = searches.iter().zip(&picks).all(even);
        let fits = bytes(searches, &picks, fixed) <= limit;
        // The lowest floor that evens frames out, or else the highest that fits.
        if fits && (is_even || !best_is_even) {
            (best, best_is_even) = (floors(middle), is_even);
        }
        if fits && !is_even { low = middle } else { high = middle }
    }
    Ok(best)
}

/// The finest choice that takes at most `limit` bytes and has no frame below its grid's floor, and its step. Where
/// nothing is small enough, the coarsest.
fn at_size_above(
    searches: &mut [GridSearch],
    limit: u64,
    fixed: u64,
    floors: &[f64],
    advance: &mut dyn FnMut(u64),
) -> io::Result<(u32, Vec<Vec<Rung>>)> {
    let all = |searches: &[GridSearch], step| searches.iter().map(|s| s.picks(step)).collect::<Vec<_>>();
    searches.iter_mut().for_each(|s| s.least_step.fill(0));
    loop {
        // The first step that is too large: the one before is the last that fits.
        let too_large = first_step(|step| bytes(searches, &all(searches, step), fixed) > limit);
        let fits = too_large.saturating_sub(1);
        let mut unknown = false;
        for step in [fits, too_large] {
            for search in searches.iter_mut() {
                let picks = search.picks(step);
                unknown |= search.try_unknown((0..).zip(picks), advance)?;
            }
        }
        if unknown {
            continue;
        }
        let fine = all(searches, too_large);
        let mut picks =
            if bytes(searches, &fine, fixed) <= limit { fine.clone() } else { all(searches, fits) };
        let mut order: Vec<Switch> = Vec::new();
        for (g, (search, (coarse, fine))) in searches.iter().zip(picks.iter().zip(&fine)).enumerate() {
            order.extend(switches(g, search, coarse, fine));
        }
        order.sort_by(|a, b| b.gain.total_cmp(&a.gain));
        let (mut counts, mut saved) = (counts(&picks), saved_bytes(searches, &picks));
        for Switch { grid, brick, to, .. } in order {
            let from = picks[grid][brick];
            counts[from as usize] -= 1;
            counts[to as usize] += 1;
            picks[grid][brick] = to;
            if from == Rung::Empty {
                saved = saved_bytes(searches, &picks);
            }
            if fixed + texel_bytes(&counts) - saved > limit {
                picks[grid][brick] = from;
                break;
            }
        }
        let mut raised = false;
        for ((search, picks), &floor) in searches.iter_mut().zip(&picks).zip(floors) {
            raised |= search.raise_frames(picks, floor, advance)?;
        }
        if !raised {
            return Ok((fits, picks));
        }
    }
}

/// What tree, masks and texels take together.
fn bytes(searches: &[GridSearch], picks: &[Vec<Rung>], fixed: u64) -> u64 {
    fixed + texel_bytes(&counts(picks)) - saved_bytes(searches, picks)
}

/// How many bricks each rung has.
fn counts(picks: &[Vec<Rung>]) -> [u32; Rung::ALL.len()] {
    let mut counts = [0; Rung::ALL.len()];
    picks.iter().flatten().for_each(|&rung| counts[rung as usize] += 1);
    counts
}

/// What the texture pages of that many bricks take.
fn texel_bytes(counts: &[u32; Rung::ALL.len()]) -> u64 {
    let bytes = |rung: Rung| relayout::plan(rung.codec(), counts[rung as usize]).bytes();
    Rung::ALL.into_iter().filter(|rung| rung.codec() != Codec::Constant).map(bytes).sum()
}

/// What empty bricks do without: their records, and nodes of which nothing is left.
fn saved_bytes(searches: &[GridSearch], picks: &[Vec<Rung>]) -> u64 {
    let of_grid = |(search, picks): (&GridSearch, &Vec<Rung>)| {
        let empty = picks.iter().zip(&search.records).filter(|(rung, _)| **rung == Rung::Empty);
        let records: u64 = empty.map(|(_, records)| u64::from(records * RECORD_BITS / 8)).sum();
        let tree = &*search.tree;
        let is_empty = |&record: &u32| match tree.records[record as usize].payload {
            Payload::Brick(id) => picks[id as usize] == Rung::Empty,
            Payload::Constant(_) => false,
        };
        let nodes = tree.nodes.items().iter().filter(|node| node.entries(&tree.runs).iter().all(is_empty));
        records + nodes.count() as u64 * NODE_WORDS as u64 * 4
    };
    searches.iter().zip(picks).map(of_grid).sum()
}
