//! What BC4 and BC7 share: surfaces of bricks side by side, and their blocks.

/// From the blocks of a surface 8 texels high, in two rows across all of it, to the blocks of one
/// 8 × 8 slice after another, each with its upper two blocks first.
pub(super) fn by_slice(blocks: &[u8], surface_width: usize, block_bytes: usize, slices: usize) -> Vec<u8> {
    let row_bytes = surface_width / 4 * block_bytes;
    let mut out = Vec::with_capacity(slices * 4 * block_bytes);
    for slice in 0..slices {
        for row in blocks.chunks_exact(row_bytes) {
            out.extend(&row[slice * 2 * block_bytes..][..2 * block_bytes]);
        }
    }
    out
}
