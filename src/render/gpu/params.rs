//! What a picture asks of the shader, as it lies in the uniform buffer.

use bytemuck::{Pod, Zeroable};

use crate::render::image::BACKDROP;
use crate::render::scene::{AMBIENT, RAMP_STEPS, Scene, Setup, TraceError};
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
    normal_x: [f32; 3],
    step: f32,
    normal_y: [f32; 3],
    step_in_cells: u32,
    normal_z: [f32; 3],
    jitter: u32,
    to_sun: [f32; 3],
    anisotropy: f32,
    sun_cosine: [f32; 3],
    light_spacing: i32,
    light_points: [u32; 3],
    emission_grid: u32,
    sun_light: [f32; 3],
    emission_frame: u32,
    sky_light: [f32; 3],
    emission_scale: f32,
    backdrop: [f32; 3],
    padding: u32,
    to_emission: [[f32; 4]; 3],
    ramp: [[f32; 4]; RAMP_STEPS],
}

impl Params {
    /// What a scene asks.
    ///
    /// # Errors
    /// [`TraceError`].
    pub fn new(scene: &Scene, [grid, frame]: [u32; 2], voxels: CoordBox) -> Result<Self, TraceError> {
        let setup = Setup::new(scene, voxels)?;
        let f = |v: [f64; 3]| v.map(|v| v as f32);
        let [normal_x, normal_y, normal_z] = setup.normals;
        let emission = scene.emission.as_ref();
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
            normal_x: f(normal_x),
            step: setup.step as f32,
            normal_y: f(normal_y),
            step_in_cells: setup.step_in_cells.into(),
            normal_z: f(normal_z),
            jitter: scene.march.jitter.into(),
            to_sun: f(setup.to_sun),
            anisotropy: scene.light.anisotropy as f32,
            sun_cosine: f(setup.sun_cosine),
            light_spacing: setup.light_spacing,
            light_points: setup.light_points.map(|n| n as u32),
            emission_grid: emission.map_or(0, |e| e.grid as u32),
            sun_light: f(setup.sun_light),
            emission_frame: emission.map_or(0, |e| e.frame as u32),
            sky_light: f(setup.sky_light),
            emission_scale: emission.map_or(0.0, |e| e.per_unit as f32 * (RAMP_STEPS - 1) as f32),
            backdrop: BACKDROP,
            padding: 0,
            to_emission: setup.to_emission.map(|row| row.map(|v| v as f32)),
            ramp: emission.map_or([[0.0; 4]; RAMP_STEPS], |e| e.ramp.map(|[r, g, b]| [r, g, b, 0.0])),
        })
    }

    /// Number of points of the light grid.
    pub fn light_points(&self) -> u32 {
        self.light_points.iter().product()
    }
}
