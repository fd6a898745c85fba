//! Stage 5 over the grids of a pack.

use super::Progress;
use super::cached_bricks::{self, CachedOffers, GridCache};
use crate::cancel::CancelToken;
use crate::error::{Error, Result};
use crate::settings::{Encoding, Integers, Quality, Settings, whole_range};
use crate::stages::allocate::{self, AdaptiveGrid, Allocation, EarlierOffers, Target};
use crate::stages::dedup::SequenceTree;
use crate::stages::encoder_cache::{ConstantAim, EncoderCache, Terms};
use crate::stages::select::GridFacts;
use crate::stages::serialise::tree_bytes;
use crate::vdb::GridClass;
use crate::verify;
use crate::volume::ValueRange;

/// A grid that is being built.
pub(super) struct GridBuild {
    /// What is known of it before a voxel is read.
    pub facts: GridFacts,
    /// Its nodes and bricks.
    pub tree: SequenceTree,
    /// What makes their texels.
    pub encoders: EncoderCache,
    /// What earlier builds found of bricks that suit each other, with a cache.
    offers: Option<CachedOffers>,
}

impl GridBuild {
    /// A grid of which no texel is made yet, with the cache around its encoders.
    ///
    /// # Errors
    /// A grid whose values no float or no range holds.
    pub fn new(
        facts: GridFacts,
        tree: SequenceTree,
        cache: Option<GridCache>,
        settings: &Settings,
        cancel: &CancelToken,
    ) -> Result<Self> {
        check_integers(&facts, &tree, settings)?;
        let encoders = EncoderCache::new(&tree, terms(&facts, &tree, settings), cancel.clone());
        let mut encoders = encoders.ok_or_else(|| {
            Error::Input(format!(
                "grid {:?}: its values span more than an f32 can hold: scale the grid down before the export",
                facts.name
            ))
        })?;
        let offers = cache.map(|cache| cached_bricks::wrap(&mut encoders, cache));
        Ok(Self { facts, tree, encoders, offers })
    }

    /// Keeps what was made of its bricks.
    ///
    /// # Errors
    /// When a scratch file cannot be read back.
    pub fn save(&mut self) -> Result<()> {
        Ok(self.encoders.save(&self.tree)?)
    }
}

/// Bytes of the trees and masks of all grids.
fn all_tree_bytes(grids: &[GridBuild]) -> Result<u64> {
    tree_bytes(grids.iter().map(|grid| (&grid.facts, &grid.tree)))
}

/// Decides how the bricks of every grid are coded.
pub(super) fn allocate(
    grids: &mut [GridBuild],
    settings: &Settings,
    progress: &mut dyn Progress,
) -> Result<Vec<Allocation>> {
    let Encoding::Uniform { codec, clustering } = &settings.encoding else {
        return adaptive(grids, settings, progress);
    };
    let mut allocations = Vec::new();
    for GridBuild { facts, tree, encoders, .. } in grids {
        allocations.push(match clustering {
            None => allocate::uniform(tree, encoders, *codec),
            Some(clustering) => {
                progress.stage("cluster", tree.pool.len().into(), "bricks");
                allocate::clustered(&facts.name, tree, encoders, *codec, settings.range, clustering)?
            }
        });
    }
    Ok(allocations)
}

fn adaptive(
    grids: &mut [GridBuild],
    settings: &Settings,
    progress: &mut dyn Progress,
) -> Result<Vec<Allocation>> {
    let size = match settings.quality() {
        Quality::Size(bytes) => Some(bytes),
        Quality::BitsPerVoxel(bits) => Some((bits * 64.0 * leaves(grids) as f64) as u64),
        _ => None,
    };
    let target = Target {
        size,
        min_frame_psnr: settings.min_frame_psnr(),
        fixed_bytes: if size.is_some() { all_tree_bytes(grids)? } else { 0 },
    };
    let bricks: u64 = grids.iter().map(|grid| u64::from(grid.tree.pool.len())).sum();
    progress.stage("allocate", bricks, "bricks");
    let mut asked = Vec::new();
    for GridBuild { facts, tree, encoders, offers } in grids {
        let (quality, voxel_size, peak) =
            (quality(facts, tree, settings), facts.smallest_voxel(), peak(tree));
        if let Quality::MaxError(bound) = quality
            && bound.absolute(peak, voxel_size) >= peak
        {
            return Err(Error::Usage(format!(
                "grid {:?}: {}",
                facts.name,
                whole_range(bound, peak, voxel_size)
            )));
        }
        let earlier = offers.as_ref().map(|offers| offers as &dyn EarlierOffers);
        asked.push(AdaptiveGrid { tree, encoders, earlier, quality, peak, voxel_size });
    }
    let cancel = progress.cancel_token();
    allocate::adaptive(asked, &target, &cancel, &mut |bricks| progress.advance(bricks))
}

/// A level set whose distances keep a bound keeps its signs where the surface is further than this part of it: its surface
/// is what was asked for, and a wide band has edges along which thousands of voxels are next to 0.
const SIGNED_PART_OF_BOUND: f64 = 0.2;

fn terms(facts: &GridFacts, tree: &SequenceTree, settings: &Settings) -> Terms {
    let is_adaptive = settings.is_adaptive();
    let (quality, voxel_size) = (quality(facts, tree, settings), facts.smallest_voxel());
    let sign_matters = verify::SIGN_MATTERS_VOXELS * voxel_size;
    let (aim, sign_matters) = match quality {
        Quality::MaxError(bound) => {
            let bound = bound.absolute(peak(tree), voxel_size);
            (ConstantAim::Max, sign_matters.min(SIGNED_PART_OF_BOUND * bound))
        }
        _ => (ConstantAim::Squares, sign_matters),
    };
    Terms {
        range: settings.range,
        aim,
        // One codec for all bricks is kept whatever it does to signs and integers: verification says so.
        sign_matters: (facts.class == GridClass::LevelSet && is_adaptive).then_some(sign_matters),
        error_below: (facts.is_integer && settings.integers != Integers::Nearest && is_adaptive)
            .then_some(verify::KEPT_INTEGER_ERROR),
    }
}

/// Integers that no float holds are not kept by any codec.
fn check_integers(facts: &GridFacts, tree: &SequenceTree, settings: &Settings) -> Result<()> {
    let frames = facts.frames.iter().zip(&tree.frames);
    match frames.into_iter().find(|(_, frame)| frame.stats.rounding > 0.0) {
        Some((frame, _)) if facts.is_integer && settings.integers == Integers::Keep => {
            Err(Error::Input(format!(
                "grid {:?} frame {}: it has integers past 16,777,216 that no 32-bit float holds: set integers = \"split\" \
             (--integers split) to pack it as grids of 24 bits that give every integer back exactly, or \"nearest\" to \
             take the nearest floats",
                facts.name, frame.number
            )))
        }
        _ => Ok(()),
    }
}

fn peak(tree: &SequenceTree) -> f64 {
    ValueRange::peak(tree.active_range(), tree.background)
}

/// What is asked of a grid.
fn quality(facts: &GridFacts, tree: &SequenceTree, settings: &Settings) -> Quality {
    settings.quality().of_grid(facts.class, peak(tree), facts.smallest_voxel())
}

/// Leaves of the source over all frames.
fn leaves(grids: &[GridBuild]) -> u64 {
    grids.iter().flat_map(|grid| &grid.tree.frames).map(|frame| frame.stats.leaves).sum()
}

/// A size that the coarsest choice does not meet is an error that names the least.
pub(super) fn check_size(grids: &[GridBuild], texel_bytes: u64, settings: &Settings) -> Result<()> {
    if !settings.is_adaptive() || !settings.quality().is_size() {
        return Ok(());
    }
    let leaves = leaves(grids);
    let bits_of = |bytes: u64| if leaves == 0 { 0.0 } else { bytes as f64 / (64.0 * leaves as f64) };
    let bytes = all_tree_bytes(grids)? + texel_bytes;
    match settings.quality() {
        Quality::Size(asked) if bytes > asked => Err(Error::Usage(format!(
            "size: {asked} bytes on the GPU cannot be reached, the least is {bytes}: raise it, or pack fewer frames"
        ))),
        Quality::BitsPerVoxel(asked) if bits_of(bytes) > asked => Err(Error::Usage(format!(
            "bits_per_voxel: {asked} cannot be reached, the least is {:.4}: raise it, or pack fewer frames",
            bits_of(bytes)
        ))),
        _ => Ok(()),
    }
}
