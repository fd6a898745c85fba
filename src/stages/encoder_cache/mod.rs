//! Stages 5 and 7: what each codec makes of each brick, measured on decoded values. Made once: what was tried to
//! choose a codec is what goes into the pack.

mod measure;
mod memo;
mod spilled;

use std::collections::BTreeSet;
use std::ops::Range;
use std::time::{Duration, Instant};

use half::f16;
use half::slice::HalfFloatSliceExt;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::dedup::{SequenceTree, texel_mask};
use crate::cancel::CancelToken;
use crate::codec::{BATCH, BrickRange, Codec, SequenceRange, Texels, decode, encode, spread};
use crate::error::Result;
use crate::pods;
use crate::profile;
use crate::settings::RangeMode;
use crate::volume::{
    BRICK_VOXELS, BRICKS_IN_FLIGHT, Brick, InactiveRule, Mask512, ScratchResult, ValueRange,
};
pub use measure::Measure;
pub use memo::Memo;
pub use spilled::Note;

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
    /// All of them.
    pub const ALL: [Self; 4] = [
        Self::Plain,
        Self::Texels(KeptCodec::Bc7),
        Self::Texels(KeptCodec::Bc4),
        Self::Texels(KeptCodec::Unorm8),
    ];

    /// Its place among them.
    pub fn index(self) -> usize {
        match self {
            Self::Plain => 0,
            Self::Texels(codec) => 1 + codec as usize,
        }
    }

    /// Notes that are kept of a brick.
    pub fn notes(self) -> usize {
        match self {
            Self::Plain => Plain::NOTES,
            Self::Texels(_) => 1,
        }
    }

    /// Bytes of texels of a brick.
    pub fn texels(self) -> usize {
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

/// Bricks that one thread encodes together at least: four fill the lanes of the BC7 encoder.
const LEAST_BATCH: usize = 8;

/// Bricks of a [`Batch`] at most: with 512 bytes of texels each, a megabyte.
pub const BATCH_BRICKS: u32 = 2048;

/// How long a build may go on before what it made is kept, so that one that is killed loses no more than that.
const SAVE_EVERY: Duration = Duration::from_secs(2);

/// Bricks of one frame that are kept and compared together.
pub struct Batch {
    /// The frame's place in the sequence.
    pub frame: usize,
    /// The batch's place in its frame.
    pub part: u32,
    /// The bricks of the pool that the frame had first and that are in this part of it.
    pub ids: Range<u32>,
}

/// Results of earlier builds. Whoever runs the stages puts it around an [`EncoderCache`]; without one everything is
/// made.
pub trait EarlierResults: Send + Sync {
    /// Adds to `memo` what earlier builds made of the bricks of some batches.
    ///
    /// # Errors
    /// When a scratch file fails.
    fn load(
        &mut self,
        memo: &mut Memo,
        tree: &SequenceTree,
        batches: &[Batch],
        wanted: &[(usize, Kind)],
    ) -> ScratchResult<()>;

    /// Notes that `memo` has results of some batches that no earlier build made.
    fn note_made(&mut self, batches: &BTreeSet<usize>, kind: Kind);

    /// Keeps those for later builds.
    ///
    /// # Errors
    /// When a scratch file cannot be read back.
    fn save(&mut self, memo: &Memo, tree: &SequenceTree, batches: &[Batch]) -> ScratchResult<()>;
}

/// What each codec does to each brick of a grid, as far as someone asked.
pub struct EncoderCache {
    /// The range that brick ranges are fractions of.
    pub sequence: SequenceRange,
    terms: Terms,
    rules: Vec<InactiveRule>,
    memo: Memo,
    batches: Vec<Batch>,
    /// For each of them the kinds of which earlier results were asked for.
    is_loaded: Vec<[bool; Kind::ALL.len()]>,
    earlier: Option<Box<dyn EarlierResults>>,
    saved: Instant,
    cancel: CancelToken,
}

impl EncoderCache {
    /// Nothing is tried yet. `None` when the sequence's values span more than an `f32` can hold.
    pub fn new(tree: &SequenceTree, terms: Terms, cancel: CancelToken) -> Option<Self> {
        let sequence = match tree.value_range() {
            Some(range) => SequenceRange::around(range.min, range.max)?,
            None => SequenceRange::default(),
        };
        let batches = batches(tree);
        Some(Self {
            rules: tree.brick_rules(),
            memo: Memo::new(tree),
            is_loaded: vec![Default::default(); batches.len()],
            batches,
            earlier: None,
            saved: Instant::now(),
            sequence,
            terms,
            cancel,
        })
    }

    /// From now on takes results of earlier builds, and gives them what is made.
    pub fn reuse(&mut self, earlier: Box<dyn EarlierResults>) {
        self.earlier = Some(earlier);
    }

    /// The parts in which bricks are kept, in the order of the pool.
    pub fn batches(&self) -> &[Batch] {
        &self.batches
    }

    /// What the errors of bricks depend on.
    pub fn terms(&self) -> &Terms {
        &self.terms
    }

    fn load(&mut self, tree: &SequenceTree, ids: &[u32], kinds: &[Kind]) -> ScratchResult<()> {
        let Some(earlier) = &mut self.earlier else { return Ok(()) };
        let mut wanted = Vec::new();
        for batch in batches_of(&self.batches, ids) {
            for &kind in kinds {
                if !std::mem::replace(&mut self.is_loaded[batch][kind.index()], true) {
                    wanted.push((batch, kind));
                }
            }
        }
        earlier.load(&mut self.memo, tree, &self.batches, &wanted)?;
        self.memo.flush()
    }

    /// Keeps what was made for later builds.
    ///
    /// # Errors
    /// When a scratch file cannot be read back.
    pub fn save(&mut self, tree: &SequenceTree) -> ScratchResult<()> {
        self.saved = Instant::now();
        match &mut self.earlier {
            Some(earlier) => earlier.save(&self.memo, tree, &self.batches),
            None => Ok(()),
        }
    }

    /// What some bricks, which were tried, would be without texels.
    ///
    /// # Errors
    /// When the scratch file cannot be read back.
    pub fn plain(&self, ids: &[u32]) -> ScratchResult<Vec<Plain>> {
        let notes = self.memo.notes(Kind::Plain, ids)?;
        Ok(notes.as_chunks().0.iter().copied().map(Plain::from_notes).collect())
    }

    /// What a codec does to some bricks that it was tried on.
    ///
    /// # Errors
    /// When the scratch file cannot be read back.
    pub fn costs(&self, ids: &[u32], codec: KeptCodec) -> ScratchResult<Vec<Cost>> {
        Ok(self.memo.notes(Kind::Texels(codec), ids)?.iter().map(Note::cost).collect())
    }

    /// What a codec made of some bricks that it was tried on.
    ///
    /// # Errors
    /// When the scratch file cannot be read back.
    pub fn texels(&self, ids: &[u32], codec: KeptCodec) -> ScratchResult<Tried> {
        let Made { notes, texels } = self.memo.made(Kind::Texels(codec), ids)?;
        Ok(Tried {
            costs: notes.iter().map(Note::cost).collect(),
            bytes: texels,
            axes: notes.iter().map(|note| note.word as u8).collect(),
        })
    }

    /// What 0 and 1 of a brick's own texels stand for.
    pub fn range(&self, tree: &SequenceTree, id: u32) -> BrickRange {
        own_range(&self.sequence, self.terms.range, tree.brick_ranges[id])
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
    ) -> Result<()> {
        self.load(tree, ids, kinds)?;
        for window in ids.chunks(BRICKS_IN_FLIGHT as usize) {
            if self.cancel.is_cancelled() {
                self.save(tree)?;
            }
            self.cancel.check()?;
            let missing: Vec<u32> = window
                .iter()
                .copied()
                .filter(|&id| kinds.iter().any(|k| !self.memo.is_known(*k, id)))
                .collect();
            tree.fetch(&missing)?;
            let shared: &SequenceTree = tree;
            // A few bricks are shared out evenly.
            let threads = rayon::current_num_threads();
            let batches = missing.len().div_ceil(BATCH).next_multiple_of(threads).max(threads);
            let batch = missing.len().div_ceil(batches).max(LEAST_BATCH);
            let made: Vec<ScratchResult<Vec<Made>>> =
                missing.par_chunks(batch).map(|ids| self.make_batch(shared, ids, kinds)).collect();
            for (ids, made) in missing.chunks(batch).zip(made) {
                made?.iter().zip(kinds).try_for_each(|(made, kind)| self.memo.add(*kind, ids, made))?;
            }
            self.memo.flush()?;
            if let Some(earlier) = &mut self.earlier {
                let batches = batches_of(&self.batches, &missing);
                kinds.iter().for_each(|&kind| earlier.note_made(&batches, kind));
            }
            if self.saved.elapsed() > SAVE_EVERY {
                self.save(tree)?;
            }
            advance(window.len() as u64);
        }
        Ok(())
    }

    fn make_batch(&self, tree: &SequenceTree, ids: &[u32], kinds: &[Kind]) -> ScratchResult<Vec<Made>> {
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
}

/// What 0 and 1 of the own texels of a brick with these values stand for.
pub fn own_range(sequence: &SequenceRange, mode: RangeMode, values: ValueRange) -> BrickRange {
    match mode {
        RangeMode::Sequence => BrickRange::SEQUENCE,
        RangeMode::Brick => sequence.fit(values.min, values.max),
    }
}

/// The places of the batches that some bricks, ascending, are in.
fn batches_of(batches: &[Batch], ids: &[u32]) -> BTreeSet<usize> {
    ids.iter().map(|id| batches.partition_point(|batch| batch.ids.end <= *id)).collect()
}

/// The batches of a grid, in the order of its pool.
fn batches(tree: &SequenceTree) -> Vec<Batch> {
    let mut all = Vec::new();
    for (frame, own) in tree.own_bricks.iter().enumerate() {
        let own: Vec<u32> = own.clone().collect();
        let part = |id: &u32| tree.pool.place(*id) / BATCH_BRICKS;
        for ids in own.chunk_by(|a, b| part(a) == part(b)) {
            all.push(Batch { frame, part: part(&ids[0]), ids: ids[0]..ids[ids.len() - 1] + 1 });
        }
    }
    all
}

/// What was made of some bricks in a kind, one brick after another.
#[derive(Default, Serialize, Deserialize)]
pub struct Made {
    /// [`Kind::notes`] a brick.
    #[serde(with = "pods")]
    pub notes: Vec<Note>,
    /// [`Kind::texels`] a brick.
    #[serde(with = "pods")]
    pub texels: Vec<u8>,
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
