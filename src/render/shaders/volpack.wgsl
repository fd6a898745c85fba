// volpack.wgsl: how to sample a .volpack on a GPU. This is the part that an engine takes over.
//
// The host supplies two functions:
//
//   fn vp_word(i: u32) -> u32                                     word i of the tree section
//   fn vp_texel(codec: u32, page: u32, p: vec3i) -> vec4f         textureLoad from a codec's page
//
// and gets, top to bottom in this file:
//
//   vp_grid(grid)                       a grid's header; load it once
//   vp_find(g, frame, p)                the node around a voxel: how large, constant or not
//   vp_node_value(g, node, p)           a voxel's value in it
//   vp_voxel(g, frame, p)               both in one: point fetch
//   vp_trilinear(g, frame, p)           eight point fetches, interpolated
//   vp_enter, vp_leave                  the HDDA: a ray's first cell, and the first behind a node
//
// Coordinates are OpenVDB's index coordinates. docs/format.md is the specification of what is read.

const VP_NONE = 0xffffffffu;
const VP_NO_MASK = 0x3fffffffu;
const VP_BC7 = 1u;
const VP_F16 = 4u;

struct VpGrid {
    origin: vec3i,      // smallest corner of what the L1 nodes cover
    cells: vec3i,       // 128³ cells of an L1 node
    roots: vec3i,       // L1 nodes of a frame
    lo: f32,            // what brick ranges are fractions of
    span: f32,
    background: f32,
    root_at: u32,       // word at which the frames' roots begin
}

fn vp_grid(grid: u32) -> VpGrid {
    let w = vp_word(2u) + 16u * grid;
    return VpGrid(
        vec3i(bitcast<i32>(vp_word(w)), bitcast<i32>(vp_word(w + 1u)), bitcast<i32>(vp_word(w + 2u))),
        vec3i(i32(vp_word(w + 3u)), i32(vp_word(w + 4u)), i32(vp_word(w + 5u))),
        vec3i(i32(vp_word(w + 6u)), i32(vp_word(w + 7u)), i32(vp_word(w + 8u))),
        bitcast<f32>(vp_word(w + 9u)),
        bitcast<f32>(vp_word(w + 10u)),
        bitcast<f32>(vp_word(w + 11u)),
        vp_word(w + 12u),
    );
}

// The node around a voxel.
struct VpNode {
    min: vec3i,         // its smallest corner
    dim: i32,           // its side: 4096, 128 or 8
    constant: bool,     // whether it has one value
    value: f32,         // that value
    record: u32,        // else the word at which its L3 record begins
}

fn vp_constant(p: vec3i, dim: i32, value: f32) -> VpNode {
    return VpNode(p & vec3i(-dim), dim, true, value, VP_NONE);
}

// How many bits of a mask are on before bit i, or VP_NONE if bit i is off. Behind the mask's words lie
// the counts before each of them, two to a word.
fn vp_rank(mask_at: u32, ranks_at: u32, i: u32) -> u32 {
    let word = i >> 5u;
    let bits = vp_word(mask_at + word);
    let bit = 1u << (i & 31u);
    if (bits & bit) == 0u {
        return VP_NONE;
    }
    let before = (vp_word(ranks_at + (word >> 1u)) >> (16u * (word & 1u))) & 0xffffu;
    return before + countOneBits(bits & (bit - 1u));
}

fn vp_link_constant(p: vec3i, dim: i32, link: u32) -> VpNode {
    return vp_constant(p, dim, bitcast<f32>(vp_word(vp_word(9u) + (link & 0x3fffffffu))));
}

fn vp_find(g: VpGrid, frame: u32, p: vec3i) -> VpNode {
    let cell = (p - g.origin) >> vec3u(7u);
    if any(cell < vec3i(0)) || any(cell >= g.cells * g.roots) {
        return vp_constant(p, 128, g.background);
    }
    // Root: one word a frame and L1 node.
    let r = cell / g.cells;
    let root_count = u32(g.roots.x * g.roots.y * g.roots.z);
    let root = u32((r.x * g.roots.y + r.y) * g.roots.z + r.z);
    let l1 = vp_word(g.root_at + frame * root_count + root);
    if l1 == 0u {
        return vp_constant(p, 128, g.background);
    }
    if (l1 >> 31u) == 1u {
        return vp_link_constant(p, 4096, l1);
    }
    // L1: mask, ranks, one link a child.
    let c = cell - r * g.cells;
    let i = u32((c.x * g.cells.y + c.y) * g.cells.z + c.z);
    let mask_words = u32(g.cells.x * g.cells.y * g.cells.z + 31) >> 5u;
    let ranks_at = l1 + mask_words;
    let child = vp_rank(l1, ranks_at, i);
    if child == VP_NONE {
        return vp_constant(p, 128, g.background);
    }
    let link = vp_word(ranks_at + ((mask_words + 1u) >> 1u) + child);
    if (link >> 31u) == 1u {
        return vp_link_constant(p, 128, link);
    }
    // L2: mask, ranks, first record.
    let l2 = vp_word(3u) + 193u * link;
    let b = vec3u(p >> vec3u(3u)) & vec3u(15u);
    let region = vp_rank(l2, l2 + 128u, (b.x * 16u + b.y) * 16u + b.z);
    if region == VP_NONE {
        return vp_constant(p, 8, g.background);
    }
    // L3: three words. A constant without a mask is one value; with one it still may be, but its
    // voxels are looked up.
    let record = vp_word(5u) + 3u * (vp_word(l2 + 192u) + region);
    let constant = (vp_word(record) & 7u) == 0u && (vp_word(record + 1u) & VP_NO_MASK) == VP_NO_MASK;
    return VpNode(p & vec3i(-8), 8, constant, bitcast<f32>(vp_word(record + 2u)), record);
}

// What a brick's texel says of voxel v (0 to 7 on each axis).
fn vp_texel_value(g: VpGrid, word0: u32, word2: u32, v: vec3i) -> f32 {
    let codec = word0 & 7u;
    if codec == 0u {
        return bitcast<f32>(word2);
    }
    let slot = word0 >> 5u;
    let atlas = 12u + 4u * (codec - 1u);
    let columns = vp_word(atlas);
    let slab_bricks = columns * vp_word(atlas + 1u);
    let page_slabs = vp_word(atlas + 2u);
    let slab = slot / slab_bricks;
    let place = slot % slab_bricks;
    let corner = vec3i(vec3u(place % columns, place / columns, slab % page_slabs));
    let page = slab / page_slabs;
    var t: f32;
    if codec == VP_BC7 {
        // Four neighbours along the packing axis are the channels of one texel.
        var a = v.zxy;
        switch (word0 >> 3u) & 3u {
            case 0u: { a = v.xyz; }
            case 1u: { a = v.yxz; }
            default: {}
        }
        let texel = vp_texel(codec, page, corner * vec3i(8, 8, 2) + vec3i(a.y, a.z, a.x >> 2u));
        t = texel[a.x & 3];
    } else {
        t = vp_texel(codec, page, corner * 8 + v).x;
    }
    if codec >= VP_F16 {
        return t;
    }
    let minimum = f32(word2 & 0xffffu) / 65535.0;
    let extent = unpack2x16float(word2).y;
    return g.lo + g.span * (minimum + extent * t);
}

fn vp_mask_bit(mask: u32, i: u32) -> bool {
    return ((vp_word(vp_word(7u) + 16u * mask + (i >> 5u)) >> (i & 31u)) & 1u) == 1u;
}

// The value of voxel p, which lies in the node.
fn vp_node_value(g: VpGrid, node: VpNode, p: vec3i) -> f32 {
    if node.constant {
        return node.value;
    }
    let v = p & vec3i(7);
    let word1 = vp_word(node.record + 1u);
    let mask = word1 & VP_NO_MASK;
    let rule = word1 >> 30u;
    if mask != VP_NO_MASK && rule != 3u {
        let i = u32((v.x * 8 + v.y) * 8 + v.z);
        if !vp_mask_bit(mask, i) {
            let minus = rule == 1u || (rule == 2u && vp_mask_bit(mask + 1u, i));
            return select(g.background, -g.background, minus);
        }
    }
    return vp_texel_value(g, vp_word(node.record), vp_word(node.record + 2u), v);
}

fn vp_voxel(g: VpGrid, frame: u32, p: vec3i) -> f32 {
    return vp_node_value(g, vp_find(g, frame, p), p);
}

// The voxels at the corners of the cell from p to p + 1, ordered by x + 2y + 4z. Seven cells of eight
// along an axis lie inside one brick.
fn vp_corners(g: VpGrid, frame: u32, p: vec3i) -> array<f32, 8> {
    var corners: array<f32, 8>;
    let node = vp_find(g, frame, p);
    let inside = all((p & vec3i(7)) < vec3i(7));
    for (var i = 0; i < 8; i++) {
        let q = p + vec3i(i & 1, (i >> 1u) & 1, i >> 2u);
        if inside {
            corners[i] = vp_node_value(g, node, q);
        } else {
            corners[i] = vp_voxel(g, frame, q);
        }
    }
    return corners;
}

// p in index space, between voxels.
fn vp_trilinear(g: VpGrid, frame: u32, p: vec3f) -> f32 {
    let cell = floor(p);
    let f = p - cell;
    let c = vp_corners(g, frame, vec3i(cell));
    let x = mix(vec4f(c[0], c[2], c[4], c[6]), vec4f(c[1], c[3], c[5], c[7]), f.x);
    let y = mix(x.xz, x.yw, f.y);
    return mix(y.x, y.y, f.z);
}

// ---- HDDA -----------------------------------------------------------------------------------------
//
// A ray crosses plane k of axis a at t = (k − origin) / direction, always from the plane's number and
// never accumulated. Its crossings, ordered by t and among equals by axis, are the order of its cells. A
// DDA takes the next crossing; an HDDA the one that leaves a node, with all that come before it. So it
// visits the cells of the DDA, less those it skipped, and needs no nudge over edges.

const VP_FAR = 3.0e38;

struct VpRay {
    origin: vec3f,
    direction: vec3f,
    inverse: vec3f,
}

fn vp_ray(origin: vec3f, direction: vec3f) -> VpRay {
    return VpRay(origin, direction, 1.0 / select(direction, vec3f(1.0), direction == vec3f(0.0)));
}

// A ray's place: the cell it is in, since when, and the axis of the face it came through (3: none).
struct VpWalk {
    cell: vec3i,
    t: f32,
    axis: i32,
}

fn vp_crossing(ray: VpRay, axis: i32, k: i32) -> f32 {
    let t = (f32(k) - ray.origin[axis]) * ray.inverse[axis];
    return select(t, VP_FAR, ray.direction[axis] == 0.0);
}

fn vp_before(t: f32, axis: i32, event_t: f32, event_axis: i32) -> bool {
    return t < event_t || (t == event_t && axis < event_axis);
}

// The cell on an axis after all its crossings that come before an event: `start` before them, `end` at
// most.
fn vp_cell_at(ray: VpRay, event_t: f32, event_axis: i32, axis: i32, start: i32, end: i32) -> i32 {
    let d = ray.direction[axis];
    if start == end || d == 0.0 {
        return start;
    }
    let guess = i32(floor(ray.origin[axis] + d * event_t));
    if d > 0.0 {
        var cell = clamp(guess, start, end);
        while cell < end && vp_before(vp_crossing(ray, axis, cell + 1), axis, event_t, event_axis) {
            cell++;
        }
        while cell > start && !vp_before(vp_crossing(ray, axis, cell), axis, event_t, event_axis) {
            cell--;
        }
        return cell;
    }
    var cell = clamp(guess, end, start);
    while cell > end && vp_before(vp_crossing(ray, axis, cell), axis, event_t, event_axis) {
        cell--;
    }
    while cell < start && !vp_before(vp_crossing(ray, axis, cell + 1), axis, event_t, event_axis) {
        cell++;
    }
    return cell;
}

fn vp_inside(cell: vec3i, low: vec3i, high: vec3i) -> bool {
    return all(cell >= low) && all(cell < high);
}

// The ray's first cell in the box from low to high (outside). A walk outside of it means a miss.
fn vp_enter(ray: VpRay, low: vec3i, high: vec3i) -> VpWalk {
    let miss = VpWalk(low - 1, 0.0, 3);
    let start = vec3i(clamp(floor(ray.origin), vec3f(-16777216.0), vec3f(16777216.0)));
    var t = -VP_FAR;
    var axis = 3;
    for (var a = 0; a < 3; a++) {
        let ahead = ray.direction[a] > 0.0;
        var plane: i32;
        if start[a] < low[a] && ahead {
            plane = low[a];
        } else if start[a] >= high[a] && !ahead {
            plane = high[a];
        } else if start[a] >= low[a] && start[a] < high[a] {
            continue;
        } else {
            return miss;
        }
        let crossing = vp_crossing(ray, a, plane);
        if axis == 3 || vp_before(t, axis, crossing, a) {
            t = crossing;
            axis = a;
        }
    }
    if axis == 3 {
        return VpWalk(start, 0.0, 3);
    }
    if t >= VP_FAR {
        return miss;
    }
    var cell = start;
    for (var a = 0; a < 3; a++) {
        let ahead = ray.direction[a] > 0.0;
        if a == axis {
            cell[a] = select(high[a] - 1, low[a], ahead);
        } else {
            let end = select(min(low[a] - 1, start[a]), max(high[a], start[a]), ahead);
            cell[a] = vp_cell_at(ray, t, axis, a, start[a], end);
        }
    }
    return VpWalk(cell, t, axis);
}

// The crossing that leaves the box from low to high, which holds the cell: (t, axis).
fn vp_exit(ray: VpRay, low: vec3i, high: vec3i) -> VpWalk {
    let plane = select(low, high, ray.direction > vec3f(0.0));
    var out = VpWalk(low, vp_crossing(ray, 0, plane.x), 0);
    for (var a = 1; a < 3; a++) {
        let t = vp_crossing(ray, a, plane[a]);
        if vp_before(t, a, out.t, out.axis) {
            out.t = t;
            out.axis = a;
        }
    }
    return out;
}

// The first cell behind the box from low to high, which holds the walk's cell. With a box of one cell
// this is a DDA's step.
fn vp_leave(ray: VpRay, walk: VpWalk, low: vec3i, high: vec3i) -> VpWalk {
    var next = vp_exit(ray, low, high);
    for (var a = 0; a < 3; a++) {
        let ahead = ray.direction[a] > 0.0;
        if a == next.axis {
            next.cell[a] = select(low[a] - 1, high[a], ahead);
        } else {
            let end = select(low[a], high[a] - 1, ahead);
            next.cell[a] = vp_cell_at(ray, next.t, next.axis, a, walk.cell[a], end);
        }
    }
    return next;
}
