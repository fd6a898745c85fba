//! What bricks would be with the texels of others.

use std::ops::Range;

use bytemuck::{Pod, Zeroable};
use serde::{Deserialize, Serialize};

use crate::codec::{BrickRange, TexelCodec};
use crate::pods;

/// What a brick would be with another's texels.
#[derive(Clone, Copy)]
pub(super) struct TexelReference {
    /// The brick whose texels they are.
    pub referenced: u32,
    /// The range that suits them best.
    pub range: BrickRange,
    /// The root of the borrower's squared error over the voxels that texels give.
    pub error_l2: f64,
    /// The same over active voxels.
    pub active_error_l2: f64,
}

/// The same as the cache has it: the other brick by its place among those that were compared, and the range as a record
/// has it.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub struct Offer {
    pub(super) referenced: u32,
    pub(super) range: u32,
    pub(super) error_l2: f64,
    pub(super) active_error_l2: f64,
}

/// What was offered to the borrowers of a batch.
#[derive(Default, Serialize, Deserialize)]
pub struct Offers {
    /// How many to each.
    #[serde(with = "pods")]
    pub(super) counts: Vec<u8>,
    /// One borrower's after another's, of each the closest first.
    #[serde(with = "pods")]
    pub(super) all: Vec<Offer>,
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
