//! Every brick in the codec that serves the whole best.

use std::io;

use super::choices::AT_ONCE;
use super::search::GridSearch;
use super::size::at_size;
use super::{AllocateError, Allocation};
use crate::settings::{FRAME_MARGIN_DB, Quality};
use crate::stages::dedup::SequenceTree;
use crate::stages::encodings::Encodings;

/// One grid to be allocated.
pub struct AdaptiveGrid<'a> {
    /// Its nodes and bricks.
    pub tree: &'a mut SequenceTree,
    /// What codecs make of its bricks.
    pub encodings: Encodings,
    /// What is asked of it, where no size is asked of all.
    pub quality: Quality,
    /// What its errors are measured against.
    pub peak: f64,
    /// A voxel's smallest side.
    pub voxel_size: f64,
}

/// What a pack is asked for beside the quality of each grid.
#[derive(Clone, Copy, Debug)]
pub struct Target {
    /// The most bytes of tree, masks and texels together.
    pub size: Option<u64>,
    /// The PSNR that no frame falls below; 6 dB below the whole's where none is given.
    pub min_frame_psnr: Option<f64>,
    /// Bytes of tree and masks with a record for every brick; only where a size is asked for.
    pub fixed_bytes: u64,
}

/// Gives each brick of each grid its codec. `advance` hears of bricks that BC7 was tried on.
///
/// # Errors
/// [`AllocateError`].
pub fn adaptive(
    grids: Vec<AdaptiveGrid>,
    target: &Target,
    advance: &mut dyn FnMut(u64),
) -> Result<Vec<Allocation>, AllocateError> {
    let mut searches = Vec::new();
    for mut grid in grids {
        let all: Vec<u32> = (0..grid.tree.pool.len()).collect();
        grid.encodings.make(grid.tree, &all, &AT_ONCE, |_| ())?;
        searches.push(GridSearch::new(grid)?);
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
            .collect::<io::Result<_>>()?,
    };
    let each = searches.into_iter().zip(picks);
    Ok(each.map(|(search, picks)| search.finish(&picks)).collect::<io::Result<_>>()?)
}
