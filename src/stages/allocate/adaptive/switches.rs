//! Bricks that change their candidate between two steps.

use super::candidate::Candidate;
use super::choices::{BLOCK, Table};
use crate::error::Result;

/// One brick's move to a finer codec.
pub(super) struct Switch {
    pub grid: u32,
    pub brick: u32,
    /// Squared peaks less for each bit more.
    pub gain: f64,
    /// Its squared error over active voxels of all frames, before and after.
    pub squares: [f64; 2],
}

/// The bricks in which two steps of a grid differ, most gain for a bit first.
pub(super) fn switches(
    grid: u32,
    table: &Table,
    coarse: &[Candidate],
    fine: &[Candidate],
) -> Result<Vec<Switch>> {
    let differ: Vec<u32> =
        (0..).zip(coarse.iter().zip(fine)).filter(|(_, (a, b))| a != b).map(|(id, _)| id).collect();
    let mut switches = Vec::with_capacity(differ.len());
    for ids in differ.chunks(BLOCK as usize) {
        for (&brick, choices) in ids.iter().zip(&table.read(ids)?) {
            let weighed = table.weighed(brick, choices);
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
