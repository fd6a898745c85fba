//! Encodes bricks; nothing else knows how values become texels. [`volpack_format::codec`] decodes them.
//!
//! A codec turns a brick's 512 values into a fixed number of bytes that lie as a GPU texture's texels or blocks do: slice
//! by slice, row by row (`z`, then `y`, then `x` of the texture).

mod bc4;
mod bc7;
mod blocks;
mod normalise;
mod plain;
mod table;

use rayon::prelude::*;

pub use table::{TexelCodec, TrialPolicy};
pub use volpack_format::Half;
pub use volpack_format::codec::{
    BrickLayout, BrickRange, Codec, Fidelity, SequenceRange, TextureFormat, decode, spread,
};

use crate::volume::{BRICK_VOXELS, Brick, Mask512};

/// A brick ready to be encoded.
pub struct Texels {
    /// The values that texels shall carry, x slowest. Those of voxels that a rule will give instead
    /// are free, and are chosen to be easy on the encoder.
    pub values: [f32; BRICK_VOXELS],
    /// The voxels whose texel counts: errors elsewhere are never seen.
    pub texel_mask: Mask512,
    /// What a normalised texel's 0 and 1 stand for.
    pub range: BrickRange,
}

impl Texels {
    /// Prepares a brick. `texel_mask` are the voxels that its texels give; `min` and `max` the range of
    /// those. The others are clamped to that range: for the inactive voxels of a level set that
    /// continues the band smoothly, and it never stretches the range.
    pub fn new(brick: &Brick, texel_mask: Mask512, (min, max): (f32, f32), range: BrickRange) -> Self {
        let mut values = brick.values;
        if texel_mask != Mask512::ALL {
            values.iter_mut().for_each(|v| *v = v.clamp(min, max));
        }
        Self { values, texel_mask, range }
    }
}

/// Some bricks, encoded.
pub struct EncodedBricks {
    /// [`BrickLayout::brick_bytes`] a brick, one after another.
    pub bytes: Vec<u8>,
    /// The packing axis of each brick: 0, 1 or 2 for x, y or z; 2 for a codec whose channels run along none.
    pub axes: Vec<u8>,
}

impl EncodedBricks {
    /// Bricks of a codec whose channels run along no axis.
    fn without_axes(bytes: Vec<u8>, bricks: usize) -> Self {
        Self { bytes, axes: vec![2; bricks] }
    }
}

/// A value that a codec cannot hold.
#[derive(Debug, thiserror::Error, PartialEq)]
#[error("the value {value} is outside what f16 can hold (±65504): choose f32, or scale the grid down")]
pub struct OutOfRange {
    /// The value.
    pub value: f32,
}

/// Bricks that one thread encodes at a time: a BC7 surface of 1024 × 8 texels, well above the 64
/// texels of width under which the encoder's SIMD lanes run dry, and small enough to share out.
pub const BATCH: usize = 64;

/// Encodes bricks on the current rayon pool. The result does not depend on how the work is split.
///
/// # Errors
/// [`OutOfRange`] for values past 65,504 with [`Codec::F16`].
pub fn encode(
    codec: TexelCodec,
    sequence: &SequenceRange,
    bricks: &[Texels],
) -> Result<EncodedBricks, OutOfRange> {
    let batches: Vec<EncodedBricks> = bricks
        .par_chunks(BATCH)
        .map(|batch| codec.encode_batch(sequence, batch))
        .collect::<Result<_, _>>()?;
    let mut all = EncodedBricks { bytes: Vec::new(), axes: Vec::new() };
    for batch in batches {
        all.bytes.extend(batch.bytes);
        all.axes.extend(batch.axes);
    }
    Ok(all)
}

/// The instruction set that `intel_tex_2` picks on this machine. Its SSE and AVX paths differ in a
/// few blocks of ten thousand, so this belongs wherever bytes are promised to be the same.
pub fn encoder_isa() -> &'static str {
    #[cfg(target_arch = "x86_64")]
    {
        // ispc's dispatch order. AVX2 and AVX-512 give the same blocks and count as one.
        if std::is_x86_feature_detected!("avx2") {
            return "avx2";
        }
        if std::is_x86_feature_detected!("avx") {
            return "avx";
        }
        "sse"
    }
    #[cfg(not(target_arch = "x86_64"))]
    std::env::consts::ARCH
}
