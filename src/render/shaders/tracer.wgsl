// tracer.wgsl: bindings, camera and modes around volpack.wgsl and march.wgsl. src/render/cpu/mod.rs is its twin.

struct Params {
    origin: vec3f,          // the eye, in cells from base
    width: u32,
    forward: vec3f,         // the ray through the middle, then to the right edge and to the top
    height: u32,
    right: vec3f,
    half_width: f32,
    up: vec3f,
    half_height: f32,
    base: vec3i,            // the voxel that cell 0 is
    grid: u32,
    low: vec3i,             // the cells to trace
    frame: u32,
    high: vec3i,
    extinction: f32,
    sun: vec3f,             // towards the sun in cells, scaled to how far off a surface shadows begin
    threshold: f32,
    sun_world: vec3f,
    ambient: f32,
    normal_x: vec3f,        // rows whose products with a gradient are the normal in world space
    step: f32,              // of the ray march, in world units or in cells
    normal_y: vec3f,
    step_in_cells: u32,
    normal_z: vec3f,
    jitter: u32,            // whether each pixel's samples are offset by a hash
    to_sun: vec3f,          // towards the sun of fog, in cells a world unit
    anisotropy: f32,
    sun_cosine: vec3f,      // its product with a direction in cells is the cosine of the angle with the sun
    light_spacing: i32,     // cells between two points of the light grid
    light_points: vec3u,    // how many there are along each axis
    emission_grid: u32,
    sun_light: vec3f,       // unoccluded sunlight times albedo
    emission_frame: u32,
    sky_light: vec3f,       // sky light times albedo
    emission_scale: f32,    // from values to places on the ramp
    backdrop: vec3f,        // radiance behind lit fog
    to_emission: array<vec4f, 3>,       // rows of the matrix from cells to the emissive grid's index space
    ramp: array<vec4f, 64>,             // emission per world unit
}

// A pipeline does one thing: what it does not is left out of its code, and costs no registers.
override MODE: u32 = 0u;
override HDDA: bool = true;
override LEVEL_SET: bool = false;
override TRILINEAR: bool = true;     // else the nearest voxel

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> tree: array<u32>;
@group(0) @binding(2) var<storage, read_write> output: array<vec4f>;
@group(0) @binding(3) var<storage, read_write> depths_to_sun: array<f32>;
// From binding 4 on a texture a codec. They and vp_texel, which reads them, are written by src/render/gpu/pipelines.rs.

fn vp_word(i: u32) -> u32 {
    return tree[i];
}

const DENSITY = 0u;
const DEPTH = 1u;
const FIRST = 2u;
const BRICKS = 3u;
const STEPS = 4u;
const NODES = 5u;
const NORMALS = 6u;
const LIT = 7u;

// What the picture shows.
fn box_of() -> VpBox {
    return VpBox(params.base, params.grid, params.low, params.frame, params.high);
}

fn traced(walk: VpWalk) -> bool {
    return vp_traced(box_of(), walk);
}

// The fog of the picture; the ray's t is in world units.
fn fog_of(ray: VpRay) -> VpFog {
    let t_of_step = select(1.0, 1.0 / length(ray.direction), params.step_in_cells != 0u);
    let phase = vp_phase(params.anisotropy, dot(ray.direction, params.sun_cosine));
    return VpFog(
        box_of(), params.extinction, params.sun_light * phase, params.step * t_of_step, params.sky_light,
    );
}

// The offset of a pixel's samples, in steps: 0.5, or a hash of the pixel.
fn sample_offset(pixel: vec2u) -> f32 {
    if params.jitter == 0u {
        return 0.5;
    }
    // The hash "lowbias32" of Wellons ("Prospecting for hash functions", 2018).
    var h = pixel.y * params.width + pixel.x;
    h = (h ^ (h >> 16u)) * 0x7feb352du;
    h = (h ^ (h >> 15u)) * 0x846ca68bu;
    h ^= h >> 16u;
    return f32(h >> 8u) / 16777216.0;
}

fn vp_depth_to_sun(p: vec3f) -> f32 {
    let place = (p - vec3f(params.low)) / f32(params.light_spacing);
    let low = vec3u(clamp(vec3i(floor(place)), vec3i(0), vec3i(params.light_points) - 2));
    let y = params.light_points.x;
    let z = y * params.light_points.y;
    let i = low.z * z + low.y * y + low.x;
    let near = vec4f(depths_to_sun[i], depths_to_sun[i + 1u], depths_to_sun[i + y], depths_to_sun[i + y + 1u]);
    let j = i + z;
    let far = vec4f(depths_to_sun[j], depths_to_sun[j + 1u], depths_to_sun[j + y], depths_to_sun[j + y + 1u]);
    return vp_between(VpCorners(near, far), place - vec3f(low));
}

fn vp_emission(p: vec3f) -> vec3f {
    let at = vec4f(p, 1.0);
    let m = params.to_emission;
    let place = vec3f(dot(m[0], at), dot(m[1], at), dot(m[2], at));
    let value = vp_trilinear(vp_grid(params.emission_grid), params.emission_frame, place) * params.emission_scale;
    if !(value > 0.0) {
        return vec3f(0.0);
    }
    let low = min(u32(value), 62u);
    return mix(params.ramp[low].xyz, params.ramp[low + 1u].xyz, min(value - f32(low), 1.0));
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
    if LEVEL_SET && TRILINEAR {
        return first_surface(ray);
    }
    if LEVEL_SET {
        return first_sign(ray);
    }
    return first_density(ray);
}

fn first_density(ray: VpRay) -> Hit {
    var walk = vp_enter(ray, params.low, params.high);
    if !traced(walk) {
        return MISS;
    }
    let g = vp_grid(params.grid);
    var cell = VP_NOWHERE;
    while traced(walk) {
        let at = vp_place(box_of(), g, cell, walk.cell);
        cell = at.cell;
        if HDDA && at.node.constant {
            vp_steps++;
            if at.node.value > params.threshold {
                return Hit(true, walk.t, walk.cell, walk.axis, at.node.value);
            }
            walk = vp_leave(ray, walk, at.low, at.high);
            continue;
        }
        let brick = vp_brick(g, at.node);
        let behind = vp_behind(ray, at.low, at.high);
        loop {
            vp_steps++;
            let value = vp_value(g, brick, walk.cell + params.base);
            if value > params.threshold {
                return Hit(true, walk.t, walk.cell, walk.axis, value);
            }
            walk = vp_step(ray, walk);
            if any(walk.cell == behind) || vp_steps >= VP_MAX_STEPS {
                break;
            }
        }
    }
    return MISS;
}

// The first voxel of another sign than the first.
fn first_sign(ray: VpRay) -> Hit {
    var walk = vp_enter(ray, params.low, params.high);
    if !traced(walk) {
        return MISS;
    }
    let g = vp_grid(params.grid);
    var cell = VP_NOWHERE;
    // Before the box the sign is the background's.
    var first = select(VP_EITHER, u32(g.background < 0.0), walk.axis < 3);
    while traced(walk) {
        let at = vp_place(box_of(), g, cell, walk.cell);
        cell = at.cell;
        let sign = vp_sign(g, at.node);
        if HDDA && at.node.constant {
            vp_steps++;
            if first + sign == VP_NEGATIVE {
                return Hit(true, walk.t, walk.cell, walk.axis, 1.0);
            }
            first = sign;
            walk = vp_leave(ray, walk, at.low, at.high);
            continue;
        }
        let brick = vp_brick(g, at.node);
        let behind = vp_behind(ray, at.low, at.high);
        loop {
            vp_steps++;
            var here = sign;
            if here == VP_EITHER {
                here = u32(vp_value(g, brick, walk.cell + params.base) < 0.0);
            }
            if first + here == VP_NEGATIVE {
                return Hit(true, walk.t, walk.cell, walk.axis, 1.0);
            }
            first = here;
            walk = vp_step(ray, walk);
            if any(walk.cell == behind) || vp_steps >= VP_MAX_STEPS {
                break;
            }
        }
    }
    return MISS;
}

// A place on the ray relative to a cell.
fn local(ray: VpRay, cell: vec3i, t: f32) -> vec3f {
    return ray.origin - vec3f(cell) + ray.direction * t;
}

// The first zero of the interpolated field. A cell reaches over to the next voxel on each axis, so the
// last layer of a node's cells is taken one by one, unless all around is background too.
fn first_surface(ray: VpRay) -> Hit {
    var walk = vp_enter(ray, params.low, params.high);
    if !traced(walk) {
        return MISS;
    }
    let g = vp_grid(params.grid);
    var l2 = VP_NOWHERE;
    // Whether the sign is known, and whether it is negative: before the box it is the background's.
    var known = walk.axis < 3;
    var negative = known && g.background < 0.0;
    while traced(walk) {
        let at = vp_place(box_of(), g, l2, walk.cell);
        l2 = at.cell;
        let skips = HDDA && at.node.constant;
        let alone = skips && at.node.dim == 8 && vp_alone(l2, walk.cell + params.base);
        let inner = min(at.high, at.node.min - params.base + at.node.dim - select(1, 0, alone));
        // Beside the last layer of a larger node the parts of cells change from brick to brick.
        let block = ((walk.cell + params.base) & vec3i(-8)) - params.base;
        let behind = vp_behind(ray, max(block, at.low), min(block + 8, at.high));
        // Two bits for each part that a cell may have: its sign, or 3 until it is looked up.
        var signs = 0xfffcu | vp_sign(g, at.node);
        let brick = vp_brick(g, at.node);
        loop {
            vp_steps++;
            if skips && vp_inside(walk.cell, at.low, inner) {
                let sign = at.node.value < 0.0;
                if known && negative != sign {
                    return Hit(true, walk.t, walk.cell, walk.axis, 1.0);
                }
                known = true;
                negative = sign;
                walk = vp_leave(ray, walk, at.low, inner);
                if at.node.dim > 8 || any(walk.cell == behind) || vp_steps >= VP_MAX_STEPS {
                    break;
                }
                continue;
            }
            // Bit 0 for a corner that is not negative, 1 for one that is, 2 for not known.
            let p = walk.cell + params.base;
            let edges = vp_edges(p);
            var seen = select(0u, 1u << u32(negative), known);
            var part = 0u;
            loop {
                var sign = (signs >> (2u * part)) & 3u;
                if sign == 3u {
                    sign = vp_sign(g, vp_part(g, params.frame, l2, p, part));
                    signs ^= (3u ^ sign) << (2u * part);
                }
                if sign == VP_EITHER && part == 0u {
                    sign = vp_idle(g, brick, p);
                }
                seen |= 1u << sign;
                part = vp_next_part(part, edges);
                if part == 0u {
                    break;
                }
            }
            if seen <= 2u {
                known = true;
                negative = seen == 2u;
            } else {
                let corners = vp_corners(g, params.frame, l2, brick, p);
                let first = corners.near.x < 0.0;
                if !mixed(corners, first) && (!known || negative == first) {
                    // So is the cell, whatever rounding makes of its interpolant.
                    known = true;
                    negative = first;
                } else {
                    let exit = vp_least(walk.next);
                    let along = ray.direction * (exit - walk.t);
                    let c = cubic(corners, local(ray, walk.cell, walk.t), along);
                    negative = select(c.x < 0.0, negative, known);
                    known = true;
                    if mixed(corners, negative) {
                        let u = first_change(c, negative);
                        if u >= 0.0 {
                            return Hit(true, walk.t + (exit - walk.t) * u, walk.cell, walk.axis, 1.0);
                        }
                    }
                }
            }
            walk = vp_step(ray, walk);
            if any(walk.cell == behind) || vp_steps >= VP_MAX_STEPS {
                break;
            }
        }
    }
    return MISS;
}

// A surface's own normal in world space; else that of the face, in cell space.
fn normal_at(ray: VpRay, hit: Hit) -> vec3f {
    if !(LEVEL_SET && TRILINEAR) {
        return select(vec3f(0.0), select(vec3f(1.0), vec3f(-1.0), ray.forward), VP_AXES == vec3i(hit.axis));
    }
    let g = vp_grid(params.grid);
    let at = vp_place(box_of(), g, VP_NOWHERE, hit.cell);
    let c = vp_corners(g, params.frame, at.cell, vp_brick(g, at.node), hit.cell + params.base);
    let p = clamp(local(ray, hit.cell, hit.t), vec3f(0.0), vec3f(1.0));
    let slope = gradient(c, p);
    let normal = vec3f(dot(params.normal_x, slope), dot(params.normal_y, slope), dot(params.normal_z, slope));
    // Where all corners are zero there is none.
    let size = length(normal);
    return select(normal, normal / size, size > 0.0);
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
        return vec3f(select(0.0, -1.0, MODE == DEPTH));
    }
    switch MODE {
        case DEPTH: { return vec3f(hit.t); }
        case FIRST: { return vec3f(hit.value); }
        case BRICKS: { return brick_hue(hit.cell + params.base); }
        case STEPS: { return vec3f(0.0); }
        case NODES: { return node_color(ray, hit); }
        case NORMALS: { return normal_at(ray, hit) * 0.5 + 0.5; }
        default: { return vec3f(lit(ray, hit)); }
    }
}

@compute @workgroup_size(8, 16)
fn main(@builtin(global_invocation_id) id: vec3u) {
    if id.x >= params.width || id.y >= params.height {
        return;
    }
    vp_steps = 0u;
    let x = f32(2u * id.x + 1u) / f32(params.width) - 1.0;
    let y = 1.0 - f32(2u * id.y + 1u) / f32(params.height);
    let edge = vec2f(x * params.half_width, y * params.half_height);
    let ahead = params.forward + params.right * x + params.up * y;
    let ray = vp_ray(params.origin, ahead / sqrt(1.0 + edge.x * edge.x + edge.y * edge.y));

    var color: vec3f;
    if LEVEL_SET || (MODE != DENSITY && MODE != LIT) {
        color = shade(ray, first_hit(ray));
    } else if TRILINEAR {
        let marched = vp_march(fog_of(ray), ray, sample_offset(id.xy));
        let through = exp(-marched.depth);
        color = select(vec3f(1.0 - through), marched.light + through * params.backdrop, VP_LIT);
    } else {
        color = vec3f(1.0 - exp(-(vp_voxel_depth(fog_of(ray), ray) * params.extinction)));
    }
    if MODE == STEPS {
        color = vec3f(f32(vp_steps));
    }
    output[id.y * params.width + id.x] = vec4f(color, f32(vp_steps));
}

// Fills the light grid: optical depths to the sun.
@compute @workgroup_size(64)
fn measure_light(@builtin(global_invocation_id) id: vec3u) {
    let points = params.light_points;
    let i = id.x;
    if i >= points.x * points.y * points.z {
        return;
    }
    vp_steps = 0u;
    let point = vec3u(i % points.x, i / points.x % points.y, i / (points.x * points.y));
    let origin = vec3f(params.low + vec3i(point) * params.light_spacing) + 0.5;
    let ray = vp_ray(origin, params.to_sun);
    depths_to_sun[i] = vp_voxel_depth(fog_of(ray), ray) * params.extinction;
}
