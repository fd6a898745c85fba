//! Bricks that borrow another's texels under a range of their own.
//!
//! Two bricks of the same shape differ by a minimum and an extent, which every record has of its own. So a brick whose
//! shape another's texels have already can do without texels: gain-shape vector quantisation (Gersho & Gray 1992, 12.10)
//! with the coded bricks themselves for a codebook, which costs no bit and needs no training (a learned one was tried too:
//! docs/decisions/0008-borrowed-texels.md).
//!
//! The bricks of a batch are compared with those of the batches near it: in a sequence those are the frame before and the
//! one after.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::ops::Range;

use bytemuck::{Pod, Zeroable};
use ndarray::Array2;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::cancel::CancelToken;
use crate::codec::{BrickRange, Half, SequenceRange, TexelCodec, decode};
use crate::error::Result;
use crate::pods;
use crate::profile;
use crate::stages::dedup::SequenceTree;
use crate::stages::encoder_cache::{Batch, Cost, EncoderCache, KeptBricks};
use crate::volume::{BRICK_VOXELS, Brick, Mask512, ScratchResult};

/// Bricks to either side that a batch is compared with at least: in short frames those of a few.
const LEAST_NEAR: usize = 128;
/// Borrowers that a thread compares at a time. 32 × 6,144 similarities are 0.8 MB.
const ROWS: usize = 32;
/// Borrowers of batches that are compared side by side, so that all cores have work to the end. The referenced bricks of a batch
/// more to either side are in memory, 2.4 KB each.
const BORROWERS_SIDE_BY_SIDE: usize = 640;
/// Lenders that are compared voxel by voxel.
const CLOSEST: usize = 3;
/// Values of a shape as it is first compared: means of 2³ voxels.
const COARSE: usize = BRICK_VOXELS / 8;

/// What a brick would be with another's texels.
#[derive(Clone, Copy)]
pub(super) struct TexelReference {
    /// The brick whose texels they are.
    pub referenced: u32,
    /// The range that suits them best.
    pub range: BrickRange,
    /// What it does to the borrower: [`Cost::error_l2`],
    pub error_l2: f64,
    /// and [`Cost::active_error_l2`].
    pub active_error_l2: f64,
}

/// What a brick would be with the texels of another: that one by its place among those that were compared, and its range as a record has it.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub struct Offer {
    referenced: u32,
    range: u32,
    error_l2: f64,
    active_error_l2: f64,
}

/// What was offered to the borrowers of a batch.
#[derive(Default, Serialize, Deserialize)]
pub struct Offers {
    /// How many to each.
    #[serde(with = "pods")]
    counts: Vec<u8>,
    /// One borrower's after another's, of each the closest first.
    #[serde(with = "pods")]
    all: Vec<Offer>,
}

/// Offers that earlier builds made. Whoever runs the stages puts it around a search; without one all are made.
pub trait EarlierOffers: Sync {
    /// For each of some comparisons what was offered, if it is known.
    fn known(&self, comparisons: &[OfferInputs]) -> Vec<Option<Offers>>;
    /// Keeps what was offered for later builds.
    fn keep(&self, comparison: &OfferInputs, offers: &Offers);
}

/// What the offers of a comparison depend on.
pub struct OfferInputs {
    /// The batches that the referenced bricks are in.
    pub around: Range<usize>,
    /// The place among them of the one that the borrowers are in.
    pub batch: usize,
    /// The place of each borrower in its frame, and a hash of its active voxels.
    pub borrowers: Vec<(u32, u64)>,
    /// How many referenced bricks each of the batches has: places are told from each other by it.
    pub counts: Vec<usize>,
    /// The place of each referenced brick in its frame, and its codec.
    pub referenced_bricks: Vec<(u32, TexelCodec)>,
}

/// A brick that could lend, with its texels as a GPU reads them, 0 to 1.
struct Lender {
    texels: Box<[f32; BRICK_VOXELS]>,
    mean: f64,
    /// Sum of squared differences from the mean.
    energy: f64,
    /// Sum of squares.
    squares: f64,
    /// Its shape as it is first compared.
    coarse: [f32; COARSE],
}

/// Batches whose offers are looked for in the cache together: some requests to a remote one at a time, and the offers
/// of no more bricks in memory than those of a few frames.
const BATCHES: usize = 32;

/// Visits the bricks that may borrow, ascending and some at a time, each with the nearest of those that lend, the
/// closest first.
pub(super) fn texel_references(
    encoders: &EncoderCache,
    tree: &mut SequenceTree,
    borrows: impl Fn(u32) -> bool,
    lends: impl Fn(u32) -> Option<TexelCodec>,
    earlier: Option<&dyn EarlierOffers>,
    cancel: &CancelToken,
    mut visit: impl FnMut(&[u32], Vec<Vec<TexelReference>>) -> Result<()>,
) -> Result<()> {
    let referenced_bricks = |ids: &Range<u32>| -> Vec<(u32, TexelCodec)> {
        ids.clone().filter_map(|id| Some((id, lends(id)?))).collect()
    };
    let mut near = Near::default();
    let batches: Vec<usize> = (0..encoders.batches().len()).collect();
    for window in batches.chunks(BATCHES) {
        let comparison = |&batch: &usize| {
            let around = around(encoders.batches(), batch);
            let batches = &encoders.batches()[around.clone()];
            Comparison {
                batch,
                borrowers: encoders.batches()[batch].ids.clone().filter(|&id| borrows(id)).collect(),
                referenced_bricks: batches.iter().flat_map(|batch| referenced_bricks(&batch.ids)).collect(),
                around,
            }
        };
        let comparisons: Vec<Comparison> = window.iter().map(comparison).collect();
        let mut known: Vec<Option<Offers>> = comparisons.iter().map(|_| None).collect();
        let mut inputs = Vec::new();
        if let Some(earlier) = earlier {
            let of = |comparison: &Comparison| comparison.inputs(encoders, tree);
            inputs = comparisons.par_iter().map(of).collect::<ScratchResult<_>>()?;
            let found = comparisons.iter().zip(earlier.known(&inputs));
            known = found.map(|(comparison, offers)| offers.filter(|o| comparison.is_sound(o))).collect();
        }
        // Frames whose voxels are not there are read side by side.
        let unknown = comparisons.iter().zip(&known).filter(|(_, known)| known.is_none());
        let unknown: Vec<u32> = unknown.flat_map(|(comparison, _)| &comparison.borrowers).copied().collect();
        tree.fetch(&unknown)?;
        let mut next = 0;
        while next < comparisons.len() {
            cancel.check()?;
            if known[next].is_none() {
                let unknown = known[next..].iter().take_while(|known| known.is_none()).count();
                let group = together(&comparisons[next..next + unknown]);
                near.move_to(encoders, tree, group, &referenced_bricks)?;
                for (i, offers) in (next..).zip(nearest(encoders, tree, group, &near)?) {
                    if let Some(earlier) = earlier {
                        earlier.keep(&inputs[i], &offers);
                    }
                    known[i] = Some(offers);
                }
            }
            let offers = known[next].take().expect("what was not known was made");
            visit(&comparisons[next].borrowers, comparisons[next].texel_references(offers))?;
            next += 1;
        }
    }
    Ok(())
}

/// The first of some comparisons that are made side by side.
fn together(comparisons: &[Comparison]) -> &[Comparison] {
    let mut borrowers = 0;
    let fits = |comparison: &&Comparison| {
        borrowers += comparison.borrowers.len();
        borrowers <= BORROWERS_SIDE_BY_SIDE
    };
    &comparisons[..comparisons.iter().take_while(fits).count().max(1)]
}

/// The borrowers of a batch, and the referenced bricks that they are compared with.
struct Comparison {
    batch: usize,
    /// The batches that the referenced bricks are in.
    around: Range<usize>,
    borrowers: Vec<u32>,
    referenced_bricks: Vec<(u32, TexelCodec)>,
}

impl Comparison {
    /// Whether offers can be its own.
    fn is_sound(&self, offers: &Offers) -> bool {
        offers.counts.len() == self.borrowers.len()
            && offers.counts.iter().map(|count| usize::from(*count)).sum::<usize>() == offers.all.len()
            && offers.all.iter().all(|offer| {
                let extent = BrickRange::from_word(offer.range).extent;
                (offer.referenced as usize) < self.referenced_bricks.len()
                    && extent.is_finite()
                    && extent > Half::ZERO
            })
    }

    /// What is offered to each borrower.
    fn texel_references(&self, offers: Offers) -> Vec<Vec<TexelReference>> {
        let reference = |offer: Offer| TexelReference {
            referenced: self.referenced_bricks[offer.referenced as usize].0,
            range: BrickRange::from_word(offer.range),
            error_l2: offer.error_l2,
            active_error_l2: offer.active_error_l2,
        };
        let mut all = offers.all.into_iter().map(reference);
        offers.counts.iter().map(|&count| all.by_ref().take(count.into()).collect()).collect()
    }

    fn inputs(&self, encoders: &EncoderCache, tree: &SequenceTree) -> ScratchResult<OfferInputs> {
        let place = |id: u32| tree.pool.place(id);
        let actives = tree.pool.active_hashes(&self.borrowers)?;
        let borrowers = self.borrowers.iter().zip(actives).map(|(&id, active)| (place(id), active));
        let batches = encoders.batches()[self.around.clone()].iter();
        Ok(OfferInputs {
            around: self.around.clone(),
            batch: self.batch - self.around.start,
            borrowers: borrowers.collect(),
            counts: batches.map(|batch| count(&self.referenced_bricks, &batch.ids)).collect(),
            referenced_bricks: self.referenced_bricks.iter().map(|&(id, codec)| (place(id), codec)).collect(),
        })
    }
}

/// The batches that a batch is compared with: itself, the one before, the one after, and more to either side until there
/// are [`LEAST_NEAR`] bricks.
fn around(batches: &[Batch], batch: usize) -> Range<usize> {
    let reach = |side: &mut dyn Iterator<Item = &Batch>| {
        let mut bricks = 0;
        side.take_while(|batch| {
            let wanted = bricks < LEAST_NEAR;
            bricks += batch.ids.len();
            wanted
        })
        .count()
    };
    let before = reach(&mut batches[..batch].iter().rev());
    batch - before..batch + 1 + reach(&mut batches[batch + 1..].iter())
}

/// How many of some referenced bricks, ascending, are in a range.
fn count(referenced_bricks: &[(u32, TexelCodec)], ids: &Range<u32>) -> usize {
    let before = |end: u32| referenced_bricks.partition_point(|(id, _)| *id < end);
    before(ids.end) - before(ids.start)
}

/// The referenced bricks of the batches that are being compared.
#[derive(Default)]
struct Near {
    batches: BTreeMap<usize, Vec<Lender>>,
}

impl Near {
    /// Decodes the referenced bricks around some batches that were not there for those before, and forgets others.
    fn move_to(
        &mut self,
        encoders: &EncoderCache,
        tree: &SequenceTree,
        comparisons: &[Comparison],
        referenced_bricks: &impl Fn(&Range<u32>) -> Vec<(u32, TexelCodec)>,
    ) -> Result<()> {
        let around = comparisons[0].around.start..comparisons[comparisons.len() - 1].around.end;
        self.batches.retain(|batch, _| around.contains(batch));
        for batch in around {
            if let Entry::Vacant(place) = self.batches.entry(batch) {
                let referenced_bricks = referenced_bricks(&encoders.batches()[batch].ids);
                place.insert(decoded(encoders, tree, &referenced_bricks)?);
            }
        }
        Ok(())
    }

    /// The referenced bricks of some of the batches.
    fn referenced_bricks(&self, around: &Range<usize>) -> Vec<&Lender> {
        self.batches.range(around.clone()).flat_map(|(_, referenced_bricks)| referenced_bricks).collect()
    }
}

fn decoded(
    encoders: &EncoderCache,
    tree: &SequenceTree,
    referenced_bricks: &[(u32, TexelCodec)],
) -> Result<Vec<Lender>> {
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
        Lender { texels, mean, energy, squares, coarse: shape.map(|v| v * trust as f32) }
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

/// For each comparison, and each of its borrowers, the closest of the referenced bricks.
fn nearest(
    encoders: &EncoderCache,
    tree: &SequenceTree,
    comparisons: &[Comparison],
    near: &Near,
) -> Result<Vec<Offers>> {
    let codebooks =
        comparisons.par_iter().map(|comparison| Codebook::new(near.referenced_bricks(&comparison.around)));
    let codebooks: Vec<Codebook> = codebooks.collect();
    let parts = comparisons.iter().zip(&codebooks).flat_map(|(comparison, codebook)| {
        comparison.borrowers.chunks(ROWS).map(move |ids| (comparison, codebook, ids))
    });
    let parts: Vec<(&Comparison, &Codebook, &[u32])> = parts.collect();
    let offers = parts.into_par_iter().map(|(comparison, codebook, ids)| {
        let _span = profile::span("share");
        codebook.nearest(encoders, ids, &tree.pool.read(ids)?, &comparison.referenced_bricks)
    });
    let mut parts = offers.collect::<Result<Vec<Offers>>>()?.into_iter();
    let of = |comparison: &Comparison| {
        let mut offers = Offers::default();
        for part in parts.by_ref().take(comparison.borrowers.len().div_ceil(ROWS)) {
            offers.counts.extend(part.counts);
            offers.all.extend(part.all);
        }
        offers
    };
    Ok(comparisons.iter().map(of).collect())
}

/// The referenced bricks of a comparison, and their shapes as they are first compared, a row each.
struct Codebook<'a> {
    referenced_bricks: Vec<&'a Lender>,
    shapes: Array2<f32>,
}

impl<'a> Codebook<'a> {
    fn new(referenced_bricks: Vec<&'a Lender>) -> Self {
        let mut shapes = Array2::<f32>::zeros((referenced_bricks.len(), COARSE));
        for (referenced, mut row) in referenced_bricks.iter().zip(shapes.rows_mut()) {
            row.as_slice_mut().expect("rows are contiguous").copy_from_slice(&referenced.coarse);
        }
        Self { referenced_bricks, shapes }
    }

    /// For each of some bricks the closest referenced bricks; `places` are those of the referenced bricks.
    fn nearest(
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
fn borrow(sequence: &SequenceRange, brick: &Brick, mean: f64, referenced: &Lender) -> Option<BrickRange> {
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
