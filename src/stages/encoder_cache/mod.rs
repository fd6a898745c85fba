//! Stages 5 and 7: what each codec makes of each brick, measured on decoded values. Made once: what was tried to
//! choose a codec is what goes into the pack.

mod batch;
mod measure;
mod memo;
mod spilled;
mod trial;

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use rayon::prelude::*;
use serde::Serialize;

use super::dedup::{SequenceTree, texel_mask};
use crate::cancel::CancelToken;
use crate::codec::{BATCH, BrickRange, SequenceRange, TexelCodec, Texels, decode, encode, spread};
use crate::error::Result;
use crate::profile;
use crate::settings::RangeMode;
use crate::volume::{
    BRICK_VOXELS, BRICKS_IN_FLIGHT, Brick, InactiveRule, Mask512, ScratchResult, ValueRange,
};
pub use batch::{BATCH_BRICKS, Batch};
use batch::{batches, batches_of};
pub use measure::Measure;
pub use memo::Memo;
pub use trial::{ConstantAim, Cost, Note, Trial, TrialResults, WithoutTexels};

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

/// How long a build may go on before what it made is kept, so that one that is killed loses no more than that.
const SAVE_EVERY: Duration = Duration::from_secs(2);

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
        wanted: &[(usize, Trial)],
    ) -> ScratchResult<()>;

    /// Notes that `memo` has results of some batches that no earlier build made.
    fn note_made(&mut self, batches: &BTreeSet<usize>, trial: Trial);

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
    /// For each of them the trials of which earlier results were asked for.
    is_loaded: Vec<[bool; Trial::ALL.len()]>,
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

    fn load(&mut self, tree: &SequenceTree, ids: &[u32], trials: &[Trial]) -> ScratchResult<()> {
        let Some(earlier) = &mut self.earlier else { return Ok(()) };
        let mut wanted = Vec::new();
        for batch in batches_of(&self.batches, ids) {
            for &trial in trials {
                if !std::mem::replace(&mut self.is_loaded[batch][trial.index()], true) {
                    wanted.push((batch, trial));
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
    pub fn plain(&self, ids: &[u32]) -> ScratchResult<Vec<WithoutTexels>> {
        let notes = self.memo.notes(Trial::WithoutTexels, ids)?;
        Ok(notes.as_chunks().0.iter().copied().map(WithoutTexels::from_notes).collect())
    }

    /// What a codec does to some bricks that it was tried on.
    ///
    /// # Errors
    /// When the scratch file cannot be read back.
    pub fn costs(&self, ids: &[u32], codec: TexelCodec) -> ScratchResult<Vec<Cost>> {
        Ok(self.memo.notes(Trial::Texels(codec), ids)?.iter().map(Note::cost).collect())
    }

    /// What a codec made of some bricks that it was tried on.
    ///
    /// # Errors
    /// When the scratch file cannot be read back.
    pub fn texels(&self, ids: &[u32], codec: TexelCodec) -> ScratchResult<KeptBricks> {
        let TrialResults { notes, texels } = self.memo.made(Trial::Texels(codec), ids)?;
        Ok(KeptBricks {
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

    /// Sees to it that some bricks, ascending, are known in every trial. `advance` hears of those that are done.
    ///
    /// # Errors
    /// When bricks cannot be read, or the scratch file not be written.
    pub fn make(
        &mut self,
        tree: &mut SequenceTree,
        ids: &[u32],
        trials: &[Trial],
        mut advance: impl FnMut(u64),
    ) -> Result<()> {
        self.load(tree, ids, trials)?;
        for window in ids.chunks(BRICKS_IN_FLIGHT as usize) {
            if self.cancel.is_cancelled() {
                self.save(tree)?;
            }
            self.cancel.check()?;
            let missing: Vec<u32> = window
                .iter()
                .copied()
                .filter(|&id| trials.iter().any(|k| !self.memo.is_known(*k, id)))
                .collect();
            tree.fetch(&missing)?;
            let shared: &SequenceTree = tree;
            // A few bricks are shared out evenly.
            let threads = rayon::current_num_threads();
            let batches = missing.len().div_ceil(BATCH).next_multiple_of(threads).max(threads);
            let batch = missing.len().div_ceil(batches).max(LEAST_BATCH);
            let made: Vec<ScratchResult<Vec<TrialResults>>> =
                missing.par_chunks(batch).map(|ids| self.make_batch(shared, ids, trials)).collect();
            for (ids, made) in missing.chunks(batch).zip(made) {
                made?.iter().zip(trials).try_for_each(|(made, trial)| self.memo.add(*trial, ids, made))?;
            }
            self.memo.flush()?;
            if let Some(earlier) = &mut self.earlier {
                let batches = batches_of(&self.batches, &missing);
                trials.iter().for_each(|&trial| earlier.note_made(&batches, trial));
            }
            if self.saved.elapsed() > SAVE_EVERY {
                self.save(tree)?;
            }
            advance(window.len() as u64);
        }
        Ok(())
    }

    fn make_batch(
        &self,
        tree: &SequenceTree,
        ids: &[u32],
        trials: &[Trial],
    ) -> ScratchResult<Vec<TrialResults>> {
        let _span = profile::span("encode");
        let bricks = &tree.pool.read(ids)?;
        let texels: Vec<Texels> = ids.iter().zip(bricks).map(|(&id, b)| self.prepare(tree, id, b)).collect();
        let each = || ids.iter().zip(bricks).zip(&texels);
        let made = |trial: &Trial| match *trial {
            Trial::WithoutTexels => {
                let plain = each().map(|((&id, b), t)| self.make_without_texels(tree, id, b, t));
                TrialResults { notes: plain.flat_map(WithoutTexels::to_notes).collect(), texels: Vec::new() }
            }
            Trial::Texels(codec) => self.make_texels(codec, bricks, &texels),
        };
        Ok(trials.iter().map(made).collect())
    }

    fn make_without_texels(
        &self,
        tree: &SequenceTree,
        id: u32,
        brick: &Brick,
        texels: &Texels,
    ) -> WithoutTexels {
        let range = tree.brick_ranges[id];
        let value = match self.terms.aim {
            ConstantAim::Squares => measure::mean(brick, &texels.texel_mask),
            ConstantAim::Max => f64::midpoint(range.min.into(), range.max.into()) as f32,
        };
        let measure = self.measure(brick, &texels.texel_mask);
        let error_only = TexelCodec::ERROR_ONLY.map(|codec| {
            let rounded = codec.round(&brick.values);
            rounded.map_or(Cost::IMPOSSIBLE, |rounded| measure.of(&rounded, None))
        });
        // Only where nothing but values says what is active may background stand for them.
        let empty = match brick.keeps_mask {
            true => Cost::IMPOSSIBLE,
            false => measure.of(&[tree.background; BRICK_VOXELS], None),
        };
        WithoutTexels { value, constant: measure.of(&[value; BRICK_VOXELS], None), empty, error_only }
    }

    fn make_texels(&self, codec: TexelCodec, bricks: &[Brick], texels: &[Texels]) -> TrialResults {
        let encoded =
            encode(codec, &self.sequence, texels).expect("codecs whose texels are kept hold any value");
        let codec = codec.codec();
        let size = codec.layout().brick_bytes();
        let each = bricks.iter().zip(texels).zip(encoded.bytes.chunks_exact(size)).zip(&encoded.axes);
        let note = |(((brick, texels), bytes), &axis): (((&Brick, &Texels), &[u8]), &u8)| {
            let decoded = decode(codec, bytes, axis, &self.sequence, texels.range);
            let spread = spread(codec, bytes, &self.sequence, texels.range);
            Note::new(self.measure(brick, &texels.texel_mask).of(&decoded, Some(&spread)), axis.into())
        };
        TrialResults { notes: each.map(note).collect(), texels: encoded.bytes }
    }
}

/// What 0 and 1 of the own texels of a brick with these values stand for.
pub fn own_range(sequence: &SequenceRange, mode: RangeMode, values: ValueRange) -> BrickRange {
    match mode {
        RangeMode::Sequence => BrickRange::SEQUENCE,
        RangeMode::Brick => sequence.fit(values.min, values.max),
    }
}

/// What a codec made of some bricks.
pub struct KeptBricks {
    /// What it does to each.
    pub costs: Vec<Cost>,
    /// Their texels, one after another.
    pub bytes: Vec<u8>,
    /// Their packing axes.
    pub axes: Vec<u8>,
}
