//! Stage 4: share bricks, masks, runs of L3 records and L2 nodes across a whole sequence.
//!
//! Frames are added in order; what a later frame has in common with an earlier one is not stored
//! again. Everything here is exact: two things are one only if their bits are. None of it needs voxels: those of a
//! frame that is known from its [`FrameIndex`] are fetched when someone asks for them.

mod frame_index;
mod nodes;
mod record;

use std::collections::{BTreeSet, HashMap};
use std::ops::Range;

use rayon::prelude::*;

use crate::error::{Error, Result};
use crate::volume::{
    Brick, BrickPool, CellContent, Child, ChunkedVec, Constant, Coord, FrameStats, InactiveRule, Interner,
    Mask512, ScratchError, ScratchFolder, ScratchResult, SortedMap, ValueRange, bits,
};

pub use frame_index::{FrameIndex, IndexedBrick, MaskPolicy, Values, texel_mask};
pub use nodes::{Node, Nodes};
pub use record::{Payload, Record};

/// One grid of a sequence, with everything that repeats stored once.
pub struct SequenceTree {
    /// The value outside everything.
    pub background: f32,
    /// The frames, in the order in which they were added.
    pub frames: Vec<FrameTree>,
    /// The distinct L2 nodes.
    pub nodes: Nodes,
    /// Runs of entries that [`SequenceTree::record`] understands, one run a distinct list of children.
    pub runs: Interner<u32>,
    /// The distinct L3 records of which more is to be said than which brick they are.
    records: ChunkedVec<Record>,
    /// The distinct masks. A mask of signs follows the mask it belongs to.
    pub masks: Interner<Mask512>,
    /// The distinct bricks.
    pub pool: BrickPool,
    /// For each brick of the pool, the range of the values that its texels carry.
    pub brick_ranges: ChunkedVec<ValueRange>,
    /// For each frame, the bricks of the pool that it had first.
    pub own_bricks: Vec<Range<u32>>,
    /// Where what does not fit in memory is.
    pub scratch: ScratchFolder,
    /// Gives the voxels of a frame that was added without.
    fetch: Option<Fetch>,
    /// Of bricks that are no entries by themselves.
    record_of_brick: SortedMap<u32>,
    record_of_constant: HashMap<(u32, Option<u32>, InactiveRule), u32>,
}

/// Reads the bricks of the frame at a place.
pub type ReadFrame = dyn Fn(usize) -> Result<ChunkedVec<Brick>> + Send + Sync;

/// The way to a frame's voxels.
pub struct Fetch {
    /// Reads them.
    pub read: Box<ReadFrame>,
    /// Frames that may be read at a time.
    pub at_once: usize,
}

/// One frame of a [`SequenceTree`].
pub struct FrameTree {
    /// Constant 4096³ regions.
    pub roots: Vec<(Coord, Constant)>,
    /// The 128³ cells that are not all background, ascending by origin.
    pub cells: Vec<(Coord, CellRef)>,
    /// The source's counts.
    pub stats: FrameStats,
}

/// What fills a 128³ cell.
#[derive(Clone, Copy, Debug)]
pub enum CellRef {
    /// One value.
    Constant(Constant),
    /// The L2 node at this place of [`SequenceTree::nodes`].
    Node(u32),
}

/// The frame cannot be added.
#[derive(Debug, thiserror::Error)]
pub enum DedupError {
    /// The scratch file failed.
    #[error(transparent)]
    Scratch(#[from] ScratchError),
    /// The background is not the one of the frames before.
    #[error("the background is {here}, but {before} in the frames before")]
    Background {
        /// This frame's.
        here: f32,
        /// The others'.
        before: f32,
    },
}

/// The bit of an entry that is a brick without a mask, all of whose voxels are its texels': most are. The others are
/// places of records.
const PLAIN_BRICK: u32 = 1 << 31;

impl SequenceTree {
    /// The record of an entry of [`SequenceTree::runs`].
    pub fn record(&self, entry: u32) -> Record {
        match entry & PLAIN_BRICK {
            0 => self.records[entry],
            _ => Record::new(None, InactiveRule::Texel, Payload::Brick(entry & !PLAIN_BRICK)),
        }
    }

    /// An empty sequence, with scratch files in a folder. `fetch` gives the voxels of frames that are added without; it is
    /// not needed where all have theirs.
    pub fn new(scratch: ScratchFolder, fetch: Option<Fetch>) -> Self {
        Self {
            background: 0.0,
            frames: Vec::new(),
            nodes: Nodes::new(&scratch),
            runs: Interner::default(),
            records: ChunkedVec::default(),
            masks: Interner::default(),
            pool: BrickPool::new(&scratch),
            brick_ranges: ChunkedVec::default(),
            own_bricks: Vec::new(),
            scratch,
            fetch,
            record_of_brick: SortedMap::default(),
            record_of_constant: HashMap::new(),
        }
    }

    /// Forgets what only [`SequenceTree::add`] needs: there will be no more frames.
    ///
    /// # Errors
    /// When the scratch file cannot be written.
    pub fn seal(&mut self) -> ScratchResult<()> {
        self.record_of_brick = SortedMap::default();
        self.record_of_constant = HashMap::new();
        self.nodes.seal()?;
        self.runs.seal();
        self.masks.seal();
        self.pool.seal()
    }

    /// Adds the next frame, and where they are at hand its voxels.
    ///
    /// # Errors
    /// [`DedupError`].
    pub fn add(
        &mut self,
        frame_index: FrameIndex,
        voxels: Option<ChunkedVec<Brick>>,
    ) -> Result<(), DedupError> {
        self.check_background(&frame_index)?;
        let first = self.pool.len();
        let mut cells = Vec::with_capacity(frame_index.cells.len());
        let mut run = Vec::new();
        for cell in frame_index.cells {
            let content = match cell.content {
                CellContent::Constant(constant) => CellRef::Constant(constant),
                CellContent::Node(children) => {
                    let mut places = [0; 64];
                    run.clear();
                    for (place, child) in children {
                        places[usize::from(place) >> 6] |= 1 << (place & 63);
                        run.push(match child {
                            Child::Constant(constant) => self.constant_region(constant),
                            Child::Brick(brick) => self.brick(
                                brick,
                                &frame_index.bricks[brick as usize],
                                &frame_index.sign_mask,
                            )?,
                        });
                    }
                    CellRef::Node(self.nodes.intern(&places, self.runs.intern(&run))?)
                }
            };
            cells.push((cell.origin, content));
        }
        self.own_bricks.push(first..self.pool.len());
        if let Some(voxels) = voxels {
            self.put_voxels(self.frames.len(), &voxels)?;
        }
        self.frames.push(FrameTree { roots: frame_index.roots, cells, stats: frame_index.stats });
        Ok(())
    }

    /// Puts the voxels of a frame's own bricks into the pool.
    fn put_voxels(&mut self, frame: usize, voxels: &ChunkedVec<Brick>) -> ScratchResult<()> {
        for id in self.own_bricks[frame].clone() {
            if !self.pool.has_values(id) {
                self.pool.put(id, &voxels[self.pool.place(id)].values)?;
            }
        }
        Ok(())
    }

    /// The same for voxels that were fetched for a frame index from elsewhere: they must be those that it tells of.
    fn put_fetched(&mut self, frame: usize, voxels: &ChunkedVec<Brick>) -> Result<()> {
        let own: Vec<u32> = self.own_bricks[frame].clone().collect();
        let digests = self.pool.digests(&own)?;
        let pool = &self.pool;
        let is_told = |(&id, digest): (&u32, &[u8; 32])| {
            voxels.get(pool.place(id)).is_some_and(|brick| {
                let brick = Brick { keeps_mask: pool.keeps_mask(id), ..brick.clone() };
                BrickPool::digest(&brick) == *digest
            })
        };
        if !own.par_iter().zip(&digests).all(is_told) {
            return Err(Error::Misled("the outline of a frame is not its own".to_owned()));
        }
        Ok(self.put_voxels(frame, voxels)?)
    }

    /// Sees to it that some bricks of the pool can be read. Frames whose voxels are not there are read for it, whole.
    ///
    /// # Errors
    /// When a frame cannot be read or the scratch file not be written.
    pub fn fetch(&mut self, ids: &[u32]) -> Result<()> {
        let frame = |id: &u32| self.own_bricks.partition_point(|own| own.end <= *id);
        let absent: BTreeSet<usize> =
            ids.iter().filter(|&&id| !self.pool.has_values(id)).map(frame).collect();
        let absent: Vec<usize> = absent.into_iter().collect();
        let at_once = self.fetch.as_ref().map_or(1, |fetch| fetch.at_once);
        for frames in absent.chunks(at_once) {
            let fetch =
                self.fetch.as_ref().expect("frames without voxels are added with a way to fetch them");
            let fetched: Vec<_> = frames.par_iter().map(|&frame| (fetch.read)(frame)).collect();
            for (&frame, voxels) in frames.iter().zip(fetched) {
                self.put_fetched(frame, &voxels?)?;
            }
        }
        Ok(self.pool.flush()?)
    }

    /// All frames have one background. A frame without any voxels takes on that of the others.
    fn check_background(&mut self, frame_index: &FrameIndex) -> Result<(), DedupError> {
        let empty = |f: &FrameTree| f.roots.is_empty() && f.cells.is_empty();
        let (here, before) = (frame_index.background, self.background);
        if self.frames.iter().all(empty) {
            self.background = here;
        } else if here.to_bits() != before.to_bits() && !frame_index.is_empty() {
            return Err(DedupError::Background { here, before });
        }
        Ok(())
    }

    /// The record of a constant 8³ region of the source.
    fn constant_region(&mut self, constant: Constant) -> u32 {
        // Without a mask, a voxel is active if its value is not the background.
        let says_itself = constant.active == (constant.value != self.background);
        let mask = if constant.active { Mask512::ALL } else { Mask512::NONE };
        let mask = (!says_itself).then(|| self.masks.intern(&[mask]));
        self.constant_record(constant.value, mask, InactiveRule::Texel)
    }

    fn constant_record(&mut self, value: f32, mask: Option<u32>, rule: InactiveRule) -> u32 {
        let next = self.records.len() as u32;
        let id = *self.record_of_constant.entry((value.to_bits(), mask, rule)).or_insert(next);
        if id == next {
            self.records.push(Record::new(mask, rule, Payload::Constant(value)));
        }
        id
    }

    /// The record of a brick of the frame that is being added, whose signs are among `sign_mask`.
    fn brick(&mut self, place: u32, brick: &IndexedBrick, sign_mask: &[Mask512]) -> ScratchResult<u32> {
        let (rule, keeps_mask) = (brick.rule(), brick.keeps_mask());
        let (range, digest) = match brick.values() {
            Values::Constant(value) => {
                let mask = self.mask(brick, sign_mask);
                return Ok(self.constant_record(value, mask, rule));
            }
            Values::Varied(range, digest) => (range, digest),
        };
        let (id, is_new) = self.pool.insert(&digest, &brick.active, keeps_mask, place)?;
        if !is_new {
            return Ok(self.record_of_brick.get(id).unwrap_or(id | PLAIN_BRICK));
        }
        self.brick_ranges.push(range);
        let mask = self.mask(brick, sign_mask);
        if (mask, rule) == (None, InactiveRule::Texel) {
            return Ok(id | PLAIN_BRICK);
        }
        let record = self.records.len() as u32;
        self.records.push(Record::new(mask, rule, Payload::Brick(id)));
        self.record_of_brick.push(id, record);
        Ok(record)
    }

    fn mask(&mut self, brick: &IndexedBrick, sign_mask: &[Mask512]) -> Option<u32> {
        brick.keeps_mask().then(|| match brick.signs() {
            Some(place) => self.masks.intern(&[brick.active, sign_mask[place]]),
            None => self.masks.intern(&[brick.active]),
        })
    }

    /// The inactive rule of each brick of the pool.
    pub fn brick_rules(&self) -> Vec<InactiveRule> {
        let mut rules = vec![InactiveRule::Texel; self.pool.len() as usize];
        for record in self.records.iter() {
            if let Payload::Brick(id) = record.payload() {
                rules[id as usize] = record.rule;
            }
        }
        rules
    }

    /// The bricks of the pool that a frame uses, shared ones each time.
    pub fn frame_bricks<'a>(&'a self, frame: &'a FrameTree) -> impl Iterator<Item = u32> + 'a {
        let nodes = frame.cells.iter().filter_map(|(_, content)| match content {
            CellRef::Node(node) => Some(&self.nodes.all()[*node as usize]),
            CellRef::Constant(_) => None,
        });
        let records = nodes.flat_map(|node| node.entries(&self.runs)).map(|&entry| self.record(entry));
        records.filter_map(|record| match record.payload() {
            Payload::Brick(id) => Some(id),
            Payload::Constant(_) => None,
        })
    }

    /// Takes bricks out of the tree: what was there is background then. Nodes without a child go too.
    ///
    /// # Errors
    /// When the scratch file fails.
    pub fn prune(&mut self, is_empty: impl Fn(u32) -> bool) -> ScratchResult<()> {
        let nodes = std::mem::replace(&mut self.nodes, Nodes::new(&self.scratch));
        let runs = std::mem::take(&mut self.runs);
        let mut moved: Vec<Option<u32>> = Vec::with_capacity(nodes.all().len());
        let mut run = Vec::new();
        nodes.visit(|node, children| {
            let mut left = [0; 64];
            run.clear();
            for (place, &entry) in bits(children).zip(node.entries(&runs)) {
                if !matches!(self.record(entry).payload(), Payload::Brick(id) if is_empty(id)) {
                    left[place >> 6] |= 1 << (place & 63);
                    run.push(entry);
                }
            }
            let node = (!run.is_empty()).then(|| self.nodes.intern(&left, self.runs.intern(&run)));
            moved.push(node.transpose()?);
            ScratchResult::Ok(())
        })?;
        for frame in &mut self.frames {
            frame.cells.retain_mut(|(_, content)| match content {
                CellRef::Constant(_) => true,
                CellRef::Node(node) => moved[*node as usize].inspect(|to| *node = *to).is_some(),
            });
        }
        self.runs.seal();
        self.nodes.seal()
    }

    /// The range of everything that is active or carried by a texel; `None` for an empty sequence.
    pub fn value_range(&self) -> Option<ValueRange> {
        let active = self.frames.iter().filter_map(|f| f.stats.active_range);
        ValueRange::union_all(active.chain(self.brick_ranges.iter().copied()))
    }

    /// Whether anything of it is constant without being a brick: it stays whatever becomes of bricks.
    pub fn has_constants(&self) -> bool {
        let of_frame = |frame: &FrameTree| {
            !frame.roots.is_empty()
                || frame.cells.iter().any(|(_, cell)| matches!(cell, CellRef::Constant(_)))
        };
        let is_constant = |entry: &u32| matches!(self.record(*entry).payload(), Payload::Constant(_));
        self.frames.iter().any(of_frame) || self.runs.items().iter().any(is_constant)
    }

    /// The range of active values, tiles included.
    pub fn active_range(&self) -> Option<ValueRange> {
        ValueRange::union_all(self.frames.iter().filter_map(|f| f.stats.active_range))
    }
}
