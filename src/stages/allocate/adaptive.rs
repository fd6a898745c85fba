//! Every brick in the codec that serves the whole best.

use super::Allocation;
use super::choices::tried_at_once;
use super::search::GridSearch;
use super::size::at_size;
use super::target::{AdaptiveGrid, Target};
use crate::cancel::CancelToken;
use crate::error::Result;
use crate::settings::{FRAME_MARGIN_DB, Quality};

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
