//! Stage 7: texels to the bytes of a codec, slab by slab.

use std::io;

use rayon::prelude::*;

use super::allocate::{Allocation, Coding};
use super::dedup::SequenceTree;
use super::encodings::{KeptCodec, Kind, Tried};
use super::relayout::{self, Cursor, Layout, Texture, TextureOf};
use crate::codec::{self, Codec, OutOfRange, Texels, decode, encode};
use crate::pack::Atlas;
use crate::profile;
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
    /// Its packing axis, where it has texels of its own.
    axes: Vec<u8>,
}

impl Outcome {
    /// What is known before any slab is encoded.
    pub fn before(allocation: &Allocation) -> Self {
        Self { axes: vec![2; allocation.len() as usize] }
    }

    /// The packing axis of the texels that a brick reads.
    pub fn axis(&self, allocation: &Allocation, brick: u32) -> u8 {
        match allocation.coding(brick) {
            Coding::Borrowed(referenced) => self.axes[referenced as usize],
            Coding::Shared(shape) => allocation.shapes[shape as usize].axis,
            _ => self.axes[brick as usize],
        }
    }
}

/// Some texels, encoded.
#[derive(Default)]
struct Encoded {
    /// One brick's after another's.
    bytes: Vec<u8>,
    axes: Vec<u8>,
    /// Roots of squared errors; 0 for shapes, which have none.
    error_l2s: Vec<f64>,
}

/// A slab of an atlas, and what lies in it.
struct Slab<'a> {
    atlas: &'a Atlas,
    place: u32,
    textures: Vec<Texture>,
}

/// Encodes every slab of every atlas in order. `finish` is applied to a slab's bytes on the thread that made
/// them, `sink` to the results in order, each with its atlas and its place there. What becomes of each grid's bricks
/// goes into `outcomes`, and their errors, where they were not known, to those of their allocation.
///
/// # Errors
/// [`QuantiseError`].
pub fn quantise<T: Send>(
    layout: &Layout,
    grids: &mut [GridBricks],
    outcomes: &mut [Outcome],
    finish: impl Fn(&Atlas, Vec<u8>) -> io::Result<T> + Sync,
    mut sink: impl FnMut(&Atlas, u32, T) -> io::Result<()>,
) -> Result<(), QuantiseError> {
    let mut slabs = layout.atlases.iter().flat_map(|atlas| (0..atlas.slabs).map(move |slab| (atlas, slab)));
    let mut cursor = Cursor::default();
    loop {
        crate::interrupt::check().map_err(io::Error::from)?;
        let allocations: Vec<&Allocation> = grids.iter().map(|grid| &*grid.allocation).collect();
        let slab = |(atlas, place)| {
            if place == 0 {
                cursor = Cursor::default();
            }
            Slab { atlas, place, textures: layout.textures(&allocations, atlas, place, &mut cursor) }
        };
        // Some a thread: one of them may take longer than another.
        let group: Vec<Slab> =
            slabs.by_ref().take(AT_ONCE * rayon::current_num_threads()).map(slab).collect();
        if group.is_empty() {
            break;
        }
        for slabs in group.chunk_by(|a, b| a.atlas.codec == b.atlas.codec) {
            let textures: Vec<Texture> = slabs.iter().flat_map(|slab| &slab.textures).copied().collect();
            prepare(grids, slabs[0].atlas.codec, &textures)?;
        }
        let shared = &*grids;
        let encoded: Vec<_> = group
            .par_iter()
            .map(|slab| {
                let _span = profile::span("quantise");
                let Encoded { bytes, axes, error_l2s } = encode_slab(shared, slab)?;
                Ok((finish(slab.atlas, relayout::assemble(slab.atlas, &bytes))?, axes, error_l2s))
            })
            .collect::<Result<_, QuantiseError>>()?;
        for ((bytes, axes, error_l2s), slab) in encoded.into_iter().zip(&group) {
            sink(slab.atlas, slab.place, bytes)?;
            for ((texture, axis), error_l2) in slab.textures.iter().zip(axes).zip(error_l2s) {
                let Some(id) = texture.brick() else { continue };
                let grid = texture.grid as usize;
                outcomes[grid].axes[id as usize] = axis;
                let all = &mut grids[grid].allocation.error_l2s;
                if !all.are_known {
                    all.put(id, &[error_l2])?;
                }
            }
        }
    }
    grids.iter_mut().try_for_each(|grid| grid.allocation.error_l2s.flush())?;
    Ok(())
}

/// Slabs that are worked on together, for each thread.
const AT_ONCE: usize = 2;

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

fn encode_slab(grids: &[GridBricks], slab: &Slab) -> Result<Encoded, QuantiseError> {
    let codec = slab.atlas.codec;
    let together = |a: &Texture, b: &Texture| a.grid == b.grid && a.brick().is_some() && b.brick().is_some();
    let mut all = Encoded::default();
    for run in slab.textures.chunk_by(together) {
        let grid = run[0].grid as usize;
        let GridBricks { tree, allocation } = &grids[grid];
        if let TextureOf::Shape(shape) = run[0].of {
            let shape = &allocation.shapes[shape as usize];
            all.add(Encoded { bytes: shape.bytes.clone(), axes: vec![shape.axis], error_l2s: vec![0.0] });
            continue;
        }
        let ids: Vec<u32> = run.iter().filter_map(Texture::brick).collect();
        all.add(match KeptCodec::of(codec) {
            Some(kept) => {
                let Tried { costs, bytes, axes } = allocation.encodings.texels(&ids, kept)?;
                Encoded { bytes, axes, error_l2s: costs.iter().map(|cost| cost.error_l2).collect() }
            }
            None => {
                let bricks = tree.pool.read(&ids)?;
                let encoded = encode_bricks(codec, &grids[grid], &ids, &bricks);
                encoded.map_err(|source| QuantiseError::OutOfRange { grid, source })?
            }
        });
    }
    Ok(all)
}

impl Encoded {
    /// Appends what comes after. What is alone, as most is, is not copied.
    fn add(&mut self, next: Self) {
        if self.axes.is_empty() {
            *self = next;
            return;
        }
        self.bytes.extend_from_slice(&next.bytes);
        self.axes.extend(next.axes);
        self.error_l2s.extend(next.error_l2s);
    }
}

fn encode_bricks(
    codec: Codec,
    grid: &GridBricks,
    ids: &[u32],
    bricks: &[Brick],
) -> Result<Encoded, OutOfRange> {
    let sequence = &grid.allocation.sequence;
    let encodings = &grid.allocation.encodings;
    let texels: Vec<Texels> =
        ids.iter().zip(bricks).map(|(&id, brick)| encodings.prepare(grid.tree, id, brick)).collect();
    let codec::Encoded { bytes, axes } = encode(codec, sequence, &texels)?;
    let each = bricks.iter().zip(&texels).zip(bytes.chunks_exact(codec.layout().brick_bytes())).zip(&axes);
    let error_l2 = |(((brick, texels), bytes), &axis): (((&Brick, &Texels), &[u8]), &u8)| match codec {
        Codec::F32 => 0.0,
        _ => {
            let decoded = decode(codec, bytes, axis, sequence, texels.range);
            brick.error_l2(&decoded, &texels.texel_mask)
        }
    };
    let error_l2s = each.map(error_l2).collect();
    Ok(Encoded { bytes, axes, error_l2s })
}
