//! Values, what inactive voxels are, and the classes of grids.

/// Voxels in a brick: 8 × 8 × 8.
pub const BRICK_VOXELS: usize = 512;

/// What an inactive voxel under a mask reads as. The numbers are the pack's.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[repr(u8)]
pub enum InactiveRule {
    /// The background.
    Background = 0,
    /// The background with its sign flipped: the inside of a level set.
    MinusBackground = 1,
    /// Minus the background where the mask's second half is on, else the background.
    Sign = 2,
    /// What the texel says.
    Texel = 3,
}

impl InactiveRule {
    /// The rule with this number, 0 to 3.
    pub fn from_bits(bits: u32) -> Self {
        match bits & 3 {
            0 => Self::Background,
            1 => Self::MinusBackground,
            2 => Self::Sign,
            _ => Self::Texel,
        }
    }
}

/// A region of one value.
#[derive(Clone, Copy, Debug)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Constant {
    /// The value of every voxel in it.
    pub value: f32,
    /// Whether they are active.
    pub active: bool,
}

impl Constant {
    /// Value and state as bits, to compare and to hash.
    pub fn key(self) -> (u32, bool) {
        (self.value.to_bits(), self.active)
    }
}

/// A closed range of values.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct ValueRange {
    /// The smallest.
    pub min: f32,
    /// The largest.
    pub max: f32,
}

impl ValueRange {
    /// The range of one value.
    pub fn of(value: f32) -> Self {
        Self { min: value, max: value }
    }

    /// The largest less the smallest.
    pub fn width(self) -> f64 {
        f64::from(self.max) - f64::from(self.min)
    }

    /// The smallest range around both.
    pub fn union(self, other: Self) -> Self {
        Self { min: self.min.min(other.min), max: self.max.max(other.max) }
    }

    /// What errors of a grid are measured against: the width of the range of its active values. Where they are all one, how
    /// far that is from the background; where that is nothing either, 1.
    pub fn peak(active: Option<Self>, background: f32) -> f64 {
        let Some(active) = active else { return 1.0 };
        let from_background = (f64::from(active.max) - f64::from(background)).abs();
        [active.width(), from_background].into_iter().find(|peak| *peak > 0.0).unwrap_or(1.0)
    }

    /// The smallest range around all of them; `None` for none.
    pub fn union_all(ranges: impl IntoIterator<Item = Self>) -> Option<Self> {
        ranges.into_iter().reduce(Self::union)
    }
}

/// What kind of field a grid holds. The numbers are the pack's.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum GridClass {
    /// Not stated.
    #[default]
    Unknown,
    /// A narrow band signed distance.
    LevelSet,
    /// A density.
    FogVolume,
    /// A staggered velocity.
    Staggered,
}

impl GridClass {
    /// OpenVDB's name of the class (`GridBase::gridClassToString`).
    pub fn name(self) -> &'static str {
        match self {
            Self::Unknown => "unknown",
            Self::LevelSet => "level set",
            Self::FogVolume => "fog volume",
            Self::Staggered => "staggered",
        }
    }

    /// The inverse of [`GridClass::name`]; [`GridClass::Unknown`] for any other name.
    pub fn from_name(name: &str) -> Self {
        match name {
            "level set" => Self::LevelSet,
            "fog volume" => Self::FogVolume,
            "staggered" => Self::Staggered,
            _ => Self::Unknown,
        }
    }
}

/// The length of a voxel's shortest edge, in world units, from a frame's index-to-world matrix (row-major, row vectors).
pub fn voxel_size(matrix: &[f64; 16]) -> f64 {
    let edge = |r: usize| matrix[4 * r..4 * r + 3].iter().map(|v| v * v).sum::<f64>().sqrt();
    edge(0).min(edge(1)).min(edge(2))
}
