// march.wgsl: bindings, camera and the steps of a ray, for all layouts of `xtask bench layouts`. It goes behind volpack.wgsl and
// before the files of one layout.
//
// Positions are voxels from `base`: voxel `base` is at 0. All layouts sample the same places of a ray, origin + direction ·
// (start + k · step), so that their sums differ by what a layout does to values and by nothing else.

struct Atlas {
    brick: vec3f,           // texels of a brick
    columns: u32,           // bricks along x, and along y
    inverse: vec3f,         // 1 / texels of the texture
}

struct Params {
    origin: vec3f,          // the eye
    width: u32,
    forward: vec3f,         // the ray through the middle, then to the right edge and to the top
    height: u32,
    right: vec3f,
    step: f32,
    up: vec3f,
    background: f32,
    low: vec3f,             // the box that is sampled
    lo: f32,                // what brick ranges are fractions of
    high: vec3f,
    span: f32,
    base: vec3i,
    nodes_at: u32,          // words at which L2 nodes, records and constants begin
    cells: vec3i,           // bricks of the indirection, or L2 nodes of the tree
    records_at: u32,
    constants_at: u32,
    atlases: array<Atlas, 5>,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> tree: array<u32>;
@group(0) @binding(2) var<storage, read_write> output: array<f32>;
@group(0) @binding(3) var bc7_texels: texture_3d<f32>;
@group(0) @binding(4) var bc4_texels: texture_3d<f32>;
@group(0) @binding(5) var unorm8_texels: texture_3d<f32>;
@group(0) @binding(6) var f16_texels: texture_3d<f32>;
@group(0) @binding(7) var f32_texels: texture_3d<f32>;
@group(0) @binding(8) var trilinear: sampler;

fn vp_word(i: u32) -> u32 {
    return tree[i];
}

fn vp_texel(codec: u32, page: u32, p: vec3i) -> vec4f {
    if (VP_CODECS & 2u) != 0u && codec == 1u { return textureLoad(bc7_texels, p, 0); }
    if (VP_CODECS & 4u) != 0u && codec == 2u { return textureLoad(bc4_texels, p, 0); }
    if (VP_CODECS & 8u) != 0u && codec == 3u { return textureLoad(unorm8_texels, p, 0); }
    if (VP_CODECS & 16u) != 0u && codec == 4u { return textureLoad(f16_texels, p, 0); }
    return textureLoad(f32_texels, p, 0);
}

struct Ray {
    origin: vec3f,          // where sample 0 is
    step: vec3f,            // from a sample to the next
    inverse: vec3f,
    samples: i32,
    start: f32,             // how far sample 0 is from the eye, in voxels
}

fn place(ray: Ray, k: i32) -> vec3f {
    return ray.origin + ray.step * f32(k);
}

// The first sample behind the box from low to high that holds sample k; at least the next one.
fn leave(ray: Ray, k: i32, low: vec3f, high: vec3f) -> i32 {
    let t = (select(low, high, ray.step > vec3f(0.0)) - ray.origin) * ray.inverse;
    return clamp(i32(ceil(min(t.x, min(t.y, t.z)))), k + 1, max(k + 1, ray.samples));
}

fn ray_of(x: u32, y: u32) -> Ray {
    let u = f32(2u * x + 1u) / f32(params.width) - 1.0;
    let v = 1.0 - f32(2u * y + 1u) / f32(params.height);
    var d = normalize(params.forward + params.right * u + params.up * v);
    // A ray that runs along an axis crosses no planes of the others in finite time.
    d = select(d, vec3f(1e-9), abs(d) < vec3f(1e-9));
    let a = (params.low - params.origin) / d;
    let b = (params.high - params.origin) / d;
    let enter = min(a, b);
    let exit = max(a, b);
    let start = max(max(enter.x, 0.0), max(enter.y, enter.z));
    let end = min(exit.x, min(exit.y, exit.z));
    let samples = max(0, i32(ceil((end - start) / params.step)));
    return Ray(params.origin + d * start, d * params.step, 1.0 / (d * params.step), samples, start);
}
