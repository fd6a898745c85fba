//! Where pictures are taken from.

use super::traverse::{Ray, Real};
use crate::pack::Grid;
use crate::volume::CoordBox;

/// A box in world space, parallel to its axes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WorldBox {
    min: [f64; 3],
    max: [f64; 3],
}

impl WorldBox {
    /// The box around boxes of voxels, each under its own index-to-world matrix; of size 0 at the origin where all are
    /// empty. A voxel is the cube around its index coordinate.
    pub fn around<'a>(boxes: impl IntoIterator<Item = (CoordBox, &'a [f64; 16])>) -> Self {
        let (mut min, mut max) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        for (voxels, matrix) in boxes.into_iter().filter(|(voxels, _)| !voxels.is_empty()) {
            for corner in 0..8 {
                let end = |a: usize| match corner >> a & 1 {
                    0 => f64::from(voxels.min.0[a]) - 0.5,
                    _ => f64::from(voxels.max.0[a]) + 0.5,
                };
                let corner = transform(matrix, std::array::from_fn(end));
                (min, max) = (
                    std::array::from_fn(|a| min[a].min(corner[a])),
                    std::array::from_fn(|a| max[a].max(corner[a])),
                );
            }
        }
        if min[0] > max[0] { Self { min: [0.0; 3], max: [0.0; 3] } } else { Self { min, max } }
    }

    /// The box around the active voxels of all frames of a grid's source, as the frame table has them: the same for every
    /// pack of one source.
    pub fn of_grid(grid: &Grid) -> Self {
        let frames = grid.frames.iter().map(|frame| &frame.record);
        Self::around(frames.map(|record| (CoordBox::from_array(record.bbox), &record.transform)))
    }

    /// The length of its diagonal, in world units.
    pub fn diagonal(&self) -> f64 {
        length(sub(self.max, self.min))
    }

    fn middle(&self) -> [f64; 3] {
        std::array::from_fn(|a| f64::midpoint(self.min[a], self.max[a]))
    }
}

/// A pinhole camera in world space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Where it is.
    pub eye: [f64; 3],
    /// What is in the middle of the picture.
    pub target: [f64; 3],
    /// The vertical angle of view in degrees.
    pub fov: f64,
}

/// How a camera is asked for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum View {
    /// Around the middle of the volume's box: azimuth and elevation in degrees, and distance in
    /// diagonals of the box.
    Orbit([f64; 3]),
    /// A camera in world space.
    Fixed(Camera),
}

impl Default for View {
    /// From ahead, above and to the side, one and a quarter diagonals away, with all of the box in
    /// view.
    fn default() -> Self {
        Self::Orbit([40.0, 20.0, 1.25])
    }
}

/// A view that cannot be parsed.
#[derive(Debug, thiserror::Error)]
#[error("{0:?} is not a camera: orbit:AZIMUTH,ELEVATION,DISTANCE or X,Y,Z;X,Y,Z;FOV (eye; target; degrees)")]
pub struct CameraError(String);

impl std::str::FromStr for View {
    type Err = CameraError;

    fn from_str(text: &str) -> Result<Self, CameraError> {
        let error = || CameraError(text.to_owned());
        let numbers = |text: &str| -> Option<[f64; 3]> {
            let numbers: Vec<f64> = text.split(',').map(|v| v.trim().parse().ok()).collect::<Option<_>>()?;
            numbers.try_into().ok().filter(|n: &[f64; 3]| n.iter().all(|v| v.is_finite()))
        };
        if let Some(orbit) = text.strip_prefix("orbit:") {
            return numbers(orbit).filter(|o| o[2] > 0.0).map(View::Orbit).ok_or_else(error);
        }
        let parts: Vec<&str> = text.split(';').collect();
        let [eye, target, fov] = parts[..] else { return Err(error()) };
        let fov = fov.trim().parse().ok().filter(|f| (1.0..170.0).contains(f)).ok_or_else(error)?;
        let (eye, target) = numbers(eye).zip(numbers(target)).filter(|(e, t)| e != t).ok_or_else(error)?;
        Ok(View::Fixed(Camera { eye, target, fov }))
    }
}

/// The vertical angle of view of an orbit.
const FOV: f64 = 45.0;

impl View {
    /// The camera for a box. Of a box of no size it is a world unit away.
    pub fn camera(&self, bounds: &WorldBox) -> Camera {
        let [azimuth, elevation, distance] = match *self {
            Self::Fixed(camera) => return camera,
            Self::Orbit(orbit) => orbit,
        };
        let target = bounds.middle();
        let diagonal = bounds.diagonal();
        let distance = distance * if diagonal > 0.0 { diagonal } else { 1.0 };
        let (azimuth, elevation) = (azimuth.to_radians(), elevation.to_radians());
        let direction = [azimuth.sin() * elevation.cos(), elevation.sin(), azimuth.cos() * elevation.cos()];
        Camera { eye: std::array::from_fn(|a| target[a] + direction[a] * distance), target, fov: FOV }
    }
}

/// Rays of a picture in cell space: `t` is distance in world units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lens {
    /// The eye in cell space.
    pub origin: [f64; 3],
    /// The ray through the middle of the picture, in cell space.
    pub forward: [f64; 3],
    /// From there to the right edge and to the top.
    pub right: [f64; 3],
    /// See `right`.
    pub up: [f64; 3],
    /// World space lengths of forward, right and up are 1, `half_width`, `half_height`.
    pub half_width: f64,
    /// See `half_width`.
    pub half_height: f64,
}

impl Lens {
    /// The camera's rays for pictures of that size. `shift` moves index space to cell space. `None` if
    /// the matrix cannot be inverted.
    pub fn new(camera: &Camera, matrix: &[f64; 16], size: [u32; 2], shift: [f64; 3]) -> Option<Self> {
        let inverse = invert3(matrix)?;
        let forward = normalise(sub(camera.target, camera.eye));
        // Straight up or down has no up of its own.
        let world_up = if forward[1].abs() > 0.999 { [0.0, 0.0, 1.0] } else { [0.0, 1.0, 0.0] };
        let right = normalise(cross(forward, world_up));
        let up = cross(right, forward);
        let half_height = (camera.fov.to_radians() / 2.0).tan();
        let half_width = half_height * f64::from(size[0]) / f64::from(size[1]);
        let translation = [matrix[12], matrix[13], matrix[14]];
        let to_cell = |v: [f64; 3]| apply3(&inverse, v);
        Some(Self {
            origin: {
                let index = to_cell(sub(camera.eye, translation));
                std::array::from_fn(|a| index[a] + shift[a])
            },
            forward: to_cell(forward),
            right: to_cell(right.map(|v| v * half_width)),
            up: to_cell(up.map(|v| v * half_height)),
            half_width,
            half_height,
        })
    }

    /// The ray through a place of the picture, −1 to 1 from left to right and from bottom to top, in the
    /// arithmetic that the shader uses.
    pub fn ray<F: Real>(&self, x: f64, y: f64) -> Ray<F> {
        let f = F::from_f64;
        let (x, y) = (f(x), f(y));
        let (w, h) = (f(self.half_width), f(self.half_height));
        let length = (F::from_i32(1) + x * w * (x * w) + y * h * (y * h)).sqrt();
        let direction = |a: usize| (f(self.forward[a]) + f(self.right[a]) * x + f(self.up[a]) * y) / length;
        Ray::new(self.origin.map(f), std::array::from_fn(direction))
    }
}

fn transform(m: &[f64; 16], p: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|c| p[0] * m[c] + p[1] * m[4 + c] + p[2] * m[8 + c] + m[12 + c])
}

/// Row vector times a 3 × 3 matrix.
pub fn apply3(m: &[[f64; 3]; 3], v: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|c| v[0] * m[0][c] + v[1] * m[1][c] + v[2] * m[2][c])
}

/// The inverse of the upper left 3 × 3.
pub fn invert3(m: &[f64; 16]) -> Option<[[f64; 3]; 3]> {
    let row = |r: usize| [m[4 * r], m[4 * r + 1], m[4 * r + 2]];
    let [a, b, c] = [row(0), row(1), row(2)];
    let columns = [cross(b, c), cross(c, a), cross(a, b)];
    let determinant = dot(a, columns[0]);
    let ok = determinant.is_finite() && determinant != 0.0;
    ok.then(|| std::array::from_fn(|r| std::array::from_fn(|col| columns[col][r] / determinant)))
}

pub fn sub(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|i| a[i] - b[i])
}

pub fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|i| a[i] * b[i]).sum()
}

pub fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

pub fn length(v: [f64; 3]) -> f64 {
    dot(v, v).sqrt()
}

/// A vector of length 1, or one of length 0 as it is.
pub fn normalise(v: [f64; 3]) -> [f64; 3] {
    let l = length(v);
    if l > 0.0 { v.map(|c| c / l) } else { v }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn views_are_parsed() {
        assert_eq!("orbit:10,20,1.5".parse::<View>().unwrap(), View::Orbit([10.0, 20.0, 1.5]));
        let fixed = Camera { eye: [1.0, 2.0, 3.0], target: [0.0; 3], fov: 45.0 };
        assert_eq!("1,2,3;0,0,0;45".parse::<View>().unwrap(), View::Fixed(fixed));
        for bad in ["", "orbit:1,2", "orbit:1,2,0", "1,2,3;1,2,3;45", "1,2,3;0,0,0;0", "1,2,x;0,0,0;45"] {
            assert!(bad.parse::<View>().is_err(), "{bad}");
        }
    }

    #[test]
    fn the_middle_ray_meets_the_target() {
        // A rotated, sheared and moved grid.
        let m = [0.7, 0.1, -0.7, 0.0, 0.0, 2.0, 0.3, 0.0, 0.7, 0.0, 0.7, 0.0, 5.0, -3.0, 1.0, 1.0];
        let voxels = CoordBox::cube(crate::volume::Coord::new(-8, 0, 16), 32);
        let camera = View::default().camera(&WorldBox::around([(voxels, &m)]));
        let lens = Lens::new(&camera, &m, [64, 32], [0.0; 3]).unwrap();
        let ray = lens.ray::<f64>(0.0, 0.0);
        let t = length(sub(camera.target, camera.eye));
        for (a, middle) in [7.5, 15.5, 31.5].into_iter().enumerate() {
            assert!((ray.origin[a] + ray.direction[a] * t - middle).abs() < 1e-9);
        }
    }
}
