//! What a picture asks of the shader, as it lies in the uniform buffer.

use bytemuck::{Pod, Zeroable};

use crate::render::scene::{AMBIENT, Scene, Setup, TraceError};
use crate::volume::CoordBox;

/// `struct Params` of `tracer.wgsl`: vectors of three are aligned to four words, and numbers fill the gaps.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub struct Params {
    origin: [f32; 3],
    width: u32,
    forward: [f32; 3],
    height: u32,
    right: [f32; 3],
    half_width: f32,
    up: [f32; 3],
    half_height: f32,
    base: [i32; 3],
    grid: u32,
    low: [i32; 3],
    frame: u32,
    high: [i32; 3],
    extinction: f32,
    sun: [f32; 3],
    threshold: f32,
    sun_world: [f32; 3],
    ambient: f32,
    normals: [[f32; 4]; 3],
}

impl Params {
    /// What a scene asks.
    ///
    /// # Errors
    /// [`TraceError`].
    pub fn new(scene: &Scene, [grid, frame]: [u32; 2], voxels: CoordBox) -> Result<Self, TraceError> {
        let setup = Setup::new(scene, voxels)?;
        let f = |v: [f64; 3]| v.map(|v| v as f32);
        Ok(Self {
            origin: f(setup.lens.origin),
            width: scene.size[0],
            forward: f(setup.lens.forward),
            height: scene.size[1],
            right: f(setup.lens.right),
            half_width: setup.lens.half_width as f32,
            up: f(setup.lens.up),
            half_height: setup.lens.half_height as f32,
            base: setup.base,
            grid,
            low: setup.bounds.min,
            frame,
            high: setup.bounds.max,
            extinction: scene.extinction as f32,
            sun: f(setup.sun),
            threshold: scene.threshold,
            sun_world: f(setup.sun_world),
            ambient: AMBIENT as f32,
            normals: setup.normals.map(|[x, y, z]| f([x, y, z])).map(|[x, y, z]| [x, y, z, 0.0]),
        })
    }
}
