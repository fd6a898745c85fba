// hdda.wgsl: rays through cells and nodes. It stands on its own; with volpack.wgsl it steps over what is
// constant.
//
//   vp_ray(origin, direction)           a ray, in cells
//   vp_enter(ray, low, high)            its first cell in a box
//   vp_step(ray, walk)                  the next cell: a DDA
//   vp_leave(ray, walk, low, high)      the first cell behind a box: with that of a node, an HDDA
//
// A ray crosses plane k of axis a at t = (k − origin) / direction, always from the plane's number and
// never accumulated. Its crossings, ordered by t and among equals by axis, are the order of its cells. A
// DDA takes the next crossing; an HDDA the one that leaves a node, with all that come before it. So it
// visits the cells of the DDA, less those it skipped, and needs no nudge over edges.

// Later than any crossing; times 2²⁴, the farthest cell, still a number.
const VP_FAR = 1.0e30;
const VP_AXES = vec3i(0, 1, 2);

struct VpRay {
    origin: vec3f,
    direction: vec3f,
    inverse: vec3f,
    base: vec3f,            // its origin as planes see it
    forward: vec3<bool>,
}

// Along an axis on which it does not move, a ray's crossings are as far off as numbers go: it begins a
// whole cell before the next plane, at a speed of next to nothing.
fn vp_ray(origin: vec3f, direction: vec3f) -> VpRay {
    let still = direction == vec3f(0.0);
    return VpRay(
        origin,
        direction,
        select(1.0 / select(direction, vec3f(1.0), still), vec3f(VP_FAR), still),
        select(origin, floor(origin), still),
        direction >= vec3f(0.0),
    );
}

// A ray's place: the cell it is in, since when, and the axis of the face it came through (3: none).
struct VpWalk {
    cell: vec3i,
    t: f32,
    axis: i32,
    next: vec3f,        // when it crosses the planes ahead,
    plane: vec3f,       // and which they are
}

// When a ray crosses plane k of each axis.
fn vp_crossings(ray: VpRay, k: vec3i) -> vec3f {
    return (vec3f(k) - ray.base) * ray.inverse;
}

// The axis of the first of three crossings.
fn vp_first(t: vec3f) -> i32 {
    return select(select(2, 1, t.y <= t.z), 0, t.x <= t.y && t.x <= t.z);
}

fn vp_least(t: vec3f) -> f32 {
    return min(t.x, min(t.y, t.z));
}

// A walk that crosses into a cell.
fn vp_arrive(ray: VpRay, cell: vec3i, t: f32, axis: i32) -> VpWalk {
    let plane = cell + select(vec3i(0), vec3i(1), ray.forward);
    return VpWalk(cell, t, axis, vp_crossings(ray, plane), vec3f(plane));
}

// A walk that crosses into a cell at t through a plane of `axis`. There the cell is `to`; on the other
// axes it is the one after all crossings that come before, from `start` on and up to `end`.
fn vp_settle(ray: VpRay, t: f32, axis: i32, to: vec3i, start: vec3i, end: vec3i) -> VpWalk {
    let here = VP_AXES == vec3i(axis);
    let ties = VP_AXES < vec3i(axis);
    let step = select(vec3i(-1), vec3i(1), ray.forward);
    let ahead = select(vec3i(0), vec3i(1), ray.forward);
    let guess = vec3i(floor(ray.origin + ray.direction * t));
    var cell = clamp(guess, min(start, end), max(start, end));
    var leaves: vec3f;
    // Rounding may leave the guess a cell off, which rarely happens.
    loop {
        let enters = vp_crossings(ray, cell + ahead - step);
        leaves = vp_crossings(ray, cell + ahead);
        let entered = (enters < vec3f(t)) | ((enters == vec3f(t)) & ties);
        let left = (leaves < vec3f(t)) | ((leaves == vec3f(t)) & ties);
        let on = left & !here & (cell != end);
        let back = !entered & !here & (cell != start);
        if !any(on | back) {
            break;
        }
        cell += select(select(vec3i(0), -step, back), step, on);
    }
    cell = select(cell, to, here);
    let plane = cell + ahead;
    return VpWalk(cell, t, axis, select(leaves, vp_crossings(ray, plane), here), vec3f(plane));
}

fn vp_inside(cell: vec3i, low: vec3i, high: vec3i) -> bool {
    return all(cell >= low) && all(cell < high);
}

// The ray's first cell in the box from low to high (outside). A walk outside of it means a miss.
fn vp_enter(ray: VpRay, low: vec3i, high: vec3i) -> VpWalk {
    let start = vec3i(clamp(floor(ray.origin), vec3f(-16777216.0), vec3f(16777216.0)));
    let before = select(start >= high, start < low, ray.forward);
    let within = (start >= low) & (start < high);
    if all(within) {
        return vp_arrive(ray, start, 0.0, 3);
    }
    let miss = VpWalk(low - 1, 0.0, 3, vec3f(0.0), vec3f(0.0));
    if !all(before | within) {
        return miss;
    }
    // The last of the box's near planes to be crossed; of equal ones that of the last axis.
    let t = select(vec3f(-VP_FAR), vp_crossings(ray, select(high, low, ray.forward)), before);
    let axis = select(select(0, 1, t.y >= t.x), 2, t.z >= t.x && t.z >= t.y);
    let event = max(t.x, max(t.y, t.z));
    if event >= VP_FAR {
        return miss;
    }
    let end = select(min(low - 1, start), max(high, start), ray.forward);
    return vp_settle(ray, event, axis, select(high - 1, low, ray.forward), start, end);
}

// The next cell. Planes are counted as floats, which is what crossings are made of.
fn vp_step(ray: VpRay, walk: VpWalk) -> VpWalk {
    let n = walk.next;
    let x = n.x <= n.y && n.x <= n.z;
    let y = !x && n.y <= n.z;
    let here = vec3<bool>(x, y, !(x || y));
    let step = select(vec3i(-1), vec3i(1), ray.forward);
    let plane = walk.plane + select(vec3f(0.0), vec3f(step), here);
    return VpWalk(
        walk.cell + select(vec3i(0), step, here),
        vp_least(n),
        select(select(2, 1, y), 0, x),
        (plane - ray.base) * ray.inverse,
        plane,
    );
}

// On each axis the cells behind the box from low to high, on the side where the ray leaves it.
fn vp_behind(ray: VpRay, low: vec3i, high: vec3i) -> vec3i {
    return select(low - 1, high, ray.forward);
}

// The first cell behind the box from low to high, which holds the walk's cell.
fn vp_leave(ray: VpRay, walk: VpWalk, low: vec3i, high: vec3i) -> VpWalk {
    let t = vp_crossings(ray, select(low, high, ray.forward));
    let axis = vp_first(t);
    let last = select(low, high - 1, ray.forward);
    return vp_settle(ray, vp_least(t), axis, vp_behind(ray, low, high), walk.cell, last);
}
