//! Source and pack voxel by voxel: errors against input that is in no file, and how blocky a pack is.

use std::collections::HashMap;

use crate::pack::{FrameReader, PackError, Region};
use crate::volume::{BRICK_DIM, BRICK_VOXELS, Coord, FlatFrame, Mask512};

/// The bricks of one frame by their smallest corner.
pub struct Bricks {
    by_origin: HashMap<Coord, (Box<[f32; BRICK_VOXELS]>, Mask512)>,
    /// In the order of the source, so that sums do not depend on a hash.
    order: Vec<Coord>,
}

impl Bricks {
    /// Those of the source.
    pub fn of_source(frame: &FlatFrame) -> Self {
        let order = frame.brick_origins();
        let each = order.iter().zip(frame.bricks.iter());
        Self { by_origin: each.map(|(at, b)| (*at, (Box::new(b.values), b.active))).collect(), order }
    }

    /// What a pack has where the source has these. Which voxels are active is the source's.
    ///
    /// # Errors
    /// When a texel chunk is damaged.
    pub fn in_pack(&self, reader: &FrameReader) -> Result<Self, PackError> {
        let values = |origin: Coord| {
            Ok::<_, PackError>(match reader.locate(origin).0 {
                Region::Background => Box::new([reader.grid().background; BRICK_VOXELS]),
                Region::Constant(constant) => Box::new([constant.value; BRICK_VOXELS]),
                Region::Brick(record) => reader.decode(&record)?.values,
            })
        };
        let each = self.order.iter().map(|&at| Ok((at, (values(at)?, self.by_origin[&at].1))));
        Ok(Self { by_origin: each.collect::<Result<_, PackError>>()?, order: self.order.clone() })
    }

    /// How far other bricks in the same places are from these, over active voxels.
    pub fn difference(&self, other: &Self) -> Difference {
        let mut out = Difference::default();
        for at in &self.order {
            let ((ours, active), (theirs, _)) = (&self.by_origin[at], &other.by_origin[at]);
            active.ones().for_each(|i| out.voxel(ours[i], theirs[i]));
        }
        out
    }

    /// How much neighbouring active voxels differ.
    pub fn jumps(&self) -> Jumps {
        let mut jumps = Jumps::default();
        for at in &self.order {
            let (values, active) = &self.by_origin[at];
            for axis in 0..3 {
                let stride = 64 >> (3 * axis);
                let mut step = [0; 3];
                step[axis] = BRICK_DIM;
                let next = self.by_origin.get(&at.offset_by(step));
                for i in active.ones() {
                    if i / stride % 8 < 7 {
                        if active.get(i + stride) {
                            jumps.inside += f64::from((values[i + stride] - values[i]).abs());
                            jumps.inside_pairs += 1;
                        }
                    } else if let Some((beyond, _)) = next.filter(|(_, active)| active.get(i - 7 * stride)) {
                        jumps.across += f64::from((beyond[i - 7 * stride] - values[i]).abs());
                        jumps.across_pairs += 1;
                    }
                }
            }
        }
        jumps
    }
}

/// Sums of the differences of neighbouring voxels.
#[derive(Clone, Copy, Debug, Default)]
pub struct Jumps {
    inside: f64,
    inside_pairs: u64,
    across: f64,
    across_pairs: u64,
}

impl Jumps {
    /// Adds those of another frame.
    pub fn add(&mut self, other: &Self) {
        self.inside += other.inside;
        self.inside_pairs += other.inside_pairs;
        self.across += other.across;
        self.across_pairs += other.across_pairs;
    }

    /// The mean jump across a brick's face over the mean jump inside one.
    fn ratio(&self) -> f64 {
        self.across / self.across_pairs as f64 / (self.inside / self.inside_pairs as f64)
    }

    /// How much blockier these are than those of the source: 1 is not at all. Not a number where nothing varies.
    pub fn blockiness(&self, source: &Self) -> f64 {
        self.ratio() / source.ratio()
    }
}

/// Errors over active leaf voxels.
#[derive(Clone, Copy, Debug, Default)]
pub struct Difference {
    /// Active leaf voxels.
    pub voxels: u64,
    /// Sum of squared differences.
    pub squares: f64,
    /// The largest difference.
    pub max: f64,
}

impl Difference {
    /// Adds one voxel.
    pub(super) fn voxel(&mut self, ours: f32, theirs: f32) {
        let error = (f64::from(ours) - f64::from(theirs)).abs();
        self.voxels += 1;
        self.squares += error * error;
        self.max = self.max.max(error);
    }

    /// Adds another frame's.
    pub fn add(&mut self, other: &Self) {
        self.voxels += other.voxels;
        self.squares += other.squares;
        self.max = self.max.max(other.max);
    }

    /// In dB under `peak`; `None` where there is no error.
    pub fn psnr(&self, peak: f64) -> Option<f64> {
        (self.squares > 0.0).then(|| 10.0 * (self.voxels as f64 * peak * peak / self.squares).log10())
    }
}
