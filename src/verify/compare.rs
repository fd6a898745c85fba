//! One frame of a pack against the tree of its source.

use rayon::prelude::*;

use super::Reading;
use super::frame_error::{FrameError, error_bin};
use super::promise::Promise;
use crate::codec::{BrickRange, Codec, Fidelity};
use crate::pack::{FrameReader, Region};
use crate::settings::Masks;
use crate::vdb::{Accessor, GridInfo, Internal, Scalar, Tree};
use crate::volume::{
    BRICK_DIM, BRICK_VOXELS, Constant, Coord, InactiveRule, L1_DIM, L2_DIM, Mask512, ValueRange,
};

/// Compares a frame of a pack with the tree that it was made from.
pub(super) fn compare<T: Scalar>(
    tree: &Tree<T>,
    info: &GridInfo,
    reading: Reading,
    reader: &FrameReader,
    promise: &Promise,
) -> FrameError {
    let comparison = Comparison { tree, reading, reader, promise };
    let mut error = FrameError::default();
    comparison.check_header(info, &mut error);
    comparison.check_tiles(&mut error);
    comparison.check_outside(&mut error);
    // Summed leaf by leaf in a fixed order, so that figures do not depend on threads.
    let leaves: Vec<FrameError> =
        (0..tree.leaves.len()).into_par_iter().map(|leaf| comparison.leaf(leaf)).collect();
    leaves.into_iter().for_each(|leaf| error.add(leaf));
    comparison.check_error_l2(&mut error);
    error
}

struct Comparison<'a, T> {
    tree: &'a Tree<T>,
    reading: Reading,
    reader: &'a FrameReader<'a>,
    promise: &'a Promise<'a>,
}

/// How far the error that is measured may be from the one that the encoder left in the frame table: both
/// are sums of the same squares, in another order.
const ERROR_L2_TOLERANCE: f64 = 1e-12;

impl<T: Scalar> Comparison<'_, T> {
    fn check_header(&self, info: &GridInfo, error: &mut FrameError) {
        let frame = &self.reader.frame().record;
        let stats = self.tree.topology_stats();
        error.active_voxels = stats.active_voxels;
        if frame.bbox != stats.bbox.to_array()
            || frame.leaves != stats.leaves
            || frame.active_voxels != stats.active_voxels
        {
            error.fail(|| "the frame table's box or counts are not the source's".to_owned());
        }
        if Some(frame.transform) != info.transform.matrix {
            error.fail(|| "the transform is not the source's".to_owned());
        }
        let (ours, theirs) = (self.reader.grid().background, self.reading.value(self.tree.background));
        let empty = stats.leaves == 0 && self.tree.l1.is_empty() && self.tree.tiles.is_empty();
        if ours != theirs && !empty {
            error.fail(|| format!("the background is {ours}, the source's is {theirs}"));
        }
    }

    /// Every tile of the source but inactive background must be there exactly.
    fn check_tiles(&self, error: &mut FrameError) {
        for tile in &self.tree.tiles {
            self.check_tile(tile.origin, L1_DIM, tile.value, tile.active, error);
        }
        let levels: [(&[Internal<T>], u32, i32); 2] =
            [(&self.tree.l1, 5, L2_DIM), (&self.tree.l2, 4, BRICK_DIM)];
        for (nodes, log2, dim) in levels {
            for node in nodes {
                for i in node.tile_indices() {
                    let origin = node.origin.offset_by(Coord::child_offset(i, log2, dim));
                    self.check_tile(origin, dim, node.tiles[i], node.is_active(i), error);
                }
            }
        }
    }

    fn check_tile(&self, origin: Coord, dim: i32, value: T, active: bool, error: &mut FrameError) {
        let value = self.reading.value(value);
        if active {
            error.add_active_value(value);
        } else if value == self.reader.grid().background {
            return;
        }
        let (region, region_dim) = self.reader.locate(origin);
        let same = match region {
            Region::Background => false,
            Region::Constant(constant) => {
                region_dim >= dim && (constant.value, constant.active) == (value, active)
            }
            Region::Brick(record) => {
                region_dim >= dim
                    && self.reader.decode(&record).is_ok_and(|brick| {
                        let state = if active { Mask512::ALL } else { Mask512::NONE };
                        brick.active == state && brick.values.iter().all(|v| *v == value)
                    })
            }
        };
        if !same {
            error.fail(|| format!("the {dim}³ tile at {:?} is not {value}", origin.0));
        }
    }

    /// Nothing may be where the source has inactive background, nor reach further than a tile of it; all else of the source
    /// is asked for.
    fn check_outside(&self, error: &mut FrameError) {
        let source = Accessor::new(self.tree);
        let background = self.reader.grid().background;
        self.reader.for_each_region(|origin, dim, _| {
            error.has_regions = true;
            let fits = match source.tile(origin) {
                Some(tile) => {
                    tile.dim >= dim && (tile.active || self.reading.value(tile.value) != background)
                }
                None => dim == BRICK_DIM,
            };
            if !fits {
                error.fail(|| format!("the pack has voxels at {:?}, where the source has none", origin.0));
            }
        });
    }

    /// The encoder's error is known to the last bit, so texels that were changed later give themselves
    /// away, also in block formats, whose own promise is loose.
    fn check_error_l2(&self, error: &mut FrameError) {
        let ours = error.codec_squares.iter().sum::<f64>().sqrt();
        let theirs = self.reader.frame().record.error_l2;
        // What the pack says may be infinite or no number, and is not near anything then.
        let is_near = (ours - theirs).abs() <= ERROR_L2_TOLERANCE * ours;
        if !is_near {
            error.fail(|| format!("the texels' error is {ours:e}, the encoder left {theirs:e}"));
        }
    }

    /// What follows for a leaf's voxels from what the pack was asked for and what it records: nothing else may be asked of
    /// them.
    fn contract(&self, region: &Region, leaf: usize) -> Contract {
        let settings = self.promise.settings;
        // What is as good as background in a lossy pack without masks needs no record.
        let drops_masks = match settings.masks {
            Masks::Keep => false,
            Masks::Drop => true,
            Masks::Auto => self.promise.sign_matters.is_none() && self.reader.grid().background == 0.0,
        };
        let may_be_empty = settings.is_adaptive() && drops_masks;
        let record = match region {
            Region::Brick(record) => record,
            Region::Background if may_be_empty => {
                return Contract {
                    keeps_mask: false,
                    exact_inactive: false,
                    codec: Some(Codec::Constant),
                    values: Bound::Nothing,
                };
            }
            _ => {
                return Contract {
                    keeps_mask: true,
                    exact_inactive: true,
                    codec: None,
                    values: Bound::Exact,
                };
            }
        };
        let exact_inactive = record.mask.is_some() && record.rule != InactiveRule::Texel;
        let sequence = &self.reader.grid().sequence;
        let span = f64::from(sequence.span);
        let extent = BrickRange::from_word(record.word2).extent.to_f64() * span;
        // Room for the arithmetic of decoding, which is in f32.
        let slack = 1e-6 * (span + f64::from(sequence.lo).abs());
        let values = match record.codec {
            _ if settings.clustering().is_some() => Bound::Nothing,
            // A brick may read texels that were made for another, and a record does not say whether it does: their ranges
            // may well be equal. What was asked, and the frame's L2 error, hold all the same.
            codec if settings.is_adaptive() && codec.is_normalised() => Bound::Nothing,
            Codec::Constant if settings.is_adaptive() => {
                // The value lies between the least and the greatest that it stands for.
                let (source, mask) = (self.tree.leaves.values(leaf), &self.tree.leaves.masks[leaf]);
                let texel_mask = (0..BRICK_VOXELS).filter(|&i| mask.get(i) || !exact_inactive);
                let range =
                    ValueRange::union_all(texel_mask.map(|i| ValueRange::of(self.reading.value(source[i]))));
                Bound::Within(range.map_or(0.0, ValueRange::width))
            }
            codec => match codec.fidelity() {
                Fidelity::Exact => Bound::Exact,
                Fidelity::NearestHalf => Bound::Half,
                // Half a step.
                Fidelity::NearestStep { steps } => Bound::Within(extent / f64::from(2 * steps) + slack),
                Fidelity::InRange => Bound::Within(extent + slack),
            },
        };
        Contract { keeps_mask: record.mask.is_some(), exact_inactive, codec: Some(record.codec), values }
    }

    fn leaf(&self, leaf: usize) -> FrameError {
        let mut error = FrameError::default();
        let origin = self.tree.leaves.origins[leaf];
        let source = self.tree.leaves.values(leaf);
        let mask = &self.tree.leaves.masks[leaf];
        mask.ones().for_each(|i| error.add_active_value(self.reading.value(source[i])));

        let background = self.reader.grid().background;
        let (region, _) = self.reader.locate(origin);
        let constant = |c: Constant| {
            (Box::new([c.value; BRICK_VOXELS]), if c.active { Mask512::ALL } else { Mask512::NONE })
        };
        let (values, active) = match region {
            Region::Background => constant(Constant { value: background, active: false }),
            Region::Constant(c) => constant(c),
            Region::Brick(record) => match self.reader.decode(&record) {
                Ok(brick) => (brick.values, brick.active),
                Err(e) => {
                    error.fail(|| format!("the brick at {:?}: {e}", origin.0));
                    return error;
                }
            },
        };
        let contract = self.contract(&region, leaf);
        let spread = match &region {
            Region::Brick(record) if self.promise.bounds_voxels() => self.reader.spread(record).ok(),
            _ => None,
        };
        if contract.keeps_mask && active != *mask {
            error.fail(|| format!("the brick at {:?} has other active voxels", origin.0));
        }
        for i in 0..BRICK_VOXELS {
            let (ours, theirs) = (values[i], self.reading.value(source[i]));
            let difference = self.reading.error(ours, source[i]);
            let float_difference = f64::from(ours) - f64::from(theirs);
            let flipped = self.promise.sign_matters.is_some() && (ours < 0.0) != (theirs < 0.0);
            let from_texel = contract.codec.filter(|_| mask.get(i) || !contract.exact_inactive);
            error.all.add_voxel(difference, flipped);
            if let Some(codec) = from_texel {
                error.codec_squares[codec as usize] += float_difference * float_difference;
            }
            if mask.get(i) {
                error.active.add_voxel(difference, flipped);
                error.active_float_squares += float_difference * float_difference;
                error.histogram[error_bin(difference.abs() / self.promise.peak)] += 1;
            }
            let at = || origin.offset_by(Coord::child_offset(i, 3, 1)).0;
            let reach = float_difference.abs() + f64::from(spread.as_ref().map_or(0.0, |s| s[i]));
            if flipped && self.promise.sign_matters.is_some_and(|d| f64::from(theirs).abs() > d) {
                error.fail(|| format!("the sign at {:?} flipped: {ours}, the source has {theirs}", at()));
            } else if !contract.allows(ours, theirs, mask.get(i)) {
                error.fail(|| format!("the value at {:?} is {ours}, the source has {theirs}", at()));
            } else if from_texel.is_none() {
                // A rule gives it, and it is exact.
            } else if self.promise.max_error.is_some_and(|bound| reach > bound) {
                error.fail(|| {
                    format!("the value at {:?} is {ours}, the source has {theirs}: past max_error", at())
                });
            } else if self.promise.error_below.is_some_and(|limit| reach >= limit) {
                error.fail(|| {
                    format!(
                        "the value at {:?} is {ours}, the source has the integer {theirs}: choose f32, a finer quality, or \
                         integers = \"nearest\" to give integers up",
                        at()
                    )
                });
            }
        }
        error
    }
}

/// What a region's codec promises of each voxel.
struct Contract {
    /// Whether the active mask is kept, bit by bit.
    keeps_mask: bool,
    /// Whether inactive voxels come from a rule and must be exact.
    exact_inactive: bool,
    /// What gives the values, if it is a record and not the tree above it. What has become background counts as constant.
    codec: Option<Codec>,
    /// How far a voxel's value may be off.
    values: Bound,
}

enum Bound {
    /// Not at all.
    Exact,
    /// The nearest half float.
    Half,
    /// This much, in the grid's units.
    Within(f64),
    /// Nothing: only the L2 error holds.
    Nothing,
}

impl Contract {
    /// Values are compared as numbers: −0 is 0.
    fn allows(&self, ours: f32, theirs: f32, active: bool) -> bool {
        let exact = ours == theirs;
        if !active && self.exact_inactive {
            return exact;
        }
        match self.values {
            Bound::Exact => exact,
            Bound::Nothing => true,
            Bound::Half => ours == half::f16::from_f32(theirs).to_f32(),
            Bound::Within(bound) => (f64::from(ours) - f64::from(theirs)).abs() <= bound,
        }
    }
}
