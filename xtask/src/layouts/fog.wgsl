// fog.wgsl: the march through filtered bricks. A region of one value is left in one step, a brick is kept while the ray is in it.

// The sum of a brick's texels from sample k to `end`. It is a loop of its own for each codec, since a branch at each sample would keep fetches
// from overlapping.
fn sum_in(texels: texture_3d<f32>, brick: Brick, ray: Ray, k: i32, end: i32) -> f32 {
    let origin = ray.origin * brick.inverse + brick.shift;
    let step = ray.step * brick.inverse;
    var sum = 0.0;
    for (var i = k; i < end; i++) {
        sum += textureSampleLevel(texels, trilinear, origin + step * f32(i), 0.0).x;
    }
    return sum;
}

fn sum_of(brick: Brick, ray: Ray, k: i32, end: i32) -> f32 {
    if (VP_CODECS & 2u) != 0u && brick.codec == BC7 {
        var sum = 0.0;
        for (var i = k; i < end; i++) {
            sum += filtered_bc7(brick, place(ray, i) - brick.low);
        }
        return sum;
    }
    if (VP_CODECS & 4u) != 0u && brick.codec == 2u { return sum_in(bc4_texels, brick, ray, k, end); }
    if (VP_CODECS & 8u) != 0u && brick.codec == 3u { return sum_in(unorm8_texels, brick, ray, k, end); }
    if (VP_CODECS & 16u) != 0u && brick.codec == 4u { return sum_in(f16_texels, brick, ray, k, end); }
    return sum_in(f32_texels, brick, ray, k, end);
}

fn march(ray: Ray) -> f32 {
    var cell = NOWHERE;
    var sum = 0.0;
    var k = 0;
    while k < ray.samples {
        let region = region_at(place(ray, k), &cell);
        let end = leave(ray, k, region.low, region.low + region.dim);
        let count = f32(end - k);
        if (region.record.x & 7u) == 0u {
            sum += count * bitcast<f32>(region.record.y);
        } else {
            let brick = brick_of(region);
            sum += count * brick.offset + brick.scale * sum_of(brick, ray, k, end);
        }
        k = end;
    }
    return sum;
}
