// tracer.wgsl: bindings, camera and modes around volpack.wgsl. src/render/cpu.rs is its twin.

struct Params {
    origin: vec3f,          // the eye, in cells from base
    mode: u32,
    forward: vec3f,         // the ray through the middle, then to the right edge and to the top
    traversal: u32,         // 0 DDA, 1 HDDA
    right: vec3f,
    half_width: f32,
    up: vec3f,
    half_height: f32,
    base: vec3i,            // the voxel that cell 0 is
    grid: u32,
    low: vec3i,             // the cells to trace
    frame: u32,
    high: vec3i,
    level_set: u32,
    sun: vec3f,             // towards the sun in cells, scaled to how far off a surface shadows begin
    extinction: f32,
    sun_world: vec3f,
    threshold: f32,
    normal_x: vec3f,        // rows whose products with a gradient are the normal in world space
    width: u32,
    normal_y: vec3f,
    height: u32,
    normal_z: vec3f,
    ambient: f32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> tree: array<u32>;
@group(0) @binding(2) var<storage, read_write> output: array<vec4f>;
@group(0) @binding(3) var bc7: texture_3d<f32>;
@group(0) @binding(4) var bc4: texture_3d<f32>;
@group(0) @binding(5) var unorm8: texture_3d<f32>;
@group(0) @binding(6) var f16_: texture_3d<f32>;
@group(0) @binding(7) var f32_: texture_3d<f32>;

fn vp_word(i: u32) -> u32 {
    return tree[i];
}

// One page a codec is bound here; an engine with more chooses by page.
fn vp_texel(codec: u32, page: u32, p: vec3i) -> vec4f {
    switch codec {
        case 1u: { return textureLoad(bc7, p, 0); }
        case 2u: { return textureLoad(bc4, p, 0); }
        case 3u: { return textureLoad(unorm8, p, 0); }
        case 4u: { return textureLoad(f16_, p, 0); }
        default: { return textureLoad(f32_, p, 0); }
    }
}

const DENSITY = 0u;
const DEPTH = 1u;
const FIRST = 2u;
const BRICKS = 3u;
const STEPS = 4u;
const NODES = 5u;
const NORMALS = 6u;
const MAX_STEPS = 65536u;

var<private> grid: VpGrid;
var<private> steps: u32;

// The node to step over: all of it for HDDA where it has one value, else one cell.
struct Step {
    node: VpNode,
    low: vec3i,
    high: vec3i,
}

fn step_at(cell: vec3i) -> Step {
    let node = vp_find(grid, params.frame, cell + params.base);
    if node.constant && params.traversal == 1u {
        let low = node.min - params.base;
        return Step(node, low, low + node.dim);
    }
    return Step(node, cell, cell + 1);
}

fn optical_depth(ray: VpRay) -> f32 {
    var depth = 0.0;
    var walk = vp_enter(ray, params.low, params.high);
    while vp_inside(walk.cell, params.low, params.high) && steps < MAX_STEPS {
        steps++;
        let s = step_at(walk.cell);
        let value = vp_node_value(grid, s.node, walk.cell + params.base);
        let start = walk.t;
        walk = vp_leave(ray, walk, max(s.low, params.low), min(s.high, params.high));
        depth += (walk.t - start) * value;
    }
    return depth;
}

struct Hit {
    found: bool,
    t: f32,
    cell: vec3i,
    axis: i32,
    value: f32,
}

const MISS = Hit(false, 0.0, vec3i(0), 3, 0.0);

fn first_hit(ray: VpRay) -> Hit {
    if params.level_set == 1u {
        return first_surface(ray);
    }
    return first_density(ray);
}

fn first_density(ray: VpRay) -> Hit {
    var walk = vp_enter(ray, params.low, params.high);
    while vp_inside(walk.cell, params.low, params.high) && steps < MAX_STEPS {
        steps++;
        let s = step_at(walk.cell);
        let value = vp_node_value(grid, s.node, walk.cell + params.base);
        if value > params.threshold {
            return Hit(true, walk.t, walk.cell, walk.axis, value);
        }
        walk = vp_leave(ray, walk, max(s.low, params.low), min(s.high, params.high));
    }
    return MISS;
}

// A place on the ray relative to a cell.
fn local(ray: VpRay, cell: vec3i, t: f32) -> vec3f {
    return ray.origin - vec3f(cell) + ray.direction * t;
}

// The first zero of the interpolated field. A cell reaches over to the next voxel on each axis, so the
// last layer of a node's cells is taken one by one.
fn first_surface(ray: VpRay) -> Hit {
    var walk = vp_enter(ray, params.low, params.high);
    var known = false;
    var negative = false;
    while vp_inside(walk.cell, params.low, params.high) && steps < MAX_STEPS {
        steps++;
        let s = step_at(walk.cell);
        if s.node.constant && vp_inside(walk.cell, s.low, s.high - 1) {
            let sign = s.node.value < 0.0;
            if known && negative != sign {
                return Hit(true, walk.t, walk.cell, walk.axis, 1.0);
            }
            known = true;
            negative = sign;
            walk = vp_leave(ray, walk, max(s.low, params.low), min(s.high - 1, params.high));
            continue;
        }
        let corners = vp_corners(grid, params.frame, walk.cell + params.base);
        let exit = vp_exit(ray, walk.cell, walk.cell + 1);
        let along = ray.direction * (exit.t - walk.t);
        let c = cubic(corners, local(ray, walk.cell, walk.t), along);
        if !known {
            known = true;
            negative = c.x < 0.0;
        }
        var mixed = false;
        for (var i = 0; i < 8; i++) {
            mixed |= (corners[i] < 0.0) != negative;
        }
        if mixed {
            let u = first_change(c, negative);
            if u >= 0.0 {
                return Hit(true, walk.t + (exit.t - walk.t) * u, walk.cell, walk.axis, 1.0);
            }
        }
        walk = vp_leave(ray, walk, walk.cell, walk.cell + 1);
    }
    return MISS;
}

// The interpolant of a cell from a place in it along a ray, as a cubic in 0 to 1.
fn cubic(v: array<f32, 8>, p: vec3f, d: vec3f) -> vec4f {
    let k = vec3f(v[1] - v[0], v[2] - v[0], v[4] - v[0]);
    let xy = v[3] - v[1] - v[2] + v[0];
    let yz = v[6] - v[2] - v[4] + v[0];
    let xz = v[5] - v[1] - v[4] + v[0];
    let xyz = v[7] - v[3] - v[5] - v[6] + v[1] + v[2] + v[4] - v[0];
    return vec4f(
        v[0] + k.x * p.x + k.y * p.y + k.z * p.z + xy * p.x * p.y + yz * p.y * p.z + xz * p.x * p.z
            + xyz * p.x * p.y * p.z,
        k.x * d.x + k.y * d.y + k.z * d.z + xy * (p.x * d.y + d.x * p.y) + yz * (p.y * d.z + d.y * p.z)
            + xz * (p.x * d.z + d.x * p.z)
            + xyz * (p.x * p.y * d.z + p.x * d.y * p.z + d.x * p.y * p.z),
        xy * d.x * d.y + yz * d.y * d.z + xz * d.x * d.z
            + xyz * (p.x * d.y * d.z + d.x * p.y * d.z + d.x * d.y * p.z),
        xyz * d.x * d.y * d.z,
    );
}

fn changed(c: vec4f, u: f32, negative: bool) -> bool {
    return ((((c.w * u + c.z) * u + c.y) * u + c.x) < 0.0) != negative;
}

// The first place in 0 to 1 where the sign is not `negative` any more; -1 if there is none.
fn first_change(c: vec4f, negative: bool) -> f32 {
    if changed(c, 0.0, negative) {
        return 0.0;
    }
    // The cubic is cut where it turns, so that each piece has at most one root.
    var turns = vec2f(0.0);
    let a = 3.0 * c.w;
    let discriminant = c.z * c.z - a * c.y;
    if discriminant >= 0.0 {
        let root = sqrt(discriminant);
        let q = select(-(root + c.z), root - c.z, c.z < 0.0);
        let first = select(q / a, 0.0, a == 0.0);
        let second = select(c.y / q, 0.0, q == 0.0);
        turns = vec2f(min(first, second), max(first, second));
    }
    var low = 0.0;
    for (var i = 0; i < 3; i++) {
        let high = vec3f(turns, 1.0)[i];
        if high > low && high <= 1.0 {
            if changed(c, high, negative) {
                var end = high;
                for (var n = 0; n < 24; n++) {
                    let middle = (low + end) * 0.5;
                    if changed(c, middle, negative) {
                        end = middle;
                    } else {
                        low = middle;
                    }
                }
                return end;
            }
            low = high;
        }
    }
    return -1.0;
}

// A surface's own normal in world space; else that of the face, in cell space.
fn normal_at(ray: VpRay, hit: Hit) -> vec3f {
    if params.level_set == 0u {
        var n = vec3f(0.0);
        if hit.axis < 3 {
            n[hit.axis] = select(1.0, -1.0, ray.direction[hit.axis] > 0.0);
        }
        return n;
    }
    let c = vp_corners(grid, params.frame, hit.cell + params.base);
    let p = clamp(local(ray, hit.cell, hit.t), vec3f(0.0), vec3f(1.0));
    let q = 1.0 - p;
    let gradient = vec3f(
        q.y * q.z * (c[1] - c[0]) + p.y * q.z * (c[3] - c[2]) + q.y * p.z * (c[5] - c[4]) + p.y * p.z * (c[7] - c[6]),
        q.x * q.z * (c[2] - c[0]) + p.x * q.z * (c[3] - c[1]) + q.x * p.z * (c[6] - c[4]) + p.x * p.z * (c[7] - c[5]),
        q.x * q.y * (c[4] - c[0]) + p.x * q.y * (c[5] - c[1]) + q.x * p.y * (c[6] - c[2]) + p.x * p.y * (c[7] - c[3]),
    );
    return normalize(vec3f(dot(params.normal_x, gradient), dot(params.normal_y, gradient), dot(params.normal_z, gradient)));
}

fn lit(ray: VpRay, hit: Hit) -> f32 {
    let facing = dot(normal_at(ray, hit), params.sun_world);
    if facing <= 0.0 {
        return params.ambient;
    }
    let shadow = vp_ray(ray.origin + ray.direction * hit.t + params.sun, params.sun);
    if first_hit(shadow).found {
        return params.ambient;
    }
    return params.ambient + (1.0 - params.ambient) * facing;
}

// A hue that differs between neighbouring bricks.
fn brick_hue(cell: vec3i) -> vec3f {
    let b = vec3u(cell >> vec3u(3u)) * vec3u(0x8da6b343u, 0xd8163841u, 0xcb1ab31fu);
    var h = b.x ^ b.y ^ b.z;
    h = (h ^ (h >> 13u)) * 0x85ebca6bu;
    h ^= h >> 16u;
    return 0.2 + 0.8 * vec3f(vec3u(h, h >> 8u, h >> 16u) & vec3u(255u)) / 255.0;
}

// Blue, red or cyan near a boundary of an L1, L2 or L3 node on the face that was hit; else grey.
fn node_color(ray: VpRay, hit: Hit) -> vec3f {
    let p = local(ray, -(params.base & vec3i(4095)), hit.t);
    let dims = vec3f(4096.0, 128.0, 8.0);
    let widths = vec3f(1.0, 0.75, 0.5);
    let colors = array(vec3f(0.1, 0.2, 1.0), vec3f(1.0, 0.15, 0.1), vec3f(0.0, 0.9, 0.9));
    for (var i = 0; i < 3; i++) {
        let place = p / dims[i];
        let off = abs(place - floor(place + 0.5)) * dims[i];
        for (var a = 0; a < 3; a++) {
            if a != hit.axis && off[a] < widths[i] {
                return colors[i];
            }
        }
    }
    return vec3f(0.25);
}

fn shade(ray: VpRay, hit: Hit) -> vec3f {
    if !hit.found {
        return vec3f(select(0.0, -1.0, params.mode == DEPTH));
    }
    switch params.mode {
        case DEPTH: { return vec3f(hit.t); }
        case FIRST: { return vec3f(hit.value); }
        case BRICKS: { return brick_hue(hit.cell + params.base); }
        case STEPS: { return vec3f(0.0); }
        case NODES: { return node_color(ray, hit); }
        case NORMALS: { return normal_at(ray, hit) * 0.5 + 0.5; }
        default: { return vec3f(lit(ray, hit)); }
    }
}

@compute @workgroup_size(8, 8)
fn main(@builtin(global_invocation_id) id: vec3u) {
    if id.x >= params.width || id.y >= params.height {
        return;
    }
    grid = vp_grid(params.grid);
    steps = 0u;
    let x = f32(2u * id.x + 1u) / f32(params.width) - 1.0;
    let y = 1.0 - f32(2u * id.y + 1u) / f32(params.height);
    let edge = vec2f(x * params.half_width, y * params.half_height);
    let ahead = params.forward + params.right * x + params.up * y;
    let ray = vp_ray(params.origin, ahead / sqrt(1.0 + edge.x * edge.x + edge.y * edge.y));

    var color: vec3f;
    if params.mode == DENSITY && params.level_set == 0u {
        color = vec3f(1.0 - exp(-(optical_depth(ray) * params.extinction)));
    } else {
        color = shade(ray, first_hit(ray));
    }
    if params.mode == STEPS {
        color = vec3f(f32(steps));
    }
    output[id.y * params.width + id.x] = vec4f(color, f32(steps));
}
