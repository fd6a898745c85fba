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
//   vp_cell(g, frame, last, p)          the 128³ cell around a voxel; keep it for the next lookup
//   vp_find(g, cell, p)                 the node around a voxel: how large, constant or a brick
//   vp_brick(g, node)                   how a node's voxels are read; keep it while in the node
//   vp_value(g, brick, p)               a voxel's value
//   vp_voxel(g, frame, p)               all of these in one: point fetch
//   vp_trilinear(g, frame, p)           eight point fetches, interpolated
//   vp_corners, vp_between              the same in two parts, for a brick that is kept
//   vp_sign, vp_alone, vp_idle          whether a node or a cell can hold a zero, without a texel
//
// hdda.wgsl goes with it, for rays, and march.wgsl, for lit fog.
//
// Coordinates are OpenVDB's index coordinates. docs/format.md is the specification of what is read.

const VP_NONE = 0xffffffffu;
const VP_NO_MASK = 0x3fffffffu;
const VP_BC7 = 1u;
const VP_NORMALISED = 14u;            // bit t is on if texels of codec tag t are fractions of the brick's range

// What a host may promise of its packs when it makes a pipeline: code for what does not occur is left
// out.
override VP_CODECS: u32 = 63u;      // bit t is on if codec tag t may occur
override VP_MASKS: bool = true;     // whether records may have masks

struct VpGrid {
    header: u32,        // word at which its header begins
    origin: vec3i,      // smallest corner of what the L1 nodes cover
    lo: f32,            // what brick ranges are fractions of
    span: f32,
    background: f32,
}

fn vp_vec3i(at: u32) -> vec3i {
    return bitcast<vec3i>(vec3u(vp_word(at), vp_word(at + 1u), vp_word(at + 2u)));
}

fn vp_words(at: vec4u) -> vec4u {
    return vec4u(vp_word(at.x), vp_word(at.y), vp_word(at.z), vp_word(at.w));
}

fn vp_grid(grid: u32) -> VpGrid {
    let at = vp_word(2u) + 16u * grid;
    return VpGrid(
        at,
        vp_vec3i(at),
        bitcast<f32>(vp_word(at + 9u)),
        bitcast<f32>(vp_word(at + 10u)),
        bitcast<f32>(vp_word(at + 11u)),
    );
}

// How many bits of a mask are on before bit i, or VP_NONE if bit i is off. Behind the mask's words lie
// the counts before each of them, two to a word.
fn vp_rank(mask_at: u32, ranks_at: u32, i: u32) -> u32 {
    let word = i >> 5u;
    let bits = vp_word(mask_at + word);
    let before = (vp_word(ranks_at + (word >> 1u)) >> (16u * (word & 1u))) & 0xffffu;
    let bit = 1u << (i & 31u);
    return select(before + countOneBits(bits & (bit - 1u)), VP_NONE, (bits & bit) == 0u);
}

// A 128³ cell. A ray stays in one for many steps, so the way from the root to it is walked once.
struct VpCell {
    place: vec3i,       // which one, counted from the grid's origin
    l2: u32,            // word at which its L2 node begins, or VP_NONE: it is constant
    records: u32,       // word at which the L2 node's records begin
    dim: i32,           // side of the constant: 128, or 4096 for all of an L1 node
    value: f32,         // its value
}

// What to begin with: a cell that no voxel is in.
const VP_NOWHERE = VpCell(vec3i(0x7fffffff), VP_NONE, 0u, 128, 0.0);

fn vp_cell(g: VpGrid, frame: u32, last: VpCell, p: vec3i) -> VpCell {
    let place = (p - g.origin) >> vec3u(7u);
    if all(place == last.place) {
        return last;
    }
    var cell = VpCell(place, VP_NONE, 0u, 128, g.background);
    let cells = vp_vec3i(g.header + 3u);
    let roots = vp_vec3i(g.header + 6u);
    if any(place < vec3i(0)) || any(place >= cells * roots) {
        return cell;
    }
    // Root: one word a frame and L1 node.
    let r = place / cells;
    let root = frame * u32(roots.x * roots.y * roots.z) + u32((r.x * roots.y + r.y) * roots.z + r.z);
    var link = vp_word(vp_word(g.header + 12u) + root);
    if link == 0u {
        return cell;
    }
    if (link >> 31u) == 1u {
        cell.dim = 4096;
    } else {
        // L1: mask, ranks, one link a child.
        let c = place - r * cells;
        let i = u32((c.x * cells.y + c.y) * cells.z + c.z);
        let mask_words = u32(cells.x * cells.y * cells.z + 31) >> 5u;
        let ranks_at = link + mask_words;
        let child = vp_rank(link, ranks_at, i);
        if child == VP_NONE {
            return cell;
        }
        link = vp_word(ranks_at + ((mask_words + 1u) >> 1u) + child);
    }
    if (link >> 31u) == 1u {
        cell.value = bitcast<f32>(vp_word(vp_word(9u) + (link & 0x3fffffffu)));
        return cell;
    }
    // L2: mask, ranks, first record.
    cell.l2 = vp_word(3u) + 193u * link;
    cell.records = vp_word(5u) + 3u * vp_word(cell.l2 + 192u);
    return cell;
}

// The node around a voxel.
struct VpNode {
    min: vec3i,         // its smallest corner
    dim: i32,           // its side: 4096, 128 or 8
    constant: bool,     // whether it has one value
    value: f32,         // that value
    record: vec3u,      // its L3 record, or one that says the same
}

fn vp_constant(p: vec3i, dim: i32, value: f32) -> VpNode {
    return VpNode(p & vec3i(-dim), dim, true, value, vec3u(0u, VP_NONE, bitcast<u32>(value)));
}

fn vp_find(g: VpGrid, cell: VpCell, p: vec3i) -> VpNode {
    if cell.l2 == VP_NONE {
        return vp_constant(p, cell.dim, cell.value);
    }
    let b = vec3u(p >> vec3u(3u)) & vec3u(15u);
    let region = vp_rank(cell.l2, cell.l2 + 128u, (b.x * 16u + b.y) * 16u + b.z);
    if region == VP_NONE {
        return vp_constant(p, 8, g.background);
    }
    // L3: three words. A constant without a mask is one value; with one it still may be, but its
    // voxels are looked up.
    let at = cell.records + 3u * region;
    let record = vec3u(vp_word(at), vp_word(at + 1u), vp_word(at + 2u));
    let constant = (record.x & 7u) == 0u && (!VP_MASKS || (record.y & VP_NO_MASK) == VP_NO_MASK);
    return VpNode(p & vec3i(-8), 8, constant, bitcast<f32>(record.z), record);
}

// How the voxels of a node are read.
struct VpBrick {
    min: vec3i,         // its smallest corner
    codec: u32,         // its tag; 0: no texels
    axis: u32,          // for bc7 the packing axis
    page: u32,          // the texture
    shift: vec3i,       // from a voxel to its texel there; for bc7 from 0 to the brick's first
    offset: f32,        // a texel's value is offset + scale · texel
    scale: f32,
    mask: u32,          // word at which its mask begins, or VP_NONE
    rule: u32,          // what inactive voxels are
}

fn vp_brick(g: VpGrid, node: VpNode) -> VpBrick {
    let r = node.record;
    let codec = r.x & 7u;
    var brick = VpBrick(node.min, codec, (r.x >> 3u) & 3u, 0u, vec3i(0), bitcast<f32>(r.z), 0.0, VP_NONE, r.y >> 30u);
    let mask = r.y & VP_NO_MASK;
    if VP_MASKS && mask != VP_NO_MASK && brick.rule != 3u {
        brick.mask = vp_word(7u) + 16u * mask;
    }
    if codec == 0u {
        return brick;
    }
    let atlas = 12u + 4u * (codec - 1u);
    let columns = vp_word(atlas);
    let slab_bricks = columns * vp_word(atlas + 1u);
    let page_slabs = vp_word(atlas + 2u);
    let slot = r.x >> 5u;
    let slab = slot / slab_bricks;
    let place = slot - slab * slab_bricks;
    let row = place / columns;
    brick.page = slab / page_slabs;
    brick.shift = vec3i(vec3u(place - row * columns, row, slab - brick.page * page_slabs)) * 8;
    if (VP_CODECS & 2u) != 0u && codec == VP_BC7 {
        brick.shift.z /= 4;
    } else {
        brick.shift -= node.min;
    }
    if ((VP_NORMALISED >> codec) & 1u) != 0u {
        brick.offset = g.lo + g.span * (f32(r.z & 0xffffu) / 65535.0);
        brick.scale = g.span * unpack2x16float(r.z).y;
    } else {
        brick.offset = 0.0;
        brick.scale = 1.0;
    }
    return brick;
}

// What a brick's texel says of voxel p.
fn vp_texel_value(brick: VpBrick, p: vec3i) -> f32 {
    if brick.codec == 0u {
        return brick.offset;
    }
    var t: f32;
    if (VP_CODECS & 2u) != 0u && brick.codec == VP_BC7 {
        // Four neighbours along the packing axis are the channels of one texel.
        let v = p & vec3i(7);
        let packed = select(select(v.z, v.y, brick.axis == 1u), v.x, brick.axis == 0u);
        let place = vec3i(select(v.x, v.y, brick.axis == 0u), select(v.z, v.y, brick.axis == 2u), packed >> 2u);
        let texel = vp_texel(VP_BC7, brick.page, brick.shift + place);
        let pair = select(texel.xy, texel.zw, (packed & 2) != 0);
        t = select(pair.x, pair.y, (packed & 1) != 0);
    } else {
        t = vp_texel(brick.codec, brick.page, brick.shift + p).x;
    }
    return brick.offset + brick.scale * t;
}

// The value of voxel p, which lies in the brick.
fn vp_value(g: VpGrid, brick: VpBrick, p: vec3i) -> f32 {
    let v = p & vec3i(7);
    if VP_MASKS && brick.mask != VP_NONE {
        let i = u32((v.x * 8 + v.y) * 8 + v.z);
        let word = brick.mask + (i >> 5u);
        if ((vp_word(word) >> (i & 31u)) & 1u) == 0u {
            let minus = brick.rule == 1u || (brick.rule == 2u && ((vp_word(word + 16u) >> (i & 31u)) & 1u) == 1u);
            return select(g.background, -g.background, minus);
        }
    }
    return vp_texel_value(brick, p);
}

fn vp_voxel(g: VpGrid, frame: u32, p: vec3i) -> f32 {
    return vp_value(g, vp_brick(g, vp_find(g, vp_cell(g, frame, VP_NOWHERE, p), p)), p);
}

// The corners of a cell: the voxels at z, ordered by x + 2y, then those at z + 1.
struct VpCorners {
    near: vec4f,
    far: vec4f,
}

// Voxel p and its neighbours in x, in y and in both, as far as they lie in the brick; for the others
// something else out of it. All are asked for at once, so that memory is waited for once.
fn vp_quad(g: VpGrid, brick: VpBrick, p: vec3i) -> vec4f {
    let a = p & vec3i(7);
    let b = (p + 1) & vec3i(7);
    var value = vec4f(g.background);
    var on = vec4<bool>(true);
    if VP_MASKS && brick.mask != VP_NONE {
        let i = vec4u(vec4i(a.x, b.x, a.x, b.x) * 64 + vec4i(a.y, a.y, b.y, b.y) * 8 + a.z);
        let at = brick.mask + (i >> vec4u(5u));
        let bit = vec4u(1u) << (i & vec4u(31u));
        on = (vp_words(at) & bit) != vec4u(0u);
        var minus = vec4<bool>(brick.rule == 1u);
        if brick.rule == 2u {
            minus = (vp_words(at + 16u) & bit) != vec4u(0u);
        }
        value = select(value, -value, minus);
    }
    if any(on) {
        let texels = vec4f(
            vp_texel_value(brick, brick.min + a),
            vp_texel_value(brick, brick.min + vec3i(b.x, a.y, a.z)),
            vp_texel_value(brick, brick.min + vec3i(a.x, b.y, a.z)),
            vp_texel_value(brick, brick.min + vec3i(b.x, b.y, a.z)),
        );
        value = select(value, texels, on);
    }
    return value;
}

// Seven cells of eight along an axis lie inside one brick; the others reach into its neighbours. Bits 0 to
// 2 of a cell's edges say on which axes it does; a part of it, a subset of them, on which that part lies in
// the next brick. Part 0 comes first, and again after the last.
fn vp_edges(p: vec3i) -> u32 {
    let edges = vec3u((p & vec3i(7)) == vec3i(7)) << vec3u(0u, 1u, 2u);
    return edges.x | edges.y | edges.z;
}

fn vp_next_part(part: u32, edges: u32) -> u32 {
    return (part - edges) & edges;
}

// The node that a part of the cell from p to p + 1 lies in.
fn vp_part(g: VpGrid, frame: u32, cell: VpCell, p: vec3i, part: u32) -> VpNode {
    let q = p + vec3i((vec3u(part) >> vec3u(0u, 1u, 2u)) & vec3u(1u));
    return vp_find(g, vp_cell(g, frame, cell, q), q);
}

// The corners of the cell from p, which lies in the brick, to p + 1. One loop for both z: more code, above
// all that of several codecs, costs more than its turns.
fn vp_corners(g: VpGrid, frame: u32, cell: VpCell, brick: VpBrick, p: vec3i) -> VpCorners {
    var c: VpCorners;
    let edges = vp_edges(p);
    var part = 0u;
    loop {
        var b = brick;
        if part != 0u {
            b = vp_brick(g, vp_part(g, frame, cell, p, part));
        }
        let inside = (vec4u(0u, 1u, 2u, 3u) & vec4u(edges & 3u)) == vec4u(part & 3u);
        for (var z = 0u; z < 2u; z++) {
            if ((4u * z) & edges) == (part & 4u) {
                let quad = vp_quad(g, b, p + vec3i(0, 0, i32(z)));
                c.near = select(c.near, quad, inside & vec4<bool>(z == 0u));
                c.far = select(c.far, quad, inside & vec4<bool>(z == 1u));
            }
        }
        part = vp_next_part(part, edges);
        if part == 0u {
            break;
        }
    }
    return c;
}

// Between the corners of a cell: f goes from 0 to 1 along each axis.
fn vp_between(c: VpCorners, f: vec3f) -> f32 {
    let z = mix(c.near, c.far, f.z);
    let y = mix(z.xy, z.zw, f.y);
    return mix(y.x, y.y, f.x);
}

// p in index space, between voxels.
fn vp_trilinear(g: VpGrid, frame: u32, p: vec3f) -> f32 {
    let low = floor(p);
    let voxel = vec3i(low);
    let cell = vp_cell(g, frame, VP_NOWHERE, voxel);
    return vp_between(vp_corners(g, frame, cell, vp_brick(g, vp_find(g, cell, voxel)), voxel), p - low);
}

// ---- Signs ----------------------------------------------------------------------------------------
//
// For surfaces, the zeros of a level set: what can be said of signs without fetching a texel.

const VP_POSITIVE = 0u;     // nothing is negative
const VP_NEGATIVE = 1u;     // all is
const VP_EITHER = 2u;       // the texels must say

// The sign of a node's voxels.
fn vp_sign(g: VpGrid, node: VpNode) -> u32 {
    if node.constant {
        return u32(node.value < 0.0);
    }
    let r = node.record;
    var least = bitcast<f32>(r.z);
    var most = least;
    if (r.x & 7u) != 0u {
        least = g.lo + g.span * (f32(r.z & 0xffffu) / 65535.0);
        most = least + g.span * unpack2x16float(r.z).y;
    }
    // Zeros are left to the texels, and what rounding might take for one: a millionth of the range.
    let zero = 1e-6 * g.span;
    let sign = select(select(VP_EITHER, VP_NEGATIVE, most < -zero), VP_POSITIVE, least > zero);
    let rule = r.y >> 30u;
    if !VP_MASKS || rule == 3u {
        return sign;
    }
    let inactive = u32(select(g.background, -g.background, rule == 1u) < 0.0);
    return select(VP_EITHER, sign, rule < 2u && sign == inactive);
}

// Whether neither the region of p nor the seven next to it on its high sides have a record: then its
// cells have no corner that is not background. Regions at the end of the L2 node count as others.
fn vp_alone(cell: VpCell, p: vec3i) -> bool {
    let b = vec3u(p >> vec3u(3u)) & vec3u(15u);
    if cell.l2 == VP_NONE || any(b == vec3u(15u)) {
        return false;
    }
    // Rows of 16 regions along z, two to a word.
    let row = vec4u(b.x, b.x, b.x + 1u, b.x + 1u) * 16u + vec4u(b.y, b.y + 1u, b.y, b.y + 1u);
    let at = cell.l2 + (row >> vec4u(1u));
    let rows = vp_words(at) >> (16u * (row & vec4u(1u)));
    return (((rows.x | rows.y | rows.z | rows.w) >> b.z) & 3u) == 0u;
}

// The sign of a cell's corners that lie in the brick, where its mask tells.
fn vp_idle(g: VpGrid, brick: VpBrick, p: vec3i) -> u32 {
    if !VP_MASKS || brick.mask == VP_NONE {
        return VP_EITHER;
    }
    let a = vec3u(p & vec3i(7));
    let b = min(a + 1u, vec3u(7u));
    // Rows of 8 voxels along z, four to a word.
    let row = vec4u(a.x, a.x, b.x, b.x) * 8u + vec4u(a.y, b.y, a.y, b.y);
    let at = brick.mask + (row >> vec4u(2u));
    let shift = 8u * (row & vec4u(3u)) + a.z;
    let pair = select(1u, 3u, b.z > a.z);
    let rows = vp_words(at) >> shift;
    if ((rows.x | rows.y | rows.z | rows.w) & pair) != 0u {
        return VP_EITHER;
    }
    var minus = brick.rule == 1u;
    if brick.rule == 2u {
        let signs = vp_words(at + 16u) >> shift;
        minus = (signs.x & 1u) == 1u;
        let all = (signs.x & signs.y & signs.z & signs.w & pair) == pair;
        if minus != all || (!minus && ((signs.x | signs.y | signs.z | signs.w) & pair) != 0u) {
            return VP_EITHER;
        }
    }
    return u32(select(g.background, -g.background, minus) < 0.0);
}
