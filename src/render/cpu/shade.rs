//! From a hit to a colour, as at the end of `shaders/tracer.wgsl`.

use super::{Hit, Tracer, Visited};
use crate::render::Mode;
use crate::render::camera::dot;
use crate::render::scene::AMBIENT;
use crate::render::traverse::{Ray, Real};
use crate::volume::{BRICK_DIM, L1_DIM, L2_DIM};

impl<'a, F: Real> Tracer<'a, F> {
    pub fn shade(&self, ray: &Ray<F>, hit: Option<Hit<F>>, visited: &mut Visited<'a>) -> [f32; 3] {
        let Some(hit) = hit else {
            return if self.scene.mode == Mode::Depth { [-1.0; 3] } else { [0.0; 3] };
        };
        match self.scene.mode {
            Mode::Depth => [hit.t.to_f64() as f32; 3],
            Mode::First => [hit.value; 3],
            Mode::Bricks => brick_hue(self.voxel(hit.cell).0),
            Mode::Nodes => self.node_color(ray, &hit),
            Mode::Normals => self.normal(ray, &hit).map(|n| (n * 0.5 + 0.5) as f32),
            Mode::Density | Mode::Lit => [self.lit(ray, &hit, visited) as f32; 3],
            Mode::Steps => [0.0; 3],
        }
    }

    /// A surface's own normal; else that of the face, in cell space.
    fn normal(&self, ray: &Ray<F>, hit: &Hit<F>) -> [f64; 3] {
        hit.normal.unwrap_or_else(|| {
            let mut n = [0.0; 3];
            if hit.axis < 3 {
                n[hit.axis] = if ray.direction[hit.axis] > F::from_i32(0) { -1.0 } else { 1.0 };
            }
            n
        })
    }

    fn lit(&self, ray: &Ray<F>, hit: &Hit<F>, visited: &mut Visited<'a>) -> f64 {
        let normal = self.normal(ray, hit);
        let facing = dot(normal, self.setup.sun_world);
        if facing <= 0.0 {
            return AMBIENT;
        }
        let sun = self.setup.sun.map(F::from_f64);
        let origin = std::array::from_fn(|a| ray.origin[a] + ray.direction[a] * hit.t + sun[a]);
        let shadow = Ray::new(origin, sun);
        if self.first_hit(&shadow, visited).is_some() { AMBIENT } else { AMBIENT + (1.0 - AMBIENT) * facing }
    }

    /// Blue, red or cyan near a boundary of an L1, L2 or L3 node on the face that was hit; else grey.
    fn node_color(&self, ray: &Ray<F>, hit: &Hit<F>) -> [f32; 3] {
        // Nodes lie on multiples of their side counted from voxel 0.
        let zero = self.setup.base.map(|b| -(b & (L1_DIM - 1)));
        let p = self.local(ray, zero, hit.t);
        for (dim, width, color) in NODE_COLORS {
            let near = (0..3).filter(|&a| a != hit.axis).any(|a| {
                let place = p[a] / F::from_i32(dim);
                let nearest = (place + F::from_f64(0.5)).floor_i32();
                let off = (place - F::from_i32(nearest)) * F::from_i32(dim);
                let width = F::from_f64(width);
                off < width && -off < width
            });
            if near {
                return color;
            }
        }
        [0.25; 3]
    }
}

/// Side, half width of the line in cells, and colour of what is drawn around nodes.
const NODE_COLORS: [(i32, f64, [f32; 3]); 3] =
    [(L1_DIM, 1.0, [0.1, 0.2, 1.0]), (L2_DIM, 0.75, [1.0, 0.15, 0.1]), (BRICK_DIM, 0.5, [0.0, 0.9, 0.9])];

/// A hue that differs between neighbouring bricks: the same bits in the shader.
fn brick_hue(cell: [i32; 3]) -> [f32; 3] {
    let [x, y, z] = cell.map(|c| (c >> 3) as u32);
    let mut h = x.wrapping_mul(0x8da6_b343) ^ y.wrapping_mul(0xd816_3841) ^ z.wrapping_mul(0xcb1a_b31f);
    h = (h ^ (h >> 13)).wrapping_mul(0x85eb_ca6b);
    h ^= h >> 16;
    [h & 255, h >> 8 & 255, h >> 16 & 255].map(|c| 0.2 + 0.8 * c as f32 / 255.0)
}
