//! Reads one frame back: from coordinates to regions, from L3 records to voxels.

use std::borrow::Cow;
use std::collections::HashMap;

use crate::codec::{BrickRange, Codec, decode, spread};
use crate::error::ensure;
use crate::tables::fits_memory;
use crate::tree::{
    self, L3Record, Link, MASK_WORDS, NODE_FIRST_RECORD, NODE_MASK_WORDS, NODE_WORDS, RECORD_WORDS, header,
    l1_words,
};
use crate::{
    Atlas, BRICK_DIM, BRICK_VOXELS, Constant, Coord, CoordBox, Frame, Grid, InactiveRule, L1_DIM, L2_DIM,
    Mask512, Pack, PackError, check,
};

/// The deepest thing that the tree has at some place.
#[derive(Clone, Copy, Debug)]
pub enum Region {
    /// Inactive background.
    Background,
    /// One value.
    Constant(Constant),
    /// The 8³ region of a record.
    Brick(L3Record),
}

/// A brick as a GPU reads it.
pub struct DecodedBrick {
    /// Every voxel's value, x slowest.
    pub values: Box<[f32; BRICK_VOXELS]>,
    /// Which voxels are active.
    pub active: Mask512,
}

/// One frame of one grid with the texel chunks that it lists, and no others.
pub struct FrameReader<'a> {
    pack: &'a Pack,
    grid: usize,
    frame: usize,
    slabs: HashMap<usize, Cow<'a, [u8]>>,
}

impl Pack {
    /// Loads one frame's texels.
    ///
    /// # Errors
    /// When a chunk is damaged.
    ///
    /// # Panics
    /// When there is no such frame.
    pub fn frame(&self, grid: usize, frame: usize) -> Result<FrameReader<'_>, PackError> {
        let chunks = &self.grids()[grid].frames[frame].chunks;
        let bytes = chunks.iter().map(|&chunk| self.chunk_bytes(chunk));
        let (raw, stored) = bytes.fold((0, 0), |(raw, stored), (r, s)| (raw + r, stored + s));
        // Rule 14.
        ensure(fits_memory(raw, stored), || format!("frame {frame} claims to unpack to {raw} bytes"))?;
        let mut slabs = HashMap::with_capacity(chunks.len());
        for &chunk in chunks {
            slabs.insert(chunk as usize, self.chunk(chunk as usize)?);
        }
        Ok(FrameReader { pack: self, grid, frame, slabs })
    }

    /// What a GPU has to hold: tree, masks and texture pages.
    pub fn gpu_bytes(&self) -> u64 {
        self.tree().len() as u64 * 4 + self.atlases().iter().map(Atlas::bytes).sum::<u64>()
    }

    /// One frame's tree without its texels: regions can be found, bricks not decoded.
    ///
    /// # Panics
    /// When there is no such frame.
    pub fn frame_tree(&self, grid: usize, frame: usize) -> FrameReader<'_> {
        assert!(frame < self.grids()[grid].frames.len(), "there is no frame {frame} in grid {grid}");
        FrameReader { pack: self, grid, frame, slabs: HashMap::new() }
    }

    /// How many 8³ regions all frames have, shared ones counted each time.
    ///
    /// Takes as long as the tree is, not as what it stands for: a few nodes that name each other often
    /// are more regions than anyone could visit.
    pub fn region_count(&self) -> u64 {
        let words = self.tree();
        let ones = |mask: &[u32]| mask.iter().map(|w| u64::from(w.count_ones())).sum::<u64>();
        let nodes = words[words[header::NODE_AT] as usize..].chunks_exact(NODE_WORDS);
        let in_node: Vec<u64> =
            nodes.take(words[header::NODES] as usize).map(|node| ones(&node[..NODE_MASK_WORDS])).collect();
        let mut total = 0u64;
        let mut in_l1: HashMap<(u32, usize), u64> = HashMap::new();
        for grid in self.grids() {
            let cells = grid.cell_count();
            let (mask_words, rank_words) = l1_words(cells);
            for &root in &words[grid.root_words()] {
                let Link::Node(l1 @ 1..) = Link::from_word(root) else { continue };
                let count = in_l1.entry((l1, cells)).or_insert_with(|| {
                    let (mask, rest) = words[l1 as usize..].split_at(mask_words);
                    let links = rest[rank_words..].iter().take(ones(mask) as usize);
                    let nodes = links.map(|&link| match Link::from_word(link) {
                        Link::Node(node) => in_node[node as usize],
                        Link::Constant { .. } => 0,
                    });
                    nodes.sum()
                });
                total = total.saturating_add(*count);
            }
        }
        total
    }
}

impl FrameReader<'_> {
    /// The frame's grid.
    pub fn grid(&self) -> &Grid {
        &self.pack.grids()[self.grid]
    }

    /// The frame.
    pub fn frame(&self) -> &Frame {
        &self.grid().frames[self.frame]
    }

    fn words(&self) -> &[u32] {
        self.pack.tree()
    }

    fn constant(&self, index: u32, active: bool) -> Constant {
        let words = self.words();
        tree::constant(words[words[header::CONSTANT_AT] as usize + index as usize], active)
    }

    /// What the tree has at a voxel, and the side of an aligned cube around it that is all that.
    pub fn locate(&self, at: Coord) -> (Region, i32) {
        let grid = self.grid();
        let mut root = 0usize;
        let mut cell = 0usize;
        for a in 0..3 {
            let offset = i64::from(at.0[a]) - i64::from(grid.origin.0[a]);
            let (cells, roots) = (i64::from(grid.cells[a]), i64::from(grid.roots[a]));
            let index = offset.div_euclid(L2_DIM.into());
            if index < 0 || index >= cells * roots {
                return (Region::Background, self.outside_dim(at));
            }
            root = root * roots as usize + (index / cells) as usize;
            cell = cell * cells as usize + (index % cells) as usize;
        }
        let words = self.words();
        let l1 = match Link::from_word(words[grid.root_at + self.frame * grid.root_count() + root]) {
            Link::Node(0) => return (Region::Background, L1_DIM),
            Link::Constant { index, active } => {
                return (Region::Constant(self.constant(index, active)), L1_DIM);
            }
            Link::Node(l1) => l1 as usize,
        };
        let (mask_words, rank_words) = l1_words(grid.cell_count());
        let (mask, rest) = words[l1..].split_at(mask_words);
        let Some(rank) = tree::rank(mask, rest, cell) else { return (Region::Background, L2_DIM) };
        match Link::from_word(rest[rank_words + rank as usize]) {
            Link::Constant { index, active } => (Region::Constant(self.constant(index, active)), L2_DIM),
            Link::Node(node) => (self.child(node, at.child_index(4, BRICK_DIM)), BRICK_DIM),
        }
    }

    /// The side of an aligned cube around a voxel outside the grid's box that is all outside.
    fn outside_dim(&self, at: Coord) -> i32 {
        let grid = self.grid();
        let root = at.align_down(L1_DIM);
        let is_apart = |a: usize| {
            let [origin, root] = [grid.origin, root].map(|corner| i64::from(corner.0[a]));
            let extent = i64::from(grid.cells[a]) * i64::from(grid.roots[a]) * i64::from(L2_DIM);
            root + i64::from(L1_DIM) <= origin || origin + extent <= root
        };
        // The box is made of whole cells.
        if (0..3).any(is_apart) { L1_DIM } else { L2_DIM }
    }

    fn child(&self, node: u32, index: usize) -> Region {
        let words = self.words();
        let node = &words[words[header::NODE_AT] as usize + node as usize * NODE_WORDS..][..NODE_WORDS];
        match tree::rank(&node[..NODE_MASK_WORDS], &node[NODE_MASK_WORDS..NODE_FIRST_RECORD], index) {
            None => Region::Background,
            Some(rank) => self.record(node[NODE_FIRST_RECORD] + rank),
        }
    }

    fn record(&self, index: u32) -> Region {
        let words = self.words();
        let at = words[header::RECORD_AT] as usize + index as usize * RECORD_WORDS;
        let record = L3Record::from_words([words[at], words[at + 1], words[at + 2]]);
        Region::Brick(record.expect("records were checked when the pack was opened"))
    }

    /// The box of every region that is not background.
    pub fn bounds(&self) -> CoordBox {
        let mut bounds = CoordBox::EMPTY;
        self.for_each_region(|origin, dim, _| bounds.union(CoordBox::cube(origin, dim)));
        bounds
    }

    /// Calls `visit` with every region that is not background: its smallest corner, its side in
    /// voxels, and what it is.
    pub fn for_each_region(&self, mut visit: impl FnMut(Coord, i32, Region)) {
        let grid = self.grid();
        let words = self.words();
        let [rx, ry, rz] = grid.roots;
        let [_, cy, cz] = grid.cells.map(|c| c as i32);
        let roots = (0..rx).flat_map(|x| (0..ry).flat_map(move |y| (0..rz).map(move |z| [x, y, z])));
        let root_count = grid.root_count();
        for (i, root) in roots.enumerate() {
            // A box from one end of i32 to the other has offsets past its range, but no corners.
            let corner = |a: usize| i64::from(grid.origin.0[a]) + i64::from(root[a]) * i64::from(L1_DIM);
            let origin = Coord(std::array::from_fn(|a| corner(a) as i32));
            let l1 = match Link::from_word(words[grid.root_at + self.frame * root_count + i]) {
                Link::Node(0) => continue,
                Link::Constant { index, active } => {
                    visit(origin, L1_DIM, Region::Constant(self.constant(index, active)));
                    continue;
                }
                Link::Node(l1) => l1 as usize,
            };
            let (mask_words, rank_words) = l1_words(grid.cell_count());
            let links = &words[l1 + mask_words + rank_words..];
            let cells = set_bits(&words[l1..l1 + mask_words]);
            for (&link, cell) in links.iter().zip(cells) {
                let cell = cell as i32;
                let cell = [cell / (cy * cz), cell / cz % cy, cell % cz];
                let origin = origin.offset_by(cell.map(|c| c * L2_DIM));
                match Link::from_word(link) {
                    Link::Constant { index, active } => {
                        visit(origin, L2_DIM, Region::Constant(self.constant(index, active)));
                    }
                    Link::Node(node) => self.for_each_child(node, origin, &mut visit),
                }
            }
        }
    }

    fn for_each_child(&self, node: u32, origin: Coord, visit: &mut impl FnMut(Coord, i32, Region)) {
        let words = self.words();
        let node = &words[words[header::NODE_AT] as usize + node as usize * NODE_WORDS..][..NODE_WORDS];
        for (record, place) in (node[NODE_FIRST_RECORD]..).zip(set_bits(&node[..NODE_MASK_WORDS])) {
            visit(origin.offset_by(Coord::child_offset(place, 4, BRICK_DIM)), BRICK_DIM, self.record(record));
        }
    }

    fn mask(&self, index: u32) -> Mask512 {
        let words = self.words();
        let at = words[header::MASK_AT] as usize + index as usize * MASK_WORDS;
        Mask512::from_words(words[at..at + MASK_WORDS].try_into().expect("16 words"))
    }

    /// Decodes a record's 512 voxels.
    ///
    /// # Errors
    /// When its texels are not among the chunks that the frame lists, or it is no record of this pack.
    pub fn decode(&self, record: &L3Record) -> Result<DecodedBrick, PackError> {
        self.check(record)?;
        let grid = self.grid();
        let mut values = if record.codec == Codec::Constant {
            Box::new([f32::from_bits(record.word2); BRICK_VOXELS])
        } else {
            let range = BrickRange::from_word(record.word2);
            decode(record.codec, &self.texels(record)?, record.axis, &grid.sequence, range)
        };
        let background = grid.background;
        let Some(index) = record.mask else {
            let mut active = Mask512::NONE;
            (0..BRICK_VOXELS).filter(|&i| values[i] != background).for_each(|i| active.set(i));
            return Ok(DecodedBrick { values, active });
        };
        let active = self.mask(index);
        let sign_mask = match record.rule {
            InactiveRule::Texel => return Ok(DecodedBrick { values, active }),
            InactiveRule::Background => Mask512::NONE,
            InactiveRule::MinusBackground => Mask512::ALL,
            InactiveRule::Sign => self.mask(index + 1),
        };
        for i in (0..BRICK_VOXELS).filter(|&i| !active.get(i)) {
            values[i] = if sign_mask.get(i) { -background } else { background };
        }
        Ok(DecodedBrick { values, active })
    }

    /// For each voxel of a record, how far what a GPU reads may be from [`FrameReader::decode`].
    ///
    /// # Errors
    /// When its texels are not among the chunks that the frame lists, or it is no record of this pack.
    pub fn spread(&self, record: &L3Record) -> Result<Box<[f32; BRICK_VOXELS]>, PackError> {
        self.check(record)?;
        if record.codec == Codec::Constant {
            return Ok(Box::new([0.0; BRICK_VOXELS]));
        }
        let range = BrickRange::from_word(record.word2);
        Ok(spread(record.codec, &self.texels(record)?, &self.grid().sequence, range))
    }

    /// Those of the tree were checked when the pack was opened; a caller may have made one up, or mixed up two packs.
    fn check(&self, record: &L3Record) -> Result<(), PackError> {
        check::l3_record(self.pack.tree(), self.pack.atlases(), record)
            .map_err(|what| PackError::Corrupt(format!("an L3 record: {what}")))
    }

    /// Rule 47.
    fn texels(&self, record: &L3Record) -> Result<Vec<u8>, PackError> {
        let atlas = self.pack.atlas(record.codec).expect("the record was checked");
        let (slab, place) = (record.slot / atlas.slab_bricks(), record.slot % atlas.slab_bricks());
        let loaded = self.pack.slab_chunk(record.codec, slab).and_then(|chunk| self.slabs.get(&chunk));
        let slab = loaded.ok_or_else(|| {
            PackError::Corrupt(format!("frame {} does not list the chunk of a brick it uses", self.frame))
        })?;
        Ok(atlas.extract(slab, place))
    }
}

fn set_bits(words: &[u32]) -> impl Iterator<Item = usize> + '_ {
    words
        .iter()
        .enumerate()
        .flat_map(|(i, &word)| (0..32).filter(move |b| word >> b & 1 != 0).map(move |b| i * 32 + b))
}
