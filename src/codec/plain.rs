//! Codecs of one texel a voxel: unorm8, f16, f32. Texel (x, y) of slice z is voxel (x, y, z).

use half::f16;
use ndarray::{ArrayView3, ArrayViewMut3};

use super::{OutOfRange, SequenceRange, Texels};
use crate::volume::BRICK_VOXELS;

/// A brick's values in the order of its texels: z slowest, x fastest.
pub(super) fn texel_order(values: &[f32; BRICK_VOXELS]) -> ArrayView3<'_, f32> {
    let voxels = ArrayView3::from_shape((8, 8, 8), values).expect("512 values");
    voxels.permuted_axes([2, 1, 0])
}

/// The same, to write to.
pub(super) fn texel_order_mut(values: &mut [f32; BRICK_VOXELS]) -> ArrayViewMut3<'_, f32> {
    let voxels = ArrayViewMut3::from_shape((8, 8, 8), values).expect("512 values");
    voxels.permuted_axes([2, 1, 0])
}

/// A value as an 8-bit fraction of its brick's range.
pub(super) fn unorm8(sequence: &SequenceRange, brick: &Texels, value: f32) -> u8 {
    (sequence.normalise(brick.range, value) * 255.0).round() as u8
}

pub(super) fn encode_unorm8(sequence: &SequenceRange, batch: &[Texels]) -> Vec<u8> {
    let texels = |brick| move |&v: &f32| unorm8(sequence, brick, v);
    batch
        .iter()
        .flat_map(|brick| texel_order(&brick.values).iter().map(texels(brick)).collect::<Vec<_>>())
        .collect()
}

pub(super) fn encode_f16(batch: &[Texels]) -> Result<Vec<u8>, OutOfRange> {
    let mut out = Vec::with_capacity(batch.len() * BRICK_VOXELS * 2);
    for brick in batch {
        for &value in texel_order(&brick.values) {
            if value.abs() > f16::MAX.to_f32() {
                return Err(OutOfRange { value });
            }
            out.extend(f16::from_f32(value).to_le_bytes());
        }
    }
    Ok(out)
}

pub(super) fn encode_f32(batch: &[Texels]) -> Vec<u8> {
    let mut out = Vec::with_capacity(batch.len() * BRICK_VOXELS * 4);
    for brick in batch {
        texel_order(&brick.values).iter().for_each(|v| out.extend(v.to_le_bytes()));
    }
    out
}

pub(super) fn decode<const N: usize>(
    bytes: &[u8],
    texel: impl Fn([u8; N]) -> f32,
    out: &mut [f32; BRICK_VOXELS],
) {
    for (value, bytes) in texel_order_mut(out).iter_mut().zip(bytes.as_chunks::<N>().0) {
        *value = texel(*bytes);
    }
}
