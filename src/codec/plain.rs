//! Codecs of one texel a voxel: unorm8, f16, f32. Texel (x, y) of slice z is voxel (x, y, z).

use half::f16;
use half::slice::HalfFloatSliceExt;
use ndarray::ArrayView3;

use super::normalise::normalise;
use super::{OutOfRange, SequenceRange, Texels};
use crate::volume::BRICK_VOXELS;

/// A brick's values in the order of its texels: z slowest, x fastest.
pub(super) fn texel_order(values: &[f32; BRICK_VOXELS]) -> ArrayView3<'_, f32> {
    let voxels = ArrayView3::from_shape((8, 8, 8), values).expect("512 values");
    voxels.permuted_axes([2, 1, 0])
}

/// Fractions, 0 to 1, in 8 bits.
pub(super) fn unorm8(fractions: &[f32; BRICK_VOXELS]) -> [u8; BRICK_VOXELS] {
    fractions.map(|fraction| {
        // f32::round, without a call for each.
        let (scaled, whole) = (fraction * 255.0, (fraction * 255.0) as i32);
        (whole + i32::from(scaled - whole as f32 >= 0.5)) as u8
    })
}

/// What a brick has at each texel, z slowest, x fastest.
fn in_texel_order<T: Copy + Default>(voxels: &[T; BRICK_VOXELS]) -> [T; BRICK_VOXELS] {
    let mut texels = [T::default(); BRICK_VOXELS];
    for (z, slice) in texels.chunks_exact_mut(64).enumerate() {
        for (y, row) in slice.chunks_exact_mut(8).enumerate() {
            for (x, texel) in row.iter_mut().enumerate() {
                *texel = voxels[x << 6 | y << 3 | z];
            }
        }
    }
    texels
}

pub(super) fn encode_unorm8(sequence: &SequenceRange, batch: &[Texels]) -> Vec<u8> {
    let mut out = Vec::with_capacity(batch.len() * BRICK_VOXELS);
    for brick in batch {
        let fractions = normalise(sequence, brick.range, &brick.values);
        out.extend_from_slice(&in_texel_order(&unorm8(&fractions)));
    }
    out
}

pub(super) fn encode_f16(batch: &[Texels]) -> Result<Vec<u8>, OutOfRange> {
    let mut out = Vec::with_capacity(batch.len() * BRICK_VOXELS * 2);
    for brick in batch {
        let texels = in_texel_order(&brick.values);
        if let Some(&value) = texels.iter().find(|v| v.abs() > f16::MAX.to_f32()) {
            return Err(OutOfRange { value });
        }
        let mut halves = [f16::ZERO; BRICK_VOXELS];
        halves.convert_from_f32_slice(&texels);
        out.extend_from_slice(bytemuck::cast_slice(&halves));
    }
    Ok(out)
}

/// Values as half floats give them back; `None` if one is past the greatest, which those just above it would round to.
pub(super) fn round_to_f16(values: &[f32; BRICK_VOXELS]) -> Option<[f32; BRICK_VOXELS]> {
    if !values.iter().all(|v| v.abs() <= f16::MAX.to_f32()) {
        return None;
    }
    let (mut halves, mut rounded) = ([f16::ZERO; BRICK_VOXELS], [0.0; BRICK_VOXELS]);
    halves.convert_from_f32_slice(values);
    halves.convert_to_f32_slice(&mut rounded);
    Some(rounded)
}

pub(super) fn encode_f32(batch: &[Texels]) -> Vec<u8> {
    let mut out = Vec::with_capacity(batch.len() * BRICK_VOXELS * 4);
    for brick in batch {
        out.extend_from_slice(bytemuck::cast_slice(&in_texel_order(&brick.values)));
    }
    out
}
