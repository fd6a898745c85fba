// fetch.wgsl: today's packs, eight fetches a sample. A node is left in one step where all corners of its cells are one value.

override KEEP: bool = false;        // whether a brick's record is kept while the ray is in the brick

fn march(ray: Ray) -> f32 {
    let g = vp_grid(0u);
    var cell = VP_NOWHERE;
    var sum = 0.0;
    var k = 0;
    while k < ray.samples {
        var low = floor(place(ray, k));
        var voxel = vec3i(low) + params.base;
        cell = vp_cell(g, 0u, cell, voxel);
        let node = vp_find(g, cell, voxel);
        let corner = vec3f(node.min - params.base);
        if node.constant {
            // Cells of the last layer reach into the next node.
            let alone = node.dim == 8 && node.value == g.background && vp_alone(cell, voxel);
            let inner = node.min + node.dim - select(1, 0, alone);
            if all(voxel < inner) {
                let next = leave(ray, k, corner, vec3f(inner - params.base));
                sum += f32(next - k) * node.value;
                k = next;
                continue;
            }
        }
        let brick = vp_brick(g, node);
        if KEEP && !node.constant {
            let end = leave(ray, k, corner, corner + 8.0);
            while k < end {
                let p = place(ray, k);
                low = clamp(floor(p), corner, corner + 7.0);
                voxel = vec3i(low) + params.base;
                var c: VpCorners;
                if vp_edges(voxel) == 0u {
                    c = VpCorners(vp_quad(g, brick, voxel), vp_quad(g, brick, voxel + vec3i(0, 0, 1)));
                } else {
                    c = vp_corners(g, 0u, cell, brick, voxel);
                }
                sum += vp_between(c, p - low);
                k++;
            }
        } else {
            sum += vp_between(vp_corners(g, 0u, cell, brick, voxel), place(ray, k) - low);
            k++;
        }
    }
    return sum;
}
