//! Stage 5: how each brick is coded, and what its texels' 0 and 1 stand for.
//!
//! A uniform format gives every brick one codec ([`uniform`]), and may merge similar ones ([`clustered()`]). The adaptive one
//! gives each brick the codec that serves the whole best ([`adaptive()`]).

mod adaptive;
mod clustered;
pub mod kmeans;

use half::f16;

use super::dedup::SequenceTree;
use super::encoder_cache::{EncoderCache, own_range};
use crate::codec::{BrickRange, Codec, Fidelity, SequenceRange, TexelCodec};
use crate::settings::RangeMode;
use crate::volume::{SCRATCH_SMALL, Scratch, ScratchFolder, ScratchResult, SortedMap, ValueRange};

pub use adaptive::{AdaptiveGrid, EarlierOffers, Offer, OfferInputs, Offers, Target, adaptive};
pub use clustered::clustered;

/// How one grid's bricks are coded.
pub struct Allocation {
    /// The range that brick ranges are fractions of.
    pub sequence: SequenceRange,
    /// How each brick of the pool is coded, as far as a byte says it.
    tags: Vec<CodingTag>,
    /// What else there is to say of those of which it does not say all: a value's bits, a referenced brick, a shape.
    words: SortedMap<u32>,
    /// Texels of no brick's own that several bricks share.
    pub shapes: Vec<Shape>,
    /// Under which range a brick reads texels that were made for another.
    borrowed: SortedMap<BrickRange>,
    /// The root of the squared error of each brick over the voxels that its texels give.
    pub error_l2s: BrickErrors,
    /// The squared error of each frame's empty bricks.
    pub empty_squares: Vec<f64>,
    /// What texels of their own are fractions of.
    mode: RangeMode,
}

/// What gives a brick its values.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Coding {
    /// The background: it needs no record.
    Empty,
    /// One value for all voxels that no rule gives.
    Constant(f32),
    /// Texels of its own.
    Own(TexelCodec),
    /// The texels of this brick, which are its own.
    Borrowed(u32),
    /// The texels of this place of [`Allocation::shapes`], which stand for a cluster of bricks.
    Clustered(u32),
}

/// A [`Coding`] in a byte.
#[derive(Clone, Copy)]
enum CodingTag {
    Empty,
    Constant,
    Own(TexelCodec),
    Borrowed,
    Clustered,
}

/// Errors of bricks, 8 bytes each, of which a sequence has too many to keep in memory.
pub struct BrickErrors {
    error_l2s: Scratch,
    /// Whether there is one for each brick before its texels are made.
    pub are_known: bool,
}

/// Texels that several bricks share, each with its own range.
pub struct Shape {
    /// Their codec.
    pub codec: TexelCodec,
    /// One brick's bytes.
    pub bytes: Vec<u8>,
    /// Their packing axis.
    pub axis: u8,
}

impl BrickErrors {
    /// None yet.
    pub(super) fn new(scratch: &ScratchFolder) -> Self {
        Self { error_l2s: Scratch::new(scratch, size_of::<f64>(), SCRATCH_SMALL), are_known: false }
    }

    /// Notes those of bricks, one after another.
    ///
    /// # Errors
    /// When the scratch file cannot be written.
    pub fn put(&mut self, first: u32, error_l2s: &[f64]) -> ScratchResult<()> {
        self.error_l2s.put(first, bytemuck::cast_slice(error_l2s))
    }

    /// Sees to it that what was noted can be read.
    ///
    /// # Errors
    /// When the scratch file cannot be written.
    pub fn flush(&mut self) -> ScratchResult<()> {
        self.error_l2s.flush()
    }

    /// Those of some bricks.
    ///
    /// # Errors
    /// When the scratch file cannot be read back.
    pub fn read(&self, ids: &[u32]) -> ScratchResult<Vec<f64>> {
        self.error_l2s.read_as(ids)
    }
}

impl Allocation {
    fn new(scratch: &ScratchFolder, encoders: &EncoderCache) -> Self {
        Self {
            sequence: encoders.sequence,
            tags: Vec::new(),
            words: SortedMap::default(),
            shapes: Vec::new(),
            borrowed: SortedMap::default(),
            error_l2s: BrickErrors::new(scratch),
            empty_squares: Vec::new(),
            mode: encoders.terms().range,
        }
    }

    /// Adds the next brick. One that reads texels of another has a range for them.
    fn push(&mut self, coding: Coding, borrowed: Option<BrickRange>) {
        let id = self.tags.len() as u32;
        let (tag, word) = match coding {
            Coding::Empty => (CodingTag::Empty, None),
            Coding::Constant(value) => (CodingTag::Constant, Some(value.to_bits())),
            Coding::Own(codec) => (CodingTag::Own(codec), None),
            Coding::Borrowed(referenced) => (CodingTag::Borrowed, Some(referenced)),
            Coding::Clustered(shape) => (CodingTag::Clustered, Some(shape)),
        };
        self.tags.push(tag);
        word.into_iter().for_each(|word| self.words.push(id, word));
        borrowed.into_iter().for_each(|range| self.borrowed.push(id, range));
    }

    /// Whether a brick was left out: what was there is background.
    pub fn is_empty_brick(&self, brick: u32) -> bool {
        matches!(self.tags[brick as usize], CodingTag::Empty)
    }

    /// Whether any was.
    pub fn has_empty_bricks(&self) -> bool {
        self.tags.iter().any(|tag| matches!(tag, CodingTag::Empty))
    }

    /// How many bricks there are.
    pub fn len(&self) -> u32 {
        self.tags.len() as u32
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.tags.is_empty()
    }

    /// How a brick is coded.
    pub fn coding(&self, brick: u32) -> Coding {
        let word = || self.words.get(brick).expect("what a byte does not say is said beside it");
        match self.tags[brick as usize] {
            CodingTag::Empty => Coding::Empty,
            CodingTag::Constant => Coding::Constant(f32::from_bits(word())),
            CodingTag::Own(codec) => Coding::Own(codec),
            CodingTag::Borrowed => Coding::Borrowed(word()),
            CodingTag::Clustered => Coding::Clustered(word()),
        }
    }

    /// The codec of a brick.
    pub fn codec(&self, brick: u32) -> Codec {
        match self.coding(brick) {
            Coding::Empty | Coding::Constant(_) => Codec::Constant,
            Coding::Own(codec) => codec.codec(),
            Coding::Borrowed(referenced) => self.codec(referenced),
            Coding::Clustered(shape) => self.shapes[shape as usize].codec.codec(),
        }
    }

    /// The range of a brick. Raw texels need none to be decoded: theirs is the tight one, for the majorant in it.
    pub fn range(&self, tree: &SequenceTree, brick: u32) -> BrickRange {
        let ValueRange { min, max } = tree.brick_ranges[brick];
        match self.coding(brick) {
            Coding::Own(codec) if !codec.codec().is_normalised() => {
                // What bounds a voxel is what its texel decodes to.
                let decoded = |value: f32| match codec.codec().fidelity() {
                    Fidelity::NearestHalf => f16::from_f32(value).to_f32(),
                    _ => value,
                };
                self.sequence.fit(decoded(min), decoded(max))
            }
            _ => self
                .borrowed
                .get(brick)
                .unwrap_or_else(|| own_range(&self.sequence, self.mode, tree.brick_ranges[brick])),
        }
    }
}

/// The numbers of all bricks, so many at a time.
fn windows(bricks: u32, size: u32) -> impl Iterator<Item = Vec<u32>> {
    (0..bricks).step_by(size as usize).map(move |first| (first..(first + size).min(bricks)).collect())
}

/// Gives every brick of `tree` one codec.
pub fn uniform(tree: &SequenceTree, encoders: &EncoderCache, codec: TexelCodec) -> Allocation {
    let mut allocation = Allocation::new(&tree.scratch, encoders);
    (0..tree.pool.len()).for_each(|_| allocation.push(Coding::Own(codec), None));
    allocation
}
