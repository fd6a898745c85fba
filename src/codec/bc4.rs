//! BC4: 4 bits a voxel, one slice per z (Khronos Data Format Specification, "RGTC/BC4").
//!
//! Only the palette of 8 values is used (first endpoint above the second): GPUs disagree about the
//! one of 6 by up to 7/255 of the endpoints' distance.
//!
//! The encoder is ours because it works on the values themselves: a block whose values lie within a few 255ths of a
//! brick's range has palette steps finer than that, which an encoder of bytes cannot use. It is 1.1 to 1.3 dB better
//! than intel_tex_2's on whole volumes (docs/decisions/0007-own-bc4-encoder.md).

use super::normalise::normalise;
use super::plain::texel_order;
use super::{SequenceRange, Texels};
use crate::volume::BRICK_VOXELS;

const BLOCK: usize = 8;
/// Texels of a block.
const TEXELS: usize = 16;
/// Pairs of endpoints that are tried for a block: those of its range, and four near each of two fits.
const TRIES: usize = 10;
/// Steps between a block's endpoints.
const STEPS: f32 = 7.0;

pub(super) fn encode(sequence: &SequenceRange, batch: &[Texels]) -> Vec<u8> {
    let mut out = Vec::with_capacity(batch.len() * BRICK_VOXELS / TEXELS * BLOCK);
    for brick in batch {
        let codes = normalise(sequence, brick.range, &brick.values).map(|fraction| fraction * 255.0);
        let weights = brick.texel_mask.weights();
        let (codes, weights) = (texel_order(&codes), texel_order(&weights));
        for block in 0..BRICK_VOXELS / TEXELS {
            let (z, by, bx) = (block / 4, block / 2 % 2, block % 2);
            let at = |t: usize| [z, by * 4 + t / 4, bx * 4 + t % 4];
            out.extend(
                Block {
                    codes: std::array::from_fn(|t| codes[at(t)]),
                    weights: std::array::from_fn(|t| weights[at(t)]),
                }
                .encode(),
            );
        }
    }
    out
}

/// One block's texels as 255ths, and how much each counts.
struct Block {
    codes: [f32; TEXELS],
    weights: [f32; TEXELS],
}

impl Block {
    fn encode(&self) -> [u8; BLOCK] {
        let counted = || (0..TEXELS).filter(|&t| self.weights[t] > 0.0).map(|t| self.codes[t]);
        let low = counted().fold(f32::INFINITY, f32::min);
        let high = counted().fold(f32::NEG_INFINITY, f32::max);
        if low > high {
            return [0; BLOCK];
        }
        let mut best = (f32::INFINITY, [0u8; 2]);
        let (mut tried, mut tries) = ([[0u8; 2]; TRIES], 0);
        let mut consider = |high: f32, low: f32| {
            let ends = [high.clamp(0.0, 255.0) as u8, low.clamp(0.0, 255.0) as u8];
            // Endpoints in this order select the palette of eight values. Fits often come to the same ends.
            let is_new = !tried.contains(&ends);
            tried[tries] = ends;
            tries += 1;
            if ends[0] > ends[1] && is_new {
                let error = self.error(ends);
                if error < best.0 {
                    best = (error, ends);
                }
            }
        };
        consider(high.ceil().max(low.floor() + 1.0), low.floor());
        consider(high.ceil(), (low.floor()).min(high.ceil() - 1.0));
        // Values that fill their range evenly are best served by ends a sixteenth of it further in.
        let inset = (high - low) / 16.0;
        let mut ends = [high - inset, low + inset];
        for _ in 0..2 {
            ends = self.fit(ends);
            for high in [ends[0].floor(), ends[0].ceil()] {
                for low in [ends[1].floor(), ends[1].ceil()] {
                    consider(high, low);
                }
            }
        }
        let ends = best.1;
        let mut bits = 0u64;
        for (t, place) in self.places(ends.map(f32::from)).into_iter().enumerate() {
            // Index 0 is the first endpoint, 1 the second, and 2 to 7 lie between in that order.
            let index = match place as u64 {
                7 => 0,
                0 => 1,
                place => 8 - place,
            };
            bits |= index << (3 * t);
        }
        let mut out = [0; BLOCK];
        out[..2].copy_from_slice(&ends);
        out[2..].copy_from_slice(&bits.to_le_bytes()[..6]);
        out
    }

    /// How many steps above the lower end each texel's nearest palette entry is.
    fn places(&self, [high, low]: [f32; 2]) -> [f32; TEXELS] {
        /// Added and taken away again it rounds to whole numbers, without a call for each texel.
        const ROUND: f32 = (1 << 23) as f32;
        let scale = STEPS / (high - low);
        let mut places = [0.0; TEXELS];
        for (place, code) in places.iter_mut().zip(&self.codes) {
            *place = ((code - low) * scale).clamp(0.0, STEPS) + ROUND - ROUND;
        }
        places
    }

    fn error(&self, ends: [u8; 2]) -> f32 {
        let [high, low] = ends.map(f32::from);
        let places = self.places([high, low]);
        let step = (high - low) / STEPS;
        let each = self.codes.iter().zip(&self.weights).zip(places);
        each.map(|((code, weight), place)| weight * (low + step * place - code).powi(2)).sum()
    }

    /// The ends for which the places that `ends` give are best: a least-squares line.
    fn fit(&self, ends: [f32; 2]) -> [f32; 2] {
        if ends[0] - ends[1] < 1e-3 {
            return ends;
        }
        let places = self.places(ends);
        let [mut n, mut sx, mut sxx, mut sy, mut sxy] = [0.0f32; 5];
        for ((&y, &w), place) in self.codes.iter().zip(&self.weights).zip(places) {
            let x = place / STEPS;
            n += w;
            sx += w * x;
            sxx += w * x * x;
            sy += w * y;
            sxy += w * x * y;
        }
        let determinant = n * sxx - sx * sx;
        if determinant < 1e-6 {
            return ends;
        }
        let slope = (n * sxy - sx * sy) / determinant;
        let low = (sy - slope * sx) / n;
        [low + slope, low]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::codec::{BrickRange, Codec};
    use crate::volume::Mask512;

    #[test]
    fn only_the_eight_value_palette_is_used() {
        let sequence = SequenceRange::around(0.0, 1.0).unwrap();
        let noise = |seed: usize| move |i: usize| ((i * 7919 + seed * 104_729) % 1009) as f32 / 1008.0;
        let bricks: Vec<Texels> = (0..64)
            .map(|seed| Texels {
                // From noise to flat, the extremes 0 and 1 (the 6-value palette's own) in many.
                values: std::array::from_fn(|i| {
                    if i % (seed + 1) == 0 { noise(seed)(i) } else { (seed % 2) as f32 }
                }),
                texel_mask: Mask512::ALL,
                range: BrickRange::SEQUENCE,
            })
            .collect();
        let bytes = encode(&sequence, &bricks);
        assert_eq!(bytes.len(), 64 * Codec::Bc4.layout().brick_bytes());
        for block in bytes.as_chunks::<BLOCK>().0 {
            let indices = u64::from_le_bytes(*block) >> 16;
            // Equal endpoints select the other palette, in which indices 0 to 5 are that value too.
            let flat = block[0] == block[1] && (0..16).all(|t| indices >> (3 * t) & 7 < 6);
            assert!(
                block[0] > block[1] || flat,
                "endpoints {} and {}, indices {indices:#x}",
                block[0],
                block[1]
            );
        }
    }
}
