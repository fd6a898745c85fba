// dense.wgsl: the control, one unorm8 texture of the whole box. Its first texel is one voxel before the box; with SKIP there is one word a
// region of 8³ positions, 0 if all of it is background.

override SKIP: bool = false;

fn march(ray: Ray) -> f32 {
    let inverse = params.atlases[2].inverse;
    let origin = (ray.origin + 1.5) * inverse;
    let step = ray.step * inverse;
    var texels = 0.0;
    var count = 0;
    var k = 0;
    while k < ray.samples {
        var end = ray.samples;
        if SKIP {
            let b = clamp(vec3i(floor(place(ray, k) * 0.125)), vec3i(0), params.cells - 1);
            end = leave(ray, k, vec3f(b) * 8.0, vec3f(b + 1) * 8.0);
            if tree[(b.z * params.cells.y + b.y) * params.cells.x + b.x] == 0u {
                k = end;
                continue;
            }
        }
        count += end - k;
        while k < end {
            texels += textureSampleLevel(unorm8_texels, trilinear, origin + step * f32(k), 0.0).x;
            k++;
        }
    }
    return f32(count) * params.lo + params.span * texels;
}
