//! The words of the tree section, as `docs/format.md`, "The tree", has them.

use std::collections::BTreeMap;

use super::{GridParts, too_large};
use crate::codec::{Codec, SequenceRange};
use crate::error::Result;
use crate::pack::Atlas;
use crate::pack::tree::{
    self, GRID_WORDS, HEADER_WORDS, L3Record, Link, MASK_WORDS, NODE_MASK_WORDS, NODE_WORDS, RECORD_WORDS,
};
use crate::stages::allocate::Coding;
use crate::stages::dedup::{CellRef, FrameTree, Payload, SequenceTree};
use crate::stages::quantise::EncodedGrid;
use crate::stages::relayout::Placement;
use crate::volume::{Constant, Coord, Interner, L1_DIM, L2_DIM, ScratchError};

/// L1 nodes that all frames of a grid may have room for: 64 MB of links. A box of 40 of them an axis is
/// 160,000 voxels wide, for 240 frames; only stray voxels far from the rest need more.
const MAX_ROOTS: i64 = 1 << 24;

/// The part of index space that a grid's L1 nodes cover.
pub(super) struct CellBox {
    origin: Coord,
    /// 128³ cells of one L1 node an axis.
    cells: [u32; 3],
    /// L1 nodes an axis.
    roots: [u32; 3],
}

impl CellBox {
    pub fn around(name: &str, tree: &SequenceTree) -> Result<Self> {
        let mut min = [i64::MAX; 3];
        let mut max = [i64::MIN; 3];
        let frames = || tree.frames.iter();
        let cells = frames().flat_map(|f| f.cells.iter().map(|(at, _)| (at, L2_DIM)));
        let roots = frames().flat_map(|f| f.roots.iter().map(|(at, _)| (at, L1_DIM)));
        for (at, dim) in cells.chain(roots) {
            for a in 0..3 {
                min[a] = min[a].min(at.0[a].into());
                max[a] = max[a].max(i64::from(at.0[a]) + i64::from(dim));
            }
        }
        if min[0] > max[0] {
            return Ok(Self { origin: Coord::default(), cells: [1; 3], roots: [1; 3] });
        }
        let (cell, root) = (i64::from(L2_DIM), i64::from(L1_DIM));
        let one_node = (0..3).all(|a| max[a] - min[a] <= root);
        if !one_node {
            // Several L1 nodes lie where OpenVDB's root entries do, so that a constant root entry is
            // one link.
            min = min.map(|v| v.div_euclid(root) * root);
            max = max.map(|v| (v + root - 1).div_euclid(root) * root);
        }
        let extent: [i64; 3] = std::array::from_fn(|a| max[a] - min[a]);
        let roots = if one_node { [1; 3] } else { extent.map(|e| e / root) };
        let frames = tree.frames.len().max(1) as i64;
        if roots.iter().try_fold(frames, |n, r| n.checked_mul(*r)).is_none_or(|n| n > MAX_ROOTS) {
            return Err(too_large(
                name,
                &format!(
                    "its voxels lie in a box of {} × {} × {} voxels, too sparse to address: \
                     delete stray voxels far from the rest, or pack its parts apart",
                    extent[0], extent[1], extent[2]
                ),
            ));
        }
        Ok(Self {
            origin: Coord(min.map(|v| v as i32)),
            cells: if one_node { extent.map(|e| (e / cell) as u32) } else { [32; 3] },
            roots: roots.map(|r| r as u32),
        })
    }

    /// Which L1 node holds a voxel, and which of its cells.
    fn index(&self, at: Coord) -> (usize, usize) {
        let cell: [u32; 3] = std::array::from_fn(|a| {
            ((i64::from(at.0[a]) - i64::from(self.origin.0[a])) / i64::from(L2_DIM)) as u32
        });
        let flat = |v: [u32; 3], dims: [u32; 3]| ((v[0] * dims[1] + v[1]) * dims[2] + v[2]) as usize;
        let root = std::array::from_fn(|a| cell[a] / self.cells[a]);
        let inside = std::array::from_fn(|a| cell[a] % self.cells[a]);
        (flat(root, self.roots), flat(inside, self.cells))
    }

    fn cell_count(&self) -> usize {
        self.cells.iter().product::<u32>() as usize
    }

    fn root_count(&self) -> usize {
        self.roots.iter().product::<u32>() as usize
    }
}

/// The tree section's words: in memory what frames are found by; nodes, records and masks, which are most of it, are
/// made as they are written.
pub(super) struct TreeWords {
    /// Header, grids, roots and L1 nodes.
    head: Vec<u32>,
    constants: Vec<u32>,
    len: usize,
}

impl TreeWords {
    /// Plans them for texels in these atlases.
    pub fn new(
        trees: &[&SequenceTree],
        boxes: &[CellBox],
        sequences: &[SequenceRange],
        atlases: &[Atlas],
    ) -> Self {
        let mut constants = Interner::<u32>::default();
        let grids_at = HEADER_WORDS;
        let roots_at = grids_at + trees.len() * GRID_WORDS;
        let root_words: usize = trees.iter().zip(boxes).map(|(t, b)| t.frames.len() * b.root_count()).sum();
        let l1_at = roots_at + root_words;

        let mut l1 = Interner::<u32>::default();
        let mut headers = Vec::new();
        let mut roots = Vec::new();
        let mut nodes = 0u32;
        for ((tree, bounds), sequence) in trees.iter().zip(boxes).zip(sequences) {
            headers.extend(grid_header(tree, bounds, sequence, roots_at + roots.len()));
            for frame in &tree.frames {
                roots.extend(frame_roots(frame, bounds, l1_at, nodes, &mut l1, &mut constants));
            }
            nodes += tree.nodes.all().len() as u32;
        }

        let node_at = l1_at + l1.items().len();
        let record_at = node_at + nodes as usize * NODE_WORDS;
        let records: usize = trees.iter().map(|tree| run_len(tree)).sum();
        let mask_at = record_at + records * RECORD_WORDS;
        let masks: usize = trees.iter().map(|tree| mask_len(tree)).sum();
        let constant_at = mask_at + masks * MASK_WORDS;
        let len = constant_at + constants.items().len();

        let mut head = vec![0; HEADER_WORDS];
        {
            use tree::header as h;
            for (place, value) in [
                (h::WORDS, len),
                (h::GRIDS, trees.len()),
                (h::GRID_AT, grids_at),
                (h::NODE_AT, node_at),
                (h::NODES, nodes as usize),
                (h::RECORD_AT, record_at),
                (h::RECORDS, records),
                (h::MASK_AT, mask_at),
                (h::MASKS, masks),
                (h::CONSTANT_AT, constant_at),
                (h::CONSTANTS, constants.items().len()),
            ] {
                head[place] = value as u32;
            }
            for atlas in atlases {
                let at = h::atlas(atlas.codec);
                head[at..at + 3].copy_from_slice(&[atlas.columns, atlas.rows, atlas.page_slabs]);
            }
        }
        head.extend(headers);
        head.extend(roots);
        head.extend(l1.items());
        debug_assert_eq!(head.len(), node_at);
        Self { head, constants: constants.items().to_vec(), len }
    }

    /// How many there are.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Gives all of them to `sink`, some at a time.
    ///
    /// # Errors
    /// When a scratch file cannot be read back, or the sink fails.
    pub fn write<E: From<ScratchError>>(
        &self,
        grids: &[GridParts],
        placement: &Placement,
        encoded: &[EncodedGrid],
        mut sink: impl FnMut(&[u32]) -> Result<(), E>,
    ) -> Result<(), E> {
        sink(&self.head)?;
        for (grid, first_record) in with_first(grids, run_len) {
            grid.tree.nodes.visit(|node, children| {
                let words: [u32; NODE_MASK_WORDS] = bytemuck::cast(*children);
                sink(&words)?;
                sink(&tree::ranks(&words))?;
                sink(&[first_record + node.run])
            })?;
        }
        for ((g, (grid, first_mask)), encoded) in with_first(grids, mask_len).enumerate().zip(encoded) {
            let slot = |id| placement.slot(g, id);
            for &entry in grid.tree.runs.items() {
                sink(&l3_record(grid, entry, slot, encoded, first_mask).to_words())?;
            }
        }
        let mut masks = grids.iter().flat_map(|grid| grid.tree.masks.items());
        masks.try_for_each(|mask| sink(&mask.to_words()))?;
        sink(&self.constants)
    }
}

/// Grids, each with how much of something those before it have.
fn with_first<'a>(
    grids: &'a [GridParts<'a>],
    len: impl Fn(&SequenceTree) -> usize,
) -> impl Iterator<Item = (&'a GridParts<'a>, u32)> {
    grids.iter().scan(0, move |first, grid| {
        let own = *first;
        *first += len(grid.tree) as u32;
        Some((grid, own))
    })
}

fn run_len(tree: &SequenceTree) -> usize {
    tree.runs.items().len()
}

fn mask_len(tree: &SequenceTree) -> usize {
    tree.masks.items().len()
}

fn grid_header(
    tree: &SequenceTree,
    bounds: &CellBox,
    sequence: &SequenceRange,
    root_at: usize,
) -> [u32; GRID_WORDS] {
    use crate::pack::tree::grid as g;
    let mut words = [0; GRID_WORDS];
    words[g::ORIGIN..g::ORIGIN + 3].copy_from_slice(&bounds.origin.0.map(|v| v as u32));
    words[g::CELLS..g::CELLS + 3].copy_from_slice(&bounds.cells);
    words[g::ROOTS..g::ROOTS + 3].copy_from_slice(&bounds.roots);
    words[g::LO] = sequence.lo.to_bits();
    words[g::SPAN] = sequence.span.to_bits();
    words[g::BACKGROUND] = tree.background.to_bits();
    words[g::ROOT_AT] = root_at as u32;
    words[g::FRAMES] = tree.frames.len() as u32;
    words
}

/// The links of one frame's roots; its L1 nodes go into `l1`, whose first word is word `l1_at`.
fn frame_roots(
    frame: &FrameTree,
    bounds: &CellBox,
    l1_at: usize,
    first_node: u32,
    l1: &mut Interner<u32>,
    constants: &mut Interner<u32>,
) -> Vec<u32> {
    let mut link = |c: Constant| {
        let index = constants.intern(&[c.value.to_bits()]);
        Link::Constant { index, active: c.active }.to_word()
    };
    let mut roots = vec![0; bounds.root_count()];
    for &(at, constant) in &frame.roots {
        roots[bounds.index(at).0] = link(constant);
    }
    let mut cells: BTreeMap<usize, Vec<(usize, u32)>> = BTreeMap::new();
    for &(at, content) in &frame.cells {
        let (root, cell) = bounds.index(at);
        let word = match content {
            CellRef::Constant(constant) => link(constant),
            CellRef::Node(node) => Link::Node(first_node + node).to_word(),
        };
        cells.entry(root).or_default().push((cell, word));
    }
    for (root, cells) in cells {
        let (mask_words, _) = tree::l1_words(bounds.cell_count());
        let mut words = vec![0; mask_words];
        for &(cell, _) in &cells {
            words[cell / 32] |= 1 << (cell % 32);
        }
        words.extend(tree::ranks(&words));
        words.extend(cells.iter().map(|(_, word)| word));
        roots[root] = Link::Node(l1_at as u32 + l1.intern(&words)).to_word();
    }
    roots
}

fn l3_record(
    grid: &GridParts,
    entry: u32,
    slot: impl Fn(u32) -> u32,
    encoded: &EncodedGrid,
    first_mask: u32,
) -> L3Record {
    let record = grid.tree.record(entry);
    let (codec, axis, slot, word2) = match record.payload() {
        Payload::Constant(value) => (Codec::Constant, 0, 0, value.to_bits()),
        Payload::Brick(id) => {
            let allocation = grid.allocation;
            match allocation.coding(id) {
                Coding::Empty => (Codec::Constant, 0, 0, grid.tree.background.to_bits()),
                Coding::Constant(value) => (Codec::Constant, 0, 0, value.to_bits()),
                _ => {
                    let range = allocation.range(grid.tree, id).to_word();
                    (allocation.codec(id), encoded.axis(allocation, id), slot(id), range)
                }
            }
        }
    };
    L3Record { codec, axis, slot, mask: record.mask().map(|m| first_mask + m), rule: record.rule, word2 }
}
