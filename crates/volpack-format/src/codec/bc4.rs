//! BC4: 4 bits a voxel, one slice per z (Khronos Data Format Specification, "RGTC/BC4").

use super::voxel;
use crate::BRICK_VOXELS;

const BLOCK: usize = 8;

/// Where the texels of a brick's `block`-th block are among its voxels, row by row.
fn texels(block: usize) -> impl Iterator<Item = usize> {
    let (z, by, bx) = (block / 4, block / 2 % 2, block % 2);
    (0..16).map(move |t| voxel(bx * 4 + t % 4, by * 4 + t / 4, z))
}

pub(super) fn decode(bytes: &[u8], out: &mut [f32; BRICK_VOXELS]) {
    for (i, block) in bytes.as_chunks::<BLOCK>().0.iter().enumerate() {
        let mut values = [0f32; 16];
        bcdec_rs::bc4_float(block, &mut values, 4, false);
        for (at, value) in texels(i).zip(values) {
            out[at] = value;
        }
    }
}

/// How far a GPU's reading of each voxel may be from [`decode`]'s, before the brick's range is applied.
///
/// Measured on an NVIDIA H200 and on Mesa's software Vulkan: up to 2.84/255 of the distance of a block's
/// endpoints for the palette of 8 values. 0.03 of it and one step of 255 is above both.
pub(super) fn spread(bytes: &[u8], out: &mut [f32; BRICK_VOXELS]) {
    for (i, block) in bytes.as_chunks::<BLOCK>().0.iter().enumerate() {
        let spread = (0.03 * f32::from(block[0].abs_diff(block[1])) + 1.0) / 255.0;
        texels(i).for_each(|at| out[at] = spread);
    }
}
