//! BC4 and BC7 for bricks of any side. volpack's own encoders take bricks of 8³ only.

use volpack::codec::{BrickRange, Codec, OutOfRange, SequenceRange, TexelCodec, Texels, decode, encode};
use volpack::volume::{BRICK_VOXELS, Mask512};

/// 4 × 4 texels of a slice are a block; of BC4, 32 blocks have the voxels of one of volpack's bricks.
const BLOCK: usize = 4;
const BLOCKS_OF_BRICK: usize = BRICK_VOXELS / (BLOCK * BLOCK);
const BC7_BYTES: usize = 16;

/// Where a texel of a block lies in volpack's bricks: block by block in a slice of 8 × 8, slice by slice.
fn voxel(block: usize, texel: usize) -> usize {
    let (x, y, z) = (block % 2 * 4 + texel % 4, block / 2 % 2 * 4 + texel / 4, block / 4);
    (x * 8 + y) * 8 + z
}

/// Encodes a brick with volpack's encoder, which treats each block on its own: any 32 blocks do as a brick. Returns the blocks and
/// what they decode to. Texels of blocks that lie outside the brick are not counted.
pub fn bc4(
    texels: usize,
    sequence: &SequenceRange,
    range: BrickRange,
    values: &[f32],
) -> Result<(Vec<u8>, Vec<f32>), OutOfRange> {
    let across = texels.div_ceil(BLOCK);
    let blocks = across * across * texels;
    let place = |block: usize, texel: usize| {
        let x = block % across * BLOCK + texel % BLOCK;
        let y = block / across % across * BLOCK + texel / BLOCK;
        (block < blocks && x < texels && y < texels)
            .then(|| (block / (across * across) * texels + y) * texels + x)
    };
    let bricks = (0..blocks).step_by(BLOCKS_OF_BRICK).map(|first| {
        let mut brick = Texels { values: [0.0; BRICK_VOXELS], texel_mask: Mask512::NONE, range };
        for (block, texel) in all_texels() {
            if let Some(at) = place(first + block, texel) {
                brick.values[voxel(block, texel)] = values[at];
                brick.texel_mask.set(voxel(block, texel));
            }
        }
        brick
    });
    let mut bytes = encode(TexelCodec::BC4, sequence, &Vec::from_iter(bricks))?.bytes;
    let mut decoded = vec![0.0; values.len()];
    for (i, brick) in bytes.chunks_exact(Codec::Bc4.layout().brick_bytes()).enumerate() {
        let brick = decode(Codec::Bc4, brick, 2, sequence, range);
        for (block, texel) in all_texels() {
            if let Some(at) = place(i * BLOCKS_OF_BRICK + block, texel) {
                decoded[at] = brick[voxel(block, texel)];
            }
        }
    }
    bytes.truncate(blocks * Codec::Bc4.layout().brick_bytes() / BLOCKS_OF_BRICK);
    Ok((bytes, decoded))
}

fn all_texels() -> impl Iterator<Item = (usize, usize)> {
    (0..BLOCKS_OF_BRICK).flat_map(|block| (0..BLOCK * BLOCK).map(move |texel| (block, texel)))
}

/// Encodes a brick along each axis and keeps the axis with the least error. Returns it, its blocks slice by slice, and
/// the texels they decode to.
pub fn bc7(texels: usize, unorms: &[u8]) -> (u8, Vec<u8>, Vec<u8>) {
    let (across, slices) = (texels / BLOCK, texels / BLOCK);
    // The slices of all three axes side by side: no surface is narrower than the 64 texels that the encoder wants.
    let width = (3 * slices * texels).max(64);
    let mut surface = vec![0u8; width * texels * 4];
    for axis in 0..3 {
        for_each_texel(texels, axis, |slice, u, v, channel, at| {
            surface[(v * width + (axis * slices + slice) * texels + u) * 4 + channel] = unorms[at];
        });
    }
    let blocks = intel_tex_2::bc7::compress_blocks(
        &intel_tex_2::bc7::alpha_very_fast_settings(),
        &intel_tex_2::RgbaSurface {
            data: &surface,
            width: width as u32,
            height: texels as u32,
            stride: width as u32 * 4,
        },
    );
    let candidates = (0..3).map(|axis| {
        let mut bytes = Vec::new();
        let mut rgba = vec![0u8; slices * texels * texels * 4];
        for slice in 0..slices {
            for row in 0..across {
                for column in 0..across {
                    let block = row * (width / BLOCK) + (axis * slices + slice) * across + column;
                    let block = &blocks[block * BC7_BYTES..][..BC7_BYTES];
                    bytes.extend_from_slice(block);
                    let first = ((slice * texels + row * BLOCK) * texels + column * BLOCK) * 4;
                    bcdec_rs::bc7(block, &mut rgba[first..], texels * 4);
                }
            }
        }
        let mut decoded = vec![0u8; unorms.len()];
        for_each_texel(texels, axis, |slice, u, v, channel, at| {
            decoded[at] = rgba[((slice * texels + v) * texels + u) * 4 + channel];
        });
        let error: u64 = decoded.iter().zip(unorms).map(|(a, b)| u64::from(a.abs_diff(*b)).pow(2)).sum();
        (error, axis as u8, bytes, decoded)
    });
    let (_, axis, bytes, decoded) = candidates.min_by_key(|c| (c.0, c.1)).expect("three axes");
    (axis, bytes, decoded)
}

/// Calls `visit` with the slice, u, v and channel of each voxel when channels run along an axis, and with the voxel's place. The
/// other two axes are u and v in ascending order.
fn for_each_texel(texels: usize, axis: usize, mut visit: impl FnMut(usize, usize, usize, usize, usize)) {
    let [along, u, v] = [[0, 1, 2], [1, 0, 2], [2, 0, 1]][axis];
    for at in 0..texels.pow(3) {
        let p = [at % texels, at / texels % texels, at / (texels * texels)];
        visit(p[along] / 4, p[u], p[v], p[along] % 4, at);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What volpack makes of a brick of 8³, and what this file makes of it.
    #[test]
    fn bricks_of_8_are_as_volpack_encodes_them() {
        let sequence = SequenceRange::around(0.0, 1.0).unwrap();
        let range = BrickRange::SEQUENCE;
        for seed in 0..20 {
            // One axis differs from the others, so that packing axes do.
            let field = |x: usize, y: usize, z: usize| {
                let p = [x, y, z].map(|c| c as f32);
                0.5 + 0.3 * (p[seed % 3] * 0.7 + seed as f32).sin()
                    + 0.15 * (p[0] * 1.9 + p[1] * 2.3 + p[2]).cos()
            };
            let ours: Vec<f32> = (0..512).map(|i| field(i % 8, i / 8 % 8, i / 64)).collect();
            let values = std::array::from_fn(|i| field(i / 64, i / 8 % 8, i % 8));
            let theirs = [Texels { values, texel_mask: Mask512::ALL, range }];

            let bc4_theirs = encode(TexelCodec::BC4, &sequence, &theirs).unwrap();
            assert_eq!(bc4(8, &sequence, range, &ours).unwrap().0, bc4_theirs.bytes);

            let unorms: Vec<u8> = ours.iter().map(|v| (v * 255.0).round() as u8).collect();
            let bc7_theirs = encode(TexelCodec::BC7, &sequence, &theirs).unwrap();
            let (axis, bytes, decoded) = bc7(8, &unorms);
            assert_eq!((axis, &bytes), (bc7_theirs.axes[0], &bc7_theirs.bytes), "seed {seed}");
            let theirs = decode(Codec::Bc7, &bytes, axis, &sequence, range);
            for (i, unorm) in decoded.into_iter().enumerate() {
                assert_eq!(f32::from(unorm) / 255.0, theirs[i % 8 * 64 + i / 8 % 8 * 8 + i / 64]);
            }
        }
    }
}
