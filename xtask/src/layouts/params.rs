//! What a picture asks of the shaders, as it lies in their uniform buffer.

use bytemuck::{Pod, Zeroable};
use volpack::codec::Codec;

use super::STEP;
use super::atlas::Lookup;
use super::gpu::Textures;
use super::source::Source;

/// One texture of `Params` in march.wgsl.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub struct Atlas {
    pub brick: [f32; 3],
    pub columns: u32,
    pub inverse: [f32; 3],
    pub padding: u32,
}

/// `struct Params` of march.wgsl.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub struct Params {
    pub origin: [f32; 3],
    pub width: u32,
    pub forward: [f32; 3],
    pub height: u32,
    pub right: [f32; 3],
    pub step: f32,
    pub up: [f32; 3],
    pub background: f32,
    pub low: [f32; 3],
    pub lo: f32,
    pub high: [f32; 3],
    pub span: f32,
    pub base: [i32; 3],
    pub nodes_at: u32,
    pub cells: [i32; 3],
    pub records_at: u32,
    pub constants_at: u32,
    pub padding: [u32; 3],
    pub atlases: [Atlas; Codec::WITH_TEXELS.len()],
}

impl Params {
    /// What all layouts ask. `base` is the voxel at position 0.
    pub fn new(source: &Source, size: [u32; 2], base: [i32; 3], textures: &Textures) -> Self {
        let Source { view, voxels, sequence, .. } = source;
        let from_base = |p: [f64; 3]| std::array::from_fn(|a| (p[a] - f64::from(base[a])) as f32);
        Self {
            origin: from_base(view.origin),
            width: size[0],
            forward: view.forward.map(|c| c as f32),
            height: size[1],
            right: view.right.map(|c| c as f32),
            step: STEP as f32,
            up: view.up.map(|c| c as f32),
            background: voxels.background,
            low: from_base(view.low),
            lo: sequence.lo,
            high: from_base(view.high),
            span: sequence.span,
            base,
            atlases: textures.atlases,
            ..Self::zeroed()
        }
    }

    /// What layouts of bricks ask beside that.
    pub fn with_lookup(
        source: &Source,
        size: [u32; 2],
        pitch: i32,
        lookup: &Lookup,
        textures: &Textures,
    ) -> Self {
        Self {
            nodes_at: lookup.nodes_at,
            records_at: lookup.records_at,
            constants_at: lookup.constants_at,
            cells: lookup.cells.map(|n| n as i32),
            ..Self::new(source, size, lookup.origin.map(|place| place * pitch), textures)
        }
    }
}
