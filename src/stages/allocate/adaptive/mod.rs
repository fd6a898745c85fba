//! Every brick in the codec that serves the whole best, as rate-distortion theory has it: the least D + λR, with one λ for
//! all (Shoham & Gersho 1988).

mod candidate;
mod choices;
mod codebook;
mod frame_floor;
mod lending;
mod offers;
mod search;
mod size;
mod steps;
mod switches;
mod target;
mod texel_references;

use super::Allocation;
use crate::cancel::CancelToken;
use crate::error::Result;
use crate::settings::{FRAME_MARGIN_DB, Quality};
use choices::tried_at_once;
pub use offers::{EarlierOffers, Offer, OfferInputs, Offers};
use search::GridSearch;
use size::at_size;
pub use target::{AdaptiveGrid, Target};

/// Gives each brick of each grid its codec. `advance` hears of bricks that slow codecs were tried on.
///
/// # Errors
/// When bricks cannot be read, a scratch file fails, or the work is cancelled.
pub fn adaptive(
    grids: Vec<AdaptiveGrid>,
    target: &Target,
    cancel: &CancelToken,
    advance: &mut dyn FnMut(u64),
) -> Result<Vec<Allocation>> {
    let mut searches = Vec::new();
    for grid in grids {
        let all: Vec<u32> = (0..grid.tree.pool.len()).collect();
        grid.encoders.make(grid.tree, &all, &tried_at_once(), |_| ())?;
        searches.push(GridSearch::new(grid, cancel.clone())?);
    }
    let picks = match target.size {
        Some(bytes) => at_size(&mut searches, bytes, target, advance)?,
        None => searches
            .iter_mut()
            .map(|search| match search.quality {
                Quality::Psnr(db) => {
                    let floor = target.min_frame_psnr.unwrap_or(db - FRAME_MARGIN_DB);
                    search.at_psnr(db, floor, advance)
                }
                Quality::MaxError(bound) => {
                    search.within(bound.absolute(search.table.peak, search.voxel_size), advance)
                }
                other => unreachable!("{other} is a size, or was made one that suits the grid"),
            })
            .collect::<Result<_>>()?,
    };
    let each = searches.into_iter().zip(picks);
    each.map(|(search, picks)| search.finish(&picks)).collect()
}
