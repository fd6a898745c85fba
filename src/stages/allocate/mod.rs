//! Stage 5: how each brick is coded, and what its texels' 0 and 1 stand for.
//!
//! A uniform format gives every brick one codec. The adaptive one gives each the one that serves the whole best (`search`, `size`), as rate-distortion theory has it: the least
//! D + λR, with one λ for all (Shoham & Gersho 1988).

mod adaptive;
mod choices;
mod cluster;
pub mod kmeans;
mod rung;
mod search;
mod share;
mod size;

use std::collections::HashMap;
use std::io;

use half::f16;

use super::dedup::SequenceTree;
use super::encodings::Encodings;
use crate::codec::{BrickRange, Codec, OutOfRange, SequenceRange};
use crate::volume::ValueRange;

pub use adaptive::{AdaptiveGrid, Target, adaptive};
pub use cluster::clustered;

/// How one grid's bricks are coded.
pub struct Allocation {
    /// The range that brick ranges are fractions of.
    pub sequence: SequenceRange,
    /// How each brick of the pool is coded.
    pub codings: Vec<Coding>,
    /// Texels that several bricks share.
    pub shapes: Vec<Shape>,
    /// Under which range a brick reads texels that were made for another.
    pub borrowed: HashMap<u32, BrickRange>,
    /// The root of the squared error of each brick over the voxels that its texels give, as far as it is
    /// known before texels are made: 0 where [`super::quantise`] will measure it.
    pub norms: Vec<f64>,
    /// The squared error of each frame's empty bricks.
    pub empty_squares: Vec<f64>,
    /// What codecs make of them.
    pub encodings: Encodings,
}

/// What gives a brick its values.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Coding {
    /// The background: it needs no record.
    Empty,
    /// One value for all voxels that no rule gives.
    Constant(f32),
    /// Texels of its own.
    Own(Codec),
    /// The texels of this place of [`Allocation::shapes`].
    Shared(u32),
}

/// Texels that several bricks share, each with its own range.
pub struct Shape {
    /// Their codec.
    pub codec: Codec,
    /// One brick's bytes.
    pub bytes: Vec<u8>,
    /// Their packing axis.
    pub axis: u8,
}

/// The pack cannot be allocated.
#[derive(Debug, thiserror::Error)]
pub enum AllocateError {
    /// Reading bricks back failed.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// A value does not fit the codec.
    #[error(transparent)]
    OutOfRange(#[from] OutOfRange),
}

impl Allocation {
    fn new(encodings: Encodings, codings: Vec<Coding>, norms: Vec<f64>) -> Self {
        Self {
            sequence: encodings.sequence,
            codings,
            shapes: Vec::new(),
            borrowed: HashMap::new(),
            norms,
            empty_squares: Vec::new(),
            encodings,
        }
    }

    /// The codec of a brick.
    pub fn codec(&self, brick: u32) -> Codec {
        match self.codings[brick as usize] {
            Coding::Empty | Coding::Constant(_) => Codec::Constant,
            Coding::Own(codec) => codec,
            Coding::Shared(shape) => self.shapes[shape as usize].codec,
        }
    }

    /// The range of a brick. Raw texels need none to be decoded: theirs is the tight one, for the majorant in it.
    pub fn range(&self, tree: &SequenceTree, brick: u32) -> BrickRange {
        let ValueRange { min, max } = tree.brick_ranges[brick];
        match self.codings[brick as usize] {
            Coding::Own(Codec::F32) => self.sequence.fit(min, max),
            // What bounds a voxel is what its texel decodes to.
            Coding::Own(Codec::F16) => {
                let [min, max] = [min, max].map(|v| f16::from_f32(v).to_f32());
                self.sequence.fit(min, max)
            }
            _ => match self.borrowed.get(&brick) {
                Some(range) => *range,
                None => self.encodings.range(tree, brick),
            },
        }
    }
}

/// The numbers of all bricks, so many at a time.
fn windows(bricks: u32, size: u32) -> impl Iterator<Item = Vec<u32>> {
    (0..bricks).step_by(size as usize).map(move |first| (first..(first + size).min(bricks)).collect())
}

/// Gives every brick of `tree` one codec.
pub fn uniform(tree: &SequenceTree, encodings: Encodings, codec: Codec) -> Allocation {
    let bricks = tree.pool.len() as usize;
    Allocation::new(encodings, vec![Coding::Own(codec); bricks], vec![0.0; bricks])
}
