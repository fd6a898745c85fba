//! The best choice that fits a size, with one λ for all grids of a pack.

use super::candidate::{Candidate, PerCandidate};
use super::choices::RECORD_BITS;
use super::search::GridSearch;
use super::steps::first_step;
use super::switches::{Switch, switches};
use super::target::Target;
use crate::codec::TexelCodec;
use crate::error::Result;
use crate::pack::plan;
use crate::pack::tree::NODE_WORDS;
use crate::settings::FRAME_MARGIN_DB;
use crate::stages::dedup::Payload;

/// The finest choice that takes at most `limit` bytes, with one λ for all grids; the coarsest if none does.
pub(super) fn at_size(
    searches: &mut [GridSearch],
    limit: u64,
    target: &Target,
    advance: &mut dyn FnMut(u64),
) -> Result<Vec<Vec<Candidate>>> {
    let fixed = target.fixed_bytes;
    let floors = match target.min_frame_psnr {
        Some(floor) => vec![floor; searches.len()],
        None => floors_at_size(searches, limit, fixed, advance)?,
    };
    let (step, alone) = at_size_above(searches, limit, fixed, &floors, advance)?;
    let squares = |searches: &[GridSearch], picks: &[Vec<Candidate>]| -> Result<f64> {
        searches.iter().zip(picks).map(|(s, picks)| s.squares(picks)).sum()
    };
    for (search, picks) in searches.iter_mut().zip(&alone) {
        search.find_references(picks, step, advance)?;
    }
    let (_, together) = at_size_above(searches, limit, fixed, &floors, advance)?;
    if squares(searches, &together)? < squares(searches, &alone)?
        && bytes(searches, &together, fixed) <= limit
    {
        return Ok(together);
    }
    searches.iter_mut().for_each(GridSearch::forget_references);
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
) -> Result<Vec<f64>> {
    let none = vec![f64::NEG_INFINITY; searches.len()];
    let (_, free) = at_size_above(searches, limit, fixed, &none, advance)?;
    let end = |(s, p): (&GridSearch, &Vec<Candidate>)| Ok((s.worst_frame(p)?, s.whole(p)? - FRAME_MARGIN_DB));
    let ends = |searches: &[GridSearch], picks: &[Vec<Candidate>]| -> Result<Vec<(f64, f64)>> {
        searches.iter().zip(picks).map(end).collect()
    };
    let free = ends(searches, &free)?;
    // A grid without error has no worst frame and no PSNR: neither is below the other.
    let is_low = |(worst, wanted): &(f64, f64)| worst < wanted;
    if !free.iter().any(is_low) {
        return Ok(none);
    }
    let floors = |part: f64| -> Vec<f64> {
        let between = |&(worst, wanted): &(f64, f64)| worst + part * (wanted - worst);
        free.iter().map(|e| if is_low(e) { between(e) } else { f64::NEG_INFINITY }).collect()
    };
    let (mut low, mut high, mut best, mut best_is_even) = (0.0, 1.0, none, false);
    for _ in 0..FLOOR_HALVINGS {
        let middle = f64::midpoint(low, high);
        let (_, picks) = at_size_above(searches, limit, fixed, &floors(middle), advance)?;
        let is_even = !ends(searches, &picks)?.iter().any(is_low);
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
) -> Result<(u32, Vec<Vec<Candidate>>)> {
    let all = |searches: &[GridSearch], step| -> Result<Vec<Vec<Candidate>>> {
        searches.iter().map(|s| s.picks(step)).collect()
    };
    searches.iter_mut().for_each(|s| s.least_step.fill(0));
    loop {
        // The first step that is too large: the one before is the last that fits.
        let too_large = first_step(None, |step| Ok(bytes(searches, &all(searches, step)?, fixed) > limit))?;
        let fits = too_large.saturating_sub(1);
        let mut unknown = false;
        for step in [fits, too_large] {
            for search in searches.iter_mut() {
                let picks = search.picks(step)?;
                unknown |= search.try_unknown((0..).zip(picks), advance)?;
            }
        }
        if unknown {
            continue;
        }
        let fine = all(searches, too_large)?;
        let picks = if bytes(searches, &fine, fixed) <= limit { fine.clone() } else { all(searches, fits)? };
        let mut order: Vec<Switch> = Vec::new();
        for (g, (search, (coarse, fine))) in (0..).zip(searches.iter().zip(picks.iter().zip(&fine))) {
            order.extend(switches(g, &search.table, coarse, fine)?);
        }
        order.sort_by(|a, b| b.gain.total_cmp(&a.gain));
        let moved = |count: usize| {
            let mut picks = picks.clone();
            for &Switch { grid, brick, .. } in &order[..count] {
                picks[grid as usize][brick as usize] = fine[grid as usize][brick as usize];
            }
            picks
        };
        let (mut low, mut high) = (0, order.len());
        while low < high {
            let middle = (low + high).div_ceil(2);
            if bytes(searches, &moved(middle), fixed) <= limit { low = middle } else { high = middle - 1 }
        }
        let picks = moved(low);
        let mut raised = false;
        for ((search, picks), &floor) in searches.iter_mut().zip(&picks).zip(floors) {
            raised |= search.raise_frames(picks, floor, fits, advance)?;
        }
        if !raised {
            return Ok((fits, picks));
        }
    }
}

/// What tree, masks and texels take together.
fn bytes(searches: &[GridSearch], picks: &[Vec<Candidate>], fixed: u64) -> u64 {
    fixed + texel_bytes(&counts(picks)) - saved_bytes(searches, picks)
}

/// How many bricks each candidate has.
fn counts(picks: &[Vec<Candidate>]) -> PerCandidate<u32> {
    let mut counts = [0; Candidate::ALL.len()];
    picks.iter().flatten().for_each(|&candidate| counts[candidate.index()] += 1);
    counts
}

/// What the texture pages of that many bricks take.
fn texel_bytes(counts: &PerCandidate<u32>) -> u64 {
    let bytes = |codec: TexelCodec| plan(codec.codec(), counts[Candidate::Texels(codec).index()]).bytes();
    TexelCodec::ALL.into_iter().map(bytes).sum()
}

/// What empty bricks do without: their records, and nodes of which nothing is left.
fn saved_bytes(searches: &[GridSearch], picks: &[Vec<Candidate>]) -> u64 {
    let of_grid = |(search, picks): (&GridSearch, &Vec<Candidate>)| {
        let tree = &*search.tree;
        let is_empty = |&record: &u32| match tree.record(record).payload() {
            Payload::Brick(id) => picks[id as usize] == Candidate::Empty,
            Payload::Constant(_) => false,
        };
        let records = tree.runs.items().iter().filter(|entry| is_empty(entry)).count() as u64;
        let nodes = tree.nodes.all().iter().filter(|node| node.entries(&tree.runs).iter().all(is_empty));
        records * u64::from(RECORD_BITS / 8) + nodes.count() as u64 * NODE_WORDS as u64 * 4
    };
    searches.iter().zip(picks).map(of_grid).sum()
}
