//! Stages 5 and 7: what each codec makes of each brick, measured on decoded values. Made once: what was tried to
//! choose a codec is what goes into the pack, and what an earlier build made is taken from the cache.

mod cached;
mod measure;
mod spilled;

use std::io;
use std::time::{Duration, Instant};

use half::f16;
use half::slice::HalfFloatSliceExt;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::dedup::{SequenceTree, texel_mask};
use crate::cache::pods;
use crate::codec::{BATCH, BrickRange, Codec, SequenceRange, Texels, decode, encode, spread};
use crate::interrupt;
use crate::profile;
use crate::settings::RangeMode;
use crate::volume::{BRICK_VOXELS, BRICKS_IN_FLIGHT, Brick, InactiveRule, Mask512};
use cached::Batches;
pub use cached::{Batch, GridCache};
pub use measure::Measure;
use spilled::{Note, Spilled};

/// What one codec does to one brick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cost {
    /// Root of the squared error over the voxels that texels give; infinite where the codec is out of the
    /// question.
    pub error_l2: f64,
    /// The same over active voxels.
    pub active_error_l2: f64,
    /// The largest error that an engine can read, on any GPU.
    pub max: f32,
}

impl Cost {
    /// No error at all.
    pub const NONE: Self = Self { error_l2: 0.0, active_error_l2: 0.0, max: 0.0 };
    /// More error than any.
    pub const IMPOSSIBLE: Self =
        Self { error_l2: f64::INFINITY, active_error_l2: f64::INFINITY, max: f32::INFINITY };
}

/// What a constant brick's value keeps small.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub enum ConstantAim {
    /// The squared error: it is the mean.
    Squares,
    /// The largest error: it is the middle of the range.
    Max,
}

/// A brick without texels, or with raw ones: what can be said of it without keeping a byte.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Plain {
    /// What it would be as a constant.
    pub value: f32,
    /// As that constant.
    pub constant: Cost,
    /// As background, without a record.
    pub empty: Cost,
    /// As half floats.
    pub f16: Cost,
}

/// What is made of bricks and kept.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub enum Kind {
    /// [`Plain`].
    Plain,
    /// Texels of a codec whose texels are fractions of a range.
    Texels(KeptCodec),
}

impl Kind {
    const ALL: [Self; 4] = [
        Self::Plain,
        Self::Texels(KeptCodec::Bc7),
        Self::Texels(KeptCodec::Bc4),
        Self::Texels(KeptCodec::Unorm8),
    ];

    /// Its place among them.
    fn index(self) -> usize {
        match self {
            Self::Plain => 0,
            Self::Texels(codec) => 1 + codec as usize,
        }
    }

    /// Notes that are kept of a brick.
    fn notes(self) -> usize {
        match self {
            Self::Plain => Plain::NOTES,
            Self::Texels(_) => 1,
        }
    }

    /// Bytes of texels of a brick.
    fn texels(self) -> usize {
        match self {
            Self::Plain => 0,
            Self::Texels(codec) => codec.codec().layout().brick_bytes(),
        }
    }
}

/// The codecs whose texels are kept. Raw ones take as much to keep as to make.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub enum KeptCodec {
    /// BC7.
    Bc7,
    /// BC4.
    Bc4,
    /// 8-bit fractions.
    Unorm8,
}

impl KeptCodec {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Bc7, Self::Bc4, Self::Unorm8];

    /// The kept one of all codecs.
    pub fn of(codec: Codec) -> Option<Self> {
        Self::ALL.into_iter().find(|kept| kept.codec() == codec)
    }

    /// As one of all codecs.
    pub fn codec(self) -> Codec {
        match self {
            Self::Bc7 => Codec::Bc7,
            Self::Bc4 => Codec::Bc4,
            Self::Unorm8 => Codec::Unorm8,
        }
    }
}

impl Plain {
    const NOTES: usize = 3;

    fn to_notes(self) -> [Note; Self::NOTES] {
        let value = self.value.to_bits();
        [Note::new(self.constant, value), Note::new(self.empty, 0), Note::new(self.f16, 0)]
    }

    fn from_notes([constant, empty, f16]: [Note; Self::NOTES]) -> Self {
        let value = f32::from_bits(constant.word);
        Self { value, constant: constant.cost(), empty: empty.cost(), f16: f16.cost() }
    }
}

/// What the error of a grid's bricks depends on beside the bricks.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Terms {
    /// What texels are fractions of.
    pub range: RangeMode,
    /// What a constant's value keeps small.
    pub aim: ConstantAim,
    /// Level sets: a voxel further from the surface than this must not change sides.
    pub sign_matters: Option<f64>,
    /// No voxel may be as far off, on any GPU: integers that are kept.
    pub error_below: Option<f64>,
}

/// Bricks of a batch at least: four fill the lanes of the BC7 encoder.
const LEAST_BATCH: usize = 8;

/// How long a build may go on before what it made is kept, so that one that is killed loses no more than that.
const SAVE_EVERY: Duration = Duration::from_secs(2);

/// What each codec does to each brick of a grid, as far as someone asked.
pub struct Encodings {
    /// The range that brick ranges are fractions of.
    pub sequence: SequenceRange,
    terms: Terms,
    rules: Vec<InactiveRule>,
    kept: [Spilled; Kind::ALL.len()],
    batches: Batches,
    saved: Instant,
}

impl Encodings {
    /// Nothing is tried yet. `None` when the sequence's values span more than an `f32` can hold. With a cache, what it
    /// has is taken from there, and what is made goes into it.
    pub fn new(tree: &SequenceTree, terms: Terms, cache: Option<GridCache>) -> Option<Self> {
        let sequence = match tree.value_range() {
            Some(range) => SequenceRange::around(range.min, range.max)?,
            None => SequenceRange::default(),
        };
        let batches = Batches::new(tree, cache, &sequence, &terms);
        Some(Self {
            rules: tree.brick_rules(),
            kept: Kind::ALL.map(|kind| Spilled::new(&tree.scratch, kind)),
            batches,
            saved: Instant::now(),
            sequence,
            terms,
        })
    }

    /// What some bricks, which were tried, would be without texels.
    ///
    /// # Errors
    /// When the scratch file cannot be read back.
    pub fn plain(&self, ids: &[u32]) -> io::Result<Vec<Plain>> {
        let notes = self.kept(Kind::Plain).notes(ids)?;
        Ok(notes.as_chunks().0.iter().copied().map(Plain::from_notes).collect())
    }

    /// What a codec does to some bricks that it was tried on.
    ///
    /// # Errors
    /// When the scratch file cannot be read back.
    pub fn costs(&self, ids: &[u32], codec: KeptCodec) -> io::Result<Vec<Cost>> {
        Ok(self.kept(Kind::Texels(codec)).notes(ids)?.iter().map(Note::cost).collect())
    }

    /// What a codec made of some bricks that it was tried on.
    ///
    /// # Errors
    /// When the scratch file cannot be read back.
    pub fn texels(&self, ids: &[u32], codec: KeptCodec) -> io::Result<Tried> {
        let kept = self.kept(Kind::Texels(codec));
        let notes = kept.notes(ids)?;
        Ok(Tried {
            costs: notes.iter().map(Note::cost).collect(),
            bytes: kept.texels(ids)?,
            axes: notes.iter().map(|note| note.word as u8).collect(),
        })
    }

    /// What 0 and 1 of a brick's own texels stand for.
    pub fn range(&self, tree: &SequenceTree, id: u32) -> BrickRange {
        match self.terms.range {
            RangeMode::Sequence => BrickRange::SEQUENCE,
            RangeMode::Brick => {
                let values = tree.brick_ranges[id];
                self.sequence.fit(values.min, values.max)
            }
        }
    }

    /// Whether a brick's texels give all of its voxels.
    pub fn is_whole(&self, id: u32) -> bool {
        self.rules[id as usize] == InactiveRule::Texel
    }

    /// A brick as its texels shall be.
    pub fn prepare(&self, tree: &SequenceTree, id: u32, brick: &Brick) -> Texels {
        let (rule, range) = (self.rules[id as usize], tree.brick_ranges[id]);
        Texels::new(brick, texel_mask(&brick.active, rule), (range.min, range.max), self.range(tree, id))
    }

    /// Measures what decoded values cost a brick whose texels give the voxels in `texel_mask`.
    pub fn measure<'a>(&self, brick: &'a Brick, texel_mask: &'a Mask512) -> Measure<'a> {
        Measure::new(brick, texel_mask, &self.terms)
    }

    fn kept(&self, kind: Kind) -> &Spilled {
        &self.kept[kind.index()]
    }

    /// Sees to it that some bricks, ascending, are known in every kind. `advance` hears of those that are done.
    ///
    /// # Errors
    /// When bricks cannot be read, or the scratch file not be written.
    pub fn make(
        &mut self,
        tree: &mut SequenceTree,
        ids: &[u32],
        kinds: &[Kind],
        mut advance: impl FnMut(u64),
    ) -> io::Result<()> {
        self.load(tree, ids, kinds)?;
        for window in ids.chunks(BRICKS_IN_FLIGHT as usize) {
            if interrupt::is_requested() {
                self.save(tree)?;
                interrupt::check()?;
            }
            let missing: Vec<u32> = window
                .iter()
                .copied()
                .filter(|&id| kinds.iter().any(|k| !self.kept(*k).is_known(id)))
                .collect();
            tree.fetch(&missing)?;
            let shared: &SequenceTree = tree;
            // A few bricks are shared out evenly.
            let threads = rayon::current_num_threads();
            let batches = missing.len().div_ceil(BATCH).next_multiple_of(threads).max(threads);
            let batch = missing.len().div_ceil(batches).max(LEAST_BATCH);
            let made: Vec<io::Result<Vec<Made>>> =
                missing.par_chunks(batch).map(|ids| self.make_batch(shared, ids, kinds)).collect();
            for (ids, made) in missing.chunks(batch).zip(made) {
                made?.iter().zip(kinds).try_for_each(|(made, kind)| self.keep(ids, *kind, made))?;
            }
            self.flush()?;
            for &kind in kinds {
                self.batches.mark(&missing, kind);
            }
            if self.saved.elapsed() > SAVE_EVERY {
                self.save(tree)?;
            }
            advance(window.len() as u64);
        }
        Ok(())
    }

    fn make_batch(&self, tree: &SequenceTree, ids: &[u32], kinds: &[Kind]) -> io::Result<Vec<Made>> {
        let _span = profile::span("encode");
        let bricks = &tree.pool.read(ids)?;
        let texels: Vec<Texels> = ids.iter().zip(bricks).map(|(&id, b)| self.prepare(tree, id, b)).collect();
        let each = || ids.iter().zip(bricks).zip(&texels);
        let made = |kind: &Kind| match *kind {
            Kind::Plain => {
                let plain = each().map(|((&id, b), t)| self.make_plain(tree, id, b, t));
                Made { notes: plain.flat_map(Plain::to_notes).collect(), texels: Vec::new() }
            }
            Kind::Texels(codec) => self.make_texels(codec.codec(), bricks, &texels),
        };
        Ok(kinds.iter().map(made).collect())
    }

    fn make_plain(&self, tree: &SequenceTree, id: u32, brick: &Brick, texels: &Texels) -> Plain {
        let range = tree.brick_ranges[id];
        let value = match self.terms.aim {
            ConstantAim::Squares => measure::mean(brick, &texels.texel_mask),
            ConstantAim::Max => f64::midpoint(range.min.into(), range.max.into()) as f32,
        };
        let measure = self.measure(brick, &texels.texel_mask);
        // Values just past the greatest half would round to it, but the codec refuses them.
        let f16 = match brick.values.iter().all(|v| v.abs() <= f16::MAX.to_f32()) {
            true => {
                let (mut halves, mut back) = ([f16::ZERO; BRICK_VOXELS], [0.0; BRICK_VOXELS]);
                halves.convert_from_f32_slice(&brick.values);
                halves.convert_to_f32_slice(&mut back);
                measure.of(&back, None)
            }
            false => Cost::IMPOSSIBLE,
        };
        // Only where nothing but values says what is active may background stand for them.
        let empty = match brick.keeps_mask {
            true => Cost::IMPOSSIBLE,
            false => measure.of(&[tree.background; BRICK_VOXELS], None),
        };
        Plain { value, constant: measure.of(&[value; BRICK_VOXELS], None), empty, f16 }
    }

    fn make_texels(&self, codec: Codec, bricks: &[Brick], texels: &[Texels]) -> Made {
        let encoded = encode(codec, &self.sequence, texels).expect("only f16 has values that it cannot hold");
        let size = codec.layout().brick_bytes();
        let each = bricks.iter().zip(texels).zip(encoded.bytes.chunks_exact(size)).zip(&encoded.axes);
        let note = |(((brick, texels), bytes), &axis): (((&Brick, &Texels), &[u8]), &u8)| {
            let decoded = decode(codec, bytes, axis, &self.sequence, texels.range);
            let spread = spread(codec, bytes, &self.sequence, texels.range);
            Note::new(self.measure(brick, &texels.texel_mask).of(&decoded, Some(&spread)), axis.into())
        };
        Made { notes: each.map(note).collect(), texels: encoded.bytes }
    }

    fn keep(&mut self, ids: &[u32], kind: Kind, made: &Made) -> io::Result<()> {
        self.kept[kind.index()].add(self.rules.len(), ids, made)
    }

    /// Sees to it that what was kept can be read.
    fn flush(&mut self) -> io::Result<()> {
        self.kept.iter_mut().try_for_each(Spilled::flush)
    }
}

/// What was made of some bricks in a kind, one brick after another.
#[derive(Default, Serialize, Deserialize)]
struct Made {
    #[serde(with = "pods")]
    notes: Vec<Note>,
    #[serde(with = "pods")]
    texels: Vec<u8>,
}

/// What a codec made of some bricks.
pub struct Tried {
    /// What it does to each.
    pub costs: Vec<Cost>,
    /// Their texels, one after another.
    pub bytes: Vec<u8>,
    /// Their packing axes.
    pub axes: Vec<u8>,
}
