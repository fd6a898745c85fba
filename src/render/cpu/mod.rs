//! The CPU tracer.
//!
//! In `f64` with [`Traversal::Dda`] it is the reference; in `f32` with [`Traversal::Hdda`] it is the
//! shader's twin, line by line: this file and `shade.rs` of `shaders/tracer.wgsl`, `march.rs` of `shaders/march.wgsl`.

mod march;
mod shade;

use rayon::prelude::*;

use self::march::LightGrid;
use super::camera::normalise;
use super::decoded_frame::{Content, DecodedBrick, DecodedFrame, Nearby};
use super::image::{Image, apart, opacity};
use super::scene::{MAX_STEPS, Scene, Setup, TraceError};
use super::surface::{cubic, evaluate, first_change};
use super::traverse::{Box3, Ray, Real, Walk};
use super::{Mode, Traversal};
use crate::volume::{BRICK_DIM, Coord};

/// What a picture shows: a frame, and the frame of the emissive grid that [`Scene::emission`] names.
#[derive(Clone, Copy)]
pub struct Medium<'a> {
    /// The frame.
    pub frame: &'a DecodedFrame,
    /// The frame of the emissive grid.
    pub emission: Option<&'a DecodedFrame>,
}

impl<'a> From<&'a DecodedFrame> for Medium<'a> {
    fn from(frame: &'a DecodedFrame) -> Self {
        Self { frame, emission: None }
    }
}

/// Traces a picture: four numbers a pixel, of which the last is the steps taken.
///
/// # Errors
/// [`TraceError`].
pub fn trace<'a, F: Real>(medium: impl Into<Medium<'a>>, scene: &Scene) -> Result<Image, TraceError> {
    Ok(trace_noting_gpu_spread::<F>(medium, scene)?.0)
}

/// The same, and for each pixel whether its rays read a brick whose texels GPUs decode differently: BC4.
///
/// # Errors
/// [`TraceError`].
pub fn trace_noting_gpu_spread<'a, F: Real>(
    medium: impl Into<Medium<'a>>,
    scene: &Scene,
) -> Result<(Image, Vec<bool>), TraceError> {
    let medium = medium.into();
    let setup = Setup::new(scene, medium.frame.bounds)?;
    let dark = Tracer::<F>::new(medium, scene, &setup);
    let light = dark.light_grid();
    let tracer = Tracer { light: light.as_ref(), ..dark };
    let [width, height] = scene.size;
    let pixels = (0..width * height).into_par_iter().map(|i| tracer.pixel(i % width, i / width));
    let (pixels, varies) = pixels.unzip();
    Ok((Image { size: scene.size, pixels }, varies))
}

/// How far arithmetic decides what these pixels (y · width + x) are: the most by which one changes where its ray and the
/// values around it are moved by a few roundings, and values by their brick's uncertainty, in sixteen ways. Where a surface
/// lies beside huge values, or a ray meets an edge, no two GPUs agree by more.
///
/// # Errors
/// [`TraceError`].
pub fn spread(frame: &DecodedFrame, scene: &Scene, pixels: &[usize]) -> Result<Vec<f32>, TraceError> {
    let setup = Setup::new(scene, frame.bounds)?;
    let dark = Tracer::<f32>::new(frame.into(), scene, &setup);
    let light = dark.light_grid();
    let tracer = Tracer { light: light.as_ref(), ..dark };
    let width = scene.size[0] as usize;
    let spread = |&pixel: &usize| {
        let [x, y] = [pixel % width, pixel / width].map(|v| v as u32);
        let (still, _) = tracer.pixel(x, y);
        let moved = (0..PERTURBATIONS).map(|p| Tracer { perturbation: Some(p), ..tracer }.pixel(x, y).0);
        // Numbers are no further than 2 apart; what is none is no number on any GPU.
        moved.map(|moved| apart(&still[..3], &moved[..3])).fold(0.0, f32::max).min(2.0)
    };
    Ok(pixels.par_iter().map(spread).collect())
}

/// For each pixel the integral of density over distance, which [`Mode::Density`] shows as opacity.
///
/// # Errors
/// [`TraceError`].
pub fn optical_depths<F: Real>(frame: &DecodedFrame, scene: &Scene) -> Result<Vec<f32>, TraceError> {
    let setup = Setup::new(scene, frame.bounds)?;
    let tracer = Tracer::<F> { extinction: F::from_i32(1), ..Tracer::new(frame.into(), scene, &setup) };
    let [width, height] = scene.size;
    let depth = |i| {
        let ray = tracer.ray(i % width, i / width);
        tracer.optical_depth(&ray, &mut Visited::default()).to_f64() as f32
    };
    Ok((0..width * height).into_par_iter().map(depth).collect())
}

/// What the rays of a pixel met.
#[derive(Default)]
struct Visited<'a> {
    steps: u32,
    varies: bool,
    nearby: Nearby<'a>,
    /// The same of the emissive grid.
    emission_nearby: Nearby<'a>,
}

#[derive(Clone, Copy)]
struct Tracer<'a, F> {
    frame: &'a DecodedFrame,
    emission: Option<&'a DecodedFrame>,
    scene: &'a Scene,
    setup: &'a Setup,
    extinction: F,
    /// Of lit fog.
    light: Option<&'a LightGrid<F>>,
    /// Which of the [`PERTURBATIONS`] moves rays and values: a bit for each axis, and one for the sign of
    /// [`perturbation_sign`].
    perturbation: Option<u32>,
}

/// What rounding moves a ray by, as a part of its farthest coordinate, and a cell's corners, as a part of the largest. A ray
/// has four roundings: two for its origin, one for how far along it a place is, and one for what is counted from there. A
/// cell's corners are summed by four and by eight.
const ROUNDING_ERROR: f32 = 4.0 * f32::EPSILON;

/// Where a ray first hits something.
struct Hit<F> {
    t: F,
    cell: [i32; 3],
    /// World space, for surfaces.
    normal: Option<[f64; 3]>,
    /// The axis of the face through which the cell was entered; 3 for none.
    axis: usize,
    value: f32,
}

impl<'a, F: Real> Tracer<'a, F> {
    fn new(medium: Medium<'a>, scene: &'a Scene, setup: &'a Setup) -> Self {
        let Medium { frame, emission } = medium;
        let extinction = F::from_f64(scene.extinction);
        Self { frame, emission, scene, setup, extinction, light: None, perturbation: None }
    }

    fn ray(&self, x: u32, y: u32) -> Ray<F> {
        let [width, height] = self.scene.size;
        let at = |i: u32, n: u32| (2.0 * f64::from(i) + 1.0) / f64::from(n) - 1.0;
        let ray: Ray<F> = self.setup.lens.ray(at(x, width), -at(y, height));
        let Some(perturbation) = self.perturbation else { return ray };
        let farthest = ray.origin.iter().map(|v| v.to_f64().abs()).fold(1.0, f64::max);
        let by = F::from_f64(farthest * f64::from(ROUNDING_ERROR));
        let origin =
            std::array::from_fn(|a| ray.origin[a] + if perturbation >> a & 1 == 1 { by } else { -by });
        Ray::new(origin, ray.direction)
    }

    fn pixel(&self, x: u32, y: u32) -> ([f32; 4], bool) {
        let ray = self.ray(x, y);
        let mut visited = Visited::default();
        let fog = !self.scene.level_set;
        let color = match self.scene.mode {
            Mode::Density if fog => {
                let depth = if self.scene.is_trilinear() {
                    self.marched_depth(&ray, self.sample_offset(x, y), &mut visited)
                } else {
                    self.optical_depth(&ray, &mut visited)
                };
                [opacity(depth, self.extinction).to_f64() as f32; 3]
            }
            Mode::Lit if fog => self.lit_fog(&ray, self.sample_offset(x, y), &mut visited),
            _ => {
                let hit = self.first_hit(&ray, &mut visited);
                self.shade(&ray, hit, &mut visited)
            }
        };
        let steps = visited.steps as f32;
        let [r, g, b] = if self.scene.mode == Mode::Steps { [steps; 3] } else { color };
        ([r, g, b, steps], visited.varies)
    }

    /// The voxel that a cell is, or has as its first corner.
    fn voxel(&self, cell: [i32; 3]) -> Coord {
        // A corner may lie behind the last voxel that there is: it wraps, as in the shader.
        Coord(std::array::from_fn(|a| cell[a].wrapping_add(self.setup.base[a])))
    }

    fn skips(&self) -> bool {
        self.scene.traversal == Traversal::Hdda
    }

    /// The node to step over (the whole of it for HDDA where it has one value, else one cell), whether
    /// it has one value, and the value of the cell's voxel.
    fn node(&self, cell: [i32; 3], visited: &mut Visited<'a>) -> (Box3, bool, f32) {
        let voxel = self.voxel(cell);
        let found = self.frame.find(voxel, &mut visited.nearby);
        let (constant, value) = match found.content {
            Content::Constant(constant) => (true, constant.value),
            Content::Brick(brick) => {
                visited.varies |= brick.uncertainty > 0.0;
                (false, self.brick_value(brick, voxel))
            }
        };
        if constant && self.skips() {
            let min = std::array::from_fn(|a| found.origin.0[a] - self.setup.base[a]);
            return (Box3::cube(min, found.dim), constant, value);
        }
        (Box3::cube(cell, 1), constant, value)
    }

    fn brick_value(&self, brick: &DecodedBrick, voxel: Coord) -> f32 {
        let moved = self.perturbation.map_or(0.0, |p| brick.uncertainty * perturbation_sign(p, voxel));
        brick.values[voxel.child_index(3, 1)] + moved
    }

    /// The integral of density over distance. What is below 0 absorbs nothing.
    fn optical_depth(&self, ray: &Ray<F>, visited: &mut Visited<'a>) -> F {
        let mut depth = F::from_i32(0);
        let bounds = self.setup.bounds;
        let Some(mut walk) = Walk::enter(ray, bounds) else { return depth };
        while bounds.contains(walk.cell) && visited.steps < MAX_STEPS {
            visited.steps += 1;
            let (node, _, value) = self.node(walk.cell, visited);
            let from = walk.t;
            walk.leave(ray, node.within(bounds));
            depth = depth + (walk.t - from) * F::from_f64(value.max(0.0).into());
        }
        depth
    }

    fn first_hit(&self, ray: &Ray<F>, visited: &mut Visited<'a>) -> Option<Hit<F>> {
        let bounds = self.setup.bounds;
        let walk = Walk::enter(ray, bounds)?;
        if self.scene.is_trilinear() {
            return self.first_surface(ray, bounds, walk, visited);
        }
        if !self.scene.level_set {
            return self.first_voxel(ray, bounds, walk, visited, |value| value > self.scene.threshold);
        }
        let mut negative = self.sign_before(&walk);
        let hit = self.first_voxel(ray, bounds, walk, visited, |value| {
            *negative.get_or_insert(value < 0.0) != (value < 0.0)
        });
        hit.map(|hit| Hit { value: 1.0, ..hit })
    }

    fn first_voxel(
        &self,
        ray: &Ray<F>,
        bounds: Box3,
        mut walk: Walk<F>,
        visited: &mut Visited<'a>,
        mut is_hit: impl FnMut(f32) -> bool,
    ) -> Option<Hit<F>> {
        while bounds.contains(walk.cell) && visited.steps < MAX_STEPS {
            visited.steps += 1;
            let (node, _, value) = self.node(walk.cell, visited);
            if is_hit(value) {
                return Some(Hit { t: walk.t, cell: walk.cell, normal: None, axis: walk.axis, value });
            }
            walk.leave(ray, node.within(bounds));
        }
        None
    }

    /// Whether it is negative where a walk comes from: the background is, or is not; nothing is known of where a ray
    /// begins inside.
    fn sign_before(&self, walk: &Walk<F>) -> Option<bool> {
        (walk.axis < 3).then_some(self.frame.background < 0.0)
    }

    /// The first zero of the interpolated field. A cell reaches over to the next voxel on each axis, so
    /// the last layer of a node's cells is taken one by one, unless all around is background too.
    fn first_surface(
        &self,
        ray: &Ray<F>,
        bounds: Box3,
        mut walk: Walk<F>,
        visited: &mut Visited<'a>,
    ) -> Option<Hit<F>> {
        let mut negative = self.sign_before(&walk);
        while bounds.contains(walk.cell) && visited.steps < MAX_STEPS {
            visited.steps += 1;
            let (node, constant, value) = self.node(walk.cell, visited);
            let alone = constant && self.is_alone(walk.cell, visited);
            let inner = Box3 { min: node.min, max: node.max.map(|v| v - i32::from(!alone)) };
            if constant && inner.contains(walk.cell) {
                let sign = value < 0.0;
                if negative.is_some_and(|n| n != sign) {
                    return Some(self.surface_hit(ray, &walk, walk.t, visited));
                }
                negative = Some(sign);
                walk.leave(ray, inner.within(bounds));
                continue;
            }
            let corners = self.corners(walk.cell, visited);
            let cell = Box3::cube(walk.cell, 1);
            let first = corners[0] < F::from_i32(0);
            let is_mixed = |negative: bool| corners.iter().any(|v| (*v < F::from_i32(0)) != negative);
            // Where all corners are of one sign, so is the cell, whatever rounding makes of its interpolant.
            if !is_mixed(first) && negative.is_none_or(|n| n == first) {
                negative = Some(first);
                walk.leave(ray, cell);
                continue;
            }
            let (exit, _) = walk.exit(ray, cell);
            let from = self.local(ray, walk.cell, walk.t);
            let along = std::array::from_fn(|a| ray.direction[a] * (exit - walk.t));
            let c = cubic(self.perturbed(corners, walk.cell), from, along);
            let start = *negative.get_or_insert(evaluate(c, F::from_i32(0)) < F::from_i32(0));
            if is_mixed(start)
                && let Some(u) = first_change(c, start)
            {
                return Some(self.surface_hit(ray, &walk, walk.t + (exit - walk.t) * u, visited));
            }
            walk.leave(ray, cell);
        }
        None
    }

    /// A place on the ray relative to a cell.
    fn local(&self, ray: &Ray<F>, cell: [i32; 3], t: F) -> [F; 3] {
        std::array::from_fn(|a| ray.origin[a] - F::from_i32(cell[a]) + ray.direction[a] * t)
    }

    fn is_alone(&self, cell: [i32; 3], visited: &mut Visited<'a>) -> bool {
        self.skips() && self.frame.is_alone(self.voxel(cell), &mut visited.nearby)
    }

    /// The voxels at a cell's corners, ordered by x + 2y + 4z.
    fn corners(&self, cell: [i32; 3], visited: &mut Visited<'a>) -> [F; 8] {
        let first = self.voxel(cell);
        let corner = |i: usize| std::array::from_fn(|a| (i >> a & 1) as i32);
        // Most cells lie in one brick.
        if first.0.iter().all(|v| v & (BRICK_DIM - 1) < BRICK_DIM - 1)
            && let Content::Brick(brick) = self.frame.find(first, &mut visited.nearby).content
        {
            visited.varies |= brick.uncertainty > 0.0;
            let value = |i| self.brick_value(brick, first.offset_by(corner(i)));
            return std::array::from_fn(|i| F::from_f64(value(i).into()));
        }
        std::array::from_fn(|i| {
            let corner = std::array::from_fn(|a| cell[a] + corner(i)[a]);
            let (_, _, value) = self.node(corner, visited);
            F::from_f64(value.into())
        })
    }

    /// A cell's corners, moved by what is rounded where sums of them are.
    fn perturbed(&self, corners: [F; 8], cell: [i32; 3]) -> [F; 8] {
        let Some(perturbation) = self.perturbation else { return corners };
        let largest = corners.iter().map(|v| v.to_f64().abs()).fold(0.0, f64::max);
        std::array::from_fn(|i| {
            let corner = Coord(std::array::from_fn(|a| cell[a] + (i >> a & 1) as i32));
            corners[i]
                + F::from_f64(largest * f64::from(ROUNDING_ERROR * perturbation_sign(perturbation, corner)))
        })
    }

    fn surface_hit(&self, ray: &Ray<F>, walk: &Walk<F>, t: F, visited: &mut Visited<'a>) -> Hit<F> {
        let c = self.perturbed(self.corners(walk.cell, visited), walk.cell).map(Real::to_f64);
        let p = self.local(ray, walk.cell, t).map(|v| v.to_f64().clamp(0.0, 1.0));
        let gradient: [f64; 3] = std::array::from_fn(|a| {
            (0..8)
                .filter(|i| i >> a & 1 == 0)
                .map(|i: usize| {
                    let side = |b: usize| if i >> b & 1 == 1 { p[b] } else { 1.0 - p[b] };
                    let weight: f64 = (0..3).filter(|&b| b != a).map(side).product();
                    weight * (c[i | 1 << a] - c[i])
                })
                .sum()
        });
        let world = std::array::from_fn(|r| (0..3).map(|a| self.setup.normals[r][a] * gradient[a]).sum());
        Hit { t, cell: walk.cell, normal: Some(normalise(world)), axis: walk.axis, value: 1.0 }
    }
}

/// The combinations of the four bits of a perturbation.
const PERTURBATIONS: u32 = 16;

/// 1 or -1, changing along the axes of `perturbation`: with these signs the corners of a cell are moved in all ways that
/// change where its zero is or how steep it is.
fn perturbation_sign(perturbation: u32, voxel: Coord) -> f32 {
    let odd = (0..3).filter(|&a| perturbation >> a & 1 == 1 && voxel.0[a] & 1 == 1).count();
    if (odd % 2 == 1) != (perturbation >> 3 == 1) { -1.0 } else { 1.0 }
}
