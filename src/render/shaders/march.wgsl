// march.wgsl: a ray march through lit fog. It needs volpack.wgsl and hdda.wgsl. src/render/cpu/march.rs is its twin.
//
// The host supplies two functions of a point in cells, which are used for lit fog only:
//
//   fn vp_depth_to_sun(p: vec3f) -> f32     optical depth from there to the sun, for instance from a grid of points
//                                           that vp_voxel_depth filled, or from a shadow map
//   fn vp_emission(p: vec3f) -> vec3f       emission there, per world unit
//
// and gets:
//
//   vp_march(fog, ray, offset)              radiance and optical depth of a ray, sampled between voxels
//   vp_voxel_depth(fog, ray)                integral of density along a ray, exact, voxel by voxel
//   vp_phase(g, cosine)                     phase function
//
// Cells are voxels counted from `base`. For samples, cell i has voxels i and i + 1 as corners; for vp_voxel_depth,
// cell i is the voxel around i, so its rays begin half a cell farther on each axis.
//
// Scattering is single. Absorption within a step is integrated analytically (Hillaire, "Physically based sky,
// atmosphere and cloud rendering in Frostbite", 2016), and the sun is sampled at the mean depth of what a step
// scatters, so that brightness hardly depends on the step.
//
// All rays of an invocation share VP_MAX_STEPS: a host that traces several sets vp_steps to 0 before each.

// What a host may promise when it creates a pipeline.
override VP_LIT: bool = true;       // radiance is needed, not the optical depth alone
override VP_EMITS: bool = false;    // vp_emission may return light
override VP_SKIPS: bool = true;     // constant nodes are left in one step; by vp_march if they are empty

// What is traced of a grid's frame.
struct VpBox {
    base: vec3i,            // the voxel that cell 0 is
    grid: u32,
    low: vec3i,             // the cells to trace, from low to high (outside)
    frame: u32,
    high: vec3i,
}

struct VpFog {
    box: VpBox,
    extinction: f32,        // optical depth of a density of 1 over a world unit
    sun: vec3f,             // unoccluded sunlight times albedo and phase function
    step: f32,              // between two samples, in t of the ray
    sky: vec3f,             // sky light times albedo
}

// Optical depth at which a ray ends: the transmittance is then 0.001.
const VP_OPAQUE = 7.0;
// Optical depth of a step below which its own absorption of emission is neglected.
const VP_CLEAR = 1e-4;
const VP_MAX_STEPS = 65536u;

// Regions left, voxels stepped through and samples taken.
var<private> vp_steps: u32;

// The node around a ray's cell, as far as it is traced: from low to high (outside).
struct VpPlace {
    cell: VpCell,
    node: VpNode,
    low: vec3i,
    high: vec3i,
}

fn vp_place(box: VpBox, g: VpGrid, last: VpCell, cell: vec3i) -> VpPlace {
    let p = cell + box.base;
    let l2 = vp_cell(g, box.frame, last, p);
    let node = vp_find(g, l2, p);
    let low = node.min - box.base;
    return VpPlace(l2, node, max(low, box.low), min(low + node.dim, box.high));
}

fn vp_traced(box: VpBox, walk: VpWalk) -> bool {
    return vp_inside(walk.cell, box.low, box.high) && vp_steps < VP_MAX_STEPS;
}

// The integral of density over distance, voxel by voxel. Densities below 0 count as 0.
fn vp_voxel_depth(fog: VpFog, ray: VpRay) -> f32 {
    var depth = 0.0;
    var walk = vp_enter(ray, fog.box.low, fog.box.high);
    if !vp_traced(fog.box, walk) {
        return depth;
    }
    let g = vp_grid(fog.box.grid);
    var cell = VP_NOWHERE;
    while vp_traced(fog.box, walk) {
        let at = vp_place(fog.box, g, cell, walk.cell);
        cell = at.cell;
        if VP_SKIPS && at.node.constant {
            vp_steps++;
            let start = walk.t;
            walk = vp_leave(ray, walk, at.low, at.high);
            depth += (walk.t - start) * max(at.node.value, 0.0);
            continue;
        }
        let brick = vp_brick(g, at.node);
        let behind = vp_behind(ray, at.low, at.high);
        loop {
            vp_steps++;
            let value = vp_value(g, brick, walk.cell + fog.box.base);
            let start = walk.t;
            walk = vp_step(ray, walk);
            depth += (walk.t - start) * max(value, 0.0);
            if any(walk.cell == behind) {
                break;
            }
        }
    }
    return depth;
}

struct VpMarched {
    light: vec3f,       // radiance without what is behind
    depth: f32,         // optical depth
}

// When a ray leaves the box from low to high.
fn vp_exit(ray: VpRay, low: vec3i, high: vec3i) -> f32 {
    return vp_least(vp_crossings(ray, select(low, high, ray.forward)));
}

// The number of the first sample that is not before t.
fn vp_sample_from(t: f32, step: f32, offset: f32) -> f32 {
    return ceil(t / step - offset);
}

// Where light that reaches the eye was scattered on average, from the middle of a step and in steps: denser fog
// scatters it nearer. The last two are the transmittance before and behind the step.
fn vp_scattering_offset(thickness: f32, through: f32, left: f32) -> f32 {
    // For thin steps the exact form would lose its digits, and the series is as good.
    let exact = 1.0 / thickness - left / (through - left) - 0.5;
    return select(exact, -thickness / 12.0, thickness < 0.1);
}

// Samples are at t = (number + offset) · step. Each looks up its node anew: a second loop for the samples of one brick
// does not help, because neighbouring rays then sample at different times.
fn vp_march(fog: VpFog, ray: VpRay, offset: f32) -> VpMarched {
    var light = vec3f(0.0);
    var depth = 0.0;
    var through = 1.0;
    let walk = vp_enter(ray, fog.box.low, fog.box.high);
    if !vp_traced(fog.box, walk) {
        return VpMarched(light, depth);
    }
    let g = vp_grid(fog.box.grid);
    let end = vp_exit(ray, fog.box.low, fog.box.high);
    var l2 = VP_NOWHERE;
    var next = vp_sample_from(walk.t, fog.step, offset);
    while depth < VP_OPAQUE && vp_steps < VP_MAX_STEPS {
        let t = (next + offset) * fog.step;
        if t >= end {
            break;
        }
        vp_steps++;
        next += 1.0;
        let p = ray.origin + ray.direction * t;
        // Rounding may put p just outside the box.
        let cell = clamp(vec3i(floor(p)), fog.box.low, fog.box.high - 1);
        let voxel = cell + fog.box.base;
        l2 = vp_cell(g, fog.box.frame, l2, voxel);
        let node = vp_find(g, l2, voxel);
        var density = node.value;
        // A cell has the next voxels as corners, so the last layer of a node's cells is not constant, unless the nodes
        // around it are background too.
        let skips = VP_SKIPS && node.constant;
        let alone = skips && node.dim == 8 && vp_alone(l2, voxel);
        let low = node.min - fog.box.base;
        let inner = low + node.dim - select(1, 0, alone);
        if skips && all(cell < inner) {
            if !VP_EMITS && density <= 0.0 {
                next = max(next, vp_sample_from(vp_exit(ray, low, inner), fog.step, offset));
                continue;
            }
        } else {
            density = vp_between(vp_corners(g, fog.box.frame, l2, vp_brick(g, node), voxel), p - vec3f(cell));
        }
        let thickness = max(density, 0.0) * fog.step * fog.extinction;
        depth += thickness;
        if VP_LIT {
            let left = exp(-depth);
            if thickness > 0.0 {
                let lit = p + ray.direction * (fog.step * vp_scattering_offset(thickness, through, left));
                light += (through - left) * (fog.sun * exp(-vp_depth_to_sun(lit)) + fog.sky);
            }
            if VP_EMITS {
                let seen = select((through - left) / thickness, through, thickness < VP_CLEAR);
                light += vp_emission(p) * (fog.step * seen);
            }
            through = left;
        }
    }
    return VpMarched(light, depth);
}

// The phase function of Henyey and Greenstein ("Diffuse radiation in the galaxy", 1941), relative to isotropic
// scattering. `cosine` is that of the angle between the ray and the direction to the sun.
fn vp_phase(g: f32, cosine: f32) -> f32 {
    return (1.0 - g * g) / pow(1.0 + g * g - 2.0 * g * cosine, 1.5);
}
