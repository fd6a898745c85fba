//! BC4: 4 bits a voxel, one slice per z (Khronos Data Format Specification, "RGTC/BC4").
//!
//! Only the palette of 8 values is used (first endpoint above the second): GPUs disagree about the
//! one of 6 by up to 7/255 of the endpoints' distance.

use intel_tex_2::RSurface;

use super::blocks::by_slice;
use super::plain::{texel_order, texel_order_mut, unorm8};
use super::{SequenceRange, Texels};
use crate::volume::BRICK_VOXELS;

const BLOCK: usize = 8;
/// Texels across the surface of one brick: its 8 slices side by side, the encoder's least width.
const WIDTH: usize = 64;

pub(super) fn encode(sequence: &SequenceRange, batch: &[Texels]) -> Vec<u8> {
    let width = WIDTH * batch.len();
    let mut surface = vec![0u8; width * 8];
    for (b, brick) in batch.iter().enumerate() {
        for ((z, y, x), &v) in texel_order(&brick.values).indexed_iter() {
            surface[y * width + b * WIDTH + z * 8 + x] = unorm8(sequence, brick, v);
        }
    }
    let blocks = intel_tex_2::bc4::compress_blocks(&RSurface {
        data: &surface,
        width: width as u32,
        height: 8,
        stride: width as u32,
    });
    by_slice(&blocks, width, BLOCK, batch.len() * 8)
}

pub(super) fn decode(bytes: &[u8], out: &mut [f32; BRICK_VOXELS]) {
    let mut out = texel_order_mut(out);
    for (i, block) in bytes.as_chunks::<BLOCK>().0.iter().enumerate() {
        let (z, by, bx) = (i / 4, i / 2 % 2, i % 2);
        let mut texels = [0f32; 16];
        bcdec_rs::bc4_float(block, &mut texels, 4, false);
        for (t, texel) in texels.into_iter().enumerate() {
            out[[z, by * 4 + t / 4, bx * 4 + t % 4]] = texel;
        }
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
                carried: Mask512::ALL,
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
