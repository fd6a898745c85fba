//! The ray march through lit fog, the twin of `shaders/march.wgsl`.
//!
//! Each sample scatters light from a sun, whose optical depth is precomputed on a [`LightGrid`], and from a constant sky, and
//! adds the emission of another grid. Scattering is single, with the phase function of Henyey and Greenstein ("Diffuse
//! radiation in the galaxy", 1941). Absorption within a step is integrated analytically (Hillaire, "Physically based sky,
//! atmosphere and cloud rendering in Frostbite", 2016), and the sun is sampled at the mean depth of what a step scatters, so
//! that brightness hardly depends on the step.

use rayon::prelude::*;

use super::{Tracer, Visited};
use crate::render::Mode;
use crate::render::camera::dot;
use crate::render::decoded_frame::Content;
use crate::render::image::BACKDROP;
use crate::render::scene::{MAX_STEPS, RAMP_STEPS};
use crate::render::traverse::{Box3, Ray, Real, Walk};
use crate::volume::Coord;

/// Optical depth at which a ray ends. The transmittance is then 0.001, below half of an 8-bit step.
const OPAQUE: f64 = 7.0;
/// Optical depth of a step below which its own absorption of emission is neglected: the exact form would divide 0 by 0.
const CLEAR: f64 = 1e-4;

/// Optical depth towards the sun on a regular grid of points; interpolated between them.
pub struct LightGrid<F> {
    /// x fastest.
    depths: Vec<F>,
}

/// The sample positions of a ray: `t = (number + offset) · step`.
struct Samples<F> {
    step: F,
    offset: F,
}

impl<F: Real> Samples<F> {
    fn at(&self, number: F) -> F {
        (number + self.offset) * self.step
    }

    /// The number of the first sample that is not before `t`.
    fn not_before(&self, t: F) -> F {
        let place = t / self.step - self.offset;
        -F::from_i32((-place).floor_i32())
    }
}

impl<'a, F: Real> Tracer<'a, F> {
    /// The light grid, if the picture needs one.
    pub fn light_grid(&self) -> Option<LightGrid<F>> {
        if self.scene.level_set || self.scene.mode != Mode::Lit {
            return None;
        }
        let [x, y, z] = self.setup.light_points;
        let row = |row: usize| {
            // Points of a row are near each other.
            let mut visited = Visited::default();
            let half = F::from_f64(0.5);
            let depth = move |column: usize| {
                let point = [column, row % y, row / y];
                // Here cell i is the voxel around i.
                let origin = std::array::from_fn(|a| {
                    F::from_i32(self.setup.bounds.min[a] + point[a] as i32 * self.setup.light_spacing) + half
                });
                visited.steps = 0;
                let ray = Ray::new(origin, self.setup.to_sun.map(F::from_f64));
                self.optical_depth(&ray, &mut visited) * self.extinction
            };
            (0..x).map(depth)
        };
        Some(LightGrid { depths: (0..y * z).into_par_iter().flat_map_iter(row).collect() })
    }

    /// The offset of a pixel's samples, in steps: 0.5, or a hash of the pixel.
    pub fn sample_offset(&self, x: u32, y: u32) -> F {
        if !self.scene.march.jitter {
            return F::from_f64(0.5);
        }
        let mut h = y.wrapping_mul(self.scene.size[0]).wrapping_add(x);
        // The hash "lowbias32" of Wellons ("Prospecting for hash functions", 2018).
        h = (h ^ h >> 16).wrapping_mul(0x7feb_352d);
        h = (h ^ h >> 15).wrapping_mul(0x846c_a68b);
        h ^= h >> 16;
        F::from_i32((h >> 8) as i32) * F::from_f64(1.0 / f64::from(1 << 24))
    }

    fn samples(&self, ray: &Ray<F>, offset: F) -> Samples<F> {
        let [x, y, z] = ray.direction;
        let step = F::from_f64(self.setup.step);
        let step = if self.setup.step_in_cells { step / (x * x + y * y + z * z).sqrt() } else { step };
        Samples { step, offset }
    }

    /// Calls `sample` with position, and density there, of each sample along a ray, until it returns false. Empty nodes are
    /// skipped, unless there is emission.
    fn march(
        &self,
        ray: &Ray<F>,
        samples: &Samples<F>,
        visited: &mut Visited<'a>,
        mut sample: impl FnMut([F; 3], F, &mut Visited<'a>) -> bool,
    ) {
        let bounds = self.setup.bounds;
        let Some(walk) = Walk::enter(ray, bounds) else { return };
        let (end, _) = walk.exit(ray, bounds);
        let mut next = samples.not_before(walk.t);
        while samples.at(next) < end && visited.steps < MAX_STEPS {
            visited.steps += 1;
            let t = samples.at(next);
            next = next + F::from_i32(1);
            let p: [F; 3] = std::array::from_fn(|a| ray.origin[a] + ray.direction[a] * t);
            // Rounding may put p just outside the box.
            let cell = std::array::from_fn(|a| p[a].floor_i32().clamp(bounds.min[a], bounds.max[a] - 1));
            let (node, constant, value) = self.node(cell, visited);
            // A cell has the next voxels as corners, so the last layer of a node's cells is not constant, unless the nodes
            // around it are background too.
            let alone = constant && self.is_alone(cell, visited);
            let inner = Box3 { min: node.min, max: node.max.map(|v| v - i32::from(!alone)) };
            let is_inner = constant && inner.contains(cell);
            if is_inner && value <= 0.0 && self.emission.is_none() {
                let behind = samples.not_before(walk.exit(ray, inner).0);
                next = if behind > next { behind } else { next };
                continue;
            }
            let density = if is_inner {
                F::from_f64(value.into())
            } else {
                let within = std::array::from_fn(|a| p[a] - F::from_i32(cell[a]));
                interpolate(self.corners(cell, visited), within)
            };
            if !sample(p, density, visited) {
                return;
            }
        }
    }

    /// The ray-marched integral of density over distance, up to where the fog is opaque.
    pub fn marched_depth(&self, ray: &Ray<F>, offset: F, visited: &mut Visited<'a>) -> F {
        let zero = F::from_i32(0);
        let samples = self.samples(ray, offset);
        let mut depth = zero;
        self.march(ray, &samples, visited, |_, value, _| {
            depth = depth + if value > zero { value * samples.step } else { zero };
            depth * self.extinction < F::from_f64(OPAQUE)
        });
        depth
    }

    /// The radiance of a ray through lit fog in front of the backdrop.
    pub fn lit_fog(&self, ray: &Ray<F>, offset: F, visited: &mut Visited<'a>) -> [f32; 3] {
        let zero = F::from_i32(0);
        let one = F::from_i32(1);
        let color = |c: [f64; 3]| c.map(F::from_f64);
        let samples = self.samples(ray, offset);
        let phase = self.phase(ray);
        let sun = color(self.setup.sun_light).map(|c| c * phase);
        let sky = color(self.setup.sky_light);
        let mut light = [zero; 3];
        let mut depth = zero;
        let mut through = one;
        self.march(ray, &samples, visited, |p, value, visited| {
            let thickness = if value > zero { value * samples.step * self.extinction } else { zero };
            depth = depth + thickness;
            let left = (-depth).exp();
            if thickness > zero {
                let by = samples.step * scattering_offset(thickness, through, left);
                let lit = std::array::from_fn(|a| p[a] + ray.direction[a] * by);
                let sunlight = (-self.depth_to_sun(lit)).exp();
                light = std::array::from_fn(|c| light[c] + (through - left) * (sun[c] * sunlight + sky[c]));
            }
            if let Some(emission) = self.emission_at(p, visited) {
                let clear = thickness < F::from_f64(CLEAR);
                let seen = samples.step * if clear { through } else { (through - left) / thickness };
                light = std::array::from_fn(|c| light[c] + emission[c] * seen);
            }
            through = left;
            depth < F::from_f64(OPAQUE)
        });
        std::array::from_fn(|c| light[c].to_f64() as f32 + through.to_f64() as f32 * BACKDROP[c])
    }

    /// The phase function for sunlight, relative to isotropic scattering.
    fn phase(&self, ray: &Ray<F>) -> F {
        let g = self.scene.light.anisotropy;
        let cosine = dot(ray.direction.map(Real::to_f64), self.setup.sun_cosine);
        F::from_f64((1.0 - g * g) / (1.0 + g * g - 2.0 * g * cosine).powf(1.5))
    }

    /// The optical depth from a point to the sun.
    fn depth_to_sun(&self, p: [F; 3]) -> F {
        let Some(light) = self.light else { return F::from_i32(0) };
        let points = self.setup.light_points;
        let spacing = F::from_i32(self.setup.light_spacing);
        let place: [F; 3] = std::array::from_fn(|a| (p[a] - F::from_i32(self.setup.bounds.min[a])) / spacing);
        let low: [usize; 3] =
            std::array::from_fn(|a| place[a].floor_i32().clamp(0, points[a] as i32 - 2) as usize);
        let within = std::array::from_fn(|a| place[a] - F::from_i32(low[a] as i32));
        let corner = |i: usize| {
            let [x, y, z]: [usize; 3] = std::array::from_fn(|a| low[a] + (i >> a & 1));
            light.depths[(z * points[1] + y) * points[0] + x]
        };
        interpolate(std::array::from_fn(corner), within)
    }

    /// The emission at a point, per world unit.
    fn emission_at(&self, p: [F; 3], visited: &mut Visited<'a>) -> Option<[F; 3]> {
        let (emission, frame) = self.scene.emission.as_ref().zip(self.emission)?;
        let rows = self.setup.to_emission.map(|row| row.map(F::from_f64));
        let at: [F; 3] =
            std::array::from_fn(|a| rows[a][0] * p[0] + rows[a][1] * p[1] + rows[a][2] * p[2] + rows[a][3]);
        let cell = at.map(Real::floor_i32);
        let within = std::array::from_fn(|a| at[a] - F::from_i32(cell[a]));
        let value = |i: usize| {
            let corner = Coord(std::array::from_fn(|a| cell[a].wrapping_add((i >> a & 1) as i32)));
            let value = match frame.find(corner, &mut visited.emission_nearby).content {
                Content::Constant(constant) => constant.value,
                Content::Brick(brick) => brick.values[corner.child_index(3, 1)],
            };
            F::from_f64(value.into())
        };
        let value = interpolate(std::array::from_fn(value), within) * F::from_f64(emission.per_unit);
        let place = value * F::from_i32(RAMP_STEPS as i32 - 1);
        // Not a number does not emit.
        let emits = place > F::from_i32(0);
        if !emits {
            return None;
        }
        let low = place.floor_i32().min(RAMP_STEPS as i32 - 2);
        let part = place - F::from_i32(low);
        let part = if part < F::from_i32(1) { part } else { F::from_i32(1) };
        let color = |i: usize, c: usize| F::from_f64(emission.ramp[i][c].into());
        let low = low as usize;
        Some(std::array::from_fn(|c| color(low, c) * (F::from_i32(1) - part) + color(low + 1, c) * part))
    }
}

/// Where light that reaches the eye was scattered on average, from the middle of a step and in steps: denser fog scatters it
/// nearer. `through` and `left` are the transmittance before and behind the step.
fn scattering_offset<F: Real>(thickness: F, through: F, left: F) -> F {
    // There the exact form would lose its digits, and the series is as good.
    if thickness < F::from_f64(0.1) {
        return -(thickness * F::from_f64(1.0 / 12.0));
    }
    F::from_i32(1) / thickness - left / (through - left) - F::from_f64(0.5)
}

/// Trilinear interpolation of eight values, ordered by x + 2y + 4z.
fn interpolate<F: Real>(v: [F; 8], [x, y, z]: [F; 3]) -> F {
    let mix = |a: F, b: F, part: F| a * (F::from_i32(1) - part) + b * part;
    let over_z: [F; 4] = std::array::from_fn(|i| mix(v[i], v[i + 4], z));
    mix(mix(over_z[0], over_z[2], y), mix(over_z[1], over_z[3], y), x)
}
