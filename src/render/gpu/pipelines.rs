//! A pipeline for each thing that the tracer does, made when it is first asked for.
//!
//! One shader for every mode, codec and key of grid takes registers and branches for all of them:
//! `docs/decisions/0013-tracer-speed.md` has what that costs.

use std::collections::HashMap;
use std::fmt::Write;
use std::sync::{Mutex, PoisonError};

use super::{CUBIC_WGSL, MARCH_WGSL, TRACER_WGSL, VOLPACK_WGSL};
use crate::codec::Codec;
use crate::pack::Pack;
use crate::pack::tree::header;
use crate::render::{Mode, Scene, Traversal};

/// What occurs in a pack, as far as the shader cares.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Has {
    /// Bit `tag` is on for each codec that has bricks; constants always may occur.
    codecs: u32,
    masks: bool,
}

impl Has {
    /// What occurs in `pack`.
    pub fn of(pack: &Pack) -> Self {
        let used = Codec::WITH_TEXELS.into_iter().filter(|codec| pack.atlas(*codec).is_some());
        Self {
            codecs: used.fold(1, |bits, codec| bits | 1 << codec as u32),
            masks: pack.tree()[header::MASKS] > 0,
        }
    }
}

#[derive(Clone, Copy, PartialEq, Eq, Hash)]
struct PipelineKey {
    mode: u32,
    hdda: bool,
    level_set: bool,
    trilinear: bool,
    emits: bool,
    has: Has,
}

/// What draws a picture.
#[derive(Clone)]
pub struct Drawing {
    /// Fills the light grid of lit fog.
    pub light: Option<wgpu::ComputePipeline>,
    /// Traces the rays.
    pub trace: wgpu::ComputePipeline,
}

/// Pixels of a workgroup, as `main` in `tracer.wgsl` has them: of the shapes from 8 × 4 to 16 × 16 the
/// fastest on an NVIDIA H200, by 3 to 20 %.
pub const WORKGROUP: [u32; 2] = [8, 16];

/// Points of the light grid in a workgroup of `measure_light`.
pub const LIGHT_WORKGROUP: u32 = 64;

/// The pipelines of one device, and what they share.
pub struct Pipelines {
    module: wgpu::ShaderModule,
    bindings: wgpu::BindGroupLayout,
    layout: wgpu::PipelineLayout,
    made: Mutex<HashMap<PipelineKey, Drawing>>,
}

impl Pipelines {
    /// Compiles the shader's front end; pipelines follow when they are asked for.
    pub fn new(device: &wgpu::Device) -> Self {
        let shader = wgpu::ShaderModuleDescriptor {
            label: Some("volpack + tracer"),
            source: wgpu::ShaderSource::Wgsl(
                format!("{VOLPACK_WGSL}\n{MARCH_WGSL}\n{CUBIC_WGSL}\n{TRACER_WGSL}\n{}", texels_wgsl())
                    .into(),
            ),
        };
        // What wgpu adds to loops, to keep foreign shaders from running for ever, costs this one a sixth
        // of its time. Every access to memory stays checked.
        let checks =
            wgpu::ShaderRuntimeChecks { force_loop_bounding: false, ..wgpu::ShaderRuntimeChecks::checked() };
        // SAFETY: without these checks all loops must end, and they do whatever the pack says: walks count
        // steps up to VP_MAX_STEPS or move towards a plane a cell at a time, `vp_settle` moves one way between
        // two cells, parts of a cell are 8, halvings 24.
        let module = unsafe { device.create_shader_module_trusted(shader, checks) };
        let bindings = bindings(device);
        let layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            bind_group_layouts: &[Some(&bindings)],
            ..Default::default()
        });
        Self { module, bindings, layout, made: Mutex::default() }
    }

    /// What pictures bind.
    pub fn bindings(&self) -> &wgpu::BindGroupLayout {
        &self.bindings
    }

    /// The pipelines that trace a scene from a pack.
    pub fn get(&self, device: &wgpu::Device, has: Has, scene: &Scene) -> Drawing {
        let key = PipelineKey {
            mode: scene.mode as u32,
            hdda: scene.traversal == Traversal::Hdda,
            level_set: scene.level_set,
            trilinear: scene.is_trilinear(),
            emits: scene.emission.is_some(),
            has,
        };
        let mut made = self.made.lock().unwrap_or_else(PoisonError::into_inner);
        made.entry(key).or_insert_with(|| self.make(device, key)).clone()
    }

    fn make(&self, device: &wgpu::Device, key: PipelineKey) -> Drawing {
        let is_lit = key.mode == Mode::Lit as u32;
        let pipeline = |entry_point| {
            device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                label: Some(entry_point),
                layout: Some(&self.layout),
                module: &self.module,
                entry_point: Some(entry_point),
                compilation_options: wgpu::PipelineCompilationOptions {
                    constants: &[
                        ("MODE", key.mode.into()),
                        ("HDDA", key.hdda.into()),
                        ("LEVEL_SET", key.level_set.into()),
                        ("TRILINEAR", key.trilinear.into()),
                        ("VP_CODECS", key.has.codecs.into()),
                        ("VP_MASKS", key.has.masks.into()),
                        ("VP_LIT", is_lit.into()),
                        ("VP_EMITS", key.emits.into()),
                        ("VP_SKIPS", key.hdda.into()),
                    ],
                    ..Default::default()
                },
                cache: None,
            })
        };
        let needs_light = is_lit && !key.level_set;
        Drawing { light: needs_light.then(|| pipeline("measure_light")), trace: pipeline("main") }
    }
}

fn bindings(device: &wgpu::Device) -> wgpu::BindGroupLayout {
    let entry = |binding, ty| wgpu::BindGroupLayoutEntry {
        binding,
        visibility: wgpu::ShaderStages::COMPUTE,
        ty,
        count: None,
    };
    let buffer = |ty| wgpu::BindingType::Buffer { ty, has_dynamic_offset: false, min_binding_size: None };
    let texture = wgpu::BindingType::Texture {
        sample_type: wgpu::TextureSampleType::Float { filterable: false },
        view_dimension: wgpu::TextureViewDimension::D3,
        multisampled: false,
    };
    let mut entries = vec![
        entry(0, buffer(wgpu::BufferBindingType::Uniform)),
        entry(1, buffer(wgpu::BufferBindingType::Storage { read_only: true })),
        entry(2, buffer(wgpu::BufferBindingType::Storage { read_only: false })),
        entry(3, buffer(wgpu::BufferBindingType::Storage { read_only: false })),
    ];
    let texture_bindings = (FIRST_TEXTURE..).take(Codec::WITH_TEXELS.len());
    entries.extend(texture_bindings.map(|binding| entry(binding, texture)));
    device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label: None, entries: &entries })
}

/// The binding of the first codec's texture.
const FIRST_TEXTURE: u32 = 4;

/// The codecs' textures, and what reads them for `volpack.wgsl`. One page a codec is bound here; an engine with more
/// chooses by page.
fn texels_wgsl() -> String {
    let (mut textures, mut reads) = (String::new(), String::new());
    for (codec, binding) in Codec::WITH_TEXELS.into_iter().zip(FIRST_TEXTURE..) {
        let (name, tag) = (codec.name(), codec as u32);
        // The last read needs no question.
        let is_it = match tag as usize == Codec::WITH_TEXELS.len() {
            true => String::new(),
            false => format!("if (VP_CODECS & {}u) != 0u && codec == {tag}u ", 1 << tag),
        };
        // Writing to a string does not fail.
        let _ = writeln!(textures, "@group(0) @binding({binding}) var {name}_texels: texture_3d<f32>;");
        let _ = writeln!(reads, "    {is_it}{{ return textureLoad({name}_texels, p, 0); }}");
    }
    format!("{textures}\nfn vp_texel(codec: u32, page: u32, p: vec3i) -> vec4f {{\n{reads}}}\n")
}

const _: () = {
    assert!(Mode::Density as u32 == 0 && Mode::Depth as u32 == 1 && Mode::First as u32 == 2);
    assert!(Mode::Bricks as u32 == 3 && Mode::Steps as u32 == 4 && Mode::Nodes as u32 == 5);
    assert!(Mode::Normals as u32 == 6 && Mode::Lit as u32 == 7);
};

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_shader_knows_the_codecs() {
        let normalised = Codec::WITH_TEXELS.into_iter().filter(|codec| codec.is_normalised());
        let normalised: u32 = normalised.map(|codec| 1 << codec as u32).sum();
        let all = (1u32 << Codec::COUNT) - 1;
        for line in
            [format!("const VP_NORMALISED = {normalised}u;"), format!("override VP_CODECS: u32 = {all}u;")]
        {
            assert!(VOLPACK_WGSL.contains(&line), "volpack.wgsl should have `{line}`");
        }
    }
}
