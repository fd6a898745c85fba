//! Bricks whose texels others may borrow, and how alike a brick is to them.

use ndarray::Array2;
use rayon::prelude::*;

use super::offers::{Offer, Offers};
use crate::codec::{BrickRange, Half, SequenceRange, TexelCodec, decode};
use crate::error::Result;
use crate::stages::dedup::SequenceTree;
use crate::stages::encoder_cache::{Cost, EncoderCache, KeptBricks};
use crate::volume::{BRICK_VOXELS, Brick, Mask512};

/// Lenders that are compared voxel by voxel.
const CLOSEST: usize = 3;

/// Values of a shape as it is first compared: means of 2³ voxels.
const COARSE: usize = BRICK_VOXELS / 8;

/// A brick that could lend, with its texels as a GPU reads them, 0 to 1.
pub(super) struct ReferencedBrick {
    texels: Box<[f32; BRICK_VOXELS]>,
    mean: f64,
    /// Sum of squared differences from the mean.
    energy: f64,
    /// Sum of squares.
    squares: f64,
    /// Its shape as it is first compared.
    coarse: [f32; COARSE],
}

pub(super) fn decoded(
    encoders: &EncoderCache,
    tree: &SequenceTree,
    referenced_bricks: &[(u32, TexelCodec)],
) -> Result<Vec<ReferencedBrick>> {
    let mut places: [Vec<u32>; TexelCodec::ALL.len()] = Default::default();
    let mut tried = Vec::new();
    for &(id, codec) in referenced_bricks {
        places[codec.index()].push(id);
    }
    for codec in TexelCodec::ALL {
        tried.push(encoders.texels(&places[codec.index()], codec)?);
    }
    let referenced = |&(id, codec): &(u32, TexelCodec)| {
        let place = places[codec.index()].binary_search(&id).expect("every lender is of one of the codecs");
        let (KeptBricks { costs, bytes, axes }, codec) = (&tried[codec.index()], codec.codec());
        let size = codec.layout().brick_bytes();
        let (bytes, axis) = (&bytes[place * size..][..size], axes[place]);
        let texels = decode(codec, bytes, axis, &SequenceRange::default(), BrickRange::SEQUENCE);
        let (mean, energy) = moments(&texels);
        let extent = encoders.range(tree, id).extent.to_f64() * f64::from(encoders.sequence.span);
        let error_l2 = costs[place].error_l2;
        // The part of its energy that is its own error is stretched with it.
        let trust = (1.0 - (error_l2 / extent).powi(2) / energy.max(f64::MIN_POSITIVE)).max(0.0).sqrt();
        let mut shape = [0.0; COARSE];
        coarse(&texels, mean, energy, &mut shape);
        let squares = sum(|i| f64::from(texels[i]).powi(2));
        ReferencedBrick { texels, mean, energy, squares, coarse: shape.map(|v| v * trust as f32) }
    };
    Ok(referenced_bricks.par_iter().map(referenced).collect())
}

/// Sums that run side by side: the order of adding is fixed, and a compiler may use vectors.
const LANES: usize = 8;

/// The sum of something over the voxels of a brick.
fn sum(of: impl Fn(usize) -> f64) -> f64 {
    let mut sums = [0.0; LANES];
    for at in (0..BRICK_VOXELS).step_by(LANES) {
        for (lane, sum) in sums.iter_mut().enumerate() {
            *sum += of(at + lane);
        }
    }
    sums.iter().sum()
}

/// Mean, and sum of squared differences from it.
fn moments(values: &[f32; BRICK_VOXELS]) -> (f64, f64) {
    let mean = sum(|i| f64::from(values[i])) / BRICK_VOXELS as f64;
    (mean, sum(|i| (f64::from(values[i]) - mean).powi(2)))
}

/// A shape's coarse values less their mean, over the root of the energy of all 512.
fn coarse(values: &[f32; BRICK_VOXELS], mean: f64, energy: f64, out: &mut [f32]) {
    out.fill(0.0);
    for (i, &value) in values.iter().enumerate() {
        let (x, y, z) = (i >> 6, i >> 3 & 7, i & 7);
        out[(x >> 1) << 4 | (y >> 1) << 2 | z >> 1] += value;
    }
    // The mean of eight voxels stands for eight: each side of a product gets the root of that.
    let scale = 1.0 / (8.0 * energy.max(f64::MIN_POSITIVE)).sqrt();
    out.iter_mut().for_each(|v| *v = ((f64::from(*v) - 8.0 * mean) * scale) as f32);
}

/// The referenced bricks of a comparison, and their shapes as they are first compared, a row each.
pub(super) struct Codebook<'a> {
    referenced_bricks: Vec<&'a ReferencedBrick>,
    shapes: Array2<f32>,
}

impl<'a> Codebook<'a> {
    pub fn new(referenced_bricks: Vec<&'a ReferencedBrick>) -> Self {
        let mut shapes = Array2::<f32>::zeros((referenced_bricks.len(), COARSE));
        for (referenced, mut row) in referenced_bricks.iter().zip(shapes.rows_mut()) {
            row.as_slice_mut().expect("rows are contiguous").copy_from_slice(&referenced.coarse);
        }
        Self { referenced_bricks, shapes }
    }

    /// For each of some bricks the closest referenced bricks; `places` are those of the referenced bricks.
    pub fn nearest(
        &self,
        encoders: &EncoderCache,
        ids: &[u32],
        bricks: &[Brick],
        places: &[(u32, TexelCodec)],
    ) -> Result<Offers> {
        let mut means = Vec::with_capacity(bricks.len());
        let mut shapes = Array2::<f32>::zeros((bricks.len(), COARSE));
        for (brick, mut row) in bricks.iter().zip(shapes.rows_mut()) {
            let (mean, energy) = moments(&brick.values);
            coarse(&brick.values, mean, energy, row.as_slice_mut().expect("rows are contiguous"));
            means.push(mean);
        }
        // The line through a shape leaves 1 - s² of a brick's energy: the most similar leaves the least.
        let similar = shapes.dot(&self.shapes.t());
        let mut all = Offers::default();
        for (((&id, brick), mean), similar) in ids.iter().zip(bricks).zip(means).zip(similar.rows()) {
            let measure = encoders.measure(brick, &Mask512::ALL);
            let offer = |j: usize| {
                let range = borrow(&encoders.sequence, brick, mean, self.referenced_bricks.get(j)?)?;
                let value = encoders.sequence.decoder(range);
                let decoded = self.referenced_bricks[j].texels.map(value);
                let Cost { error_l2, active_error_l2, .. } = measure.of(&decoded, None);
                Some(Offer { referenced: j as u32, range: range.to_word(), error_l2, active_error_l2 })
            };
            let closest = closest(similar.iter().copied(), |j| places[j].0 != id);
            let mut offers: Vec<Offer> = closest.into_iter().filter_map(offer).collect();
            offers.sort_by(|a, b| a.error_l2.total_cmp(&b.error_l2));
            all.counts.push(offers.len() as u8);
            all.all.extend(offers);
        }
        Ok(all)
    }
}

/// The places of the greatest similarities above 0; places that are none stand for fewer.
fn closest(similar: impl Iterator<Item = f32>, may_lend: impl Fn(usize) -> bool) -> [usize; CLOSEST] {
    let mut closest = [(0.0f32, usize::MAX); CLOSEST];
    for (j, similar) in similar.enumerate() {
        if similar > closest[CLOSEST - 1].0 && may_lend(j) {
            let at = closest.partition_point(|(s, _)| *s >= similar);
            closest[at..].rotate_right(1);
            closest[at] = (similar, j);
        }
    }
    closest.map(|(_, j)| j)
}

/// The range under which a referenced brick's texels come closest to a brick of this mean, as a line through them does; `None` if
/// it runs the other way.
fn borrow(
    sequence: &SequenceRange,
    brick: &Brick,
    mean: f64,
    referenced: &ReferencedBrick,
) -> Option<BrickRange> {
    let (values, texels) = (&brick.values, &referenced.texels);
    let product = sum(|i| (f64::from(values[i]) - mean) * (f64::from(texels[i]) - referenced.mean));
    let (lo, span) = (f64::from(sequence.lo), f64::from(sequence.span));
    let gain = product / referenced.energy;
    let min = ((mean - gain * referenced.mean - lo) / span * 65535.0).round().clamp(0.0, 65535.0);
    // The minimum is coarse and may have met an end of the range: the extent makes the best of it.
    let rest = lo + span * min / 65535.0;
    let dot = sum(|i| (f64::from(values[i]) - rest) * f64::from(texels[i]));
    let extent = Half::from_f64(dot / referenced.squares / span);
    let is_ahead = extent.is_finite() && extent > Half::ZERO;
    is_ahead.then_some(BrickRange { min: min as u16, extent })
}
