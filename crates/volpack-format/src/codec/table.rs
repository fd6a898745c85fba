//! All that a reader knows of each codec. A new one is a file beside this one, a name in [`Codec`] and a row here.
//!
//! Format 1 is full: its tree header has no words for a sixth atlas and its grid table no error for it, so a new codec
//! needs format 2.

use super::{Codec, bc4, bc7, plain};
use crate::{BRICK_VOXELS, Half};

type Voxels = [f32; BRICK_VOXELS];

/// One codec.
pub(super) struct Row {
    pub codec: Codec,
    /// In manifests, reports and messages.
    pub name: &'static str,
    /// Slices of a brick's texels.
    pub slices: usize,
    /// Texels along the side of a block; 1 for a format without blocks.
    pub block_dim: usize,
    /// Bytes of a block, or of a texel.
    pub block_bytes: usize,
    /// Whether texels are fractions of the brick's range rather than values.
    pub is_normalised: bool,
    /// Whether each brick chooses its packing axis. Otherwise the record's axis is 2.
    pub has_axis: bool,
    /// Word size of the byte shuffle before zstd; 1 for no shuffle.
    pub word_bytes: usize,
    pub texture: TextureFormat,
    pub fidelity: Fidelity,
    /// Fills in what a texture unit gives for the bytes of a brick with this packing axis.
    pub decode: fn(&[u8], u8, &mut Voxels),
    /// Fills in how far GPUs may differ from `decode`; none if they agree.
    pub spread: Option<fn(&[u8], &mut Voxels)>,
}

/// The format of the texture that holds a codec's bricks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TextureFormat {
    /// BC7, four channels.
    Bc7RgbaUnorm,
    /// BC4, one channel.
    Bc4RUnorm,
    /// 8-bit fractions.
    R8Unorm,
    /// Half floats.
    R16Float,
    /// Floats.
    R32Float,
}

/// What a codec promises of every voxel that its texels give.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fidelity {
    /// The value itself.
    Exact,
    /// The nearest half float.
    NearestHalf,
    /// The nearest of equal steps of the brick's range.
    NearestStep {
        /// Steps from its least value to its greatest.
        steps: u32,
    },
    /// To stay inside the brick's range: an error of a block format has no closer bound.
    InRange,
}

/// By tag.
pub(super) static TABLE: [Row; 6] = [
    Row {
        codec: Codec::Constant,
        name: "constant",
        slices: 0,
        block_dim: 1,
        block_bytes: 0,
        is_normalised: false,
        has_axis: false,
        word_bytes: 1,
        texture: TextureFormat::R8Unorm,
        fidelity: Fidelity::Exact,
        decode: |_, _, _| (),
        spread: None,
    },
    Row {
        codec: Codec::Bc7,
        name: "bc7",
        slices: 2,
        block_dim: 4,
        block_bytes: 16,
        is_normalised: true,
        has_axis: true,
        word_bytes: 1,
        texture: TextureFormat::Bc7RgbaUnorm,
        fidelity: Fidelity::InRange,
        decode: bc7::decode,
        spread: None,
    },
    Row {
        codec: Codec::Bc4,
        name: "bc4",
        slices: 8,
        block_dim: 4,
        block_bytes: 8,
        is_normalised: true,
        has_axis: false,
        word_bytes: 1,
        texture: TextureFormat::Bc4RUnorm,
        fidelity: Fidelity::InRange,
        decode: |bytes, _, out| bc4::decode(bytes, out),
        spread: Some(bc4::spread),
    },
    Row {
        codec: Codec::Unorm8,
        name: "unorm8",
        slices: 8,
        block_dim: 1,
        block_bytes: 1,
        is_normalised: true,
        has_axis: false,
        word_bytes: 1,
        texture: TextureFormat::R8Unorm,
        fidelity: Fidelity::NearestStep { steps: 255 },
        decode: |bytes, _, out| plain::decode(bytes, |[byte]| f32::from(byte) / 255.0, out),
        spread: None,
    },
    Row {
        codec: Codec::F16,
        name: "f16",
        slices: 8,
        block_dim: 1,
        block_bytes: 2,
        is_normalised: false,
        has_axis: false,
        word_bytes: 2,
        texture: TextureFormat::R16Float,
        fidelity: Fidelity::NearestHalf,
        decode: |bytes, _, out| {
            plain::decode(bytes, |half| Half::from_bits(u16::from_le_bytes(half)).to_f32(), out)
        },
        spread: None,
    },
    Row {
        codec: Codec::F32,
        name: "f32",
        slices: 8,
        block_dim: 1,
        block_bytes: 4,
        is_normalised: false,
        has_axis: false,
        word_bytes: 4,
        texture: TextureFormat::R32Float,
        fidelity: Fidelity::Exact,
        decode: |bytes, _, out| plain::decode(bytes, f32::from_le_bytes, out),
        spread: None,
    },
];

// A tag is a place in the table.
const _: () = {
    let mut tag = 0;
    while tag < TABLE.len() {
        assert!(TABLE[tag].codec as usize == tag);
        tag += 1;
    }
};
