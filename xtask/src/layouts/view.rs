//! The camera and the box that is sampled, in index space.

use std::error::Error;

use volpack::pack::Grid;
use volpack::render::{Lens, Mode};
use volpack::volume::CoordBox;

use crate::trace;

/// Rays of a picture, in voxels.
#[derive(Clone, Copy)]
pub struct View {
    /// The eye.
    pub origin: [f64; 3],
    /// The ray through the middle, and from there to the right edge and to the top.
    pub forward: [f64; 3],
    pub right: [f64; 3],
    pub up: [f64; 3],
    /// The box that is sampled.
    pub low: [f64; 3],
    pub high: [f64; 3],
}

impl View {
    /// The benchmarks' camera for the first frame of a grid. `voxels` is the box of what is not background: samples reach one voxel
    /// farther.
    pub fn new(grid: &Grid, voxels: CoordBox, size: [u32; 2]) -> Result<Self, Box<dyn Error>> {
        let scene = trace::scene(grid, Mode::Depth, size);
        let lens = Lens::new(&scene.camera, &scene.matrix, size, [0.0; 3])
            .ok_or("the grid has no inverse transform")?;
        let Lens { origin, forward, right, up, .. } = lens;
        let low = voxels.min.0.map(|c| f64::from(c) - 1.0);
        let high = voxels.max.0.map(|c| f64::from(c) + 1.0);
        Ok(Self { origin, forward, right, up, low, high })
    }

    /// The ray of a pixel: its direction, and where it enters and leaves the box.
    pub fn ray(&self, [x, y]: [u32; 2], [width, height]: [u32; 2]) -> ([f64; 3], [f64; 2]) {
        let u = f64::from(2 * x + 1) / f64::from(width) - 1.0;
        let v = 1.0 - f64::from(2 * y + 1) / f64::from(height);
        let d: [f64; 3] = std::array::from_fn(|a| self.forward[a] + self.right[a] * u + self.up[a] * v);
        let length = d.iter().map(|c| c * c).sum::<f64>().sqrt();
        let d = d.map(|c| c / length);
        let planes = |a: usize| [self.low[a], self.high[a]].map(|plane| (plane - self.origin[a]) / d[a]);
        let start = (0..3).map(planes).map(|[a, b]| a.min(b)).fold(0.0, f64::max);
        let end = (0..3).map(planes).map(|[a, b]| a.max(b)).fold(f64::INFINITY, f64::min);
        (d, [start, end])
    }

    /// The places of the first and the last brick of a pitch that rays are in.
    pub fn ends(&self, pitch: i32) -> [[i32; 3]; 2] {
        let pitch = f64::from(pitch);
        [self.low.map(|c| (c / pitch).floor() as i32), self.high.map(|c| (c / pitch).ceil() as i32 - 1)]
    }
}
