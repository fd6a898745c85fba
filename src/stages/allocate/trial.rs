//! What each codec would cost each brick, measured on decoded values.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom, Write};

use half::f16;
use rayon::prelude::*;

use crate::codec::{BATCH, BrickRange, Codec, SequenceRange, Texels, decode, encode, spread};
use crate::stages::dedup::{SequenceTree, carried};
use crate::volume::{BRICK_VOXELS, BRICKS_IN_FLIGHT, Brick, InactiveRule, Mask512};

/// The ways to code a brick.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Rung {
    /// Not at all: background, without a record.
    Empty,
    Constant,
    Bc7,
    Bc4,
    Unorm8,
    F16,
    F32,
    /// Another brick's texels: it costs what a constant costs.
    Borrowed,
}

impl Rung {
    /// By ascending bits.
    pub const ALL: [Self; 8] = [
        Self::Empty,
        Self::Constant,
        Self::Borrowed,
        Self::Bc7,
        Self::Bc4,
        Self::Unorm8,
        Self::F16,
        Self::F32,
    ];

    /// The codec of its own texels; `Constant` where it has none.
    pub fn codec(self) -> Codec {
        match self {
            Self::Empty | Self::Constant | Self::Borrowed => Codec::Constant,
            Self::Bc7 => Codec::Bc7,
            Self::Bc4 => Codec::Bc4,
            Self::Unorm8 => Codec::Unorm8,
            Self::F16 => Codec::F16,
            Self::F32 => Codec::F32,
        }
    }
}

/// Rungs that may err.
const LOSSY: usize = Rung::F32 as usize;

/// What one codec does to one brick.
#[derive(Clone, Copy, Debug)]
pub(super) struct Cost {
    /// Root of the squared error over the voxels that texels give; infinite where the codec is out of the
    /// question.
    pub norm: f64,
    /// The same over active voxels.
    pub active_norm: f64,
    /// The largest error that an engine can read, on any GPU.
    pub max: f32,
}

impl Cost {
    /// No error at all.
    pub const NONE: Self = Self { norm: 0.0, active_norm: 0.0, max: 0.0 };
    pub const IMPOSSIBLE: Self = Self { norm: f64::INFINITY, active_norm: f64::INFINITY, max: f32::INFINITY };
    const UNKNOWN: Self = Self { norm: f64::NAN, active_norm: f64::NAN, max: f32::NAN };
}

/// What a constant brick's value keeps small.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ConstantAim {
    /// The squared error: it is the mean.
    Squares,
    /// The largest error: it is the middle of the range.
    Max,
}

/// What each rung does to each brick of a grid. BC7, which takes twenty times as long as all others
/// together, is tried when it is asked for.
pub(super) struct Trials {
    pub sequence: SequenceRange,
    pub ranges: Vec<BrickRange>,
    /// What each brick would be as a constant.
    pub constants: Vec<f32>,
    pub(super) rules: Vec<InactiveRule>,
    costs: Vec<[Cost; LOSSY]>,
    /// Level sets: a voxel further from the surface than this must not change sides.
    sign_matters: Option<f64>,
    pub kept: KeptTexels,
}

impl Trials {
    /// Tries every codec but BC7 on every brick.
    pub fn new(
        tree: &mut SequenceTree,
        (sequence, ranges): (SequenceRange, Vec<BrickRange>),
        aim: ConstantAim,
        sign_matters: Option<f64>,
    ) -> io::Result<Self> {
        let mut trials = Self {
            sequence,
            constants: Vec::with_capacity(ranges.len()),
            rules: tree.brick_rules(),
            costs: Vec::with_capacity(ranges.len()),
            sign_matters,
            kept: KeptTexels::new(ranges.len())?,
            ranges,
        };
        let mut bricks = Vec::new();
        for first in (0..tree.pool.len()).step_by(BRICKS_IN_FLIGHT as usize) {
            bricks.clear();
            tree.pool.read(first..(first + BRICKS_IN_FLIGHT).min(tree.pool.len()), &mut bricks)?;
            let tried: Vec<(f32, [Cost; LOSSY])> = bricks
                .par_chunks(BATCH)
                .enumerate()
                .flat_map_iter(|(i, batch)| trials.try_cheap(tree, first as usize + i * BATCH, batch, aim))
                .collect();
            let (constants, costs): (Vec<_>, Vec<_>) = tried.into_iter().unzip();
            trials.constants.extend(constants);
            trials.costs.extend(costs);
        }
        Ok(trials)
    }

    /// What a rung does to a brick; `None` while it has not been tried.
    pub fn cost(&self, brick: usize, rung: Rung) -> Option<Cost> {
        let cost = *self.costs[brick].get(rung as usize).unwrap_or(&Cost::NONE);
        (!cost.norm.is_nan()).then_some(cost)
    }

    fn texels(&self, tree: &SequenceTree, id: usize, brick: &Brick) -> Texels {
        let range = tree.brick_ranges[id];
        Texels::new(brick, carried(brick, self.rules[id]), (range.min, range.max), self.ranges[id])
    }

    fn try_cheap(
        &self,
        tree: &SequenceTree,
        first: usize,
        bricks: &[Brick],
        aim: ConstantAim,
    ) -> Vec<(f32, [Cost; LOSSY])> {
        let texels: Vec<Texels> =
            bricks.iter().zip(first..).map(|(brick, id)| self.texels(tree, id, brick)).collect();
        let [bc4, unorm8] = [Codec::Bc4, Codec::Unorm8].map(|codec| self.try_batch(codec, bricks, &texels));
        let each = bricks.iter().zip(&texels).zip(bc4.costs).zip(unorm8.costs).zip(first..);
        each.map(|((((brick, texels), bc4), unorm8), id)| {
            let range = tree.brick_ranges[id];
            let constant = match aim {
                ConstantAim::Squares => mean(brick, &texels.carried),
                ConstantAim::Max => (0.5 * (f64::from(range.min) + f64::from(range.max))) as f32,
            };
            let as_constant = self.measure(brick, &texels.carried, &[constant; BRICK_VOXELS], None);
            let halves = brick.values.map(|v| f16::from_f32(v).to_f32());
            // Values just past the greatest half would round to it, but the codec refuses them.
            let f16 = match brick.values.iter().all(|v| v.abs() <= f16::MAX.to_f32()) {
                true => self.measure(brick, &texels.carried, &halves, None),
                false => Cost::IMPOSSIBLE,
            };
            // Only where nothing but values says what is active may background stand for them.
            let empty = match brick.keeps_mask {
                true => Cost::IMPOSSIBLE,
                false => self.measure(brick, &texels.carried, &[tree.background; BRICK_VOXELS], None),
            };
            (constant, [empty, as_constant, Cost::UNKNOWN, bc4, unorm8, f16])
        })
        .collect()
    }

    fn try_batch(&self, codec: Codec, bricks: &[Brick], texels: &[Texels]) -> Tried {
        let encoded = encode(codec, &self.sequence, texels).expect("only f16 has values that it cannot hold");
        let size = codec.layout().brick_bytes();
        let each = bricks.iter().zip(texels).zip(encoded.bytes.chunks_exact(size)).zip(&encoded.axes);
        let cost = |(((brick, texels), bytes), &axis): (((&Brick, &Texels), &[u8]), &u8)| {
            let decoded = decode(codec, bytes, axis, &self.sequence, texels.range);
            let spread = spread(codec, bytes, &self.sequence, texels.range);
            self.measure(brick, &texels.carried, &decoded, Some(&spread))
        };
        let costs = each.map(cost).collect();
        Tried { costs, bytes: encoded.bytes, axes: encoded.axes }
    }

    pub(super) fn measure(
        &self,
        brick: &Brick,
        carried: &Mask512,
        decoded: &[f32; BRICK_VOXELS],
        spread: Option<&[f32; BRICK_VOXELS]>,
    ) -> Cost {
        let (mut squares, mut active_squares, mut max) = (0.0, 0.0, 0.0f64);
        for i in carried.ones() {
            let error = (f64::from(decoded[i]) - f64::from(brick.values[i])).abs();
            squares += error * error;
            if brick.active.get(i) {
                active_squares += error * error;
            }
            max = max.max(error + f64::from(spread.map_or(0.0, |s| s[i])));
        }
        if let Some(distance) = self.sign_matters {
            let flips = |i: usize| {
                (decoded[i] < 0.0) != (brick.values[i] < 0.0) && f64::from(brick.values[i]).abs() > distance
            };
            if carried.ones().any(flips) {
                return Cost::IMPOSSIBLE;
            }
        }
        // Rounded up, because a bound is what it is compared with.
        let max = if f64::from(max as f32) < max { (max as f32).next_up() } else { max as f32 };
        Cost { norm: squares.sqrt(), active_norm: active_squares.sqrt(), max }
    }

    /// The texels of a brick in a codec that was tried on it, and their packing axis.
    pub fn texels_of(&mut self, tree: &mut SequenceTree, id: u32, codec: Codec) -> io::Result<(Vec<u8>, u8)> {
        let kept = self.kept_or_brick(tree, id, codec)?;
        Ok(self.encode_kept(tree, id, codec, kept))
    }

    /// What [`Trials::encode_kept`] makes texels of: all that has to be read, which one thread does at a time.
    pub fn kept_or_brick(
        &mut self,
        tree: &mut SequenceTree,
        id: u32,
        codec: Codec,
    ) -> io::Result<KeptOrBrick> {
        if self.kept.holds(codec) {
            let (bytes, axis) = self.kept.get(id)?;
            return Ok(KeptOrBrick::Kept(bytes, axis));
        }
        let mut brick = Vec::with_capacity(1);
        tree.pool.read(id..id + 1, &mut brick)?;
        Ok(KeptOrBrick::Brick(Box::new(brick.remove(0))))
    }

    /// A brick's texels and their packing axis.
    pub fn encode_kept(
        &self,
        tree: &SequenceTree,
        id: u32,
        codec: Codec,
        kept: KeptOrBrick,
    ) -> (Vec<u8>, u8) {
        match kept {
            KeptOrBrick::Kept(bytes, axis) => (bytes, axis),
            KeptOrBrick::Brick(brick) => {
                let texels = [self.texels(tree, id as usize, &brick)];
                let encoded = encode(codec, &self.sequence, &texels).expect("f16 was tried on it");
                (encoded.bytes, encoded.axes[0])
            }
        }
    }

    /// Tries BC7 on some bricks, ascending, and keeps their texels. `advance` hears of each that is done.
    pub fn try_bc7(
        &mut self,
        tree: &mut SequenceTree,
        ids: &[u32],
        mut advance: impl FnMut(u64),
    ) -> io::Result<()> {
        let mut bricks = Vec::new();
        for ids in ids.chunks(BRICKS_IN_FLIGHT as usize) {
            bricks.clear();
            tree.pool.read_each(ids, &mut bricks)?;
            let batches = bricks.par_chunks(BATCH).zip(ids.par_chunks(BATCH));
            let tried: Vec<Tried> = batches
                .map(|(bricks, ids)| {
                    let each = bricks.iter().zip(ids);
                    let texels: Vec<_> = each.map(|(b, &id)| self.texels(tree, id as usize, b)).collect();
                    self.try_batch(Codec::Bc7, bricks, &texels)
                })
                .collect();
            for (tried, ids) in tried.into_iter().zip(ids.chunks(BATCH)) {
                self.kept.add(ids, &tried)?;
                for (&id, cost) in ids.iter().zip(tried.costs) {
                    self.costs[id as usize][Rung::Bc7 as usize] = cost;
                }
            }
            advance(ids.len() as u64);
        }
        Ok(())
    }
}

/// A brick's texels, or the brick itself where they were not kept.
pub(super) enum KeptOrBrick {
    Kept(Vec<u8>, u8),
    Brick(Box<Brick>),
}

/// The mean of the voxels that texels would give.
fn mean(brick: &Brick, carried: &Mask512) -> f32 {
    let sum: f64 = carried.ones().map(|i| f64::from(brick.values[i])).sum();
    (sum / f64::from(carried.count().max(1))) as f32
}

/// A batch that one codec was tried on.
struct Tried {
    costs: Vec<Cost>,
    bytes: Vec<u8>,
    axes: Vec<u8>,
}

/// The BC7 texels of bricks that were tried, so that none is encoded twice: in a scratch file, 128 bytes each.
pub struct KeptTexels {
    file: File,
    /// The place of each brick of the pool in the file.
    places: Vec<u32>,
    axes: Vec<u8>,
}

const NOT_KEPT: u32 = u32::MAX;

impl KeptTexels {
    fn new(bricks: usize) -> io::Result<Self> {
        Ok(Self { file: tempfile::tempfile()?, places: vec![NOT_KEPT; bricks], axes: Vec::new() })
    }

    fn add(&mut self, ids: &[u32], tried: &Tried) -> io::Result<()> {
        self.file.seek(SeekFrom::End(0))?;
        self.file.write_all(&tried.bytes)?;
        for (&id, place) in ids.iter().zip(self.axes.len() as u32..) {
            self.places[id as usize] = place;
        }
        self.axes.extend(&tried.axes);
        Ok(())
    }

    /// Whether every brick that got this codec has its texels here.
    pub fn holds(&self, codec: Codec) -> bool {
        codec == Codec::Bc7
    }

    /// The texels of a brick that was tried, and their packing axis.
    ///
    /// # Errors
    /// When the scratch file cannot be read back.
    pub fn get(&mut self, id: u32) -> io::Result<(Vec<u8>, u8)> {
        let place = self.places[id as usize];
        let mut bytes = vec![0; Codec::Bc7.layout().brick_bytes()];
        self.file.seek(SeekFrom::Start(u64::from(place) * bytes.len() as u64))?;
        self.file.read_exact(&mut bytes)?;
        Ok((bytes, self.axes[place as usize]))
    }
}
