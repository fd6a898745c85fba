//! The wgpu tracer: a pack's sections uploaded as they lie in the file, and `shaders/` run on them.

mod params;
mod pipelines;

use std::sync::OnceLock;

use bytemuck::Pod;
use wgpu::util::DeviceExt;

use self::params::Params;
use self::pipelines::{Has, LIGHT_WORKGROUP, Pipelines, WORKGROUP};
use super::image::Image;
use super::scene::Scene;
use crate::codec::{Codec, TextureFormat};
use crate::pack::{Atlas, Pack};
use crate::volume::CoordBox;

pub use super::gpu_error::GpuError;

/// `volpack.wgsl` and `hdda.wgsl`, what an engine takes over.
pub const VOLPACK_WGSL: &str =
    concat!(include_str!("shaders/volpack.wgsl"), "\n", include_str!("shaders/hdda.wgsl"));
/// `march.wgsl`, what an engine takes over as well to light fog.
pub const MARCH_WGSL: &str = include_str!("shaders/march.wgsl");
/// `tracer.wgsl`, which goes with it.
pub const TRACER_WGSL: &str = include_str!("shaders/tracer.wgsl");
/// `cubic.wgsl`, with which the tracer finds surfaces.
pub const CUBIC_WGSL: &str = include_str!("shaders/cubic.wgsl");

/// A device that can trace.
pub struct Gpu {
    /// The adapter's name.
    pub name: String,
    /// Whether it is a program on the CPU, whose times say nothing of a GPU.
    pub is_software: bool,
    device: wgpu::Device,
    queue: wgpu::Queue,
    pipelines: Pipelines,
    timestamps: bool,
}

/// A pack on a GPU.
pub struct Uploaded {
    tree: wgpu::Buffer,
    /// In the order of [`Codec::WITH_TEXELS`].
    textures: Vec<wgpu::TextureView>,
    has: Has,
}

impl Gpu {
    /// The best adapter, opened once in a process: software Vulkan takes seconds to compile the shader.
    ///
    /// # Errors
    /// [`GpuError::Unavailable`].
    pub fn shared() -> Result<&'static Self, GpuError> {
        static GPU: OnceLock<Result<Gpu, String>> = OnceLock::new();
        GPU.get_or_init(|| Self::open().map_err(|e| e.to_string()))
            .as_ref()
            .map_err(|e| GpuError::Unavailable(e.clone()))
    }

    /// What would trace, in words that change with the adapter and its driver; `None` where there is none. It is asked
    /// for once in a process, and takes a fraction of [`Gpu::shared`].
    pub fn identity() -> Option<&'static str> {
        static IDENTITY: OnceLock<Option<String>> = OnceLock::new();
        let of = |info: &wgpu::AdapterInfo| {
            format!("{} {} {:?} {}", info.name, info.driver, info.backend, info.driver_info)
        };
        IDENTITY.get_or_init(|| Self::info().map(of)).as_deref()
    }

    /// Whether the best adapter is a program on the CPU. No device is opened for that.
    pub fn would_be_software() -> bool {
        Self::info().is_some_and(|info| info.device_type == wgpu::DeviceType::Cpu)
    }

    fn info() -> Option<&'static wgpu::AdapterInfo> {
        static INFO: OnceLock<Option<wgpu::AdapterInfo>> = OnceLock::new();
        INFO.get_or_init(|| Self::adapter().ok().map(|adapter| adapter.get_info())).as_ref()
    }

    fn adapter() -> Result<wgpu::Adapter, GpuError> {
        // Vulkan, Metal and Direct3D 12 only: the GL backend decodes 3-D BC4 wrong.
        let instance = wgpu::Instance::new(wgpu::InstanceDescriptor {
            backends: wgpu::Backends::VULKAN | wgpu::Backends::METAL | wgpu::Backends::DX12,
            ..wgpu::InstanceDescriptor::new_without_display_handle()
        });
        let options = wgpu::RequestAdapterOptions {
            power_preference: wgpu::PowerPreference::HighPerformance,
            ..Default::default()
        };
        pollster::block_on(instance.request_adapter(&options))
            .map_err(|_| GpuError::Unavailable("no Vulkan device found".to_owned()))
    }

    fn open() -> Result<Self, GpuError> {
        let adapter = Self::adapter()?;
        let info = adapter.get_info();
        let lacks = |what: &str| GpuError::Lacks { adapter: info.name.clone(), what: what.to_owned() };
        let blocks =
            wgpu::Features::TEXTURE_COMPRESSION_BC | wgpu::Features::TEXTURE_COMPRESSION_BC_SLICED_3D;
        if !adapter.features().contains(blocks) {
            return Err(lacks("has no block-compressed 3-D textures"));
        }
        let timestamps = adapter.features().contains(wgpu::Features::TIMESTAMP_QUERY);
        let timing = if timestamps { wgpu::Features::TIMESTAMP_QUERY } else { wgpu::Features::empty() };
        let (device, queue) = pollster::block_on(adapter.request_device(&wgpu::DeviceDescriptor {
            label: Some("volpack"),
            required_features: blocks | timing,
            required_limits: adapter.limits(),
            ..Default::default()
        }))
        .map_err(|e| GpuError::Failed(e.to_string()))?;
        let pipelines = Pipelines::new(&device);
        let is_software = info.device_type == wgpu::DeviceType::Cpu;
        Ok(Self { name: info.name, is_software, device, queue, pipelines, timestamps })
    }

    /// Uploads a pack's tree and texture pages.
    ///
    /// # Errors
    /// [`GpuError::Lacks`] past one of the adapter's limits, which it names.
    pub fn upload(&self, pack: &Pack) -> Result<Uploaded, GpuError> {
        let lacks = |what: String| GpuError::Lacks { adapter: self.name.clone(), what };
        let limits = self.device.limits();
        let tree_bytes = pack.tree().len() as u64 * 4;
        let most = limits.max_storage_buffer_binding_size.min(limits.max_buffer_size);
        if tree_bytes > most {
            return Err(lacks(format!("binds storage of {most} bytes, the pack's tree has {tree_bytes}")));
        }
        let tree = self.device.create_buffer_init(&wgpu::util::BufferInitDescriptor {
            label: Some("tree"),
            contents: bytemuck::cast_slice(pack.tree()),
            usage: wgpu::BufferUsages::STORAGE,
        });
        let mut textures = Vec::new();
        for codec in Codec::WITH_TEXELS {
            textures.push(match pack.atlas(codec) {
                None => self.texture(wgpu::TextureFormat::R8Unorm, [1; 3]).create_view(&Default::default()),
                Some(atlas) => {
                    if atlas.slabs > atlas.page_slabs {
                        let pages = atlas.slabs.div_ceil(atlas.page_slabs);
                        return Err(lacks(format!(
                            "is given one texture page a codec by this tracer, {} has {pages}",
                            codec.name()
                        )));
                    }
                    let size = page_size(atlas);
                    if size.iter().any(|s| *s > limits.max_texture_dimension_3d) {
                        let most = limits.max_texture_dimension_3d;
                        return Err(lacks(format!(
                            "has 3-D textures of {most} texels an axis, a page is {size:?}"
                        )));
                    }
                    self.upload_page(pack, atlas, size)?
                }
            });
        }
        Ok(Uploaded { tree, textures, has: Has::of(pack) })
    }

    fn texture(&self, format: wgpu::TextureFormat, size: [u32; 3]) -> wgpu::Texture {
        self.device.create_texture(&wgpu::TextureDescriptor {
            label: None,
            size: wgpu::Extent3d { width: size[0], height: size[1], depth_or_array_layers: size[2] },
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D3,
            format,
            usage: wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST,
            view_formats: &[],
        })
    }

    /// One copy a slab, each a range of the page's slices.
    fn upload_page(&self, pack: &Pack, atlas: &Atlas, size: [u32; 3]) -> Result<wgpu::TextureView, GpuError> {
        let layout = atlas.codec.layout();
        let slices = layout.slices as u32;
        let texture = self.texture(texture_format(atlas.codec), size);
        for slab in 0..atlas.slabs {
            self.queue.write_texture(
                wgpu::TexelCopyTextureInfo {
                    texture: &texture,
                    mip_level: 0,
                    origin: wgpu::Origin3d { x: 0, y: 0, z: slab * slices },
                    aspect: wgpu::TextureAspect::All,
                },
                &pack.slab(atlas.codec, slab)?,
                wgpu::TexelCopyBufferLayout {
                    offset: 0,
                    bytes_per_row: Some(atlas.columns * layout.row_bytes as u32),
                    rows_per_image: Some(atlas.rows * layout.rows as u32),
                },
                wgpu::Extent3d { width: size[0], height: size[1], depth_or_array_layers: slices },
            );
        }
        Ok(texture.create_view(&Default::default()))
    }

    /// Traces a frame of a grid. `voxels` is the box of what is not background in it.
    ///
    /// # Errors
    /// When the device fails.
    pub fn trace(
        &self,
        uploaded: &Uploaded,
        [grid, frame]: [u32; 2],
        voxels: CoordBox,
        scene: &Scene,
    ) -> Result<Image, GpuError> {
        Ok(self.trace_timed(uploaded, [grid, frame], voxels, scene, 1)?.0)
    }

    /// The same, `repeats` times, with the milliseconds of each pass where the adapter counts time.
    ///
    /// # Errors
    /// When the device fails.
    pub fn trace_timed(
        &self,
        uploaded: &Uploaded,
        [grid, frame]: [u32; 2],
        voxels: CoordBox,
        scene: &Scene,
        repeats: u32,
    ) -> Result<(Image, Vec<f64>), GpuError> {
        let [width, height] = scene.size;
        let bytes = u64::from(width) * u64::from(height) * 16;
        if bytes > self.device.limits().max_storage_buffer_binding_size {
            return Err(GpuError::Lacks {
                adapter: self.name.clone(),
                what: format!("cannot write a picture of {width} × {height}"),
            });
        }
        let asked = Params::new(scene, [grid, frame], voxels)?;
        let params = self.device.create_buffer_init(&wgpu::util::BufferInitDescriptor {
            label: Some("params"),
            contents: bytemuck::bytes_of(&asked),
            usage: wgpu::BufferUsages::UNIFORM,
        });
        let buffer = |size, usage| {
            self.device.create_buffer(&wgpu::BufferDescriptor {
                label: None,
                size,
                usage,
                mapped_at_creation: false,
            })
        };
        let output = buffer(bytes, wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC);
        let readback = buffer(bytes, wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST);
        let drawing = self.pipelines.get(&self.device, uploaded.has, scene);
        // A buffer cannot be empty.
        let lights = if drawing.light.is_some() { asked.light_points() } else { 1 };
        let light = buffer(u64::from(lights) * 4, wgpu::BufferUsages::STORAGE);
        let group = self.bind(uploaded, [&params, &uploaded.tree, &output, &light]);

        let mut milliseconds = Vec::new();
        for repeat in 0..repeats {
            let mut encoder = self.device.create_command_encoder(&Default::default());
            let queries = self.timestamps.then(|| Queries::new(&self.device));
            {
                let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor {
                    label: Some("trace"),
                    timestamp_writes: queries.as_ref().map(|q| wgpu::ComputePassTimestampWrites {
                        query_set: &q.set,
                        beginning_of_pass_write_index: Some(0),
                        end_of_pass_write_index: Some(1),
                    }),
                });
                pass.set_bind_group(0, &group, &[]);
                if let Some(pipeline) = &drawing.light {
                    pass.set_pipeline(pipeline);
                    pass.dispatch_workgroups(lights.div_ceil(LIGHT_WORKGROUP), 1, 1);
                }
                pass.set_pipeline(&drawing.trace);
                let [across, down] = WORKGROUP;
                pass.dispatch_workgroups(width.div_ceil(across), height.div_ceil(down), 1);
            }
            if let Some(q) = &queries {
                encoder.resolve_query_set(&q.set, 0..2, &q.resolved, 0);
                encoder.copy_buffer_to_buffer(&q.resolved, 0, &q.readback, 0, 16);
            }
            if repeat + 1 == repeats {
                encoder.copy_buffer_to_buffer(&output, 0, &readback, 0, bytes);
            }
            self.queue.submit([encoder.finish()]);
            if let Some(q) = &queries {
                let ticks: Vec<u64> = self.read(&q.readback)?;
                let nanoseconds = (ticks[1] - ticks[0]) as f64 * f64::from(self.queue.get_timestamp_period());
                milliseconds.push(nanoseconds / 1e6);
            }
        }
        Ok((Image { size: scene.size, pixels: self.read(&readback)? }, milliseconds))
    }

    fn bind(&self, uploaded: &Uploaded, buffers: [&wgpu::Buffer; 4]) -> wgpu::BindGroup {
        let buffers = buffers.map(wgpu::Buffer::as_entire_binding);
        let textures = uploaded.textures.iter().map(wgpu::BindingResource::TextureView);
        let entries: Vec<_> = buffers
            .into_iter()
            .chain(textures)
            .zip(0..)
            .map(|(resource, binding)| wgpu::BindGroupEntry { binding, resource })
            .collect();
        self.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: None,
            layout: self.pipelines.bindings(),
            entries: &entries,
        })
    }

    /// Waits for the device and reads a buffer.
    fn read<T: Pod>(&self, buffer: &wgpu::Buffer) -> Result<Vec<T>, GpuError> {
        let (sender, receiver) = std::sync::mpsc::channel();
        buffer.slice(..).map_async(wgpu::MapMode::Read, move |result| {
            // The receiver is gone only when waiting failed, which is what is reported then.
            let _ = sender.send(result);
        });
        let failed = |e: &dyn std::fmt::Display| GpuError::Failed(e.to_string());
        self.device.poll(wgpu::PollType::wait_indefinitely()).map_err(|e| failed(&e))?;
        receiver.recv().map_err(|e| failed(&e))?.map_err(|e| failed(&e))?;
        let view = buffer.slice(..).get_mapped_range().map_err(|e| failed(&e))?;
        let values = bytemuck::allocation::pod_collect_to_vec(&view);
        drop(view);
        buffer.unmap();
        Ok(values)
    }
}

struct Queries {
    set: wgpu::QuerySet,
    resolved: wgpu::Buffer,
    readback: wgpu::Buffer,
}

impl Queries {
    fn new(device: &wgpu::Device) -> Self {
        let buffer = |usage| {
            device.create_buffer(&wgpu::BufferDescriptor {
                label: None,
                size: 16,
                usage,
                mapped_at_creation: false,
            })
        };
        Self {
            set: device.create_query_set(&wgpu::QuerySetDescriptor {
                label: None,
                ty: wgpu::QueryType::Timestamp,
                count: 2,
            }),
            resolved: buffer(wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC),
            readback: buffer(wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST),
        }
    }
}

/// The format of a codec's texture.
pub fn texture_format(codec: Codec) -> wgpu::TextureFormat {
    match codec.texture() {
        TextureFormat::Bc7RgbaUnorm => wgpu::TextureFormat::Bc7RgbaUnorm,
        TextureFormat::Bc4RUnorm => wgpu::TextureFormat::Bc4RUnorm,
        TextureFormat::R8Unorm => wgpu::TextureFormat::R8Unorm,
        TextureFormat::R16Float => wgpu::TextureFormat::R16Float,
        TextureFormat::R32Float => wgpu::TextureFormat::R32Float,
    }
}

/// Texels of the first page.
fn page_size(atlas: &Atlas) -> [u32; 3] {
    let slabs = atlas.slabs.min(atlas.page_slabs);
    [atlas.columns * 8, atlas.rows * 8, slabs * atlas.codec.layout().slices as u32]
}
