//! Every brick in the codec that serves the whole best.

use std::io;

use super::search::GridSearch;
use super::size::at_size;
use super::trial::{ConstantAim, Trials};
use super::{AllocateError, Allocation};
use crate::settings::{FRAME_MARGIN_DB, Quality, RangeMode};
use crate::stages::dedup::SequenceTree;

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
    /// Bytes of tree and masks with a record for every brick.
    pub fixed_bytes: u64,
}

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
