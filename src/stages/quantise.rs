//! Stage 7: texels to the bytes of a codec, slab by slab.

use std::{io, mem};

use rayon::prelude::*;

use super::allocate::{Allocation, Coding};
use super::dedup::SequenceTree;
use super::encodings::{KeptCodec, Kind, Tried};
use super::relayout::{self, PlannedAtlas, Texture, TextureOf};
use crate::codec::{Codec, OutOfRange, Texels, decode, encode};
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

/// The contents of some slots before they are encoded.
enum Run {
    /// One slot's texels, which are there already.
    Encoded(Encoded),
    /// Bricks of one grid, by their numbers in its pool.
    Bricks(Vec<u32>),
}

/// One brick's texels, encoded.
struct Encoded {
    bytes: Vec<u8>,
    axis: u8,
    /// Root of the squared error; `None` where it was known before.
    norm: Option<f64>,
}

/// Encodes every slab of an atlas in order. `finish` is applied to a slab's bytes on the thread that made
/// them, `sink` to the results in order. What becomes of each grid's bricks goes into `outcomes`.
///
/// # Errors
/// [`QuantiseError`].
pub fn quantise<T: Send>(
    planned: &PlannedAtlas,
    grids: &mut [GridBricks],
    outcomes: &mut [Outcome],
    finish: impl Fn(Vec<u8>) -> io::Result<T> + Sync,
    mut sink: impl FnMut(T) -> io::Result<()>,
) -> Result<(), QuantiseError> {
    let atlas = &planned.atlas;
    // Two slabs a thread: one of them may take longer than another.
    let group = 2 * rayon::current_num_threads() as u32;
    for first in (0..atlas.slabs).step_by(group as usize) {
        crate::interrupt::check().map_err(io::Error::from)?;
        let slabs: Vec<Vec<Texture>> = (first..(first + group).min(atlas.slabs))
            .map(|slab| planned.textures(atlas.slots(slab)))
            .collect();
        make_kept(grids, atlas.codec, &slabs.concat())?;
        let runs = slabs
            .iter()
            .map(|textures| read_runs(grids, atlas.codec, textures))
            .collect::<io::Result<Vec<_>>>()?;
        let grids = &*grids;
        let encoded: Vec<_> = runs
            .into_par_iter()
            .map(|runs| {
                let _span = trace::span("quantise");
                let encoded = encode_slab(atlas.codec, grids, runs)?;
                let bytes: Vec<u8> = encoded.iter().flat_map(|e| &e.bytes).copied().collect();
                Ok((finish(relayout::assemble(atlas, &bytes))?, encoded))
            })
            .collect::<Result<_, QuantiseError>>()?;
        for ((slab, encoded), textures) in encoded.into_iter().zip(&slabs) {
            sink(slab)?;
            for (texture, encoded) in textures.iter().zip(encoded) {
                if let TextureOf::Brick(id) = texture.of {
                    let outcome = &mut outcomes[texture.grid as usize];
                    outcome.axes[id as usize] = encoded.axis;
                    encoded.norm.into_iter().for_each(|norm| outcome.norms[id as usize] = norm);
                }
            }
        }
    }
    Ok(())
}

/// Makes the texels of some slots that are kept and not there yet.
fn make_kept(grids: &mut [GridBricks], codec: Codec, textures: &[Texture]) -> io::Result<()> {
    let Some(kept) = KeptCodec::of(codec) else { return Ok(()) };
    for (g, GridBricks { tree, allocation }) in grids.iter_mut().enumerate() {
        let own = |texture: &Texture| match texture.of {
            TextureOf::Brick(id) => (texture.grid as usize == g).then_some(id),
            TextureOf::Shape(_) => None,
        };
        let ids: Vec<u32> = textures.iter().filter_map(own).collect();
        allocation.encodings.make(tree, &ids, &[Kind::Texels(kept)], |_| ())?;
    }
    Ok(())
}

/// What lies in some slots, each run with its grid: texels where they are known, else bricks.
fn read_runs(grids: &mut [GridBricks], codec: Codec, textures: &[Texture]) -> io::Result<Vec<(usize, Run)>> {
    let together = |a: &Texture, b: &Texture| {
        a.grid == b.grid && matches!((a.of, b.of), (TextureOf::Brick(_), TextureOf::Brick(_)))
    };
    let mut runs = Vec::new();
    for run in textures.chunk_by(together) {
        let index = run[0].grid as usize;
        let GridBricks { tree, allocation } = &mut grids[index];
        if let TextureOf::Shape(shape) = run[0].of {
            let shape = &allocation.shapes[shape as usize];
            let encoded = Encoded { bytes: shape.bytes.clone(), axis: shape.axis, norm: None };
            runs.push((index, Run::Encoded(encoded)));
            continue;
        }
        let id = |texture: &Texture| match texture.of {
            TextureOf::Brick(id) => id,
            TextureOf::Shape(_) => unreachable!("shapes are runs of their own"),
        };
        let ids: Vec<u32> = run.iter().map(id).collect();
        match KeptCodec::of(codec) {
            Some(kept) => {
                let Tried { costs, bytes, axes } = allocation.encodings.texels(&ids, kept)?;
                let each = bytes.chunks_exact(codec.layout().brick_bytes()).zip(costs).zip(axes);
                runs.extend(each.map(|((bytes, cost), axis)| {
                    (index, Run::Encoded(Encoded { bytes: bytes.to_vec(), axis, norm: Some(cost.norm) }))
                }));
            }
            None => {
                tree.fetch(&ids)?;
                runs.push((index, Run::Bricks(ids)));
            }
        }
    }
    Ok(runs)
}

fn encode_slab(
    codec: Codec,
    grids: &[GridBricks],
    runs: Vec<(usize, Run)>,
) -> Result<Vec<Encoded>, QuantiseError> {
    let mut out = Vec::new();
    for (grid, run) in runs {
        match run {
            Run::Encoded(encoded) => out.push(encoded),
            Run::Bricks(ids) => {
                let bricks = grids[grid].tree.pool.read(&ids)?;
                out.extend(
                    encode_bricks(codec, &grids[grid], &ids, &bricks)
                        .map_err(|source| QuantiseError::OutOfRange { grid, source })?,
                );
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
