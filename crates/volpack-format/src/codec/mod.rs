//! How a brick's values are stored, and how they are read back.
//!
//! A codec turns a brick's 512 values into a fixed number of bytes that lie as a GPU texture's texels
//! or blocks do, and back into exactly the values that the texture unit gives. Bytes of one brick
//! are ordered slice by slice, row by row (`z`, then `y`, then `x` of the texture).

mod bc4;
mod bc7;
mod plain;
mod range;
mod table;

pub use range::{BrickRange, SequenceRange};
pub use table::{Fidelity, TextureFormat};

use std::ops::RangeInclusive;

use crate::BRICK_VOXELS;
use table::{Row, TABLE};

/// For each packing axis of bc7, how far apart in a brick two voxels are that are neighbours along it, down a slice (`v`)
/// and across it (`u`): those two are the other axes in ascending order.
pub const PACKING_STRIDES: [[usize; 3]; 3] = [[64, 1, 8], [8, 1, 64], [1, 8, 64]];

/// The place of a voxel in a brick.
fn voxel(x: usize, y: usize, z: usize) -> usize {
    x << 6 | y << 3 | z
}

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
    /// How many there are.
    pub const COUNT: usize = TABLE.len();

    /// Every codec that has texels, in the order of their tags.
    pub const WITH_TEXELS: [Self; Self::COUNT - 1] = {
        let mut codecs = [Self::Constant; Self::COUNT - 1];
        let mut i = 0;
        while i < codecs.len() {
            codecs[i] = TABLE[i + 1].codec;
            i += 1;
        }
        codecs
    };

    /// The codec with this tag.
    pub fn from_tag(tag: u32) -> Option<Self> {
        TABLE.get(tag as usize).map(|row| row.codec)
    }

    const fn row(self) -> &'static Row {
        &TABLE[self as usize]
    }

    /// Its name in manifests and reports.
    pub const fn name(self) -> &'static str {
        self.row().name
    }

    /// Whether texels are fractions of the brick's range rather than values.
    pub fn is_normalised(self) -> bool {
        self.row().is_normalised
    }

    /// The packing axes that a brick's record may name: 0, 1 and 2 for x, y and z, or 2 alone where channels run along none.
    pub fn axes(self) -> RangeInclusive<u8> {
        if self.row().has_axis { 0..=2 } else { 2..=2 }
    }

    /// Whether texels lie in blocks, which an encoder fits to the values.
    pub fn is_blocks(self) -> bool {
        self.row().block_dim > 1
    }

    /// Bytes of the words whose bytes are gathered before zstd; 1 for none.
    pub fn word_bytes(self) -> usize {
        self.row().word_bytes
    }

    /// The texture that holds its bricks.
    pub fn texture(self) -> TextureFormat {
        self.row().texture
    }

    /// Whether GPUs may decode it to values that differ from each other: see [`spread`].
    pub fn varies_by_gpu(self) -> bool {
        self.row().spread.is_some()
    }

    /// What it promises of every voxel that its texels give.
    pub fn fidelity(self) -> Fidelity {
        self.row().fidelity
    }

    /// How one brick lies in a texture.
    pub const fn layout(self) -> BrickLayout {
        let Row { slices, block_dim, block_bytes, .. } = *self.row();
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
    pub const fn brick_bytes(&self) -> usize {
        self.slices * self.rows * self.row_bytes
    }
}

/// Decodes one brick's texels to the values that a GPU reads, x slowest. `bytes` must be
/// [`BrickLayout::brick_bytes`] long.
///
/// # Panics
/// When `bytes` has another length, or `axis` is above 2 for bc7.
pub fn decode(
    codec: Codec,
    bytes: &[u8],
    axis: u8,
    sequence: &SequenceRange,
    range: BrickRange,
) -> Box<[f32; BRICK_VOXELS]> {
    let mut out = Box::new([0.0; BRICK_VOXELS]);
    decode_texels(codec, bytes, axis, &mut out);
    if codec.is_normalised() {
        let value = sequence.decoder(range);
        out.iter_mut().for_each(|v| *v = value(*v));
    }
    out
}

/// The same without the ranges: what a texture unit gives, which are fractions for a codec that
/// [is normalised](Codec::is_normalised).
///
/// # Panics
/// When `bytes` is not [`BrickLayout::brick_bytes`] long, or `axis` is above 2 for bc7.
pub fn decode_texels(codec: Codec, bytes: &[u8], axis: u8, out: &mut [f32; BRICK_VOXELS]) {
    assert_eq!(bytes.len(), codec.layout().brick_bytes(), "bytes of a brick in {}", codec.name());
    (codec.row().decode)(bytes, axis, out);
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
    if let Some(spread) = codec.row().spread {
        spread(bytes, &mut out);
        let extent = sequence.span * range.extent.to_f32();
        out.iter_mut().for_each(|s| *s *= extent);
    }
    if codec.is_normalised() {
        let arithmetic = ARITHMETIC * (sequence.lo.abs() + sequence.span);
        out.iter_mut().for_each(|s| *s += arithmetic);
    }
    out
}
