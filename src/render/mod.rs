//! Pictures: a CPU tracer that is slow and obviously right, and a wgpu tracer that reads a pack as an
//! engine does.
//!
//! Both trace the same rays through the same unit cells and write the same numbers, so that pictures of
//! a pack can be compared with pictures of its source, and the shader with the CPU.
//!
//! Space: a fog voxel (i, j, k) is the cube around its index coordinate, so rays are moved by half a
//! voxel and then voxel (i, j, k) is the *cell* from (i, j, k) to (i + 1, j + 1, k + 1). A level set is
//! sampled at index coordinates and interpolated between them: its cells have eight voxels as corners,
//! unless [`Interpolation::Nearest`] is asked for.

mod black_body;
mod camera;
mod cpu;
mod decoded_frame;
mod extinction;
#[cfg(feature = "gpu")]
pub mod gpu;
#[cfg(not(feature = "gpu"))]
#[path = "no_gpu.rs"]
pub mod gpu;
mod gpu_error;
mod image;
mod light;
mod renderer;
mod scene;
mod surface;
mod traverse;

pub use camera::{Camera, Lens, WorldBox};
pub use cpu::{Medium, optical_depths, spread, trace, trace_noting_gpu_spread};
pub use decoded_frame::DecodedFrame;
pub use extinction::body_extinction;
pub use image::{Difference, Image, apart, difference, write_apng, write_png};
pub use light::{Light, SOOTY_ALBEDO};
pub use renderer::{Device, Renderer};
pub use scene::{Emission, March, Scene, TraceError};
pub use traverse::{Box3, Ray, Real, Walk};

use clap::ValueEnum;

use crate::pack::Grid;
pub use crate::settings::{Step, Up, View};

/// What a picture shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Mode {
    /// Density added up along the ray, as opacity (Beer-Lambert); level sets: the same as lit
    Density,
    /// Distance to the first hit
    Depth,
    /// Density of the first hit; level sets: 1
    First,
    /// A hue for each brick that is hit first
    Bricks,
    /// How many steps a ray took
    Steps,
    /// The boundaries of the first node hit: L3 cyan, L2 red, L1 blue
    Nodes,
    /// The normal of the face through which the first hit was entered; level sets: of the surface
    Normals,
    /// Lit by a sun, with shadows; fog: single scattering and emission
    Lit,
}

impl Mode {
    /// Every mode.
    pub const ALL: [Self; 8] = [
        Self::Density,
        Self::Depth,
        Self::First,
        Self::Bricks,
        Self::Steps,
        Self::Nodes,
        Self::Normals,
        Self::Lit,
    ];

    /// The mode in which packs are compared with their sources: the opacity of fog, the lit surface of a level set.
    pub fn of_grid(grid: &Grid) -> Self {
        if grid.is_level_set() { Self::Lit } else { Self::Density }
    }

    /// Whether pixels are categories, which two tracers share or do not, rather than measures.
    pub fn is_categorical(self) -> bool {
        matches!(self, Self::Bricks | Self::Steps | Self::Nodes | Self::Normals)
    }
}

/// How a grid is interpolated between voxels.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Interpolation {
    /// The nearest voxel: with --mode density, fog is integrated exactly, voxel by voxel; a level set's surface is made of
    /// voxel faces
    Nearest,
    /// Trilinear, as games sample it: fog is ray-marched in equal steps, a level set's surface is smooth
    Trilinear,
}

/// How a ray steps.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum Traversal {
    /// Cell by cell
    Dda,
    /// Over every empty or constant node in one step
    #[default]
    Hdda,
}
