//! Stage 7: texels to the bytes of a codec, slab by slab.

use std::io;
use std::ops::Range;

use rayon::prelude::*;

use super::allocate::Allocation;
use super::dedup::{Payload, SequenceTree, carried};
use super::relayout;
use crate::codec::{Codec, OutOfRange, Texels, decode, encode};
use crate::pack::Atlas;
use crate::volume::{Brick, InactiveRule};

/// Bricks that are in memory at once: 8 MB of voxels, enough batches for every core.
const BRICKS_IN_FLIGHT: u32 = 4096;

/// One grid's bricks and where they begin in the atlas.
pub struct GridBricks<'a> {
    /// The grid.
    pub tree: &'a mut SequenceTree,
    /// Its codecs and ranges.
    pub allocation: &'a Allocation,
    /// The slot of the first brick of its pool; the others follow.
    pub first_slot: u32,
}

/// The slabs cannot be encoded.
#[derive(Debug, thiserror::Error)]
pub enum QuantiseError {
    /// Reading bricks back or writing slabs failed.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// A value that the codec cannot hold, in the grid at this place.
    #[error("{source}")]
    OutOfRange {
        /// Which of the grids.
        grid: usize,
        /// The value.
        source: OutOfRange,
    },
}

/// What became of each brick of a grid.
#[derive(Default)]
pub struct Outcome {
    /// Its packing axis.
    pub axes: Vec<u8>,
    /// The squared error over the voxels that its texels give, on the decoded value.
    pub squares: Vec<f64>,
}

/// The bricks of one slab that come from one grid.
struct Part {
    grid: usize,
    first: u32,
    bricks: Vec<Brick>,
}

/// Encodes every slab of `atlas` in order. `finish` is applied to a slab's bytes on the thread that made
/// them, `sink` to the results in order. Returns what became of each grid's bricks.
///
/// # Errors
/// [`QuantiseError`].
pub fn quantise<T: Send>(
    atlas: &Atlas,
    grids: &mut [GridBricks],
    finish: impl Fn(Vec<u8>) -> io::Result<T> + Sync,
    mut sink: impl FnMut(T) -> io::Result<()>,
) -> Result<Vec<Outcome>, QuantiseError> {
    let rules: Vec<Vec<InactiveRule>> = grids.iter().map(|g| brick_rules(g.tree)).collect();
    let mut outcomes: Vec<Outcome> = grids.iter().map(|_| Outcome::default()).collect();
    let group = (BRICKS_IN_FLIGHT / atlas.slab_bricks()).max(1);
    for first in (0..atlas.slabs).step_by(group as usize) {
        let slabs = first..(first + group).min(atlas.slabs);
        let parts = slabs.map(|slab| read_parts(grids, atlas.slots(slab))).collect::<io::Result<Vec<_>>>()?;
        let grids = &*grids;
        let encoded: Vec<_> = parts
            .into_par_iter()
            .map(|parts| {
                let (bytes, outcomes) = encode_slab(atlas, grids, &rules, parts)?;
                Ok((finish(relayout::assemble(atlas, &bytes))?, outcomes))
            })
            .collect::<Result<_, QuantiseError>>()?;
        for (slab, parts) in encoded {
            sink(slab)?;
            for (grid, part) in parts {
                outcomes[grid].axes.extend(part.axes);
                outcomes[grid].squares.extend(part.squares);
            }
        }
    }
    Ok(outcomes)
}

/// The inactive rule of each brick of the pool.
fn brick_rules(tree: &SequenceTree) -> Vec<InactiveRule> {
    // Records of bricks are made in the order of the pool.
    let of_brick = tree.records.iter().filter(|r| matches!(r.payload, Payload::Brick(_)));
    of_brick.map(|r| r.rule).collect()
}

fn read_parts(grids: &mut [GridBricks], slots: Range<u32>) -> io::Result<Vec<Part>> {
    let mut parts = Vec::new();
    for (grid, source) in grids.iter_mut().enumerate() {
        let start = slots.start.max(source.first_slot) - source.first_slot;
        let end = slots.end.saturating_sub(source.first_slot).min(source.tree.pool.len());
        if start < end {
            let mut bricks = Vec::new();
            source.tree.pool.read(start..end, &mut bricks)?;
            parts.push(Part { grid, first: start, bricks });
        }
    }
    Ok(parts)
}

type PartOutcomes = Vec<(usize, Outcome)>;

fn encode_slab(
    atlas: &Atlas,
    grids: &[GridBricks],
    rules: &[Vec<InactiveRule>],
    parts: Vec<Part>,
) -> Result<(Vec<u8>, PartOutcomes), QuantiseError> {
    let mut bytes = Vec::with_capacity(atlas.slab_bytes());
    let mut outcomes = Vec::new();
    for Part { grid, first, bricks } in parts {
        let source = &grids[grid];
        let texels: Vec<Texels> = bricks
            .iter()
            .zip(first as usize..)
            .map(|(brick, id)| {
                let carried = carried(brick, rules[grid][id]);
                let range = source.tree.brick_ranges[id];
                Texels::new(brick, carried, (range.min, range.max), source.allocation.ranges[id])
            })
            .collect();
        let encoded = encode(atlas.codec, &source.allocation.sequence, &texels)
            .map_err(|source| QuantiseError::OutOfRange { grid, source })?;
        let size = atlas.codec.layout().brick_bytes();
        let each = bricks.iter().zip(&texels).zip(encoded.bytes.chunks_exact(size)).zip(&encoded.axes);
        let squares = each.map(|(((brick, texels), bytes), &axis)| {
            if atlas.codec == Codec::F32 {
                return 0.0;
            }
            let decoded = decode(atlas.codec, bytes, axis, &source.allocation.sequence, texels.range);
            let square = |i: usize| (f64::from(decoded[i]) - f64::from(brick.values[i])).powi(2);
            texels.carried.ones().map(square).sum()
        });
        let squares = squares.collect();
        bytes.extend(encoded.bytes);
        outcomes.push((grid, Outcome { axes: encoded.axes, squares }));
    }
    Ok((bytes, outcomes))
}
