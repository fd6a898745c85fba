//! Chooses between the tracers.

use clap::ValueEnum;
use serde::Serialize;

use super::Mode;
use super::cpu::{Medium, trace};
use super::decoded_frame::DecodedFrame;
use super::extinction::body_extinction;
use super::gpu::{Gpu, GpuError, Uploaded};
use super::image::Image;
use super::scene::Scene;
use crate::pack::{FrameReader, Pack};
use crate::settings::View;

/// What traces a picture.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, ValueEnum)]
pub enum Device {
    /// A GPU if there is one, else software Vulkan or the CPU
    #[default]
    Auto,
    /// A GPU or software Vulkan
    Gpu,
    /// The CPU tracer
    Cpu,
}

/// Traces frames of one pack.
pub struct Renderer<'a> {
    pack: &'a Pack,
    device: Device,
    gpu: Option<(&'static Gpu, Uploaded)>,
    /// Why it is the CPU though a GPU would have been welcome.
    pub fallback: Option<String>,
}

impl<'a> Renderer<'a> {
    /// Opens a device and uploads the pack to it.
    ///
    /// # Errors
    /// With [`Device::Gpu`], when there is none or it cannot hold the pack.
    pub fn new(pack: &'a Pack, device: Device) -> Result<Self, GpuError> {
        if device == Device::Cpu {
            return Ok(Self { pack, device, gpu: None, fallback: None });
        }
        let opened = Gpu::shared().and_then(|gpu| {
            let uploaded = gpu.upload(pack)?;
            Ok((gpu, uploaded))
        });
        match opened {
            Ok(gpu) => Ok(Self { pack, device, gpu: Some(gpu), fallback: None }),
            Err(GpuError::Pack(e)) => Err(GpuError::Pack(e)),
            Err(e) if device == Device::Auto => {
                Ok(Self { pack, device, gpu: None, fallback: Some(e.to_string()) })
            }
            Err(e) => Err(e),
        }
    }

    /// The same, except that [`Device::Auto`] prefers the CPU tracer to software Vulkan, which is slower and takes seconds
    /// to start.
    ///
    /// # Errors
    /// See [`Renderer::new`].
    pub fn fastest(pack: &'a Pack, device: Device) -> Result<Self, GpuError> {
        let device = match device {
            Device::Auto if Gpu::would_be_software() => Device::Cpu,
            asked => asked,
        };
        Self::new(pack, device)
    }

    /// The name of what traces.
    pub fn device_name(&self) -> &str {
        self.gpu.as_ref().map_or("CPU tracer", |(gpu, _)| &gpu.name)
    }

    /// Whether it is a GPU, or software that stands for one.
    pub fn is_gpu(&self) -> bool {
        self.gpu.is_some()
    }

    /// An extinction for lit pictures of a grid, from its frame with the most voxels: see [`body_extinction`].
    ///
    /// # Errors
    /// When a chunk of the pack is damaged, or the frame cannot be traced.
    pub fn body_extinction(&self, grid: usize) -> Result<Option<f64>, GpuError> {
        let of = &self.pack.grids()[grid];
        let Some(frame) = (0..of.frames.len()).max_by_key(|&f| of.frames[f].record.active_voxels) else {
            return Ok(None);
        };
        // One view for all pictures, so that fog is as dense from wherever it is seen.
        let scene = Scene::new(of, frame, &View::default(), Mode::Density, [1; 2]);
        Ok(body_extinction(&DecodedFrame::from_pack(&self.pack.frame(grid, frame)?)?, &scene)?)
    }

    /// Traces a frame of a grid.
    ///
    /// # Errors
    /// When a chunk of the pack is damaged or the device fails.
    pub fn render(&self, grid: usize, frame: usize, scene: &Scene) -> Result<Image, GpuError> {
        let reader = self.pack.frame(grid, frame)?;
        match &self.gpu {
            Some((gpu, uploaded)) => {
                let traced = gpu.trace(uploaded, [grid as u32, frame as u32], reader.bounds(), scene);
                match traced {
                    // A picture too large for the adapter.
                    Err(GpuError::Lacks { .. }) if self.device == Device::Auto => self.on_cpu(&reader, scene),
                    traced => traced,
                }
            }
            None => self.on_cpu(&reader, scene),
        }
    }

    fn on_cpu(&self, reader: &FrameReader, scene: &Scene) -> Result<Image, GpuError> {
        let emission = match &scene.emission {
            Some(other) => Some(DecodedFrame::from_pack(&self.pack.frame(other.grid, other.frame)?)?),
            None => None,
        };
        let frame = DecodedFrame::from_pack(reader)?;
        Ok(trace::<f32>(Medium { frame: &frame, emission: emission.as_ref() }, scene)?)
    }
}
