//! Encode and decode of one brick: the only room that knows texel maths.
//!
//! A codec turns a brick's 512 values into a fixed number of bytes that lie as a GPU texture's texels
//! or blocks do, and back into exactly the values that the texture unit gives. Bytes of one brick
//! are ordered slice by slice, row by row (`z`, then `y`, then `x` of the texture).

mod bc4;
mod bc7;
mod blocks;
mod plain;
mod range;

use rayon::prelude::*;

pub use range::{BrickRange, SequenceRange};

use crate::volume::{BRICK_VOXELS, Brick, Mask512};

/// How a brick's values are stored. The numbers are the pack's codec tags.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[repr(u8)]
pub enum Codec {
    /// No texels: one value, in the L3 record.
    Constant = 0,
    /// BC7 blocks, four neighbours along the packing axis in R, G, B and A: 2 bits a voxel.
    Bc7 = 1,
    /// BC4 blocks, one slice per z: 4 bits a voxel.
    Bc4 = 2,
    /// One byte a voxel.
    Unorm8 = 3,
    /// Half floats, values as they are.
    F16 = 4,
    /// Floats, values as they are.
    F32 = 5,
}

impl Codec {
    /// Every codec that has texels, in the order of their tags.
    pub const WITH_TEXELS: [Self; 5] = [Self::Bc7, Self::Bc4, Self::Unorm8, Self::F16, Self::F32];

    /// The codec with this tag.
    pub fn from_tag(tag: u32) -> Option<Self> {
        [Self::Constant].into_iter().chain(Self::WITH_TEXELS).find(|c| *c as u32 == tag)
    }

    /// Its name in manifests and reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Constant => "constant",
            Self::Bc7 => "bc7",
            Self::Bc4 => "bc4",
            Self::Unorm8 => "unorm8",
            Self::F16 => "f16",
            Self::F32 => "f32",
        }
    }

    /// Whether texels are fractions of the brick's range rather than values.
    pub fn is_normalised(self) -> bool {
        matches!(self, Self::Bc7 | Self::Bc4 | Self::Unorm8)
    }

    /// How one brick lies in a texture.
    pub fn layout(self) -> BrickLayout {
        let (slices, block_dim, block_bytes) = match self {
            Self::Constant => (0, 1, 0),
            Self::Bc7 => (2, 4, 16),
            Self::Bc4 => (8, 4, 8),
            Self::Unorm8 => (8, 1, 1),
            Self::F16 => (8, 1, 2),
            Self::F32 => (8, 1, 4),
        };
        BrickLayout { slices, rows: 8 / block_dim, row_bytes: 8 / block_dim * block_bytes }
    }
}

/// One brick in a texture: 8 × 8 texels in each of some slices.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BrickLayout {
    /// Slices of 8 × 8 texels.
    pub slices: usize,
    /// Rows of blocks (or of texels) in a slice.
    pub rows: usize,
    /// Bytes of one row.
    pub row_bytes: usize,
}

impl BrickLayout {
    /// Bytes of one brick.
    pub fn brick_bytes(&self) -> usize {
        self.slices * self.rows * self.row_bytes
    }
}

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

/// The encoded bricks of one batch.
pub struct Encoded {
    /// [`BrickLayout::brick_bytes`] a brick, one after another.
    pub bytes: Vec<u8>,
    /// The packing axis of each brick: 0, 1 or 2 for x, y or z. Always 2 but for bc7.
    pub axes: Vec<u8>,
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
pub fn encode(codec: Codec, sequence: &SequenceRange, bricks: &[Texels]) -> Result<Encoded, OutOfRange> {
    let batches: Vec<Encoded> = bricks
        .par_chunks(BATCH)
        .map(|batch| encode_batch(codec, sequence, batch))
        .collect::<Result<_, _>>()?;
    let mut all = Encoded { bytes: Vec::new(), axes: Vec::new() };
    for batch in batches {
        all.bytes.extend(batch.bytes);
        all.axes.extend(batch.axes);
    }
    Ok(all)
}

fn encode_batch(codec: Codec, sequence: &SequenceRange, batch: &[Texels]) -> Result<Encoded, OutOfRange> {
    let plain_axes = vec![2; batch.len()];
    let bytes = match codec {
        Codec::Constant => Vec::new(),
        Codec::Bc7 => return Ok(bc7::encode(sequence, batch)),
        Codec::Bc4 => bc4::encode(sequence, batch),
        Codec::Unorm8 => plain::encode_unorm8(sequence, batch),
        Codec::F16 => plain::encode_f16(batch)?,
        Codec::F32 => plain::encode_f32(batch),
    };
    Ok(Encoded { bytes, axes: plain_axes })
}

/// Decodes one brick's texels to the values that a GPU reads, x slowest. `bytes` must be
/// [`BrickLayout::brick_bytes`] long.
pub fn decode(
    codec: Codec,
    bytes: &[u8],
    axis: u8,
    sequence: &SequenceRange,
    range: BrickRange,
) -> Box<[f32; BRICK_VOXELS]> {
    let mut out = Box::new([0.0; BRICK_VOXELS]);
    match codec {
        Codec::Constant => {}
        Codec::Bc7 => bc7::decode(bytes, axis, &mut out),
        Codec::Bc4 => bc4::decode(bytes, &mut out),
        Codec::Unorm8 => plain::decode(bytes, |[byte]| f32::from(byte) / 255.0, &mut out),
        Codec::F16 => plain::decode_f16(bytes, &mut out),
        Codec::F32 => plain::decode(bytes, f32::from_le_bytes, &mut out),
    }
    if codec.is_normalised() {
        let value = sequence.decoder(range);
        out.iter_mut().for_each(|v| *v = value(*v));
    }
    out
}

/// How far a GPU's arithmetic may be from [`decode`]'s, of the largest number in it, `lo + span · (m/65535 + e · t)`: four
/// roundings of 2⁻²⁴ here, there as many and a division that WGSL allows 2.5 units in the last place (5 · 2⁻²⁴).
const ARITHMETIC: f32 = 16.0 / (1 << 24) as f32;

/// For each voxel, how far what a GPU reads may be from what [`decode`] gives, in the grid's units.
pub fn spread(
    codec: Codec,
    bytes: &[u8],
    sequence: &SequenceRange,
    range: BrickRange,
) -> Box<[f32; BRICK_VOXELS]> {
    let mut out = Box::new([0.0; BRICK_VOXELS]);
    if codec == Codec::Bc4 {
        bc4::spread(bytes, &mut out);
        let extent = sequence.span * range.extent.to_f32();
        out.iter_mut().for_each(|s| *s *= extent);
    }
    if codec.is_normalised() {
        let arithmetic = ARITHMETIC * (sequence.lo.abs() + sequence.span);
        out.iter_mut().for_each(|s| *s += arithmetic);
    }
    out
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
