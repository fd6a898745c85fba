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
    let picks = match target.quality {
        Quality::Psnr(db) => {
            let floor = target.min_frame_psnr.unwrap_or(db - FRAME_MARGIN_DB);
            searches.iter_mut().map(|s| s.at_psnr(db, floor, advance)).collect::<io::Result<_>>()?
        }
        Quality::MaxError(bound) => {
            let within = |s: &mut GridSearch| s.within(bound.absolute(s.table.peak, s.voxel_size), advance);
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
