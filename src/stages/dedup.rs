//! Stage 4: share bricks, masks, runs of L3 records and L2 nodes across a whole sequence.
//!
//! Frames are added in order; what a later frame has in common with an earlier one is not stored
//! again. Everything here is exact: two things are one only if their bits are.

use std::collections::HashMap;
use std::io;

use rayon::prelude::*;

use crate::stages::flatten::Flattened;
use crate::volume::{
    Brick, BrickPool, CellContent, Child, Constant, Coord, FrameStats, InactiveRule, Interner, Mask512,
    ValueRange, bits,
};

/// Whether bricks keep their active masks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MaskPolicy {
    /// Always.
    Keep,
    /// Not where every inactive voxel is background: the texels carry the background then, and a
    /// voxel is active where its value is something else.
    DropWhereBackground,
    /// The same, but only where the background is 0, as it is for fog: another one is not a value that
    /// texels give back exactly.
    DropFog,
}

/// One grid of a sequence, with everything that repeats stored once.
pub struct SequenceTree {
    /// The value outside everything.
    pub background: f32,
    /// The frames, in the order in which they were added.
    pub frames: Vec<FrameTree>,
    /// The distinct L2 nodes.
    pub nodes: Interner<Node>,
    /// Runs of places in [`SequenceTree::records`], one run a distinct list of children.
    pub runs: Interner<u32>,
    /// The distinct L3 records.
    pub records: Vec<Record>,
    /// The distinct masks. A mask of signs follows the mask it belongs to.
    pub masks: Interner<Mask512>,
    /// The voxels of the distinct bricks.
    pub pool: BrickPool,
    /// For each brick of the pool, the range of the values that its texels carry.
    pub brick_ranges: Vec<ValueRange>,
    policy: MaskPolicy,
    record_of_brick: Vec<u32>,
    record_of_constant: HashMap<(u32, Option<u32>, InactiveRule), u32>,
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

/// An L2 node: which of its 4096 children exist, and where the run of their records begins.
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub struct Node {
    /// One bit a child, x slowest.
    pub children: [u64; 64],
    /// The place of the first child's entry in [`SequenceTree::runs`].
    pub run: u64,
}

impl Node {
    /// How many children there are.
    pub fn child_count(&self) -> usize {
        self.children.iter().map(|w| w.count_ones() as usize).sum()
    }

    /// The node's entries in `runs`.
    pub fn entries<'a>(&self, runs: &'a Interner<u32>) -> &'a [u32] {
        &runs.items()[self.run as usize..][..self.child_count()]
    }
}

/// One distinct 8³ region.
#[derive(Clone, Copy, Debug)]
pub struct Record {
    /// The place of its mask in [`SequenceTree::masks`]; `None` where a voxel is active if its value is
    /// not the background.
    pub mask: Option<u32>,
    /// What its inactive voxels are.
    pub rule: InactiveRule,
    /// What its other voxels are.
    pub payload: Payload,
}

/// The values of a [`Record`].
#[derive(Clone, Copy, Debug)]
pub enum Payload {
    /// All the same.
    Constant(f32),
    /// Those of this brick of the pool.
    Brick(u32),
}

/// The frame cannot be added.
#[derive(Debug, thiserror::Error)]
pub enum DedupError {
    /// The scratch file failed.
    #[error("the scratch file in {}: {source}", std::env::temp_dir().display())]
    Scratch {
        /// Why.
        #[from]
        source: io::Error,
    },
    /// The background is not the one of the frames before.
    #[error("the background is {here}, but {before} in the frames before")]
    Background {
        /// This frame's.
        here: f32,
        /// The others'.
        before: f32,
    },
}

/// A brick with what can be found out about it without knowing the others.
struct Prepared {
    brick: Brick,
    rule: InactiveRule,
    minus: Mask512,
    range: Option<ValueRange>,
    hash: u128,
}

impl Prepared {
    fn new(mut brick: Brick, background: f32, policy: MaskPolicy) -> Self {
        let (rule, minus) = brick.inactive_rule(background);
        let drop = match policy {
            MaskPolicy::Keep => false,
            MaskPolicy::DropWhereBackground => true,
            MaskPolicy::DropFog => background == 0.0,
        };
        brick.keeps_mask = !(drop && rule == InactiveRule::Background);
        let rule = if brick.keeps_mask { rule } else { InactiveRule::Texel };
        let range = brick.range_over(&carried(&brick, rule)).map(|(min, max)| ValueRange { min, max });
        let hash = BrickPool::hash(&brick);
        Self { brick, rule, minus, range, hash }
    }

    /// The one value that all carried voxels have, if they do.
    fn constant(&self, background: f32) -> Option<f32> {
        let Some(range) = self.range else { return Some(background) };
        if range.min != range.max {
            return None;
        }
        // 0 and −0 compare equal but are not the same bits.
        let carried = carried(&self.brick, self.rule);
        let mut values = carried.ones().map(|i| self.brick.values[i]);
        let first = values.next()?;
        values.all(|v| v.to_bits() == first.to_bits()).then_some(first)
    }
}

/// The voxels whose values texels have to give: all but those that a rule gives.
pub fn carried(brick: &Brick, rule: InactiveRule) -> Mask512 {
    match rule {
        InactiveRule::Background | InactiveRule::MinusBackground | InactiveRule::Sign => brick.active,
        InactiveRule::Texel => Mask512::ALL,
    }
}

impl SequenceTree {
    /// An empty sequence.
    ///
    /// # Errors
    /// When no scratch file can be made.
    pub fn new(policy: MaskPolicy) -> io::Result<Self> {
        Ok(Self {
            background: 0.0,
            frames: Vec::new(),
            nodes: Interner::default(),
            runs: Interner::default(),
            records: Vec::new(),
            masks: Interner::default(),
            pool: BrickPool::new()?,
            brick_ranges: Vec::new(),
            policy,
            record_of_brick: Vec::new(),
            record_of_constant: HashMap::new(),
        })
    }

    /// Adds the next frame.
    ///
    /// # Errors
    /// [`DedupError`].
    pub fn add(&mut self, flat: Flattened) -> Result<(), DedupError> {
        self.check_background(&flat)?;
        let frame = flat.frame;
        let (background, policy) = (self.background, self.policy);
        let bricks: Vec<Prepared> =
            frame.bricks.into_par_iter().map(|b| Prepared::new(b, background, policy)).collect();

        let mut cells = Vec::with_capacity(frame.cells.len());
        let mut run = Vec::new();
        for cell in frame.cells {
            let content = match cell.content {
                CellContent::Constant(constant) => CellRef::Constant(constant),
                CellContent::Node(children) => {
                    let mut node = Node { children: [0; 64], run: 0 };
                    run.clear();
                    for (place, child) in children {
                        node.children[usize::from(place) >> 6] |= 1 << (place & 63);
                        run.push(match child {
                            Child::Constant(constant) => self.constant_region(constant),
                            Child::Brick(brick) => self.brick(&bricks[brick as usize])?,
                        });
                    }
                    node.run = self.runs.intern(&run).into();
                    CellRef::Node(self.nodes.intern(&[node]))
                }
            };
            cells.push((cell.origin, content));
        }
        self.frames.push(FrameTree { roots: frame.roots, cells, stats: frame.stats });
        Ok(())
    }

    /// All frames have one background. A frame without any voxels takes on that of the others.
    fn check_background(&mut self, flat: &Flattened) -> Result<(), DedupError> {
        let empty = |f: &FrameTree| f.roots.is_empty() && f.cells.is_empty();
        let (here, before) = (flat.background, self.background);
        if self.frames.iter().all(empty) {
            self.background = here;
        } else if here.to_bits() != before.to_bits()
            && !(flat.frame.roots.is_empty() && flat.frame.cells.is_empty())
        {
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
            self.records.push(Record { mask, rule, payload: Payload::Constant(value) });
        }
        id
    }

    fn brick(&mut self, prepared: &Prepared) -> io::Result<u32> {
        let constant = prepared.constant(self.background);
        let brick = match constant {
            Some(_) => None,
            None => Some(self.pool.insert(prepared.hash, &prepared.brick)?),
        };
        if let Some((id, false)) = brick {
            return Ok(self.record_of_brick[id as usize]);
        }
        let mask = prepared.brick.keeps_mask.then(|| match prepared.rule {
            InactiveRule::Sign => self.masks.intern(&[prepared.brick.active, prepared.minus]),
            _ => self.masks.intern(&[prepared.brick.active]),
        });
        let rule = prepared.rule;
        Ok(match (constant, brick) {
            (Some(value), _) => self.constant_record(value, mask, rule),
            (None, Some((id, _))) => {
                let record = self.records.len() as u32;
                self.records.push(Record { mask, rule, payload: Payload::Brick(id) });
                self.record_of_brick.push(record);
                self.brick_ranges.push(prepared.range.expect("a brick that is not constant carries values"));
                record
            }
            (None, None) => unreachable!("a brick that is not constant is in the pool"),
        })
    }

    /// The inactive rule of each brick of the pool.
    pub fn brick_rules(&self) -> Vec<InactiveRule> {
        // Records of bricks are made in the order of the pool.
        let of_brick = self.records.iter().filter(|r| matches!(r.payload, Payload::Brick(_)));
        of_brick.map(|r| r.rule).collect()
    }

    /// The bricks of the pool that a frame uses, shared ones each time.
    pub fn frame_bricks<'a>(&'a self, frame: &'a FrameTree) -> impl Iterator<Item = u32> + 'a {
        let nodes = frame.cells.iter().filter_map(|(_, content)| match content {
            CellRef::Node(node) => Some(&self.nodes.items()[*node as usize]),
            CellRef::Constant(_) => None,
        });
        let records = nodes.flat_map(|node| node.entries(&self.runs)).map(|&r| &self.records[r as usize]);
        records.filter_map(|record| match record.payload {
            Payload::Brick(id) => Some(id),
            Payload::Constant(_) => None,
        })
    }

    /// Takes bricks out of the tree: what was there is background then. Nodes without a child go too.
    pub fn prune(&mut self, is_empty: impl Fn(u32) -> bool) {
        let (nodes, runs) = (std::mem::take(&mut self.nodes), std::mem::take(&mut self.runs));
        let mut moved: Vec<Option<u32>> = Vec::with_capacity(nodes.items().len());
        let mut run = Vec::new();
        for node in nodes.items() {
            let mut left = Node { children: [0; 64], run: 0 };
            run.clear();
            for (place, &record) in bits(&node.children).zip(node.entries(&runs)) {
                if !matches!(self.records[record as usize].payload, Payload::Brick(id) if is_empty(id)) {
                    left.children[place >> 6] |= 1 << (place & 63);
                    run.push(record);
                }
            }
            moved.push((!run.is_empty()).then(|| {
                left.run = self.runs.intern(&run).into();
                self.nodes.intern(&[left])
            }));
        }
        for frame in &mut self.frames {
            frame.cells.retain_mut(|(_, content)| match content {
                CellRef::Constant(_) => true,
                CellRef::Node(node) => moved[*node as usize].inspect(|to| *node = *to).is_some(),
            });
        }
    }

    /// The range of everything that is active or carried by a texel; `None` for an empty sequence.
    pub fn value_range(&self) -> Option<ValueRange> {
        let active = self.frames.iter().filter_map(|f| f.stats.active_range);
        ValueRange::union_all(active.chain(self.brick_ranges.iter().copied()))
    }

    /// The range of active values, tiles included: the peak that PSNR is measured against.
    pub fn active_range(&self) -> Option<ValueRange> {
        ValueRange::union_all(self.frames.iter().filter_map(|f| f.stats.active_range))
    }
}
