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

use rayon::prelude::*;

use super::codebook::{Codebook, ReferencedBrick, decoded};
use super::offers::{EarlierOffers, Offer, OfferInputs, Offers, TexelReference};
use crate::cancel::CancelToken;
use crate::codec::{BrickRange, Half, TexelCodec};
use crate::error::Result;
use crate::profile;
use crate::stages::dedup::SequenceTree;
use crate::stages::encoder_cache::{Batch, EncoderCache};
use crate::volume::ScratchResult;

/// Bricks to either side that a batch is compared with at least: in short frames those of a few.
const LEAST_NEAR: usize = 128;
/// Borrowers that a thread compares at a time. 32 × 6,144 similarities are 0.8 MB.
const ROWS: usize = 32;
/// Borrowers of batches that are compared side by side, so that all cores have work to the end. The referenced bricks of a batch
/// more to either side are in memory, 2.4 KB each.
const BORROWERS_SIDE_BY_SIDE: usize = 640;

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
    batches: BTreeMap<usize, Vec<ReferencedBrick>>,
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
    fn referenced_bricks(&self, around: &Range<usize>) -> Vec<&ReferencedBrick> {
        self.batches.range(around.clone()).flat_map(|(_, referenced_bricks)| referenced_bricks).collect()
    }
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
