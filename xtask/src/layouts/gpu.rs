//! Runs the shaders of the layouts and times them.

use std::collections::HashMap;
use std::error::Error;

use bytemuck::{Pod, Zeroable as _};
use volpack::codec::Codec;
use volpack::render::gpu::{VOLPACK_WGSL, texture_format};
use wgpu::util::DeviceExt;

use super::atlas::Texture;
use super::params::{Atlas, Params};

/// Pixels of a workgroup, as `main` in density.wgsl and surface.wgsl has them.
const WORKGROUP: [u32; 2] = [8, 16];
/// Frames of one submission: a query set has at most 4096 timestamps.
const FRAMES_AT_ONCE: u32 = 1000;

/// A shader with its switches.
#[derive(Clone, Debug)]
pub struct Program {
    /// The files that follow march.wgsl.
    pub files: &'static [&'static str],
    pub constants: Vec<(&'static str, f64)>,
}

/// A device that can filter every codec's texture.
pub struct Gpu {
    pub info: wgpu::AdapterInfo,
    device: wgpu::Device,
    queue: wgpu::Queue,
    bindings: wgpu::BindGroupLayout,
    layout: wgpu::PipelineLayout,
    sampler: wgpu::Sampler,
    modules: HashMap<*const &'static str, wgpu::ShaderModule>,
    pipelines: HashMap<String, wgpu::ComputePipeline>,
}

/// The textures of one set of bricks on the device, and how bricks lie in them.
#[derive(Clone)]
pub struct Textures {
    views: [wgpu::TextureView; Codec::WITH_TEXELS.len()],
    pub atlases: [Atlas; Codec::WITH_TEXELS.len()],
}

/// A picture to make, on the device.
pub struct Kernel {
    pipeline: wgpu::ComputePipeline,
    group: wgpu::BindGroup,
    output: wgpu::Buffer,
    size: [u32; 2],
}

impl Gpu {
    /// Opens the best Vulkan adapter.
    pub fn open() -> Result<Self, Box<dyn Error>> {
        let instance = wgpu::Instance::new(wgpu::InstanceDescriptor {
            backends: wgpu::Backends::VULKAN,
            ..wgpu::InstanceDescriptor::new_without_display_handle()
        });
        let options = wgpu::RequestAdapterOptions {
            power_preference: wgpu::PowerPreference::HighPerformance,
            ..Default::default()
        };
        let adapter =
            pollster::block_on(instance.request_adapter(&options)).map_err(|_| "no Vulkan device found")?;
        let info = adapter.get_info();
        // Adaptive packs may have bricks in f32, which only some devices filter.
        let features = wgpu::Features::TEXTURE_COMPRESSION_BC
            | wgpu::Features::TEXTURE_COMPRESSION_BC_SLICED_3D
            | wgpu::Features::TIMESTAMP_QUERY
            | wgpu::Features::FLOAT32_FILTERABLE;
        let lacks = features - adapter.features();
        if !lacks.is_empty() {
            return Err(format!("{} lacks {lacks:?}", info.name).into());
        }
        let (device, queue) = pollster::block_on(adapter.request_device(&wgpu::DeviceDescriptor {
            label: Some("layouts"),
            required_features: features,
            required_limits: adapter.limits(),
            ..Default::default()
        }))?;
        let bindings = bindings(&device);
        let layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            bind_group_layouts: &[Some(&bindings)],
            ..Default::default()
        });
        let sampler = device.create_sampler(&wgpu::SamplerDescriptor {
            mag_filter: wgpu::FilterMode::Linear,
            min_filter: wgpu::FilterMode::Linear,
            ..Default::default()
        });
        let (modules, pipelines) = (HashMap::new(), HashMap::new());
        Ok(Self { info, device, queue, bindings, layout, sampler, modules, pipelines })
    }

    /// Whether it is a program on the CPU, whose times say nothing of a GPU.
    pub fn is_software(&self) -> bool {
        self.info.device_type == wgpu::DeviceType::Cpu
    }

    /// Uploads textures; codecs without one get one texel.
    pub fn upload(&self, textures: &[Texture]) -> Result<Textures, Box<dyn Error>> {
        let mut atlases = [Atlas::zeroed(); Codec::WITH_TEXELS.len()];
        let most = self.device.limits().max_texture_dimension_3d;
        for texture in textures {
            if texture.size.iter().any(|side| *side > most) {
                return Err(
                    format!("a texture of {:?} texels exceeds the device's {most}", texture.size).into()
                );
            }
            atlases[texture.codec as usize - 1] = Atlas {
                brick: texture.brick.map(|d| d as f32),
                columns: texture.columns,
                inverse: texture.size.map(|d| 1.0 / d as f32),
                padding: 0,
            };
        }
        let views = Codec::WITH_TEXELS.map(|codec| match textures.iter().find(|t| t.codec == codec) {
            Some(texture) => self.texture(texture_format(codec), texture.size, &texture.bytes),
            None => self.texture(wgpu::TextureFormat::R8Unorm, [1; 3], &[0]),
        });
        Ok(Textures { views, atlases })
    }

    fn texture(&self, format: wgpu::TextureFormat, size: [u32; 3], bytes: &[u8]) -> wgpu::TextureView {
        let descriptor = wgpu::TextureDescriptor {
            label: None,
            size: wgpu::Extent3d { width: size[0], height: size[1], depth_or_array_layers: size[2] },
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D3,
            format,
            usage: wgpu::TextureUsages::TEXTURE_BINDING,
            view_formats: &[],
        };
        let order = wgpu::util::TextureDataOrder::LayerMajor;
        let texture = self.device.create_texture_with_data(&self.queue, &descriptor, order, bytes);
        texture.create_view(&Default::default())
    }

    /// A buffer for pictures of `channels` floats a pixel.
    pub fn output(&self, [width, height]: [u32; 2], channels: u32) -> wgpu::Buffer {
        self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("output"),
            size: u64::from(width) * u64::from(height) * u64::from(channels) * 4,
            usage: wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC,
            mapped_at_creation: false,
        })
    }

    /// Prepares a picture.
    pub fn kernel(
        &mut self,
        program: &Program,
        words: &[u32],
        textures: &Textures,
        params: Params,
        output: &wgpu::Buffer,
    ) -> Kernel {
        let buffer = |contents, usage| {
            self.device.create_buffer_init(&wgpu::util::BufferInitDescriptor { label: None, contents, usage })
        };
        let uniform = buffer(bytemuck::bytes_of(&params), wgpu::BufferUsages::UNIFORM);
        let words = buffer(bytemuck::cast_slice(words), wgpu::BufferUsages::STORAGE);
        let buffers = [&uniform, &words, output].map(wgpu::Buffer::as_entire_binding);
        let views = textures.views.iter().map(wgpu::BindingResource::TextureView);
        let entries: Vec<_> = buffers
            .into_iter()
            .chain(views)
            .chain([wgpu::BindingResource::Sampler(&self.sampler)])
            .zip(0..)
            .map(|(resource, binding)| wgpu::BindGroupEntry { binding, resource })
            .collect();
        let group = self.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: None,
            layout: &self.bindings,
            entries: &entries,
        });
        let pipeline = self.pipeline(program);
        Kernel { pipeline, group, output: output.clone(), size: [params.width, params.height] }
    }

    fn pipeline(&mut self, program: &Program) -> wgpu::ComputePipeline {
        let Self { device, layout, modules, pipelines, .. } = self;
        let module = modules.entry(program.files.as_ptr()).or_insert_with(|| module(device, program.files));
        let key = format!("{:p} {:?}", program.files.as_ptr(), program.constants);
        let make = || {
            device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                label: None,
                layout: Some(layout),
                module,
                entry_point: Some("main"),
                compilation_options: wgpu::PipelineCompilationOptions {
                    constants: &program.constants,
                    ..Default::default()
                },
                cache: None,
            })
        };
        pipelines.entry(key).or_insert_with(make).clone()
    }

    /// Makes a picture that often, and returns the milliseconds of each time.
    pub fn time(&self, kernel: &Kernel, frames: u32) -> Result<Vec<f64>, Box<dyn Error>> {
        let mut milliseconds = Vec::new();
        while milliseconds.len() < frames as usize {
            let count = (frames - milliseconds.len() as u32).min(FRAMES_AT_ONCE);
            let queries = self.device.create_query_set(&wgpu::QuerySetDescriptor {
                label: None,
                ty: wgpu::QueryType::Timestamp,
                count: 2 * count,
            });
            let bytes = u64::from(count) * 16;
            let resolved =
                self.buffer(bytes, wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC);
            let readback = self.buffer(bytes, wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST);
            let mut encoder = self.device.create_command_encoder(&Default::default());
            for frame in 0..count {
                kernel.encode(
                    &mut encoder,
                    Some(wgpu::ComputePassTimestampWrites {
                        query_set: &queries,
                        beginning_of_pass_write_index: Some(2 * frame),
                        end_of_pass_write_index: Some(2 * frame + 1),
                    }),
                );
            }
            encoder.resolve_query_set(&queries, 0..2 * count, &resolved, 0);
            encoder.copy_buffer_to_buffer(&resolved, 0, &readback, 0, bytes);
            self.queue.submit([encoder.finish()]);
            let ticks: Vec<u64> = self.read(&readback)?;
            let period = f64::from(self.queue.get_timestamp_period());
            milliseconds.extend(ticks.chunks_exact(2).map(|t| (t[1] - t[0]) as f64 * period / 1e6));
        }
        Ok(milliseconds)
    }

    /// Makes a picture once.
    pub fn picture(&self, kernel: &Kernel) -> Result<Vec<f32>, Box<dyn Error>> {
        let bytes = kernel.output.size();
        let readback = self.buffer(bytes, wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST);
        let mut encoder = self.device.create_command_encoder(&Default::default());
        kernel.encode(&mut encoder, None);
        encoder.copy_buffer_to_buffer(&kernel.output, 0, &readback, 0, bytes);
        self.queue.submit([encoder.finish()]);
        self.read(&readback)
    }

    fn buffer(&self, size: u64, usage: wgpu::BufferUsages) -> wgpu::Buffer {
        self.device.create_buffer(&wgpu::BufferDescriptor {
            label: None,
            size,
            usage,
            mapped_at_creation: false,
        })
    }

    /// Waits for the device and reads a buffer.
    fn read<T: Pod>(&self, buffer: &wgpu::Buffer) -> Result<Vec<T>, Box<dyn Error>> {
        let (sender, receiver) = std::sync::mpsc::channel();
        buffer.slice(..).map_async(wgpu::MapMode::Read, move |result| drop(sender.send(result)));
        self.device.poll(wgpu::PollType::wait_indefinitely())?;
        receiver.recv()??;
        let view = buffer.slice(..).get_mapped_range()?;
        Ok(bytemuck::allocation::pod_collect_to_vec(&view))
    }
}

impl Kernel {
    fn encode(&self, encoder: &mut wgpu::CommandEncoder, times: Option<wgpu::ComputePassTimestampWrites>) {
        let mut pass =
            encoder.begin_compute_pass(&wgpu::ComputePassDescriptor { label: None, timestamp_writes: times });
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, &self.group, &[]);
        let groups: [u32; 2] = std::array::from_fn(|a| self.size[a].div_ceil(WORKGROUP[a]));
        pass.dispatch_workgroups(groups[0], groups[1], 1);
    }
}

fn module(device: &wgpu::Device, files: &[&str]) -> wgpu::ShaderModule {
    let shader = wgpu::ShaderModuleDescriptor {
        label: Some("layouts"),
        source: wgpu::ShaderSource::Wgsl(
            [&[VOLPACK_WGSL, include_str!("march.wgsl")], files].concat().join("\n").into(),
        ),
    };
    let checks =
        wgpu::ShaderRuntimeChecks { force_loop_bounding: false, ..wgpu::ShaderRuntimeChecks::checked() };
    // SAFETY: without these checks all loops must end: those of a march count samples up, the others are bounded by constants. Their
    // cost would be a sixth of the time, as src/render/gpu/pipelines.rs has it.
    unsafe { device.create_shader_module_trusted(shader, checks) }
}

fn bindings(device: &wgpu::Device) -> wgpu::BindGroupLayout {
    let buffer = |ty| wgpu::BindingType::Buffer { ty, has_dynamic_offset: false, min_binding_size: None };
    let texture = wgpu::BindingType::Texture {
        sample_type: wgpu::TextureSampleType::Float { filterable: true },
        view_dimension: wgpu::TextureViewDimension::D3,
        multisampled: false,
    };
    let types = [
        buffer(wgpu::BufferBindingType::Uniform),
        buffer(wgpu::BufferBindingType::Storage { read_only: true }),
        buffer(wgpu::BufferBindingType::Storage { read_only: false }),
    ]
    .into_iter()
    .chain([texture; Codec::WITH_TEXELS.len()])
    .chain([wgpu::BindingType::Sampler(wgpu::SamplerBindingType::Filtering)]);
    let entries: Vec<_> = types
        .zip(0..)
        .map(|(ty, binding)| wgpu::BindGroupLayoutEntry {
            binding,
            visibility: wgpu::ShaderStages::COMPUTE,
            ty,
            count: None,
        })
        .collect();
    device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label: None, entries: &entries })
}
