// surface.wgsl: the first zero of a level set in filtered bricks, and the normal there. Filtered samples find where the sign changes. With
// EXACT the corners of the cells before that sample are fetched, for the exact zero and slope; else halving and differences of
// filtered samples must do.

override EXACT: bool = true;

// Filter weights have 8 bits, so a filtered sign may change this many samples after the exact one.
const LATE = 0.125;
// Halvings of a half voxel: finer than the filter's weights.
const HALVINGS = 10;
// Half the distance of the samples that a slope is taken from, in voxels.
const APART = 0.5;
const MISS = vec4f(-1.0, 0.0, 0.0, 0.0);

// The sign of all values of a region, as far as its record tells.
fn sign_of(region: Region) -> u32 {
    if (region.record.x & 7u) == 0u {
        return u32(bitcast<f32>(region.record.y) < 0.0);
    }
    let least = params.lo + params.span * (f32(region.record.y & 0xffffu) / 65535.0);
    let most = least + params.span * unpack2x16float(region.record.y).y;
    // Zeros are left to the texels, and what rounding might take for one.
    let zero = 1e-6 * params.span;
    return select(select(VP_EITHER, VP_NEGATIVE, most < -zero), VP_POSITIVE, least > zero);
}

fn at(ray: Ray, t: f32) -> vec3f {
    return ray.origin + ray.step * t;
}

fn value_at(p: vec3f, cell: ptr<function, Cell>) -> f32 {
    let region = region_at(p, cell);
    if (region.record.x & 7u) == 0u {
        return bitcast<f32>(region.record.y);
    }
    let brick = brick_of(region);
    return brick.offset + brick.scale * filtered(brick, p);
}

// The value of a voxel, counted from the brick's first.
fn voxel(brick: Brick, p: vec3i) -> f32 {
    let first = vec3i(brick.first);
    var t: f32;
    if (VP_CODECS & 2u) != 0u && brick.codec == BC7 {
        let along = select(select(p.z, p.y, brick.axis == 1u), p.x, brick.axis == 0u);
        let across = vec3i(select(p.x, p.y, brick.axis == 0u), select(p.z, p.y, brick.axis == 2u), along >> 2u);
        t = vp_texel(BC7, 0u, first + across)[along & 3];
    } else {
        t = vp_texel(brick.codec, 0u, first + i32(BORDER) + p).x;
    }
    return brick.offset + brick.scale * t;
}

// The corners of a cell: all of them are in one brick.
fn corners_at(low: vec3f, cell: ptr<function, Cell>) -> VpCorners {
    let region = region_at(low + 0.5, cell);
    if (region.record.x & 7u) == 0u {
        let value = vec4f(bitcast<f32>(region.record.y));
        return VpCorners(value, value);
    }
    let brick = brick_of(region);
    let p = vec3i(low - brick.low);
    return VpCorners(
        vec4f(voxel(brick, p), voxel(brick, p + vec3i(1, 0, 0)), voxel(brick, p + vec3i(0, 1, 0)), voxel(brick, p + vec3i(1, 1, 0))),
        vec4f(voxel(brick, p + vec3i(0, 0, 1)), voxel(brick, p + vec3i(1, 0, 1)), voxel(brick, p + vec3i(0, 1, 1)), voxel(brick, p + 1)),
    );
}

// The first exact zero between two places of a ray, and its normal.
fn exact_zero(ray: Ray, from_t: f32, to_t: f32, negative: bool, cell: ptr<function, Cell>) -> vec4f {
    var t = from_t;
    // A half voxel lies in at most four cells.
    for (var i = 0; i < 5 && t < to_t; i++) {
        let low = floor(at(ray, t + 1e-3));
        let planes = (select(low, low + 1.0, ray.step > vec3f(0.0)) - ray.origin) * ray.inverse;
        let end = clamp(min(planes.x, min(planes.y, planes.z)), t + 1e-3, to_t);
        let corners = corners_at(low, cell);
        if mixed(corners, negative) {
            let u = first_change(cubic(corners, at(ray, t) - low, ray.step * (end - t)), negative);
            if u >= 0.0 {
                let zero = t + (end - t) * u;
                return vec4f(zero, gradient(corners, clamp(at(ray, zero) - low, vec3f(0.0), vec3f(1.0))));
            }
        }
        t = end;
    }
    return MISS;
}

fn halved_zero(ray: Ray, from_t: f32, to_t: f32, negative: bool, cell: ptr<function, Cell>) -> vec4f {
    var low = from_t;
    var high = to_t;
    for (var i = 0; i < HALVINGS; i++) {
        let middle = 0.5 * (low + high);
        if (value_at(at(ray, middle), cell) < 0.0) == negative {
            low = middle;
        } else {
            high = middle;
        }
    }
    let p = at(ray, high);
    let x = vec3f(APART, 0.0, 0.0);
    let slope = vec3f(
        value_at(p + x, cell) - value_at(p - x, cell),
        value_at(p + x.yxy, cell) - value_at(p - x.yxy, cell),
        value_at(p + x.yyx, cell) - value_at(p - x.yyx, cell),
    );
    return vec4f(high, slope);
}

fn first_zero(ray: Ray) -> vec4f {
    var cell = NOWHERE;
    // Before the box is background.
    var negative = params.background < 0.0;
    var k = 0;
    while k < ray.samples {
        let region = region_at(place(ray, k), &cell);
        let end = leave(ray, k, region.low, region.low + region.dim);
        let sign = sign_of(region);
        var found = sign + u32(negative) == VP_NEGATIVE;
        if sign == VP_EITHER {
            let brick = brick_of(region);
            while !found && k < end {
                found = (brick.offset + brick.scale * filtered(brick, place(ray, k)) < 0.0) != negative;
                k += select(1, 0, found);
            }
        }
        if !found {
            k = end;
            continue;
        }
        let before = max(f32(k) - 1.0, 0.0);
        var hit: vec4f;
        if EXACT {
            hit = exact_zero(ray, max(before - LATE, 0.0), f32(k), negative, &cell);
        } else {
            hit = halved_zero(ray, before, f32(k), negative, &cell);
        }
        if hit.x >= 0.0 {
            return hit;
        }
        // The filtered sign changed before the exact one: the next sample will tell.
        k++;
    }
    return MISS;
}

@compute @workgroup_size(8, 16)
fn main(@builtin(global_invocation_id) id: vec3u) {
    if id.x >= params.width || id.y >= params.height {
        return;
    }
    let ray = ray_of(id.x, id.y);
    let hit = first_zero(ray);
    let at = 4u * (id.y * params.width + id.x);
    let size = length(hit.yzw);
    let normal = select(hit.yzw, hit.yzw / size, size > 0.0);
    output[at] = select(-1.0, ray.start + hit.x * params.step, hit.x >= 0.0);
    output[at + 1u] = normal.x;
    output[at + 2u] = normal.y;
    output[at + 3u] = normal.z;
}
