//! What a picture shows and how, and what follows from it for all pixels: the input of both tracers.

use super::camera::{Camera, Lens, View, WorldBox, apply3, invert3, length, normalise};
use super::traverse::{Box3, MAX_CELL};
use super::{Interpolation, Mode, Traversal};
use crate::pack::Grid;
use crate::volume::CoordBox;

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
    /// How a level set is interpolated between voxels.
    pub interpolation: Interpolation,
    /// Optical depth of a density of 1 over a world unit.
    pub extinction: f64,
    /// Densities above this are a hit.
    pub threshold: f32,
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
        Self {
            mode,
            traversal: Traversal::default(),
            camera: view.camera(&bounds),
            size,
            matrix: grid.frames[frame].record.transform,
            level_set: grid.is_level_set(),
            interpolation: Interpolation::default(),
            extinction: if depth > 0.0 { BOX_DEPTH / depth } else { 0.0 },
            threshold: HIT_DENSITY * densest,
        }
    }

    /// Whether cells lie between voxels, which are their corners; else they are voxels.
    pub(super) fn is_trilinear(&self) -> bool {
        self.level_set && self.interpolation == Interpolation::Trilinear
    }
}

/// Towards the sun, in world space.
const SUN: [f64; 3] = [0.48, 0.80, 0.36];
/// Light that reaches shadows.
pub const AMBIENT: f64 = 0.15;
/// A shadow ray begins this many cells off the surface, so that the surface does not shade itself.
const SHADOW_OFFSET: f64 = 1.5;
/// Why a frame cannot be traced.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum TraceError {
    /// The scene's matrix has no inverse.
    #[error("the grid's transform cannot be inverted")]
    Transform,
    /// The box of what is not background is too wide for the tracers' arithmetic.
    #[error("its voxels lie in a box {0} voxels wide, and pictures are drawn of at most {MAX_CELL}")]
    TooWide(i64),
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
    /// Towards the sun, in world space.
    pub sun_world: [f64; 3],
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
        let sun_world = normalise(SUN);
        let sun = apply3(&inverse, sun_world);
        let sun = sun.map(|v| v * SHADOW_OFFSET / length(sun));
        Ok(Self { base, bounds, lens, sun, normals: inverse, sun_world })
    }
}
