//! Index-space coordinates and boxes.

/// Voxels along one axis of a brick.
pub const BRICK_DIM: i32 = 8;
/// Voxels along one axis of an L2 node: 16 bricks. Also the grid that origins and boxes snap to, so
/// that node boundaries agree between the frames of a sequence.
pub const L2_DIM: i32 = 128;
/// Bricks that an L2 node has places for.
pub const NODE_CHILDREN: usize = ((L2_DIM / BRICK_DIM) as usize).pow(3);
/// Voxels along one axis of an OpenVDB root entry and of a full L1 node: 32 L2 nodes.
pub const L1_DIM: i32 = 4096;

/// A voxel's integer position in OpenVDB index space.
///
/// Ordered by x, then y, then z, which is the order in which OpenVDB stores nodes and voxels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(transparent))]
pub struct Coord(pub [i32; 3]);

impl Coord {
    /// A coordinate from its components.
    pub const fn new(x: i32, y: i32, z: i32) -> Self {
        Self([x, y, z])
    }

    /// The origin of the cube with side `dim` (a power of two) that holds this voxel.
    #[inline]
    pub fn align_down(self, dim: i32) -> Self {
        debug_assert!(dim.count_ones() == 1);
        Self(self.0.map(|c| c & !(dim - 1)))
    }

    /// Whether every component is a multiple of `dim` (a power of two).
    pub fn is_aligned(self, dim: i32) -> bool {
        self == self.align_down(dim)
    }

    /// This coordinate moved by `offset`. The sum must fit an `i32`, as it does inside any node.
    #[inline]
    pub fn offset_by(self, offset: [i32; 3]) -> Self {
        Self(std::array::from_fn(|a| self.0[a] + offset[a]))
    }

    /// The offset of the `index`-th child of a node with `2^log2` children an axis (x slowest, z
    /// fastest), each `child_dim` voxels wide.
    pub fn child_offset(index: usize, log2: u32, child_dim: i32) -> [i32; 3] {
        let mask = (1usize << log2) - 1;
        [
            (index >> (2 * log2)) as i32 * child_dim,
            ((index >> log2) & mask) as i32 * child_dim,
            (index & mask) as i32 * child_dim,
        ]
    }

    /// The inverse of [`Coord::child_offset`]: which child of the aligned node around this voxel
    /// holds it.
    #[inline]
    pub fn child_index(self, log2: u32, child_dim: i32) -> usize {
        let mask = (1i32 << log2) - 1;
        let shift = child_dim.trailing_zeros();
        let [x, y, z] = self.0.map(|c| ((c >> shift) & mask) as usize);
        (((x << log2) | y) << log2) | z
    }
}

/// An inclusive box of voxels. Empty when any minimum is above its maximum.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct CoordBox {
    /// The smallest corner.
    pub min: Coord,
    /// The largest corner, inside the box.
    pub max: Coord,
}

impl CoordBox {
    /// The empty box, as OpenVDB has it: minimum at `i32::MAX`, maximum at `i32::MIN`.
    pub const EMPTY: Self = Self { min: Coord([i32::MAX; 3]), max: Coord([i32::MIN; 3]) };

    /// The box of the cube with side `dim` at `origin`.
    pub fn cube(origin: Coord, dim: i32) -> Self {
        Self { min: origin, max: origin.offset_by([dim - 1; 3]) }
    }

    /// Whether no voxel is inside.
    pub fn is_empty(&self) -> bool {
        (0..3).any(|a| self.min.0[a] > self.max.0[a])
    }

    /// Grows this box to hold `other`.
    pub fn union(&mut self, other: Self) {
        for a in 0..3 {
            self.min.0[a] = self.min.0[a].min(other.min.0[a]);
            self.max.0[a] = self.max.0[a].max(other.max.0[a]);
        }
    }

    /// The box of six integers: minimum, then maximum.
    pub fn from_array([a, b, c, d, e, f]: [i32; 6]) -> Self {
        Self { min: Coord([a, b, c]), max: Coord([d, e, f]) }
    }

    /// The six integers that reports print: minimum, then maximum.
    pub fn to_array(self) -> [i32; 6] {
        let ([a, b, c], [d, e, f]) = (self.min.0, self.max.0);
        [a, b, c, d, e, f]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn child_index_inverts_child_offset() {
        for (log2, dim) in [(3, 1), (4, BRICK_DIM), (5, L2_DIM)] {
            let node = Coord::new(-L1_DIM, 0, 2 * L1_DIM);
            for index in [0, 1, 7, 63, (1usize << (3 * log2)) - 1] {
                let at = node.offset_by(Coord::child_offset(index, log2, dim));
                assert_eq!(at.child_index(log2, dim), index);
            }
        }
    }
}
