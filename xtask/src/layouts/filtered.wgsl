// filtered.wgsl: bricks whose last layer of texels is the first of the next brick, so that the texture unit filters every sample.
//
//   region_at(p, cell)                  what lies around a position: background, a constant or a brick
//   brick_of(region)                    how a brick is sampled
//   filtered(brick, p)                  a texel's value there, before the brick's range is applied

override TREE: bool = false;        // else an indirection of one word a brick
override RECORDS: bool = true;      // else all bricks have one codec and one range, and an indirection names slots
override PITCH: f32 = 7.0;
override BORDER: f32 = 0.0;         // texels of a brick before its first position

const BC7 = 1u;
const CONSTANT = 0x80000000u;
const NODE_DIM = 16;

struct Region {
    low: vec3f,             // its smallest corner
    dim: f32,
    record: vec2u,          // codec, axis and slot; range. Codec 0: one value
}

// The L2 node that a ray was in last.
struct Cell {
    place: vec3i,
    node: u32,              // word at which it begins, or VP_NONE: it has one value
    value: u32,
}

const NOWHERE = Cell(vec3i(-1), VP_NONE, 0u);

fn in_indirection(p: vec3f) -> Region {
    let b = clamp(vec3i(floor(p * (1.0 / PITCH))), vec3i(0), params.cells - 1);
    let link = tree[(b.z * params.cells.y + b.y) * params.cells.x + b.x];
    var record = vec2u(0u, bitcast<u32>(params.background));
    if (link & CONSTANT) != 0u {
        record.y = tree[params.constants_at + (link ^ CONSTANT)];
    } else if RECORDS && link != 0u {
        let at = params.records_at + 2u * (link - 1u);
        record = vec2u(tree[at], tree[at + 1u]);
    } else if link != 0u {
        // The range 0 to 1 in halves.
        record = vec2u(firstTrailingBit(VP_CODECS & 62u) | ((link - 1u) << 5u), 0x3c000000u);
    }
    return Region(vec3f(b) * PITCH, PITCH, record);
}

fn in_tree(p: vec3f, cell: ptr<function, Cell>) -> Region {
    let b = clamp(vec3i(floor(p * (1.0 / PITCH))), vec3i(0), NODE_DIM * params.cells - 1);
    let c = b >> vec3u(4u);
    if any(c != (*cell).place) {
        let i = u32((c.x * params.cells.y + c.y) * params.cells.z + c.z);
        let mask_words = u32(params.cells.x * params.cells.y * params.cells.z + 31) >> 5u;
        let child = vp_rank(0u, mask_words, i);
        *cell = Cell(c, VP_NONE, bitcast<u32>(params.background));
        if child != VP_NONE {
            let link = tree[mask_words + ((mask_words + 1u) >> 1u) + child];
            if (link & CONSTANT) != 0u {
                (*cell).value = tree[params.constants_at + (link ^ CONSTANT)];
            } else {
                (*cell).node = params.nodes_at + 193u * link;
            }
        }
    }
    let node = (*cell).node;
    if node == VP_NONE {
        return Region(vec3f(c * NODE_DIM) * PITCH, f32(NODE_DIM) * PITCH, vec2u(0u, (*cell).value));
    }
    let j = vec3u(b) & vec3u(15u);
    let rank = vp_rank(node, node + 128u, (j.x * 16u + j.y) * 16u + j.z);
    var record = vec2u(0u, bitcast<u32>(params.background));
    if rank != VP_NONE {
        let at = params.records_at + 3u * (tree[node + 192u] + rank);
        record = vec2u(tree[at], tree[at + 2u]);
    }
    return Region(vec3f(b) * PITCH, PITCH, record);
}

fn region_at(p: vec3f, cell: ptr<function, Cell>) -> Region {
    if TREE {
        return in_tree(p, cell);
    }
    return in_indirection(p);
}

struct Brick {
    codec: u32,
    axis: u32,
    low: vec3f,             // its smallest corner
    first: vec3f,           // its first texel
    shift: vec3f,           // but for bc7: from a position to its place in the texture
    inverse: vec3f,
    offset: f32,            // a value is offset + scale · texel
    scale: f32,
}

fn brick_of(region: Region) -> Brick {
    let codec = region.record.x & 7u;
    let atlas = params.atlases[codec - 1u];
    let slot = region.record.x >> 5u;
    let row = slot / atlas.columns;
    let layer = row / atlas.columns;
    let first = vec3f(vec3u(slot - row * atlas.columns, row - layer * atlas.columns, layer)) * atlas.brick;
    let shift = (first + 0.5 + BORDER - region.low) * atlas.inverse;
    var brick = Brick(codec, (region.record.x >> 3u) & 3u, region.low, first, shift, atlas.inverse, 0.0, 1.0);
    if ((VP_NORMALISED >> codec) & 1u) != 0u {
        brick.offset = params.lo + params.span * (f32(region.record.y & 0xffffu) / 65535.0);
        brick.scale = params.span * unpack2x16float(region.record.y).y;
    }
    return brick;
}

fn filtered(brick: Brick, p: vec3f) -> f32 {
    if (VP_CODECS & 2u) != 0u && brick.codec == BC7 {
        return filtered_bc7(brick, p - brick.low);
    }
    let at = p * brick.inverse + brick.shift;
    if (VP_CODECS & 4u) != 0u && brick.codec == 2u { return textureSampleLevel(bc4_texels, trilinear, at, 0.0).x; }
    if (VP_CODECS & 8u) != 0u && brick.codec == 3u { return textureSampleLevel(unorm8_texels, trilinear, at, 0.0).x; }
    if (VP_CODECS & 16u) != 0u && brick.codec == 4u { return textureSampleLevel(f16_texels, trilinear, at, 0.0).x; }
    return textureSampleLevel(f32_texels, trilinear, at, 0.0).x;
}

// Four neighbours along the packing axis are the channels of one texel. Two of them are mixed here, and the other axes are filtered; only
// from channel 3 of a texel to channel 0 of the next it takes a second fetch.
fn filtered_bc7(brick: Brick, p: vec3f) -> f32 {
    let along = clamp(select(select(p.z, p.y, brick.axis == 1u), p.x, brick.axis == 0u), 0.0, PITCH);
    let low = min(floor(along), PITCH - 1.0);
    let c = u32(low) & 3u;
    let across = vec3f(select(p.x, p.y, brick.axis == 0u), select(p.z, p.y, brick.axis == 2u), floor(low * 0.25));
    let at = (across + brick.first + 0.5) * brick.inverse;
    let texel = textureSampleLevel(bc7_texels, trilinear, at, 0.0);
    var pair = select(select(texel.xy, texel.yz, c == 1u), texel.zw, c == 2u);
    if c == 3u {
        let next = textureSampleLevel(bc7_texels, trilinear, at + vec3f(0.0, 0.0, brick.inverse.z), 0.0);
        pair = vec2f(texel.w, next.x);
    }
    return mix(pair.x, pair.y, along - low);
}
