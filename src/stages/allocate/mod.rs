//! Stage 5: how each brick is coded, and what its texels' 0 and 1 stand for.
//!
//! A uniform format gives every brick one codec. The adaptive one gives each the one that serves the whole best (`search`, `size`), as rate-distortion theory has it: the least
//! D + λR, with one λ for all (Shoham & Gersho 1988).

mod adaptive;
mod borrow;
mod candidate;
mod choices;
mod cluster;
pub mod kmeans;
mod search;
mod size;

use std::io;

use half::f16;

use super::dedup::SequenceTree;
use super::encodings::Encodings;
use crate::codec::{BrickRange, Codec, OutOfRange, SequenceRange};
use crate::volume::{SCRATCH_SMALL, Scratch, ScratchFolder, SortedMap, ValueRange};

pub use adaptive::{AdaptiveGrid, Target, adaptive};
pub use cluster::clustered;

/// How one grid's bricks are coded.
pub struct Allocation {
    /// The range that brick ranges are fractions of.
    pub sequence: SequenceRange,
    /// How each brick of the pool is coded, as far as a byte says it.
    kinds: Vec<Kind>,
    /// What else there is to say of those of which it does not say all: a value's bits, a referenced brick, a shape.
    words: SortedMap<u32>,
    /// Texels of no brick's own that several bricks share.
    pub shapes: Vec<Shape>,
    /// Under which range a brick reads texels that were made for another.
    borrowed: SortedMap<BrickRange>,
    /// The root of the squared error of each brick over the voxels that its texels give.
    pub error_l2s: Norms,
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
    /// The texels of this brick, which are its own.
    Borrowed(u32),
    /// The texels of this place of [`Allocation::shapes`].
    Shared(u32),
}

/// A [`Coding`] in a byte.
#[derive(Clone, Copy)]
enum Kind {
    Empty,
    Constant,
    Own(Codec),
    Borrowed,
    Shared,
}

/// Errors of bricks, 8 bytes each, of which a sequence has too many to keep in memory.
pub struct Norms {
    error_l2s: Scratch,
    /// Whether there is one for each brick before its texels are made. Else quantising adds those that lack.
    pub are_known: bool,
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

impl Norms {
    /// None yet.
    fn new(scratch: &ScratchFolder) -> Self {
        Self { error_l2s: Scratch::new(scratch, size_of::<f64>(), SCRATCH_SMALL), are_known: false }
    }

    /// Notes those of bricks, one after another.
    ///
    /// # Errors
    /// When the scratch file cannot be written.
    pub fn put(&mut self, first: u32, error_l2s: &[f64]) -> io::Result<()> {
        self.error_l2s.put(first, bytemuck::cast_slice(error_l2s))
    }

    /// Sees to it that what was noted can be read.
    ///
    /// # Errors
    /// When the scratch file cannot be written.
    pub fn flush(&mut self) -> io::Result<()> {
        self.error_l2s.flush()
    }

    /// Those of some bricks.
    ///
    /// # Errors
    /// When the scratch file cannot be read back.
    pub fn read(&self, ids: &[u32]) -> io::Result<Vec<f64>> {
        self.error_l2s.read_as(ids)
    }
}

impl Allocation {
    fn new(scratch: &ScratchFolder, encodings: Encodings) -> Self {
        Self {
            sequence: encodings.sequence,
            kinds: Vec::new(),
            words: SortedMap::default(),
            shapes: Vec::new(),
            borrowed: SortedMap::default(),
            error_l2s: Norms::new(scratch),
            empty_squares: Vec::new(),
            encodings,
        }
    }

    /// Adds the next brick. One that reads texels of another has a range for them.
    fn push(&mut self, coding: Coding, borrowed: Option<BrickRange>) {
        let id = self.kinds.len() as u32;
        let (kind, word) = match coding {
            Coding::Empty => (Kind::Empty, None),
            Coding::Constant(value) => (Kind::Constant, Some(value.to_bits())),
            Coding::Own(codec) => (Kind::Own(codec), None),
            Coding::Borrowed(referenced) => (Kind::Borrowed, Some(referenced)),
            Coding::Shared(shape) => (Kind::Shared, Some(shape)),
        };
        self.kinds.push(kind);
        word.into_iter().for_each(|word| self.words.push(id, word));
        borrowed.into_iter().for_each(|range| self.borrowed.push(id, range));
    }

    /// How many bricks there are.
    pub fn len(&self) -> u32 {
        self.kinds.len() as u32
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.kinds.is_empty()
    }

    /// How a brick is coded.
    pub fn coding(&self, brick: u32) -> Coding {
        let word = || self.words.get(brick).expect("what a byte does not say is said beside it");
        match self.kinds[brick as usize] {
            Kind::Empty => Coding::Empty,
            Kind::Constant => Coding::Constant(f32::from_bits(word())),
            Kind::Own(codec) => Coding::Own(codec),
            Kind::Borrowed => Coding::Borrowed(word()),
            Kind::Shared => Coding::Shared(word()),
        }
    }

    /// The codec of a brick.
    pub fn codec(&self, brick: u32) -> Codec {
        match self.coding(brick) {
            Coding::Empty | Coding::Constant(_) => Codec::Constant,
            Coding::Own(codec) => codec,
            Coding::Borrowed(referenced) => self.codec(referenced),
            Coding::Shared(shape) => self.shapes[shape as usize].codec,
        }
    }

    /// The range of a brick. Raw texels need none to be decoded: theirs is the tight one, for the majorant in it.
    pub fn range(&self, tree: &SequenceTree, brick: u32) -> BrickRange {
        let ValueRange { min, max } = tree.brick_ranges[brick];
        match self.coding(brick) {
            Coding::Own(Codec::F32) => self.sequence.fit(min, max),
            // What bounds a voxel is what its texel decodes to.
            Coding::Own(Codec::F16) => {
                let [min, max] = [min, max].map(|v| f16::from_f32(v).to_f32());
                self.sequence.fit(min, max)
            }
            _ => self.borrowed.get(brick).unwrap_or_else(|| self.encodings.range(tree, brick)),
        }
    }
}

/// The numbers of all bricks, so many at a time.
fn windows(bricks: u32, size: u32) -> impl Iterator<Item = Vec<u32>> {
    (0..bricks).step_by(size as usize).map(move |first| (first..(first + size).min(bricks)).collect())
}

/// Gives every brick of `tree` one codec.
pub fn uniform(tree: &SequenceTree, encodings: Encodings, codec: Codec) -> Allocation {
    let mut allocation = Allocation::new(&tree.scratch, encodings);
    (0..tree.pool.len()).for_each(|_| allocation.push(Coding::Own(codec), None));
    allocation
}
