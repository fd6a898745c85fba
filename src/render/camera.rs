//! Where pictures are taken from.

use super::traverse::{Ray, Real};
use crate::pack::Grid;
use crate::settings::{Up, View};
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
        length(self.size())
    }

    fn size(&self) -> [f64; 3] {
        sub(self.max, self.min)
    }

    fn middle(&self) -> [f64; 3] {
        std::array::from_fn(|a| f64::midpoint(self.min[a], self.max[a]))
    }
}

impl Up {
    /// A guess from the shape, because a pack does not contain the axis. Smoke, clouds and explosions are about as wide as
    /// they are deep, so up is the one of y and z around which the box is closer to a square; y if both are equal.
    pub fn of_box(bounds: &WorldBox) -> Self {
        let [x, y, z] = bounds.size();
        let unlike = |a: f64, b: f64| a.max(b) / a.min(b);
        // Where a side is 0 the comparison is false.
        if unlike(x, y) < unlike(x, z) { Self::Z } else { Self::Y }
    }

    /// A direction given as right, up and towards the viewer in front, in world space. With z up the front is at -y, as in
    /// Blender.
    pub fn to_world(self, [right, up, front]: [f64; 3]) -> [f64; 3] {
        match self {
            Self::X => [up, right, -front],
            Self::Y => [right, up, front],
            Self::Z => [right, -front, up],
        }
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
    /// What is up in the picture.
    pub up: Up,
}

impl Default for View {
    /// From ahead, above and to the side, one and a quarter diagonals away, with all of the box in
    /// view.
    fn default() -> Self {
        Self::Orbit { azimuth: 40.0, elevation: 20.0, distance: Some(1.25) }
    }
}

/// The vertical angle of view of an orbit.
const FOV: f64 = 45.0;

/// Free margin around a fitted box, as a fraction of half the picture.
const MARGIN: f64 = 0.04;

impl View {
    /// The camera for a box, in pictures of a size. Of a box of no size it is a world unit away.
    pub fn camera(&self, bounds: &WorldBox, up: Up, size: [u32; 2]) -> Camera {
        let (azimuth, elevation, distance) = match *self {
            Self::Fixed { eye, target, fov } => return Camera { eye, target, fov, up },
            Self::Orbit { azimuth, elevation, distance } => (azimuth, elevation, distance),
        };
        let target = bounds.middle();
        let back = up.to_world(direction(azimuth, elevation));
        let at = |distance: f64| {
            let distance = if distance > 0.0 { distance } else { 1.0 };
            Camera { eye: std::array::from_fn(|a| target[a] + back[a] * distance), target, fov: FOV, up }
        };
        let Some(diagonals) = distance else {
            return at(fitting_distance(bounds, at(1.0).axes(), half_size(FOV, size)));
        };
        at(diagonals * bounds.diagonal())
    }
}

/// How far from its middle a box is seen whole, along the axes right, up and forward.
fn fitting_distance(bounds: &WorldBox, axes: [[f64; 3]; 3], half_size: [f64; 2]) -> f64 {
    let half = bounds.size().map(|s| s / 2.0);
    let corners =
        (0..8).map(|i: u32| std::array::from_fn(|a| if i >> a & 1 == 1 { half[a] } else { -half[a] }));
    let distance = |corner: [f64; 3]| {
        let [right, up, forward] = axes.map(|axis| dot(axis, corner));
        let [width, height] = half_size.map(|s| s * (1.0 - MARGIN));
        (right.abs() / width).max(up.abs() / height) - forward
    };
    corners.map(distance).fold(0.0, f64::max)
}

/// Half the width and the height of a picture, a unit away.
fn half_size(fov: f64, size: [u32; 2]) -> [f64; 2] {
    let height = (fov.to_radians() / 2.0).tan();
    [height * f64::from(size[0]) / f64::from(size[1]), height]
}

impl Camera {
    /// Right, up and forward, in world space.
    fn axes(&self) -> [[f64; 3]; 3] {
        let forward = normalise(sub(self.target, self.eye));
        let upwards = self.up.to_world([0.0, 1.0, 0.0]);
        // Straight up or down has no up of its own.
        let is_vertical = dot(forward, upwards).abs() > 0.999;
        let upwards = if is_vertical { self.up.to_world([0.0, 0.0, 1.0]) } else { upwards };
        let right = normalise(cross(forward, upwards));
        [right, cross(right, forward), forward]
    }
}

/// The direction of an azimuth and an elevation in degrees: right, up, front.
pub fn direction(azimuth: f64, elevation: f64) -> [f64; 3] {
    let (azimuth, elevation) = (azimuth.to_radians(), elevation.to_radians());
    [azimuth.sin() * elevation.cos(), elevation.sin(), azimuth.cos() * elevation.cos()]
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
        let [right, up, forward] = camera.axes();
        let [half_width, half_height] = half_size(camera.fov, size);
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
    fn the_middle_ray_meets_the_target() {
        // A rotated, sheared and moved grid.
        let m = [0.7, 0.1, -0.7, 0.0, 0.0, 2.0, 0.3, 0.0, 0.7, 0.0, 0.7, 0.0, 5.0, -3.0, 1.0, 1.0];
        let voxels = CoordBox::cube(crate::volume::Coord::new(-8, 0, 16), 32);
        let camera = View::default().camera(&WorldBox::around([(voxels, &m)]), Up::Y, [64, 32]);
        let lens = Lens::new(&camera, &m, [64, 32], [0.0; 3]).unwrap();
        let ray = lens.ray::<f64>(0.0, 0.0);
        let t = length(sub(camera.target, camera.eye));
        for (a, middle) in [7.5, 15.5, 31.5].into_iter().enumerate() {
            assert!((ray.origin[a] + ray.direction[a] * t - middle).abs() < 1e-9);
        }
    }

    #[test]
    fn a_fitted_box_fills_the_picture_and_no_more() {
        let bounds = WorldBox { min: [-1.0, 2.0, 5.0], max: [3.0, 3.0, 11.0] };
        for (size, view) in
            [([64, 64], "orbit:40,20"), ([160, 90], "orbit:-100,-60"), ([30, 90], "orbit:0,90")]
        {
            let camera = view.parse::<View>().unwrap().camera(&bounds, Up::Z, size);
            let [right, up, forward] = camera.axes();
            let [width, height] = half_size(camera.fov, size);
            let reach = (0..8).map(|i: u32| {
                let end = |a: usize| if i >> a & 1 == 1 { bounds.max[a] } else { bounds.min[a] };
                let corner = sub(std::array::from_fn(end), camera.eye);
                let ahead = dot(corner, forward);
                (dot(corner, right).abs() / width).max(dot(corner, up).abs() / height) / ahead
            });
            let farthest = reach.fold(0.0, f64::max);
            assert!((farthest - (1.0 - MARGIN)).abs() < 1e-9, "{view}: {farthest}");
        }
    }

    #[test]
    fn up_is_guessed_from_the_shape() {
        let of = |size: [f64; 3]| Up::of_box(&WorldBox { min: [0.0; 3], max: size });
        // A column of smoke by Blender and one by Houdini, a flat cloud, a cube, a sheet, nothing.
        assert_eq!(of([94.0, 94.0, 190.0]), Up::Z);
        assert_eq!(of([111.0, 222.0, 112.0]), Up::Y);
        assert_eq!(of([126.0, 86.0, 154.0]), Up::Y);
        assert_eq!(of([8.0; 3]), Up::Y);
        assert_eq!([of([8.0, 0.0, 8.0]), of([8.0, 8.0, 0.0]), of([0.0; 3])], [Up::Y, Up::Z, Up::Y]);
    }

    #[test]
    fn whatever_is_up_the_axes_are_a_right_handed_frame() {
        for up in [Up::X, Up::Y, Up::Z] {
            let [r, u, f] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(|axis| up.to_world(axis));
            assert_eq!(cross(r, u), f, "{up:?}");
        }
    }
}
