//! BC7: four neighbours along the packing axis in the channels of one texel, 2 bits a voxel
//! (Utrecht thesis 4.4; Khronos Data Format Specification, "BPTC").

use super::PACKING_STRIDES;
use crate::BRICK_VOXELS;

const BLOCK: usize = 16;

pub(super) fn decode(bytes: &[u8], axis: u8, out: &mut [f32; BRICK_VOXELS]) {
    let [along, down, across] = PACKING_STRIDES[usize::from(axis)];
    for (i, block) in bytes.as_chunks::<BLOCK>().0.iter().enumerate() {
        let (slice, bv, bu) = (i / 4, i / 2 % 2, i % 2);
        let mut texels = [0u8; 64];
        bcdec_rs::bc7(block, &mut texels, 16);
        for (t, channels) in texels.as_chunks::<4>().0.iter().enumerate() {
            let at = (bv * 4 + t / 4) * down + (bu * 4 + t % 4) * across;
            for (c, &unorm) in channels.iter().enumerate() {
                out[(slice * 4 + c) * along + at] = FRACTIONS[usize::from(unorm)];
            }
        }
    }
}

/// 255ths.
const FRACTIONS: [f32; 256] = {
    let mut fractions = [0.0; 256];
    let mut i = 0;
    while i < 256 {
        fractions[i] = i as f32 / 255.0;
        i += 1;
    }
    fractions
};
