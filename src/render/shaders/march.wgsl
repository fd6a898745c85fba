// march.wgsl: fog between its voxels, in equal steps, and its light. It needs volpack.wgsl and hdda.wgsl.
// src/render/cpu/march.rs is its twin.
//
// For lit fog the host supplies two functions of a place in cells:
//
//   fn vp_depth_to_sun(p: vec3f) -> f32     the optical depth from there to the sun, for instance from a lattice
//                                           that vp_voxel_depth filled, or from a shadow map
//   fn vp_glow(p: vec3f) -> vec3f           the light that is emitted there, per world unit; 0 for none
//
// and gets:
//
//   vp_march(fog, ray, first)               light and transmittance of a ray, from samples between voxels
//   vp_voxel_depth(fog, ray)                density along a ray, exact, voxel by voxel
//   vp_phase(g, cosine)                     how much fog scatters towards the eye
//
// Cells are voxels counted from `base`. For samples a cell lies between its voxel and the next ones; for
// vp_voxel_depth it is the voxel, so that its rays begin half a cell farther on each axis.
//
// Scattering is single. A step's own absorption is integrated exactly (Hillaire, "Physically based sky, atmosphere
// and cloud rendering in Frostbite", 2016), so that light does not depend on the step's length.

// What a host may promise when it makes a pipeline.
override VP_LIT: bool = true;       // light is asked for, and not the optical depth alone
override VP_GLOWS: bool = false;    // vp_glow may return light
override VP_SKIPS: bool = true;     // constant nodes are left in one step

struct VpFog {
    base: vec3i,            // the voxel that cell 0 is
    grid: u32,
    low: vec3i,             // the cells to trace, from low to high (outside)
    frame: u32,
    high: vec3i,
    extinction: f32,        // optical depth of a density of 1 over a world unit
    sun: vec3f,             // what a place scatters of the sun's light, where that is not dimmed
    step: f32,              // between two samples, in t of the ray
    sky: vec3f,             // what it scatters of the sky's
}

// Optical depth at which a ray ends: what is behind is dimmed to a thousandth.
const VP_OPAQUE = 7.0;
// A step's optical depth under which what glows in it is taken as not dimmed.
const VP_CLEAR = 1e-4;
const VP_MAX_STEPS = 65536u;

// Regions left and samples taken.
var<private> vp_steps: u32;

// The node around a ray's cell, as far as it is traced: from low to high (outside).
struct VpPlace {
    cell: VpCell,
    node: VpNode,
    low: vec3i,
    high: vec3i,
}

fn vp_place(fog: VpFog, g: VpGrid, last: VpCell, cell: vec3i) -> VpPlace {
    let p = cell + fog.base;
    let l2 = vp_cell(g, fog.frame, last, p);
    let node = vp_find(g, l2, p);
    let low = node.min - fog.base;
    return VpPlace(l2, node, max(low, fog.low), min(low + node.dim, fog.high));
}

fn vp_traced(fog: VpFog, walk: VpWalk) -> bool {
    return vp_inside(walk.cell, fog.low, fog.high) && vp_steps < VP_MAX_STEPS;
}

// The integral of density over distance, voxel by voxel. What is below 0 absorbs nothing.
fn vp_voxel_depth(fog: VpFog, ray: VpRay) -> f32 {
    var depth = 0.0;
    var walk = vp_enter(ray, fog.low, fog.high);
    if !vp_traced(fog, walk) {
        return depth;
    }
    let g = vp_grid(fog.grid);
    var cell = VP_NOWHERE;
    while vp_traced(fog, walk) {
        let at = vp_place(fog, g, cell, walk.cell);
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
            let value = vp_value(g, brick, walk.cell + fog.base);
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
    light: vec3f,
    depth: f32,         // optical depth up to where the ray ended
}

// The number of the first sample that is not before t.
fn vp_sample_from(t: f32, step: f32, first: f32) -> f32 {
    return ceil(t / step - first);
}

// Samples lie `first` of a step behind each multiple of the step.
fn vp_march(fog: VpFog, ray: VpRay, first: f32) -> VpMarched {
    var light = vec3f(0.0);
    var depth = 0.0;
    var through = 1.0;
    var walk = vp_enter(ray, fog.low, fog.high);
    if !vp_traced(fog, walk) {
        return VpMarched(light, depth);
    }
    let g = vp_grid(fog.grid);
    var l2 = VP_NOWHERE;
    var next = vp_sample_from(walk.t, fog.step, first);
    while vp_traced(fog, walk) && depth < VP_OPAQUE {
        vp_steps++;
        let at = vp_place(fog, g, l2, walk.cell);
        l2 = at.cell;
        // A cell reaches over to the next voxels: the last layer of a node's cells is not of one value, unless all
        // around is background too.
        let skips = VP_SKIPS && at.node.constant;
        let alone = skips && at.node.dim == 8 && vp_alone(l2, walk.cell + fog.base);
        let inner = min(at.high, at.node.min - fog.base + at.node.dim - select(1, 0, alone));
        let is_inner = skips && vp_inside(walk.cell, at.low, inner);
        let block = ((walk.cell + fog.base) & vec3i(-8)) - fog.base;
        let low = select(max(block, at.low), at.low, is_inner);
        let high = select(min(block + 8, at.high), inner, is_inner);
        walk = vp_leave(ray, walk, low, high);
        if !VP_GLOWS && is_inner && at.node.value <= 0.0 {
            next = vp_sample_from(walk.t, fog.step, first);
            continue;
        }
        let brick = vp_brick(g, at.node);
        loop {
            let t = (next + first) * fog.step;
            if t >= walk.t || vp_steps >= VP_MAX_STEPS {
                break;
            }
            vp_steps++;
            next += 1.0;
            let p = ray.origin + ray.direction * t;
            var value = at.node.value;
            if !is_inner {
                // By a rounding a place may lie beside its region.
                let cell = clamp(vec3i(floor(p)), low, high - 1);
                value = vp_between(vp_corners(g, fog.frame, l2, brick, cell + fog.base), p - vec3f(cell));
            }
            let thickness = max(value, 0.0) * fog.step * fog.extinction;
            depth += thickness;
            if VP_LIT {
                let left = exp(-depth);
                if thickness > 0.0 {
                    light += (through - left) * (fog.sun * exp(-vp_depth_to_sun(p)) + fog.sky);
                }
                if VP_GLOWS {
                    let seen = select((through - left) / thickness, through, thickness < VP_CLEAR);
                    light += vp_glow(p) * (fog.step * seen);
                }
                through = left;
            }
            if depth >= VP_OPAQUE {
                break;
            }
        }
    }
    return VpMarched(light, depth);
}

// The phase function of Henyey and Greenstein ("Diffuse radiation in the galaxy", 1941), as a multiple of what
// scatters alike everywhere. The cosine is that of the angle between the ray and the way to the sun.
fn vp_phase(g: f32, cosine: f32) -> f32 {
    return (1.0 - g * g) / pow(1.0 + g * g - 2.0 * g * cosine, 1.5);
}
