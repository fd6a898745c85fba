//! BC7: four neighbours along the packing axis in the channels of one texel, 2 bits a voxel
//! (Utrecht thesis 4.4; Khronos Data Format Specification, "BPTC").
//!
//! A block spans 4 × 4 texels, so 4 × 4 × 4 voxels, and its error is in the fit of a line through
//! 4-D points. Which axis lies in the channels changes that fit, so all three are tried and the one
//! with the least squared error is kept.

use intel_tex_2::RgbaSurface;
use volpack_format::codec::{PACKING_STRIDES, decode_texels};

use super::blocks::by_slice;
use super::normalise::normalise;
use super::plain::unorm8;
use super::{Codec, EncodedBricks, SequenceRange, Texels};
use crate::volume::BRICK_VOXELS;

const BLOCK: usize = 16;
/// Bytes of a brick: 2 slices of 2 × 2 blocks.
const BRICK: usize = 2 * 4 * BLOCK;
/// Texels across the surface of one brick: its 2 slices side by side.
const WIDTH: usize = 16;
/// Surfaces are at least this wide: the encoder runs a row through its SIMD lanes.
const LEAST_WIDTH: usize = 64;

pub(super) fn encode(sequence: &SequenceRange, batch: &[Texels]) -> EncodedBricks {
    let fractions: Vec<[f32; BRICK_VOXELS]> =
        batch.iter().map(|brick| normalise(sequence, brick.range, &brick.values)).collect();
    let unorms: Vec<[u8; BRICK_VOXELS]> = fractions.iter().map(unorm8).collect();
    let by_axis = [0, 1, 2].map(|axis| encode_axis(&unorms, axis));

    let mut out = EncodedBricks { bytes: Vec::with_capacity(batch.len() * BRICK), axes: Vec::new() };
    for (i, (brick, fractions)) in batch.iter().zip(&fractions).enumerate() {
        let bytes = |axis: u8| &by_axis[usize::from(axis)][i * BRICK..][..BRICK];
        let counts = brick.texel_mask.weights();
        let error = |axis: u8| {
            let mut decoded = [0f32; BRICK_VOXELS];
            decode_texels(Codec::Bc7, bytes(axis), axis, &mut decoded);
            let squares: [f64; BRICK_VOXELS] = std::array::from_fn(|i| {
                let error = (f64::from(decoded[i]) - f64::from(fractions[i])) * f64::from(counts[i]);
                error * error
            });
            // One after another: symmetrical bricks err alike along several axes, and which one is the least must not
            // depend on how a compiler adds.
            squares.iter().sum::<f64>()
        };
        let errors = [0, 1, 2].map(error);
        let axis = (0..3u8).min_by(|&a, &b| errors[usize::from(a)].total_cmp(&errors[usize::from(b)]));
        let axis = axis.expect("there are three axes");
        out.bytes.extend(bytes(axis));
        out.axes.push(axis);
    }
    out
}

fn encode_axis(bricks: &[[u8; BRICK_VOXELS]], axis: usize) -> Vec<u8> {
    let width = (WIDTH * bricks.len()).max(LEAST_WIDTH);
    let mut surface = vec![0u8; width * 8 * 4];
    for (b, brick) in bricks.iter().enumerate() {
        let [along, down, across] = PACKING_STRIDES[axis];
        for a in 0..8 {
            for v in 0..8 {
                let row = (v * width + b * WIDTH + a / 4 * 8) * 4 + a % 4;
                for u in 0..8 {
                    surface[row + u * 4] = brick[a * along + v * down + u * across];
                }
            }
        }
    }
    // The fastest profile that is within 0.3 dB of the slowest on every volume tried.
    let settings = intel_tex_2::bc7::alpha_very_fast_settings();
    let blocks = intel_tex_2::bc7::compress_blocks(
        &settings,
        &RgbaSurface { data: &surface, width: width as u32, height: 8, stride: width as u32 * 4 },
    );
    by_slice(&blocks, width, BLOCK, bricks.len() * 2)
}
