//! What a flattened frame is without its voxels: all that sharing needs, in a seventh of the source's bytes.

use bytemuck::{Pod, Zeroable};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::pods;
use crate::stages::flatten::Flattened;
use crate::volume::{
    Brick, BrickPool, Cell, CellContent, Child, ChunkedVec, Constant, Coord, FlatFrame, FrameStats,
    InactiveRule, L1_DIM, L2_DIM, Mask512, NODE_CHILDREN, ValueRange,
};

/// Whether bricks keep their active masks.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
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

/// One frame of one grid without its voxels.
#[derive(Clone, Serialize, Deserialize)]
pub struct FrameIndex {
    /// The value outside everything.
    pub background: f32,
    /// Constant 4096³ regions.
    pub roots: Vec<(Coord, Constant)>,
    /// The cells that are not all background, ascending by origin.
    pub cells: Vec<Cell>,
    /// The bricks that the cells name, in the order in which they name them.
    #[serde(with = "pods")]
    pub bricks: Vec<IndexedBrick>,
    /// For those whose rule is [`InactiveRule::Sign`], in that order, the voxels at minus the background.
    #[serde(with = "pods")]
    pub sign_mask: Vec<Mask512>,
    /// The source's counts.
    pub stats: FrameStats,
}

/// A brick without its voxels: what can be found out about it without knowing the others.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub struct IndexedBrick {
    /// Which voxels of the source are active.
    pub active: Mask512,
    /// [`BrickPool::digest`]; nothing where all values are one.
    digest: [u8; 32],
    /// The range of the values that its texels have to give.
    min: f32,
    max: f32,
    /// The place of its mask in [`FrameIndex::sign_mask`], if it has one.
    sign_mask: u32,
    /// An [`InactiveRule`] in the lowest bits, and those below.
    flags: u32,
}

/// Its active mask has to be kept.
const KEEPS_MASK: u32 = 1 << 2;
/// All values that its texels have to give are one.
const IS_CONSTANT: u32 = 1 << 3;

/// The voxels of a brick that its texels have to give.
#[derive(Clone, Copy)]
pub enum Values {
    /// All the same, bit by bit.
    Constant(f32),
    /// Their range, and the [`BrickPool::digest`] of the brick.
    Varied(ValueRange, [u8; 32]),
}

impl FrameIndex {
    /// Takes the voxels away from a frame: gives them apart, each brick with whether it keeps its mask.
    pub fn split(flat: Flattened, policy: MaskPolicy) -> (Self, ChunkedVec<Brick>) {
        let Flattened { frame: FlatFrame { roots, cells, bricks: mut voxels, stats }, background } = flat;
        let indexed = voxels.par_iter_mut().map(|brick| IndexedBrick::new(brick, background, policy));
        let (mut bricks, signs): (Vec<IndexedBrick>, Vec<Option<Mask512>>) = indexed.unzip();
        let mut sign_mask = Vec::new();
        for (brick, signs) in bricks.iter_mut().zip(signs) {
            brick.sign_mask = sign_mask.len() as u32;
            sign_mask.extend(signs);
        }
        (Self { background, roots, cells, bricks, sign_mask, stats }, voxels)
    }

    /// Whether what it says is of one piece: a frame that was read is, and what comes from elsewhere has to be looked
    /// at.
    pub fn is_sound(&self) -> bool {
        let mut next = 0;
        self.cells.iter().all(|cell| match &cell.content {
            CellContent::Constant(_) => true,
            CellContent::Node(children) => {
                let in_order = children.is_sorted_by(|a, b| a.0 < b.0);
                let mut places = children.iter().filter_map(|(_, child)| match child {
                    Child::Brick(place) => Some(*place),
                    Child::Constant(_) => None,
                });
                let numbered = places.all(|place| {
                    next += 1;
                    place == next - 1
                });
                in_order
                    && numbered
                    && children.last().is_none_or(|(place, _)| usize::from(*place) < NODE_CHILDREN)
            }
        }) && next as usize == self.bricks.len()
            && self.bricks.iter().all(|brick| brick.is_sound(self.sign_mask.len()))
            && self.cells.is_sorted_by(|a, b| a.origin < b.origin)
            && self.cells.iter().all(|cell| cell.origin.is_aligned(L2_DIM))
            && self.roots.iter().all(|(origin, _)| origin.is_aligned(L1_DIM))
            && self.roots.is_sorted_by(|a, b| a.0 < b.0)
    }

    /// Whether there is nothing in it.
    pub(super) fn is_empty(&self) -> bool {
        self.roots.is_empty() && self.cells.is_empty()
    }
}

impl IndexedBrick {
    /// Whether its active mask has to be kept.
    pub fn keeps_mask(&self) -> bool {
        self.flags & KEEPS_MASK != 0
    }

    /// What its inactive voxels are.
    pub fn rule(&self) -> InactiveRule {
        InactiveRule::from_bits(self.flags)
    }

    /// What its other voxels are.
    pub fn values(&self) -> Values {
        match self.flags & IS_CONSTANT {
            0 => Values::Varied(ValueRange { min: self.min, max: self.max }, self.digest),
            _ => Values::Constant(self.min),
        }
    }

    /// The place of its signs in [`FrameIndex::sign_mask`], if it has some.
    pub fn signs(&self) -> Option<usize> {
        (self.rule() == InactiveRule::Sign).then_some(self.sign_mask as usize)
    }

    fn is_sound(&self, sign_mask: usize) -> bool {
        let in_order = match self.values() {
            Values::Constant(_) => true,
            Values::Varied(range, _) => {
                range.min.is_finite() && range.max.is_finite() && range.min <= range.max
            }
        };
        in_order
            && self.signs().is_none_or(|place| place < sign_mask)
            && (self.keeps_mask() || self.rule() == InactiveRule::Texel)
    }

    fn new(brick: &mut Brick, background: f32, policy: MaskPolicy) -> (Self, Option<Mask512>) {
        let (rule, sign_mask) = brick.inactive_rule(background);
        let drop = match policy {
            MaskPolicy::Keep => false,
            MaskPolicy::DropWhereBackground => true,
            MaskPolicy::DropFog => background == 0.0,
        };
        brick.keeps_mask = !(drop && rule == InactiveRule::Background);
        let rule = if brick.keeps_mask { rule } else { InactiveRule::Texel };
        let mut indexed = Self { active: brick.active, ..Self::zeroed() };
        indexed.flags = rule as u32 | if brick.keeps_mask { KEEPS_MASK } else { 0 };
        match values(brick, &texel_mask(&brick.active, rule), background) {
            Values::Constant(value) => {
                indexed.flags |= IS_CONSTANT;
                (indexed.min, indexed.max) = (value, value);
            }
            Values::Varied(range, digest) => {
                (indexed.min, indexed.max, indexed.digest) = (range.min, range.max, digest);
            }
        }
        (indexed, (rule == InactiveRule::Sign).then_some(sign_mask))
    }
}

fn values(brick: &Brick, texel_mask: &Mask512, background: f32) -> Values {
    let Some((min, max)) = brick.range_over(texel_mask) else { return Values::Constant(background) };
    let mut bits = texel_mask.ones().map(|i| brick.values[i].to_bits());
    // 0 and −0 compare equal but are not the same bits.
    let first = bits.next();
    if min == max && bits.all(|b| Some(b) == first) {
        return Values::Constant(first.map_or(background, f32::from_bits));
    }
    Values::Varied(ValueRange { min, max }, BrickPool::digest(brick))
}

/// The voxels whose values texels have to give: all but those that a rule gives.
pub fn texel_mask(active: &Mask512, rule: InactiveRule) -> Mask512 {
    match rule {
        InactiveRule::Background | InactiveRule::MinusBackground | InactiveRule::Sign => *active,
        InactiveRule::Texel => Mask512::ALL,
    }
}
