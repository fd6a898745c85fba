//! Encoded bricks as a GPU binds them: a texture a codec, and the words that lead from a place to a brick.

use volpack::codec::{BrickRange, Codec};
use volpack::pack::tree::{NODE_FIRST_RECORD, NODE_MASK_WORDS, NODE_WORDS, ranks};
use volpack::volume::NODE_CHILDREN;

use super::bricks::{Encoded, Placed, Shape};

/// Marks a constant in an indirection, and in the links of the tree.
const CONSTANT: u32 = 1 << 31;
/// Bricks of an L2 node along an axis.
const NODE_DIM: i32 = 16;

/// A 3-D texture.
pub struct Texture {
    pub codec: Codec,
    /// Texels along x, y and z.
    pub size: [u32; 3],
    /// Its rows, slice by slice.
    pub bytes: Vec<u8>,
    /// Bricks along x, and along y.
    pub columns: u32,
    /// Texels of a brick along x, y and z.
    pub brick: [u32; 3],
}

/// What leads from a place to a brick.
pub struct Lookup {
    pub words: Vec<u32>,
    /// The place of its first brick.
    pub origin: [i32; 3],
    /// Bricks of an indirection, or L2 nodes, along x, y and z.
    pub cells: [u32; 3],
    /// Words at which L2 nodes, records and constants begin.
    pub nodes_at: u32,
    pub records_at: u32,
    pub constants_at: u32,
    /// Whether texel bricks have records. Without, the words name slots, and all bricks have one codec and range.
    pub has_records: bool,
    /// Bytes of records.
    pub record_bytes: u64,
}

impl Lookup {
    /// Bytes of the tree or indirection without records.
    pub fn tree_bytes(&self) -> u64 {
        self.words.len() as u64 * 4 - self.record_bytes
    }
}

/// Places bricks of one codec in a texture as near to a cube as whole bricks allow. `None` if no brick has that codec.
pub fn texture(shape: Shape, codec: Codec, bricks: &[Placed<Encoded>]) -> Option<Texture> {
    let bricks: Vec<&Encoded> = bricks.iter().map(|(_, brick)| brick).filter(|b| b.codec == codec).collect();
    if bricks.is_empty() {
        return None;
    }
    let layout = shape.layout(codec);
    let columns = (1..).find(|side: &usize| side.pow(3) >= bricks.len()).expect("some cube holds them");
    let layers = bricks.len().div_ceil(columns * columns);
    let mut bytes = vec![0; columns * columns * layers * layout.bytes()];
    for (slot, brick) in bricks.iter().enumerate() {
        let (column, row, layer) = (slot % columns, slot / columns % columns, slot / (columns * columns));
        for (i, texels) in brick.bytes.chunks_exact(layout.row_bytes).enumerate() {
            let (slice, line) =
                (layer * layout.dims[2] + i / layout.rows, row * layout.rows + i % layout.rows);
            let at = ((slice * columns * layout.rows + line) * columns + column) * layout.row_bytes;
            bytes[at..at + layout.row_bytes].copy_from_slice(texels);
        }
    }
    let brick = layout.dims.map(|d| d as u32);
    let counts = [columns, columns, layers].map(|n| n as u32);
    let size = std::array::from_fn(|a| brick[a] * counts[a]);
    Some(Texture { codec, size, bytes, columns: columns as u32, brick })
}

/// The first word of each brick's record, with the slot that [`texture`] gives it.
fn first_words(bricks: &[Placed<Encoded>]) -> Vec<u32> {
    let mut slots = [0u32; Codec::COUNT];
    let word = |(_, brick): &Placed<Encoded>| {
        let slot = &mut slots[brick.codec as usize];
        *slot += 1;
        brick.codec as u32 | u32::from(brick.axis) << 3 | (*slot - 1) << 5
    };
    bricks.iter().map(word).collect()
}

/// The box of some places: its smallest, and how many along each axis.
fn bounds(places: impl Iterator<Item = [i32; 3]> + Clone) -> ([i32; 3], [u32; 3]) {
    let least: [i32; 3] = std::array::from_fn(|a| places.clone().map(|p| p[a]).min().unwrap_or(0));
    let count = |a: usize| places.clone().map(|p| p[a]).max().unwrap_or(0) - least[a] + 1;
    (least, std::array::from_fn(|a| count(a) as u32))
}

/// One word a brick cell: 0 background, a constant's number, or 1 + the number of a record of two words. `ends` are the first and
/// the last place that rays may be in.
pub fn indirection(bricks: &[Placed<Encoded>], ends: [[i32; 3]; 2]) -> Lookup {
    let (origin, cells) = bounds(bricks.iter().map(|(place, _)| *place).chain(ends));
    let [nx, ny, nz] = cells.map(|n| n as usize);
    let mut words = vec![0; nx * ny * nz];
    let (mut records, mut constants) = (Vec::new(), Vec::new());
    let with_texels = || bricks.iter().map(|(_, brick)| brick).filter(|b| b.codec != Codec::Constant);
    let first = with_texels().next().map(|brick| brick.codec);
    let whole = BrickRange::SEQUENCE.to_word();
    let has_records = with_texels().any(|b| {
        Some(b.codec) != first || (b.codec.is_normalised() && b.range != whole) || b.codec == Codec::Bc7
    });
    let mut texel_bricks = 0;
    for ((place, brick), word0) in bricks.iter().zip(first_words(bricks)) {
        let [x, y, z] = std::array::from_fn(|a| (place[a] - origin[a]) as usize);
        words[(z * ny + y) * nx + x] = if brick.codec == Codec::Constant {
            constants.push(brick.range);
            CONSTANT | (constants.len() as u32 - 1)
        } else {
            if has_records {
                records.extend([word0, brick.range]);
            }
            texel_bricks += 1;
            texel_bricks
        };
    }
    let records_at = words.len() as u32;
    let constants_at = records_at + records.len() as u32;
    let record_bytes = 4 * (records.len() + constants.len()) as u64;
    words.extend(records);
    words.extend(constants);
    Lookup { words, origin, cells, nodes_at: 0, records_at, constants_at, has_records, record_bytes }
}

/// A tree as in today's packs, in units of bricks: one L1 node of any size (mask, ranks, a link a child), L2 nodes of 16³
/// bricks, records of three words, and constants. `ends` as for an indirection.
pub fn tree(bricks: &[Placed<Encoded>], ends: [[i32; 3]; 2]) -> Lookup {
    let node_of = |place: &[i32; 3]| place.map(|b| b.div_euclid(NODE_DIM));
    let (origin, cells) =
        bounds(bricks.iter().map(|(place, _)| *place).chain(ends).map(|place| node_of(&place)));
    let [_, ny, nz] = cells.map(|n| n as usize);
    let index = |place: &[i32; 3]| {
        let [x, y, z] = std::array::from_fn(|a| (node_of(place)[a] - origin[a]) as usize);
        (x * ny + y) * nz + z
    };
    let child = |place: &[i32; 3]| {
        let [x, y, z] = place.map(|b| b.rem_euclid(NODE_DIM) as usize);
        (x * 16 + y) * 16 + z
    };
    let words0 = first_words(bricks);
    let mut by_node: Vec<Vec<usize>> = vec![Vec::new(); cells.iter().product::<u32>() as usize];
    (0..bricks.len()).for_each(|i| by_node[index(&bricks[i].0)].push(i));

    let mut mask = vec![0u32; by_node.len().div_ceil(32)];
    let (mut links, mut nodes, mut records, mut constants) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for (cell, mut children) in by_node.into_iter().enumerate().filter(|(_, children)| !children.is_empty()) {
        mask[cell / 32] |= 1 << (cell % 32);
        let first = &bricks[children[0]].1;
        let is_one = |i: &usize| bricks[*i].1.codec == Codec::Constant && bricks[*i].1.range == first.range;
        if children.len() == NODE_CHILDREN && children.iter().all(is_one) {
            links.push(CONSTANT | constants.len() as u32);
            constants.push(first.range);
            continue;
        }
        links.push((nodes.len() / NODE_WORDS) as u32);
        children.sort_by_key(|i| child(&bricks[*i].0));
        let mut node_mask = vec![0u32; NODE_MASK_WORDS];
        let first_record = (records.len() / 3) as u32;
        for i in children {
            let bit = child(&bricks[i].0);
            node_mask[bit / 32] |= 1 << (bit % 32);
            records.extend([words0[i], u32::MAX, bricks[i].1.range]);
        }
        let node_ranks = ranks(&node_mask);
        nodes.extend(node_mask);
        nodes.extend(node_ranks);
        nodes.push(first_record);
        debug_assert_eq!(nodes.len() % NODE_WORDS, 0);
        debug_assert_eq!(NODE_FIRST_RECORD + 1, NODE_WORDS);
    }
    let mut words = mask.clone();
    words.extend(ranks(&mask));
    words.extend(links);
    let nodes_at = words.len() as u32;
    words.extend(nodes);
    let records_at = words.len() as u32;
    let record_bytes = 4 * records.len() as u64;
    words.extend(records);
    let constants_at = words.len() as u32;
    words.extend(constants);
    let origin = origin.map(|n| n * NODE_DIM);
    Lookup { words, origin, cells, nodes_at, records_at, constants_at, has_records: true, record_bytes }
}
