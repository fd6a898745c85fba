//! Replaces the wgpu tracer in a build without the feature `gpu`: no device is available, so the CPU traces.

use std::convert::Infallible;

use super::image::Image;
use super::scene::Scene;
use crate::pack::Pack;
use crate::volume::CoordBox;

pub use super::gpu_error::GpuError;

/// A device that cannot exist.
#[allow(missing_docs)] // As those of the wgpu tracer.
pub struct Gpu {
    pub name: String,
    pub is_software: bool,
    never: Infallible,
}

/// A pack on a device that cannot exist.
pub enum Uploaded {}

#[allow(missing_docs)] // As those of the wgpu tracer.
impl Gpu {
    pub fn shared() -> Result<&'static Self, GpuError> {
        Err(GpuError::Unavailable("built without the gpu feature".to_owned()))
    }

    pub fn identity() -> Option<&'static str> {
        None
    }

    pub fn would_be_software() -> bool {
        false
    }

    pub fn upload(&self, _: &Pack) -> Result<Uploaded, GpuError> {
        match self.never {}
    }

    pub fn trace(&self, _: &Uploaded, _: [u32; 2], _: CoordBox, _: &Scene) -> Result<Image, GpuError> {
        match self.never {}
    }

    pub fn trace_timed(
        &self,
        _: &Uploaded,
        _: [u32; 2],
        _: CoordBox,
        _: &Scene,
        _: u32,
    ) -> Result<(Image, Vec<f64>), GpuError> {
        match self.never {}
    }
}
