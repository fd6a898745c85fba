// fog.wgsl: the march through filtered bricks. A region of one value is left in one step, a brick is kept while the ray is in it.

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
            k = end;
            continue;
        }
        let brick = brick_of(region);
        var texels = 0.0;
        while k < end {
            texels += filtered(brick, place(ray, k));
            k++;
        }
        sum += count * brick.offset + brick.scale * texels;
    }
    return sum;
}
