//! How many columns, rows and slabs the texture of a codec gets.

use crate::codec::Codec;
use crate::pack::{Atlas, MAX_TEXELS};

/// Bricks across a page at most.
const MAX_COLUMNS: u32 = MAX_TEXELS / 8;
/// The size that a full slab comes closest to: what the format calls "about 256 KiB".
const SLAB_BYTES: u32 = 256 << 10;

/// Lays out `bricks` bricks so that little of the last slab stays empty: the slabs share them evenly,
/// so at most a brick a row and one a slab is lost.
pub fn plan(codec: Codec, bricks: u32) -> Atlas {
    let layout = codec.layout();
    let slab_bricks = SLAB_BYTES / layout.brick_bytes() as u32;
    let slabs = bricks.div_ceil(slab_bricks);
    let per_slab = if slabs == 0 { 0 } else { bricks.div_ceil(slabs) };
    let rows = per_slab.div_ceil(MAX_COLUMNS).max(1);
    let columns = per_slab.div_ceil(rows).max(1);
    // With evened-out slabs the last ones could be left without a brick.
    let slabs = bricks.div_ceil(columns * rows);
    Atlas { codec, bricks, columns, rows, slabs, page_slabs: MAX_TEXELS / layout.slices as u32 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn little_is_lost_to_padding() {
        for codec in Codec::WITH_TEXELS {
            for bricks in [1, 37, 255, 257, 2048, 2049, 3268, 100_000] {
                let atlas = plan(codec, bricks);
                let places = atlas.slabs * atlas.slab_bricks();
                assert!(places >= bricks, "{codec:?} {bricks}");
                assert!(places - bricks <= atlas.slabs * (atlas.rows + 1), "{codec:?} {bricks}: {atlas:?}");
                assert!(atlas.columns <= MAX_COLUMNS && atlas.rows <= MAX_COLUMNS);
                assert!(atlas.slab_bytes() <= SLAB_BYTES as usize);
            }
        }
        assert_eq!(plan(Codec::Bc7, 0).bytes(), 0);
    }
}
