//! What each rung comes to for a brick, and what is exact of it.

use std::io;

use super::rung::Rung;
use crate::stages::encodings::{Cost, Encodings, KeptCodec, Kind};

/// An L3 record is three words.
pub(super) const RECORD_BITS: u32 = 96;

/// What the rungs come to that have a cost of their own, in squared peaks. Looked up some hundred times a brick, and
/// there for every brick of a sequence: so half as wide as costs are, and 48 bytes. They serve to choose between rungs;
/// what a chosen one costs is read from the encodings.
#[derive(Clone, Copy)]
pub(super) struct Choices {
    /// Over all users and over all the voxels that texels give.
    distortion: [f32; Rung::OWN],
    /// Over active voxels.
    active_squares: [f32; Rung::OWN],
}

impl Choices {
    pub const NONE: Self = Self { distortion: [0.0; Rung::OWN], active_squares: [0.0; Rung::OWN] };

    /// Notes squares. What is infinite is out of the question, so nothing else may be.
    pub fn set(&mut self, rung: Rung, distortion: f64, active_squares: f64) {
        let Some(i) = rung.own() else { return };
        let narrow = |v: f64| if v.is_infinite() { f32::INFINITY } else { (v as f32).min(f32::MAX) };
        (self.distortion[i], self.active_squares[i]) = (narrow(distortion), narrow(active_squares));
    }

    /// The distortion of a rung that has one of its own, or none at all.
    pub fn distortion(&self, rung: Rung) -> f64 {
        rung.own().map_or(0.0, |i| self.distortion[i].into())
    }

    /// The same over active voxels.
    pub fn active_squares(&self, rung: Rung) -> f64 {
        rung.own().map_or(0.0, |i| self.active_squares[i].into())
    }
}

/// The bits of a brick's texels and of its records.
pub(super) fn bits(rung: Rung, records: u32) -> f64 {
    let records = if rung == Rung::Empty { 0 } else { records };
    f64::from(rung.texel_bits()) + f64::from(RECORD_BITS) * f64::from(records)
}

/// What rungs do to some bricks, by [`Rung::ALL`], and [`Rung::Constant`]'s values. What was not tried costs nothing,
/// and loans are not among it.
pub(super) fn costs(
    encodings: &mut Encodings,
    ids: &[u32],
    bc7_is_tried: &[bool],
) -> io::Result<Vec<([Cost; Rung::ALL.len()], f32)>> {
    let mut all = Vec::with_capacity(ids.len());
    for plain in encodings.plain(ids)? {
        let mut costs = [Cost::NONE; Rung::ALL.len()];
        costs[Rung::Empty as usize] = plain.empty;
        costs[Rung::Constant as usize] = plain.constant;
        costs[Rung::F16 as usize] = plain.f16;
        costs[Rung::Borrowed as usize] = Cost::IMPOSSIBLE;
        all.push((costs, plain.value));
    }
    for (rung, codec) in [(Rung::Bc4, KeptCodec::Bc4), (Rung::Unorm8, KeptCodec::Unorm8)] {
        for ((costs, _), cost) in all.iter_mut().zip(encodings.costs(ids, codec)?) {
            costs[rung as usize] = cost;
        }
    }
    let tried = || (0..ids.len()).filter(|&i| bc7_is_tried[ids[i] as usize]);
    let bc7: Vec<u32> = tried().map(|i| ids[i]).collect();
    for (i, cost) in tried().zip(encodings.costs(&bc7, KeptCodec::Bc7)?) {
        all[i].0[Rung::Bc7 as usize] = cost;
    }
    Ok(all)
}

/// What all bricks are tried with before anything is chosen: BC7 takes twenty times as long as all of it, and is tried
/// when it is asked for.
pub(super) const AT_ONCE: [Kind; 3] =
    [Kind::Plain, Kind::Texels(KeptCodec::Bc4), Kind::Texels(KeptCodec::Unorm8)];
