//! What a picture shows and how, and what follows from it for all pixels: the input of both tracers.

use super::black_body::black_body;
use super::camera::{Camera, Lens, WorldBox, apply3, dot, invert3, length, normalise};
use super::light::Light;
use super::traverse::{Box3, MAX_CELL};
use super::{Interpolation, Mode, Traversal};
use crate::pack::Grid;
use crate::settings::{Step, Up, View};
use crate::volume::{CoordBox, L2_DIM};

/// What a picture shows, from where, and how it looks.
#[derive(Clone, Copy, Debug)]
pub struct Scene {
    /// What a picture shows.
    pub mode: Mode,
    /// How rays step.
    pub traversal: Traversal,
    /// Where it is taken from.
    pub camera: Camera,
    /// Width and height in pixels.
    pub size: [u32; 2],
    /// Index space to world space.
    pub matrix: [f64; 16],
    /// Whether the grid's zero is a surface.
    pub level_set: bool,
    /// How the grid is interpolated between voxels.
    pub interpolation: Interpolation,
    /// How fog is ray-marched.
    pub march: March,
    /// The lights of fog.
    pub light: Light,
    /// The emissive grid of lit fog.
    pub emission: Option<Emission>,
    /// Optical depth of a density of 1 over a world unit.
    pub extinction: f64,
    /// Densities above this are a hit.
    pub threshold: f32,
}

/// How fog is ray-marched.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct March {
    /// The distance between two samples.
    pub step: Step,
    /// Whether each pixel's samples are offset by a hash, which turns banding into noise.
    pub jitter: bool,
}

impl Default for March {
    /// Half a voxel, as in NanoVDB's example, so that no voxel is skipped.
    fn default() -> Self {
        Self { step: Step::Voxels(0.5), jitter: false }
    }
}

/// An emissive grid.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Emission {
    /// Its place in the pack.
    pub grid: usize,
    /// Its frame.
    pub frame: usize,
    /// Its index space to world space.
    pub matrix: [f64; 16],
    /// 1 divided by the value at which `ramp` ends.
    pub per_unit: f64,
    /// Emission per world unit for values from 0 on, in linear sRGB.
    pub ramp: [[f32; 3]; RAMP_STEPS],
}

/// Entries of a ramp, which is interpolated linearly: enough for a smooth change from dark red to yellow.
pub const RAMP_STEPS: usize = 64;
/// Radiance of the hottest value over a tenth of the box's diagonal. It is much brighter than fog in the sun, because a fire
/// is seen through its smoke.
const GLOW: f64 = 20.0;
/// A grid whose values are all below this is not in kelvin.
const LEAST_KELVIN: f32 = 100.0;
/// The temperature below which nothing glows visibly (Draper, 1847).
const DRAPER_POINT: f64 = 798.0;
/// The temperature of the highest value of such a grid: a yellow flame.
const FLAME_KELVIN: f64 = 1900.0;

impl Emission {
    /// The emission of a grid of temperatures or flames: black bodies, whose radiance grows with the fourth power of their
    /// temperature (Stefan and Boltzmann). `kelvin` is the temperature at value 1. Without it, a grid with values above 100
    /// is in kelvin, and the highest value of any other grid is a yellow flame. `None` if nothing is hot enough to glow.
    ///
    /// # Panics
    /// When there is no such frame.
    pub fn new(
        grids: &[Grid],
        grid: usize,
        frame: usize,
        kelvin: Option<f64>,
        strength: f64,
    ) -> Option<Self> {
        let of = &grids[grid];
        let hottest = of.record.active_max.max(f32::MIN_POSITIVE);
        let is_kelvin = hottest > LEAST_KELVIN;
        let per_value = if is_kelvin { 1.0 } else { FLAME_KELVIN / f64::from(hottest) };
        let kelvin = kelvin.unwrap_or(per_value) * f64::from(hottest);
        if kelvin < DRAPER_POINT {
            return None;
        }
        let diagonal = WorldBox::of_grid(of).diagonal();
        let brightest = if diagonal > 0.0 { strength * GLOW / (0.1 * diagonal) } else { 0.0 };
        let ramp = std::array::from_fn(|i| {
            let part = i as f64 / (RAMP_STEPS - 1) as f64;
            if part * kelvin < DRAPER_POINT {
                return [0.0; 3];
            }
            black_body(part * kelvin).map(|c| (c * brightest * part.powi(4)) as f32)
        });
        let matrix = of.frames[frame].record.transform;
        Some(Self { grid, frame, matrix, per_unit: 1.0 / f64::from(hottest), ramp })
    }
}

/// Optical depth through a whole box at its highest density: dense enough to see a surface, thin enough
/// to see into it.
const BOX_DEPTH: f64 = 24.0;
/// Densities above this part of the highest are a hit.
const HIT_DENSITY: f32 = 0.05;

impl Scene {
    /// A picture of a frame of a pack, or of its source. Camera, extinction and threshold are one for all frames of the
    /// grid and come from what its tables say of the source, so packs of one source are pictured alike whatever they lost.
    ///
    /// # Panics
    /// When there is no such frame.
    pub fn new(grid: &Grid, frame: usize, view: &View, mode: Mode, size: [u32; 2]) -> Self {
        let bounds = WorldBox::of_grid(grid);
        // What is below 0 absorbs nothing.
        let densest = grid.record.active_max.max(0.0);
        let depth = bounds.diagonal() * f64::from(densest);
        let level_set = grid.is_level_set();
        Self {
            mode,
            traversal: Traversal::default(),
            camera: view.camera(&bounds, Up::of_box(&bounds), size),
            size,
            matrix: grid.frames[frame].record.transform,
            level_set,
            // Exact for fog.
            interpolation: if level_set { Interpolation::Trilinear } else { Interpolation::Nearest },
            march: March::default(),
            light: Light::default(),
            emission: None,
            extinction: if depth > 0.0 { BOX_DEPTH / depth } else { 0.0 },
            threshold: HIT_DENSITY * densest,
        }
    }

    /// Whether cells lie between voxels, which are their corners; else they are voxels.
    pub(super) fn is_trilinear(&self) -> bool {
        match self.mode {
            _ if self.level_set => self.interpolation == Interpolation::Trilinear,
            Mode::Density => self.interpolation == Interpolation::Trilinear,
            // Lit fog is sampled as games do.
            mode => mode == Mode::Lit,
        }
    }
}

/// Towards the sun of a level set: right, up, front.
const SUN: [f64; 3] = [0.48, 0.80, 0.36];
/// Light that reaches shadows.
pub const AMBIENT: f64 = 0.15;
/// A shadow ray begins this many cells off the surface, so that the surface does not shade itself.
const SHADOW_OFFSET: f64 = 1.5;
/// Voxels between two points of the light grid, if the box is small enough. Shadows in fog are soft, and half the
/// resolution takes an eighth of the time.
const LIGHT_SPACING: i32 = 2;
/// Maximum number of points of the light grid: 2 MiB, and a second or two of one core.
const MAX_LIGHT_POINTS: usize = 1 << 19;
/// Maximum number of nodes that their rays cross. It makes the grid coarser in boxes of many thousand voxels.
const MAX_LIGHT_STEPS: usize = 1 << 25;
/// Nodes of fog that such a ray crosses, beside the empty nodes of 128 voxels of the box.
const FOG_STEPS: usize = 32;
/// Steps after which a ray is given up: more than any box in view has cells across.
pub const MAX_STEPS: u32 = 1 << 16;

/// Why a frame cannot be traced.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum TraceError {
    /// The scene's matrix has no inverse.
    #[error("the grid's transform cannot be inverted")]
    Transform,
    /// The box of what is not background is too wide for the tracers' arithmetic.
    #[error("its voxels lie in a box {0} voxels wide, and pictures are drawn of at most {MAX_CELL}")]
    TooWide(i64),
    /// Rays would take more samples than a ray may.
    #[error(
        "the step of the ray march is too small: rays would take more than {MAX_STEPS} samples; use a larger --step"
    )]
    StepTooSmall,
}

/// What both tracers need and is the same for all pixels. Cells are counted from `base`, so that
/// an `f32` has as many bits for a volume far from the origin as for one around it.
pub struct Setup {
    /// The voxel that cell 0 is.
    pub base: [i32; 3],
    /// The cells to trace.
    pub bounds: Box3,
    /// The camera's rays.
    pub lens: Lens,
    /// Towards the sun, in cell space, as long as shadow rays begin off the surface.
    pub sun: [f64; 3],
    /// For a gradient in cell space, rows whose products are the normal in world space.
    pub normals: [[f64; 3]; 3],
    /// Towards the sun of a level set, in world space.
    pub sun_world: [f64; 3],
    /// The step of the ray march, in world units or in cells.
    pub step: f64,
    /// Whether the step is in cells.
    pub step_in_cells: bool,
    /// Towards the sun of fog, in cells a world unit.
    pub to_sun: [f64; 3],
    /// Its product with a ray's direction in cells is the cosine of the angle between ray and sun.
    pub sun_cosine: [f64; 3],
    /// Unoccluded sunlight times the albedo.
    pub sun_light: [f64; 3],
    /// Sky light times the albedo.
    pub sky_light: [f64; 3],
    /// Cells between two points of the light grid, whose first point is the box's first corner.
    pub light_spacing: i32,
    /// Points of the light grid along each axis. The last ones lie on the box's end or behind it.
    pub light_points: [usize; 3],
    /// Rows of the matrix from cells to the index space of the emissive grid.
    pub to_emission: [[f64; 4]; 3],
}

impl Setup {
    /// `voxels` is the box of everything that is not background.
    ///
    /// # Errors
    /// [`TraceError`].
    pub fn new(scene: &Scene, voxels: CoordBox) -> Result<Self, TraceError> {
        let (base, size) = if voxels.is_empty() {
            ([0; 3], [0; 3])
        } else {
            let size = |a: usize| i64::from(voxels.max.0[a]) - i64::from(voxels.min.0[a]) + 1;
            (voxels.min.0, std::array::from_fn(size))
        };
        if let Some(wide) = size.into_iter().find(|size| *size > i64::from(MAX_CELL)) {
            return Err(TraceError::TooWide(wide));
        }
        let bounds = Box3 { min: [0; 3], max: size.map(|size| size as i32) };
        let bounds = if scene.is_trilinear() { bounds.grown() } else { bounds };
        let shift = if scene.is_trilinear() { 0.0 } else { 0.5 };
        let shift = base.map(|b| shift - f64::from(b));
        let lens = Lens::new(&scene.camera, &scene.matrix, scene.size, shift).ok_or(TraceError::Transform)?;
        // world = index · M, so gradients go by the inverse transposed: row r of it is what index
        // axis a has of world axis r.
        let inverse = invert3(&scene.matrix).ok_or(TraceError::Transform)?;
        let up = scene.camera.up;
        let sun_world = normalise(up.to_world(SUN));
        let sun = apply3(&inverse, sun_world);
        let sun = sun.map(|v| v * SHADOW_OFFSET / length(sun));
        let fog_sun = scene.light.to_sun(up);
        let row = |r: usize| std::array::from_fn(|c| scene.matrix[4 * r + c]);
        let (light_spacing, light_points) = light_grid(bounds);
        let to_sun = apply3(&inverse, fog_sun);
        let (step, step_in_cells) = match scene.march.step {
            Step::Voxels(step) => (step, true),
            Step::World(step) => (step, false),
        };
        let step_cells = if step_in_cells { step } else { step * length(to_sun) };
        let longest = length(bounds.max.map(f64::from));
        if scene.is_trilinear() && !scene.level_set && longest / step_cells > f64::from(MAX_STEPS) {
            return Err(TraceError::StepTooSmall);
        }
        Ok(Self {
            base,
            bounds,
            lens,
            sun,
            normals: inverse,
            sun_world,
            step,
            step_in_cells,
            to_sun,
            sun_cosine: std::array::from_fn(|r| dot(row(r), fog_sun)),
            sun_light: scene.light.sun_light(),
            sky_light: scene.light.sky_light(),
            light_spacing,
            light_points,
            to_emission: match &scene.emission {
                Some(emission) => to_emission(&scene.matrix, &emission.matrix, base)?,
                None => [[0.0; 4]; 3],
            },
        })
    }
}

/// Spacing of the light grid of a box, and its points along each axis.
fn light_grid(bounds: Box3) -> (i32, [usize; 3]) {
    let points = |spacing: i32| -> [usize; 3] {
        std::array::from_fn(|a| {
            let cells = (bounds.max[a] - bounds.min[a]).max(1) as usize;
            cells.div_ceil(spacing as usize) + 1
        })
    };
    let across: usize = (0..3).map(|a| (bounds.max[a] - bounds.min[a]).max(0) as usize).sum();
    let most = MAX_LIGHT_POINTS.min(MAX_LIGHT_STEPS / (across / L2_DIM as usize + FOG_STEPS));
    let is_enough = |spacing: &i32| {
        let points = points(*spacing);
        points.into_iter().try_fold(1usize, usize::checked_mul).is_some_and(|n| n <= most)
    };
    // A box is at most MAX_CELL wide, and two points an axis are few enough in any box.
    let spacing = (LIGHT_SPACING..=MAX_CELL).find(is_enough).unwrap_or(MAX_CELL);
    (spacing, points(spacing))
}

/// The matrix from the cells of a grid, counted from `base`, to the index space of another grid.
fn to_emission(from: &[f64; 16], to: &[f64; 16], base: [i32; 3]) -> Result<[[f64; 4]; 3], TraceError> {
    let inverse = invert3(to).ok_or(TraceError::Transform)?;
    let row = |r: usize| [from[4 * r], from[4 * r + 1], from[4 * r + 2]];
    let axes = [0, 1, 2].map(|r| apply3(&inverse, row(r)));
    let moved = std::array::from_fn(|c| from[12 + c] - to[12 + c]);
    let base = base.map(f64::from);
    let origin = apply3(&inverse, moved);
    let at_base = |c: usize| origin[c] + (0..3).map(|r| base[r] * axes[r][c]).sum::<f64>();
    Ok(std::array::from_fn(|c| [axes[0][c], axes[1][c], axes[2][c], at_base(c)]))
}
