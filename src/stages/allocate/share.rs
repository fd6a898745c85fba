//! Bricks that borrow another's texels under a range of their own.
//!
//! Two bricks of the same shape differ by a minimum and an extent, which every record has of its own. So a brick whose
//! shape another's texels have already can do without texels: gain-shape vector quantisation (Gersho & Gray 1992, 12.10)
//! with the coded bricks themselves for a codebook, which costs no bit and needs no training (a learned one was tried too:
//! docs/decisions/0008-borrowed-texels.md).

use std::io;

use half::f16;
use ndarray::Array2;
use rayon::prelude::*;

use super::trial::{Cost, KeptOrBrick, Rung, Trials};
use crate::codec::{BrickRange, SequenceRange, decode};
use crate::stages::dedup::SequenceTree;
use crate::volume::{BRICK_VOXELS, Brick, InactiveRule, Mask512};

/// Borrowers that are compared at a time, and on both sides of them in the pool, which is in order of frames, the
/// lenders that they are compared with: enough for the frame before and the one after, and linear in the sequence.
const BORROWERS: usize = 2048;
/// Rows of one product: 256 × 8,192 similarities are 8 MB.
const ROWS: usize = 256;
/// Lenders that are compared voxel by voxel.
const CLOSEST: usize = 3;
/// Values of a shape as it is first compared: means of 2³ voxels.
const COARSE: usize = BRICK_VOXELS / 8;

/// What a brick would be with another's texels.
#[derive(Clone, Copy)]
pub(super) struct Loan {
    /// The brick whose texels they are.
    pub lender: u32,
    /// The range that suits them best.
    pub range: BrickRange,
    /// What it does to the borrower.
    pub cost: Cost,
}

/// A brick that could lend, with its texels as a GPU reads them, 0 to 1.
struct Lender {
    id: u32,
    texels: Box<[f32; BRICK_VOXELS]>,
    mean: f64,
    /// Sum of squared differences from the mean.
    energy: f64,
    /// The root of the part of its energy that is not its own error, which is stretched with it.
    trust: f64,
}

/// For each of `borrowers`, ascending, the nearest of `lenders`, ascending, each with its rung: the closest first.
pub(super) fn loans(
    trials: &mut Trials,
    tree: &mut SequenceTree,
    borrowers: &[u32],
    lenders: &[(u32, Rung)],
) -> io::Result<Vec<Vec<Loan>>> {
    let mut found = Vec::with_capacity(borrowers.len());
    for window in borrowers.chunks(BORROWERS) {
        let (first, last) = (window[0], window[window.len() - 1]);
        let from = lenders.partition_point(|(id, _)| *id < first).saturating_sub(BORROWERS);
        let to = (lenders.partition_point(|(id, _)| *id <= last) + BORROWERS).min(lenders.len());
        let lenders = trials.lenders(tree, &lenders[from..to])?;
        let mut bricks = Vec::with_capacity(window.len());
        tree.pool.read_each(window, &mut bricks)?;
        found.extend(nearest(trials, window, &bricks, &lenders));
    }
    Ok(found)
}

impl Trials {
    fn lenders(&mut self, tree: &mut SequenceTree, ids: &[(u32, Rung)]) -> io::Result<Vec<Lender>> {
        let kept = ids
            .iter()
            .map(|&(id, rung)| self.kept_or_brick(tree, id, rung.codec()))
            .collect::<io::Result<Vec<_>>>()?;
        let (trials, tree) = (&*self, &*tree);
        let lender = |(&(id, rung), kept): (&(u32, Rung), KeptOrBrick)| {
            let (bytes, axis) = trials.encode_kept(tree, id, rung.codec(), kept);
            let texels = decode(rung.codec(), &bytes, axis, &SequenceRange::default(), BrickRange::SEQUENCE);
            let (mean, energy) = moments(&texels);
            let extent = trials.ranges[id as usize].extent.to_f64() * f64::from(trials.sequence.span);
            let norm = trials.cost(id as usize, rung).map_or(0.0, |cost| cost.norm);
            let trust = (1.0 - (norm / extent).powi(2) / energy.max(f64::MIN_POSITIVE)).max(0.0).sqrt();
            Lender { id, texels, mean, energy, trust }
        };
        Ok(ids.par_iter().zip(kept).map(lender).collect())
    }
}

/// Mean, and sum of squared differences from it.
fn moments(values: &[f32; BRICK_VOXELS]) -> (f64, f64) {
    let mean = values.iter().map(|v| f64::from(*v)).sum::<f64>() / BRICK_VOXELS as f64;
    (mean, values.iter().map(|v| (f64::from(*v) - mean).powi(2)).sum())
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

fn nearest(trials: &Trials, ids: &[u32], bricks: &[Brick], lenders: &[Lender]) -> Vec<Vec<Loan>> {
    let mut codebook = Array2::<f32>::zeros((lenders.len(), COARSE));
    for (lender, mut row) in lenders.iter().zip(codebook.rows_mut()) {
        let row = row.as_slice_mut().expect("rows are contiguous");
        coarse(&lender.texels, lender.mean, lender.energy, row);
        row.iter_mut().for_each(|v| *v *= lender.trust as f32);
    }
    let codebook = codebook.t();
    ids.par_chunks(ROWS)
        .zip(bricks.par_chunks(ROWS))
        .flat_map_iter(|(ids, bricks)| {
            let mut shapes = Array2::<f32>::zeros((bricks.len(), COARSE));
            for (brick, mut row) in bricks.iter().zip(shapes.rows_mut()) {
                let (mean, energy) = moments(&brick.values);
                coarse(&brick.values, mean, energy, row.as_slice_mut().expect("rows are contiguous"));
            }
            // The line through a shape leaves 1 - s² of a brick's energy: the most similar leaves the least.
            let similar = shapes.dot(&codebook);
            let each = ids.iter().zip(bricks).zip(similar.rows());
            each.map(|((&id, brick), similar)| {
                let mut closest = [(0.0f32, usize::MAX); CLOSEST];
                for (j, &similar) in similar.iter().enumerate() {
                    if similar > closest[CLOSEST - 1].0 && lenders[j].id != id {
                        let at = closest.partition_point(|(s, _)| *s >= similar);
                        closest[at..].rotate_right(1);
                        closest[at] = (similar, j);
                    }
                }
                let found = closest.iter().filter_map(|&(_, j)| lenders.get(j));
                let mut loans: Vec<Loan> = found.filter_map(|lender| trials.borrow(brick, lender)).collect();
                loans.sort_by(|a, b| a.cost.norm.total_cmp(&b.cost.norm));
                loans
            })
            .collect::<Vec<_>>()
        })
        .collect()
}

impl Trials {
    /// The brick as a line through a lender's texels; `None` if it runs the other way.
    fn borrow(&self, brick: &Brick, lender: &Lender) -> Option<Loan> {
        let (mean, _) = moments(&brick.values);
        let pairs = brick.values.iter().zip(lender.texels.iter());
        let product: f64 =
            pairs.clone().map(|(v, t)| (f64::from(*v) - mean) * (f64::from(*t) - lender.mean)).sum();
        let (lo, span) = (f64::from(self.sequence.lo), f64::from(self.sequence.span));
        let gain = product / lender.energy;
        let min = ((mean - gain * lender.mean - lo) / span * 65535.0).round().clamp(0.0, 65535.0);
        // The minimum is coarse and may have met an end of the range: the extent makes the best of it.
        let rest = lo + span * min / 65535.0;
        let texel_squares: f64 = lender.texels.iter().map(|t| f64::from(*t).powi(2)).sum();
        let dot: f64 = pairs.map(|(v, t)| (f64::from(*v) - rest) * f64::from(*t)).sum();
        let extent = f16::from_f64(dot / texel_squares / span);
        if !(extent.is_finite() && extent > f16::ZERO) {
            return None;
        }
        let range = BrickRange { min: min as u16, extent };
        let decoded = std::array::from_fn(|i| self.sequence.decode(range, lender.texels[i]));
        let cost = self.measure(brick, &Mask512::ALL, &decoded, None);
        Some(Loan { lender: lender.id, range, cost })
    }

    /// Whether a brick's texels give all of its voxels, so that it may borrow and lend.
    pub fn is_whole(&self, brick: usize) -> bool {
        self.rules[brick] == InactiveRule::Texel
    }
}
