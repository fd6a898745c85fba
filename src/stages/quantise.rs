//! Stage 7: texels to the bytes of a codec, slab by slab.

use std::{io, mem};

use rayon::prelude::*;

use super::allocate::{Allocation, Coding};
use super::dedup::SequenceTree;
use super::encodings::{KeptCodec, Kind, Tried};
use super::relayout::{self, PlannedAtlas, Texture, TextureOf};
use crate::codec::{Codec, OutOfRange, Texels, decode, encode};
use crate::pack::Atlas;
use crate::trace;
use crate::volume::Brick;

/// One grid's bricks and how they are coded.
pub struct GridBricks<'a> {
    /// The grid.
    pub tree: &'a mut SequenceTree,
    /// Its codecs and ranges.
    pub allocation: &'a mut Allocation,
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
pub struct Outcome {
    /// Its packing axis.
    pub axes: Vec<u8>,
    /// The root of the squared error over the voxels that its texels give, on the decoded value.
    pub norms: Vec<f64>,
}

impl Outcome {
    /// What is known before any slab is encoded: constants and shapes. Their norms are here from now on.
    pub fn before(allocation: &mut Allocation) -> Self {
        let axis = |coding: &Coding| match *coding {
            Coding::Shared(shape) => allocation.shapes[shape as usize].axis,
            _ => 2,
        };
        Self { axes: allocation.codings.iter().map(axis).collect(), norms: mem::take(&mut allocation.norms) }
    }
}

/// One brick's texels, encoded.
struct Encoded {
    bytes: Vec<u8>,
    axis: u8,
    /// Root of the squared error; `None` where it was known before.
    norm: Option<f64>,
}

/// A slab of an atlas, and what lies in it.
struct Slab<'a> {
    atlas: &'a Atlas,
    place: u32,
    textures: Vec<Texture>,
}

/// Encodes every slab of every atlas in order. `finish` is applied to a slab's bytes on the thread that made
/// them, `sink` to the results in order, each with its atlas and its place there. What becomes of each grid's bricks
/// goes into `outcomes`.
///
/// # Errors
/// [`QuantiseError`].
pub fn quantise<T: Send>(
    atlases: &[PlannedAtlas],
    grids: &mut [GridBricks],
    outcomes: &mut [Outcome],
    finish: impl Fn(&Atlas, Vec<u8>) -> io::Result<T> + Sync,
    mut sink: impl FnMut(&Atlas, u32, T) -> io::Result<()>,
) -> Result<(), QuantiseError> {
    let slabs = atlases.iter().flat_map(|planned| (0..planned.atlas.slabs).map(move |slab| (planned, slab)));
    let mut slabs = slabs.map(|(planned, place)| {
        let atlas = &planned.atlas;
        Slab { atlas, place, textures: planned.textures(atlas.slots(place)) }
    });
    loop {
        crate::interrupt::check().map_err(io::Error::from)?;
        // Two a thread: one of them may take longer than another.
        let group: Vec<Slab> = slabs.by_ref().take(2 * rayon::current_num_threads()).collect();
        if group.is_empty() {
            return Ok(());
        }
        for slabs in group.chunk_by(|a, b| a.atlas.codec == b.atlas.codec) {
            let textures: Vec<Texture> = slabs.iter().flat_map(|slab| &slab.textures).copied().collect();
            prepare(grids, slabs[0].atlas.codec, &textures)?;
        }
        let shared = &*grids;
        let encoded: Vec<_> = group
            .par_iter()
            .map(|slab| {
                let _span = trace::span("quantise");
                let encoded = encode_slab(shared, slab)?;
                let bytes: Vec<u8> = encoded.iter().flat_map(|e| &e.bytes).copied().collect();
                Ok((finish(slab.atlas, relayout::assemble(slab.atlas, &bytes))?, encoded))
            })
            .collect::<Result<_, QuantiseError>>()?;
        for ((bytes, encoded), slab) in encoded.into_iter().zip(&group) {
            sink(slab.atlas, slab.place, bytes)?;
            for (texture, encoded) in slab.textures.iter().zip(encoded) {
                if let TextureOf::Brick(id) = texture.of {
                    let outcome = &mut outcomes[texture.grid as usize];
                    outcome.axes[id as usize] = encoded.axis;
                    encoded.norm.into_iter().for_each(|norm| outcome.norms[id as usize] = norm);
                }
            }
        }
    }
}

/// Sees to it that the texels of some slots, which are kept, or else their bricks can be read.
fn prepare(grids: &mut [GridBricks], codec: Codec, textures: &[Texture]) -> io::Result<()> {
    for (g, GridBricks { tree, allocation }) in grids.iter_mut().enumerate() {
        let own = textures.iter().filter(|texture| texture.grid as usize == g).filter_map(Texture::brick);
        let ids: Vec<u32> = own.collect();
        match KeptCodec::of(codec) {
            Some(kept) => allocation.encodings.make(tree, &ids, &[Kind::Texels(kept)], |_| ())?,
            None => tree.fetch(&ids)?,
        }
    }
    Ok(())
}

fn encode_slab(grids: &[GridBricks], slab: &Slab) -> Result<Vec<Encoded>, QuantiseError> {
    let codec = slab.atlas.codec;
    let together = |a: &Texture, b: &Texture| a.grid == b.grid && a.brick().is_some() && b.brick().is_some();
    let mut out = Vec::with_capacity(slab.textures.len());
    for run in slab.textures.chunk_by(together) {
        let grid = run[0].grid as usize;
        let GridBricks { tree, allocation } = &grids[grid];
        if let TextureOf::Shape(shape) = run[0].of {
            let shape = &allocation.shapes[shape as usize];
            out.push(Encoded { bytes: shape.bytes.clone(), axis: shape.axis, norm: None });
            continue;
        }
        let ids: Vec<u32> = run.iter().filter_map(Texture::brick).collect();
        match KeptCodec::of(codec) {
            Some(kept) => {
                let Tried { costs, bytes, axes } = allocation.encodings.texels(&ids, kept)?;
                let each = bytes.chunks_exact(codec.layout().brick_bytes()).zip(costs).zip(axes);
                out.extend(each.map(|((bytes, cost), axis)| Encoded {
                    bytes: bytes.to_vec(),
                    axis,
                    norm: Some(cost.norm),
                }));
            }
            None => {
                let bricks = tree.pool.read(&ids)?;
                let encoded = encode_bricks(codec, &grids[grid], &ids, &bricks);
                out.extend(encoded.map_err(|source| QuantiseError::OutOfRange { grid, source })?);
            }
        }
    }
    Ok(out)
}

fn encode_bricks(
    codec: Codec,
    grid: &GridBricks,
    ids: &[u32],
    bricks: &[Brick],
) -> Result<Vec<Encoded>, OutOfRange> {
    let sequence = &grid.allocation.sequence;
    let encodings = &grid.allocation.encodings;
    let texels: Vec<Texels> =
        ids.iter().zip(bricks).map(|(&id, brick)| encodings.prepare(grid.tree, id, brick)).collect();
    let encoded = encode(codec, sequence, &texels)?;
    let size = codec.layout().brick_bytes();
    let each = bricks.iter().zip(&texels).zip(encoded.bytes.chunks_exact(size)).zip(encoded.axes);
    let encoded = each.map(|(((brick, texels), bytes), axis)| {
        let norm = if codec == Codec::F32 {
            0.0
        } else {
            let decoded = decode(codec, bytes, axis, sequence, texels.range);
            brick.error_norm(&decoded, &texels.carried)
        };
        Encoded { bytes: bytes.to_vec(), axis, norm: Some(norm) }
    });
    Ok(encoded.collect())
}
