// cubic.wgsl: zeros and slopes of the trilinear field in a cell, from its eight corners (VpCorners of volpack.wgsl).

// Whether a corner has the other sign.
fn mixed(corners: VpCorners, negative: bool) -> bool {
    let other = vec4<bool>(!negative);
    return any(((corners.near < vec4f(0.0)) == other) | ((corners.far < vec4f(0.0)) == other));
}

// The interpolant of a cell from a place in it along a ray, as a cubic in 0 to 1.
fn cubic(corners: VpCorners, p: vec3f, d: vec3f) -> vec4f {
    let v = array(
        corners.near.x, corners.near.y, corners.near.z, corners.near.w,
        corners.far.x, corners.far.y, corners.far.z, corners.far.w,
    );
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

// The slope of the interpolant at a place in a cell.
fn gradient(c: VpCorners, p: vec3f) -> vec3f {
    let x = mix(vec4f(c.near.xz, c.far.xz), vec4f(c.near.yw, c.far.yw), p.x);
    let z = mix(c.near, c.far, p.z);
    return vec3f(
        mix(z.y - z.x, z.w - z.z, p.y),
        mix(x.y - x.x, x.w - x.z, p.z),
        mix(x.z - x.x, x.w - x.y, p.y),
    );
}
