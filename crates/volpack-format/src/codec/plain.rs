//! Codecs of one texel a voxel: unorm8, f16, f32. Texel (x, y) of slice z is voxel (x, y, z).

use super::voxel;
use crate::BRICK_VOXELS;

/// Decodes texels of `N` bytes.
pub(super) fn decode<const N: usize>(
    bytes: &[u8],
    texel: impl Fn([u8; N]) -> f32,
    out: &mut [f32; BRICK_VOXELS],
) {
    for (i, bytes) in bytes.as_chunks::<N>().0.iter().enumerate() {
        out[voxel(i & 7, i >> 3 & 7, i >> 6)] = texel(*bytes);
    }
}
