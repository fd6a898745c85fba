//! One frame's voxels, quick to look up by coordinate: what the CPU tracer traces.

use std::collections::HashMap;

use rayon::prelude::*;

use crate::codec::Codec;
use crate::pack::{FrameReader, PackError, Region};
use crate::vdb::{Internal, Scalar, Tree};
use crate::volume::{
    BRICK_DIM, BRICK_VOXELS, Constant, Coord, CoordBox, L1_DIM, L2_DIM, Mask512, NODE_CHILDREN,
};

/// A frame as nested constants and bricks of values.
pub struct DecodedFrame {
    /// The value outside everything.
    pub background: f32,
    /// The box of everything that is not background, in whole bricks; empty if there is nothing.
    pub bounds: CoordBox,
    roots: HashMap<Coord, Constant>,
    cells: HashMap<Coord, Cell>,
    bricks: Vec<DecodedBrick>,
}

/// 512 voxels of a frame.
pub struct DecodedBrick {
    /// Their values, x slowest.
    pub values: Box<[f32; BRICK_VOXELS]>,
    /// How far a GPU's values may be from these: 0 but for BC4, whose blocks each GPU interpolates in its own way.
    pub uncertainty: f32,
}

enum Cell {
    Constant(Constant),
    /// For each place of an L2 node what is there; 0 is background.
    Node(Box<[u32; NODE_CHILDREN]>, Vec<Constant>),
}

/// The 128³ that was looked up last. A ray stays in one for long, and to find one takes a hash.
#[derive(Clone, Copy, Default)]
pub struct Nearby<'a> {
    last: Option<(Coord, Option<&'a Cell>)>,
}

/// How far apart GPUs interpolate, of the distance of a block's endpoints.
const GPU_UNCERTAINTY: f32 = 0.03;

fn span(values: &[f32]) -> f32 {
    let least = values.iter().copied().fold(f32::INFINITY, f32::min);
    let most = values.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    most - least
}

/// Marks a place's number as that of a constant.
const CONSTANT: u32 = 1 << 31;

/// The node around a voxel.
#[derive(Clone, Copy)]
pub struct Found<'a> {
    /// What it holds.
    pub content: Content<'a>,
    /// Its smallest corner.
    pub origin: Coord,
    /// Its side.
    pub dim: i32,
}

/// What a node holds.
#[derive(Clone, Copy)]
pub enum Content<'a> {
    /// One value.
    Constant(Constant),
    /// 512 voxels.
    Brick(&'a DecodedBrick),
}

/// Where a constant goes, by its size.
type PutConstant = fn(&mut DecodedFrame, Coord, Constant);

/// How a tree's values are read.
struct TreeValues<F> {
    background: f32,
    value: F,
}

/// What becomes of a leaf.
enum Leaf {
    /// All inactive background: nothing.
    Background,
    /// One value, over which a ray steps at once.
    Constant(Constant),
    Voxels(Box<[f32; BRICK_VOXELS]>),
}

impl<F> TreeValues<F> {
    fn value<T: Scalar>(&self, value: T, active: bool) -> f32
    where
        F: Fn(T) -> f32,
    {
        let value = (self.value)(value);
        // Where the background is 0, an inactive -0 is background too.
        if active || self.background != 0.0 { value } else { value + 0.0 }
    }

    /// A tile, unless it is inactive background.
    fn tile<T: Scalar>(&self, value: T, active: bool) -> Option<Constant>
    where
        F: Fn(T) -> f32,
    {
        let value = self.value(value, active);
        (active || value != self.background).then_some(Constant { value, active })
    }

    fn leaf<T: Scalar>(&self, values: &[T; BRICK_VOXELS], mask: Mask512) -> Leaf
    where
        F: Fn(T) -> f32,
    {
        let values: Box<[f32; BRICK_VOXELS]> =
            Box::new(std::array::from_fn(|i| self.value(values[i], mask.get(i))));
        let active = mask == Mask512::ALL;
        let is_one = active || mask == Mask512::NONE;
        let value = values[0];
        if !is_one || values.iter().any(|v| v.to_bits() != value.to_bits()) {
            return Leaf::Voxels(values);
        }
        if active || value != self.background {
            Leaf::Constant(Constant { value, active })
        } else {
            Leaf::Background
        }
    }
}

impl DecodedFrame {
    fn empty(background: f32) -> Self {
        Self {
            background,
            bounds: CoordBox::EMPTY,
            roots: HashMap::new(),
            cells: HashMap::new(),
            bricks: Vec::new(),
        }
    }

    /// A frame of the source, whose values become what `value` makes of them.
    pub fn from_tree<T: Scalar>(tree: &Tree<T>, value: impl Fn(T) -> f32 + Sync) -> Self {
        let source = TreeValues { background: value(tree.background) + 0.0, value };
        let mut field = Self::empty(source.background);
        for tile in &tree.tiles {
            if let Some(constant) = source.tile(tile.value, tile.active) {
                field.put_root(tile.origin, constant);
            }
        }
        let levels: [(&[Internal<T>], u32, i32, PutConstant); 2] =
            [(&tree.l1, 5, L2_DIM, Self::put_cell), (&tree.l2, 4, BRICK_DIM, Self::put_region)];
        for (nodes, log2, dim, put) in levels {
            for node in nodes {
                for i in node.tile_indices() {
                    if let Some(constant) = source.tile(node.tiles[i], node.is_active(i)) {
                        put(&mut field, node.origin.offset_by(Coord::child_offset(i, log2, dim)), constant);
                    }
                }
            }
        }
        let leaf = |i: usize| source.leaf(tree.leaves.values(i), tree.leaves.masks[i]);
        let leaves: Vec<Leaf> = (0..tree.leaves.len()).into_par_iter().map(leaf).collect();
        for (origin, leaf) in tree.leaves.origins.iter().zip(leaves) {
            match leaf {
                Leaf::Background => {}
                Leaf::Constant(constant) => field.put_region(*origin, constant),
                Leaf::Voxels(values) => field.put_brick(*origin, DecodedBrick { values, uncertainty: 0.0 }),
            }
        }
        field
    }

    /// A frame of a pack, decoded.
    ///
    /// # Errors
    /// When a texel chunk is damaged.
    pub fn from_pack(frame: &FrameReader) -> Result<Self, PackError> {
        let mut field = Self::empty(frame.grid().background);
        let mut result = Ok(());
        frame.for_each_region(|origin, dim, region| match region {
            Region::Background => {}
            Region::Constant(constant) if dim == L1_DIM => field.put_root(origin, constant),
            Region::Constant(constant) => field.put_cell(origin, constant),
            Region::Brick(record) if record.codec == Codec::Constant && record.mask.is_none() => {
                let value = f32::from_bits(record.word2);
                field.put_region(origin, Constant { value, active: value != field.background });
            }
            Region::Brick(record) => match frame.decode(&record) {
                Ok(brick) => {
                    let varies = record.codec.varies_by_gpu();
                    let uncertainty = if varies { GPU_UNCERTAINTY * span(&brick.values[..]) } else { 0.0 };
                    field.put_brick(origin, DecodedBrick { values: brick.values, uncertainty });
                }
                Err(e) => result = Err(e),
            },
        });
        result.map(|()| field)
    }

    fn put_root(&mut self, origin: Coord, constant: Constant) {
        self.bounds.union(CoordBox::cube(origin, L1_DIM));
        self.roots.insert(origin, constant);
    }

    fn put_cell(&mut self, origin: Coord, constant: Constant) {
        self.bounds.union(CoordBox::cube(origin, L2_DIM));
        self.cells.insert(origin, Cell::Constant(constant));
    }

    fn place(&mut self, origin: Coord) -> (&mut u32, &mut Vec<Constant>) {
        self.bounds.union(CoordBox::cube(origin, BRICK_DIM));
        let cell = self
            .cells
            .entry(origin.align_down(L2_DIM))
            .or_insert_with(|| Cell::Node(Box::new([0; NODE_CHILDREN]), Vec::new()));
        let Cell::Node(places, constants) = cell else { unreachable!("a cell is constant or a node") };
        (&mut places[origin.child_index(4, BRICK_DIM)], constants)
    }

    fn put_region(&mut self, origin: Coord, constant: Constant) {
        let (place, constants) = self.place(origin);
        *place = CONSTANT | constants.len() as u32;
        constants.push(constant);
    }

    fn put_brick(&mut self, origin: Coord, brick: DecodedBrick) {
        let number = self.bricks.len() as u32 + 1;
        *self.place(origin).0 = number;
        self.bricks.push(brick);
    }

    /// The node around a voxel.
    pub fn find<'a>(&'a self, at: Coord, nearby: &mut Nearby<'a>) -> Found<'a> {
        let found = |content, dim: i32| Found { content, origin: at.align_down(dim), dim };
        let background = Content::Constant(Constant { value: self.background, active: false });
        match self.cell(at, nearby) {
            None if self.roots.is_empty() => found(background, L2_DIM),
            None => match self.roots.get(&at.align_down(L1_DIM)) {
                Some(root) => found(Content::Constant(*root), L1_DIM),
                None => found(background, L2_DIM),
            },
            Some(Cell::Constant(c)) => found(Content::Constant(*c), L2_DIM),
            Some(Cell::Node(places, constants)) => {
                let content = match places[at.child_index(4, BRICK_DIM)] {
                    0 => background,
                    c if c & CONSTANT != 0 => Content::Constant(constants[(c & !CONSTANT) as usize]),
                    brick => Content::Brick(&self.bricks[brick as usize - 1]),
                };
                found(content, BRICK_DIM)
            }
        }
    }

    fn cell<'a>(&'a self, at: Coord, nearby: &mut Nearby<'a>) -> Option<&'a Cell> {
        let place = at.align_down(L2_DIM);
        match nearby.last {
            Some((last, cell)) if last == place => cell,
            _ => nearby.last.insert((place, self.cells.get(&place))).1,
        }
    }

    /// Whether the region of a voxel and the seven next to it on its high sides are background, all of
    /// them in one L2 node: then no cell of that region has a corner that is not.
    pub fn is_alone<'a>(&'a self, at: Coord, nearby: &mut Nearby<'a>) -> bool {
        let region = |axis: usize| at.0[axis].rem_euclid(L2_DIM) / BRICK_DIM;
        let Some(Cell::Node(places, _)) = self.cell(at, nearby) else { return false };
        let last = L2_DIM / BRICK_DIM - 1;
        (0..3).all(|axis| region(axis) < last)
            && (0..8).all(|corner| {
                let side = |axis: usize| BRICK_DIM * (corner >> axis & 1);
                let next = at.offset_by([side(0), side(1), side(2)]);
                places[next.child_index(4, BRICK_DIM)] == 0
            })
    }
}
