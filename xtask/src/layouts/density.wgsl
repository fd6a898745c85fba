// density.wgsl: a picture of fog. The file of a layout gives
//
//   fn march(ray: Ray) -> f32           the sum of the samples 0 to ray.samples of a ray

@compute @workgroup_size(8, 16)
fn main(@builtin(global_invocation_id) id: vec3u) {
    if id.x < params.width && id.y < params.height {
        output[id.y * params.width + id.x] = march(ray_of(id.x, id.y)) * params.step;
    }
}
