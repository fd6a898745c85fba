//! What the adaptive format is asked for.

use super::offers::EarlierOffers;
use crate::settings::Quality;
use crate::stages::dedup::SequenceTree;
use crate::stages::encoder_cache::EncoderCache;

/// One grid to be allocated.
pub struct AdaptiveGrid<'a> {
    /// Its nodes and bricks.
    pub tree: &'a mut SequenceTree,
    /// What codecs make of its bricks.
    pub encoders: &'a mut EncoderCache,
    /// What earlier builds found of bricks that suit each other.
    pub earlier: Option<&'a dyn EarlierOffers>,
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
