//! Stage 7: texels to the bytes of a codec, slab by slab.

use rayon::prelude::*;

use super::allocate::{Allocation, BrickErrors, Coding};
use super::dedup::SequenceTree;
use super::encoder_cache::{EncoderCache, KeptBricks, Trial};
use super::relayout::{self, Cursor, Placement, Texture, TextureOf};
use crate::cancel::CancelToken;
use crate::codec::{EncodedBricks, Fidelity, OutOfRange, TexelCodec, Texels, decode, encode};
use crate::error::{Error, Result};
use crate::pack::Atlas;
use crate::profile;
use crate::volume::{Brick, ScratchResult};

/// One grid's bricks, how they are coded, and what makes their texels.
pub struct GridBricks<'a> {
    /// The grid's name.
    pub name: &'a str,
    /// Its bricks.
    pub tree: &'a mut SequenceTree,
    /// Their codecs and ranges.
    pub allocation: &'a Allocation,
    /// Their encoders.
    pub encoders: &'a mut EncoderCache,
}

/// What became of each brick of a grid.
pub struct EncodedGrid {
    /// Its packing axis, where it has texels of its own.
    axes: Vec<u8>,
    /// Errors of bricks, where the allocation did not know them.
    error_l2s: Option<BrickErrors>,
}

impl EncodedGrid {
    fn new(grid: &GridBricks) -> Result<Self> {
        let allocation = grid.allocation;
        let mut error_l2s = None;
        if !allocation.error_l2s.are_known {
            let mut errors = BrickErrors::new(&grid.tree.scratch);
            // Those of clusters are known: quantising adds those of bricks that have texels of their own.
            let is_clustered = |&id: &u32| !matches!(allocation.coding(id), Coding::Own(_));
            let clustered: Vec<u32> = (0..allocation.len()).filter(is_clustered).collect();
            let known = allocation.error_l2s.read(&clustered)?;
            clustered.iter().zip(known).try_for_each(|(&id, error_l2)| errors.put(id, &[error_l2]))?;
            error_l2s = Some(errors);
        }
        Ok(Self { axes: vec![2; allocation.len() as usize], error_l2s })
    }

    /// The packing axis of the texels that a brick reads.
    pub fn axis(&self, allocation: &Allocation, brick: u32) -> u8 {
        match allocation.coding(brick) {
            Coding::Borrowed(referenced) => self.axes[referenced as usize],
            Coding::Clustered(shape) => allocation.shapes[shape as usize].axis,
            _ => self.axes[brick as usize],
        }
    }

    /// The roots of the squared errors of some bricks over the voxels that their texels give.
    ///
    /// # Errors
    /// When the scratch file cannot be read back.
    pub fn error_l2s(&self, allocation: &Allocation, ids: &[u32]) -> ScratchResult<Vec<f64>> {
        self.error_l2s.as_ref().unwrap_or(&allocation.error_l2s).read(ids)
    }
}

/// The texels of a slab, or of a part of it.
#[derive(Default)]
struct SlabTexels {
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
/// them, `sink` to the results in order, each with its atlas and its place there.
///
/// # Errors
/// When bricks cannot be read, a value does not fit its codec, or the work is cancelled; and those of `finish` and
/// `sink`.
pub fn quantise<T: Send>(
    placement: &Placement,
    grids: &mut [GridBricks],
    cancel: &CancelToken,
    finish: impl Fn(&Atlas, Vec<u8>) -> Result<T> + Sync,
    mut sink: impl FnMut(&Atlas, u32, T) -> Result<()>,
) -> Result<Vec<EncodedGrid>> {
    let mut encoded_grids: Vec<EncodedGrid> = grids.iter().map(EncodedGrid::new).collect::<Result<_>>()?;
    let allocations: Vec<&Allocation> = grids.iter().map(|grid| grid.allocation).collect();
    let mut slabs =
        placement.atlases.iter().flat_map(|atlas| (0..atlas.slabs).map(move |slab| (atlas, slab)));
    let mut cursor = Cursor::default();
    loop {
        cancel.check()?;
        let slab = |(atlas, place)| {
            if place == 0 {
                cursor = Cursor::default();
            }
            Slab { atlas, place, textures: placement.textures(&allocations, atlas, place, &mut cursor) }
        };
        // Some a thread: one of them may take longer than another.
        let group: Vec<Slab> =
            slabs.by_ref().take(SLABS_PER_THREAD * rayon::current_num_threads()).map(slab).collect();
        if group.is_empty() {
            break;
        }
        for slabs in group.chunk_by(|a, b| a.atlas.codec == b.atlas.codec) {
            let textures: Vec<Texture> = slabs.iter().flat_map(|slab| &slab.textures).copied().collect();
            prepare(grids, codec(slabs[0].atlas), &textures)?;
        }
        let shared = &*grids;
        let encoded: Vec<_> = group
            .par_iter()
            .map(|slab| {
                let _span = profile::span("quantise");
                let SlabTexels { bytes, axes, error_l2s } = encode_slab(shared, slab)?;
                Ok((finish(slab.atlas, relayout::assemble(slab.atlas, &bytes))?, axes, error_l2s))
            })
            .collect::<Result<_>>()?;
        for ((bytes, axes, error_l2s), slab) in encoded.into_iter().zip(&group) {
            sink(slab.atlas, slab.place, bytes)?;
            for ((texture, axis), error_l2) in slab.textures.iter().zip(axes).zip(error_l2s) {
                let Some(id) = texture.brick() else { continue };
                let grid = &mut encoded_grids[texture.grid as usize];
                grid.axes[id as usize] = axis;
                if let Some(errors) = &mut grid.error_l2s {
                    errors.put(id, &[error_l2])?;
                }
            }
        }
    }
    encoded_grids.iter_mut().filter_map(|grid| grid.error_l2s.as_mut()).try_for_each(BrickErrors::flush)?;
    Ok(encoded_grids)
}

/// Slabs that are worked on together, for each thread.
const SLABS_PER_THREAD: usize = 2;

/// The codec of an atlas.
fn codec(atlas: &Atlas) -> TexelCodec {
    TexelCodec::of(atlas.codec).expect("an atlas has texels")
}

/// Sees to it that the texels of some slots, which are kept, or else their bricks can be read.
fn prepare(grids: &mut [GridBricks], codec: TexelCodec, textures: &[Texture]) -> Result<()> {
    for (g, GridBricks { tree, encoders, .. }) in grids.iter_mut().enumerate() {
        let own = textures.iter().filter(|texture| texture.grid as usize == g).filter_map(Texture::brick);
        let ids: Vec<u32> = own.collect();
        match codec.keeps_texels() {
            true => encoders.make(tree, &ids, &[Trial::Texels(codec)], |_| ())?,
            false => tree.fetch(&ids)?,
        }
    }
    Ok(())
}

fn encode_slab(grids: &[GridBricks], slab: &Slab) -> Result<SlabTexels> {
    let codec = codec(slab.atlas);
    let together = |a: &Texture, b: &Texture| a.grid == b.grid && a.brick().is_some() && b.brick().is_some();
    let mut all = SlabTexels::default();
    for run in slab.textures.chunk_by(together) {
        let grid = run[0].grid as usize;
        let GridBricks { name, tree, allocation, encoders } = &grids[grid];
        if let TextureOf::Shape(shape) = run[0].of {
            let shape = &allocation.shapes[shape as usize];
            all.add(SlabTexels { bytes: shape.bytes.clone(), axes: vec![shape.axis], error_l2s: vec![0.0] });
            continue;
        }
        let ids: Vec<u32> = run.iter().filter_map(Texture::brick).collect();
        all.add(match codec.keeps_texels() {
            true => {
                let KeptBricks { costs, bytes, axes } = encoders.texels(&ids, codec)?;
                SlabTexels { bytes, axes, error_l2s: costs.iter().map(|cost| cost.error_l2).collect() }
            }
            false => {
                let bricks = tree.pool.read(&ids)?;
                let encoded = encode_bricks(codec, &grids[grid], &ids, &bricks);
                encoded.map_err(|source| Error::OutOfRange { grid: (*name).to_owned(), source })?
            }
        });
    }
    Ok(all)
}

impl SlabTexels {
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
    codec: TexelCodec,
    grid: &GridBricks,
    ids: &[u32],
    bricks: &[Brick],
) -> Result<SlabTexels, OutOfRange> {
    let sequence = &grid.allocation.sequence;
    let texels: Vec<Texels> =
        ids.iter().zip(bricks).map(|(&id, brick)| grid.encoders.prepare(grid.tree, id, brick)).collect();
    let EncodedBricks { bytes, axes } = encode(codec, sequence, &texels)?;
    let codec = codec.codec();
    let each = bricks.iter().zip(&texels).zip(bytes.chunks_exact(codec.layout().brick_bytes())).zip(&axes);
    let error_l2 =
        |(((brick, texels), bytes), &axis): (((&Brick, &Texels), &[u8]), &u8)| match codec.fidelity() {
            Fidelity::Exact => 0.0,
            _ => {
                let decoded = decode(codec, bytes, axis, sequence, texels.range);
                brick.error_l2(&decoded, &texels.texel_mask)
            }
        };
    let error_l2s = each.map(error_l2).collect();
    Ok(SlabTexels { bytes, axes, error_l2s })
}
