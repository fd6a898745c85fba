//! The voxels of a pack's first frame on the CPU: what bricks are cut from, and what errors are measured against.

use std::collections::HashMap;
use std::error::Error;

use volpack::codec::Codec;
use volpack::pack::{Pack, Region};
use volpack::volume::{BRICK_DIM, BRICK_VOXELS, Coord, CoordBox, L2_DIM};

/// A region of 8³ voxels.
enum Content {
    Constant(f32),
    Voxels(Box<[f32; BRICK_VOXELS]>),
}

/// A frame's values, by region of 8³ voxels and by constant cell of 128³.
pub struct Voxels {
    /// The value outside of everything.
    pub background: f32,
    /// The box of what is not background, in whole regions.
    pub bounds: CoordBox,
    regions: HashMap<Coord, Content>,
    cells: HashMap<Coord, f32>,
}

impl Voxels {
    /// Decodes the first frame of the first grid.
    pub fn of(pack: &Pack) -> Result<Self, Box<dyn Error>> {
        let frame = pack.frame(0, 0)?;
        let mut voxels = Self {
            background: frame.grid().background,
            bounds: frame.bounds(),
            regions: HashMap::new(),
            cells: HashMap::new(),
        };
        let mut result: Result<(), Box<dyn Error>> = Ok(());
        frame.for_each_region(|origin, dim, region| match region {
            Region::Background => {}
            Region::Constant(constant) if dim == L2_DIM => {
                voxels.cells.insert(origin, constant.value);
            }
            Region::Constant(_) => result = Err("root tiles of 4096³ voxels are not supported".into()),
            Region::Brick(record) if record.codec == Codec::Constant && record.mask.is_none() => {
                voxels.regions.insert(origin, Content::Constant(f32::from_bits(record.word2)));
            }
            Region::Brick(record) => match frame.decode(&record) {
                Ok(brick) => drop(voxels.regions.insert(origin, Content::Voxels(brick.values))),
                Err(e) => result = Err(e.into()),
            },
        });
        result.map(|()| voxels)
    }

    /// The boxes of everything that is not background.
    pub fn boxes(&self) -> impl Iterator<Item = CoordBox> + '_ {
        let regions = self.regions.keys().map(|at| CoordBox::cube(*at, BRICK_DIM));
        regions.chain(self.cells.keys().map(|at| CoordBox::cube(*at, L2_DIM)))
    }

    /// The least and the greatest value, background included.
    pub fn range(&self) -> (f32, f32) {
        let constants = self.cells.values().copied().chain([self.background]);
        let regions = self.regions.values().flat_map(|content| match content {
            Content::Constant(value) => std::slice::from_ref(value),
            Content::Voxels(values) => &values[..],
        });
        let all = regions.copied().chain(constants);
        all.fold((f32::INFINITY, f32::NEG_INFINITY), |(min, max), v| (min.min(v), max.max(v)))
    }

    /// The regions that have a value for each voxel, x slowest.
    pub fn bricks(&self) -> impl Iterator<Item = (Coord, &[f32; BRICK_VOXELS])> {
        self.regions.iter().filter_map(|(origin, content)| match content {
            Content::Constant(_) => None,
            Content::Voxels(values) => Some((*origin, &**values)),
        })
    }

    /// The value of a voxel.
    pub fn get(&self, at: Coord) -> f32 {
        match self.regions.get(&at.align_down(BRICK_DIM)) {
            Some(Content::Constant(value)) => *value,
            Some(Content::Voxels(values)) => values[at.child_index(3, 1)],
            None => self.cells.get(&at.align_down(L2_DIM)).copied().unwrap_or(self.background),
        }
    }

    /// The values of a box of voxels, x fastest, z slowest.
    pub fn block(&self, origin: Coord, size: [i32; 3]) -> Vec<f32> {
        let [width, height, depth] = size;
        let mut values = vec![0.0; (width * height * depth) as usize];
        let first = origin.align_down(BRICK_DIM);
        let starts = |a: usize| (first.0[a]..origin.0[a] + size[a]).step_by(BRICK_DIM as usize);
        for (x, y, z) in
            starts(0).flat_map(|x| starts(1).flat_map(move |y| starts(2).map(move |z| (x, y, z))))
        {
            let region = Coord::new(x, y, z);
            let end = |a: usize| (region.0[a] + BRICK_DIM).min(origin.0[a] + size[a]);
            for z in region.0[2].max(origin.0[2])..end(2) {
                for y in region.0[1].max(origin.0[1])..end(1) {
                    for x in region.0[0].max(origin.0[0])..end(0) {
                        let [i, j, k] = [x - origin.0[0], y - origin.0[1], z - origin.0[2]];
                        values[((k * height + j) * width + i) as usize] = self.get(Coord::new(x, y, z));
                    }
                }
            }
        }
        values
    }

    /// The field between voxels: trilinear.
    pub fn at(&self, p: [f64; 3]) -> f64 {
        let low = p.map(f64::floor);
        let corner = |i: usize| {
            let at: [i32; 3] = std::array::from_fn(|a| low[a] as i32 + (i >> a & 1) as i32);
            f64::from(self.get(Coord(at)))
        };
        interpolate(std::array::from_fn(corner), std::array::from_fn(|a| p[a] - low[a]))
    }
}

/// Trilinear between eight corners, ordered by x + 2y + 4z.
pub fn interpolate(corners: [f64; 8], at: [f64; 3]) -> f64 {
    let weight =
        |i: usize| (0..3).map(|a| if i >> a & 1 == 1 { at[a] } else { 1.0 - at[a] }).product::<f64>();
    corners.iter().enumerate().map(|(i, corner)| corner * weight(i)).sum()
}
