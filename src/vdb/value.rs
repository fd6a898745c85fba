//! The value types of OpenVDB grids, as they lie in a file.

use half::f16;

/// A type of value that a grid's voxels may have.
#[derive(Clone, Debug, PartialEq, Eq)]
#[allow(missing_docs)] // The variants are OpenVDB's own type names.
pub enum ValueType {
    Half,
    Float,
    Double,
    Int32,
    Int64,
    Vec3s,
    Vec3d,
    Vec3i,
    Bool,
    Mask,
    PointDataIndex32,
    /// A type, or a tree configuration, whose layout is not known here.
    Other(String),
}

impl ValueType {
    /// Parses a grid type as the file has it, for instance `Tree_float_5_4_3`.
    pub fn from_tree_type(tree_type: &str) -> Self {
        let known = tree_type.strip_prefix("Tree_").and_then(|t| t.strip_suffix("_5_4_3"));
        match known {
            Some("half") => Self::Half,
            Some("float") => Self::Float,
            Some("double") => Self::Double,
            Some("int32") => Self::Int32,
            Some("int64") => Self::Int64,
            Some("vec3s") => Self::Vec3s,
            Some("vec3d") => Self::Vec3d,
            Some("vec3i") => Self::Vec3i,
            Some("bool") => Self::Bool,
            Some("mask") => Self::Mask,
            Some("ptdataidx32") => Self::PointDataIndex32,
            _ => Self::Other(tree_type.to_owned()),
        }
    }

    /// OpenVDB's name of the type.
    pub fn name(&self) -> &str {
        match self {
            Self::Half => "half",
            Self::Float => "float",
            Self::Double => "double",
            Self::Int32 => "int32",
            Self::Int64 => "int64",
            Self::Vec3s => "vec3s",
            Self::Vec3d => "vec3d",
            Self::Vec3i => "vec3i",
            Self::Bool => "bool",
            Self::Mask => "mask",
            Self::PointDataIndex32 => "ptdataidx32",
            Self::Other(name) => name,
        }
    }

    /// Whether grids of this type can be packed.
    pub fn is_scalar(&self) -> bool {
        matches!(self, Self::Half | Self::Float | Self::Double | Self::Int32 | Self::Int64)
    }

    /// Whether its values are integers that can be packed.
    pub fn is_integer(&self) -> bool {
        matches!(self, Self::Int32 | Self::Int64)
    }

    /// Whether a leaf's buffer is a second bit mask instead of 512 values (OpenVDB's
    /// `LeafNode<bool>` and `LeafNode<ValueMask>`).
    pub(super) fn has_bit_leaves(&self) -> bool {
        matches!(self, Self::Bool | Self::Mask)
    }
}

/// A voxel value that can be read from a file.
pub trait Value: Copy + Default + PartialEq + Send + Sync + std::fmt::Debug + 'static {
    /// Bytes of one value in a file.
    const SIZE: usize;
    /// Bytes of one value in a grid that is stored as half floats. OpenVDB halves real types only.
    const HALF_SIZE: usize = Self::SIZE;

    /// Reads one value from exactly [`Value::SIZE`] bytes.
    fn from_le(bytes: &[u8]) -> Self;
    /// Reads one value from exactly [`Value::HALF_SIZE`] bytes of a half-float grid.
    fn from_half_le(bytes: &[u8]) -> Self {
        Self::from_le(bytes)
    }
    /// OpenVDB's `math::negative`: what an inactive value of "minus the background" is.
    fn negative(self) -> Self;
    /// The value as JSON has it; null for infinities and NaN.
    fn to_json(self) -> serde_json::Value;
}

/// A [`Value`] that can be packed.
pub trait Scalar: Value + PartialOrd {
    /// Whether an `f32` holds every value.
    const FITS_F32: bool = false;

    /// The nearest `f32`: exact for `f32` itself.
    fn to_f32(self) -> f32;
    /// The nearest `f64`: exact for all but large `i64`.
    fn to_f64(self) -> f64;
    /// How far a decoded value is from this one; 0 only where they are equal.
    fn error_of(self, decoded: f32) -> f64 {
        f64::from(decoded) - self.to_f64()
    }
    /// An integer as a whole number; 0 for what is none.
    fn to_integer(self) -> i64 {
        0
    }
}

macro_rules! scalar {
    ($t:ty, $negative:expr $(, half = $half:expr)? $(, fits_f32 = $fits:literal)? $(, integer = $to_integer:expr)?) => {
        impl Value for $t {
            const SIZE: usize = size_of::<$t>();
            $(const HALF_SIZE: usize = 2;
            #[inline]
            fn from_half_le(bytes: &[u8]) -> Self {
                let half: fn(f16) -> $t = $half;
                half(f16::from_le_bytes([bytes[0], bytes[1]]))
            })?
            #[inline]
            fn from_le(bytes: &[u8]) -> Self {
                <$t>::from_le_bytes(bytes.try_into().expect("SIZE bytes"))
            }
            fn negative(self) -> Self {
                let negative: fn($t) -> $t = $negative;
                negative(self)
            }
            fn to_json(self) -> serde_json::Value {
                self.into()
            }
        }
        impl Scalar for $t {
            $(const FITS_F32: bool = $fits;)?
            $(fn to_integer(self) -> i64 {
                let to_integer: fn($t) -> i64 = $to_integer;
                to_integer(self)
            }
            fn error_of(self, decoded: f32) -> f64 {
                let decoded = f64::from(decoded);
                // A whole number of an f64 has few bits: an i128 holds it and the difference.
                if decoded.fract() == 0.0 && decoded.abs() < 1e38 {
                    (decoded as i128 - i128::from(self)) as f64
                } else {
                    decoded - self as f64
                }
            })?
            #[inline]
            fn to_f32(self) -> f32 {
                self as f32
            }
            #[inline]
            fn to_f64(self) -> f64 {
                self as f64
            }
        }
    };
}

scalar!(f32, |v| -v, half = f16::to_f32, fits_f32 = true);
scalar!(f64, |v| -v, half = f16::to_f64);
scalar!(i32, i32::wrapping_neg, integer = i64::from);
scalar!(i64, i64::wrapping_neg, integer = |v| v);

/// OpenVDB 13's `HalfGrid`. Its values have two bytes whether or not the grid says that it is saved as half floats.
impl Value for f16 {
    const SIZE: usize = 2;
    #[inline]
    fn from_le(bytes: &[u8]) -> Self {
        Self::from_le_bytes(bytes.try_into().expect("SIZE bytes"))
    }
    fn negative(self) -> Self {
        -self
    }
    fn to_json(self) -> serde_json::Value {
        Scalar::to_f32(self).into()
    }
}

impl Scalar for f16 {
    const FITS_F32: bool = true;

    #[inline]
    fn to_f32(self) -> f32 {
        self.into()
    }
    #[inline]
    fn to_f64(self) -> f64 {
        self.into()
    }
}

impl Value for bool {
    const SIZE: usize = 1;
    fn from_le(bytes: &[u8]) -> Self {
        bytes[0] != 0
    }
    fn negative(self) -> Self {
        !self
    }
    fn to_json(self) -> serde_json::Value {
        self.into()
    }
}

impl Value for u32 {
    const SIZE: usize = 4;
    fn from_le(bytes: &[u8]) -> Self {
        Self::from_le_bytes(bytes.try_into().expect("SIZE bytes"))
    }
    fn negative(self) -> Self {
        self.wrapping_neg()
    }
    fn to_json(self) -> serde_json::Value {
        self.into()
    }
}

impl<T: Scalar> Value for [T; 3] {
    const SIZE: usize = 3 * T::SIZE;
    const HALF_SIZE: usize = 3 * T::HALF_SIZE;
    fn from_le(bytes: &[u8]) -> Self {
        std::array::from_fn(|i| T::from_le(&bytes[i * T::SIZE..(i + 1) * T::SIZE]))
    }
    fn from_half_le(bytes: &[u8]) -> Self {
        std::array::from_fn(|i| T::from_half_le(&bytes[i * T::HALF_SIZE..(i + 1) * T::HALF_SIZE]))
    }
    fn negative(self) -> Self {
        self.map(T::negative)
    }
    fn to_json(self) -> serde_json::Value {
        serde_json::Value::Array(self.map(T::to_json).to_vec())
    }
}

/// Runs `$body` with `$T` standing for the Rust type of a [`ValueType`] whose layout is known, or
/// `$other` for the rest.
#[macro_export]
#[doc(hidden)]
macro_rules! __with_value_type {
    ($value_type:expr, $T:ident => $body:expr, $name:ident => $other:expr) => {{
        use $crate::vdb::ValueType as V;
        match $value_type {
            V::Half => {
                type $T = $crate::vdb::f16;
                $body
            }
            V::Float => {
                type $T = f32;
                $body
            }
            V::Double => {
                type $T = f64;
                $body
            }
            V::Int32 => {
                type $T = i32;
                $body
            }
            V::Int64 => {
                type $T = i64;
                $body
            }
            V::Vec3s => {
                type $T = [f32; 3];
                $body
            }
            V::Vec3d => {
                type $T = [f64; 3];
                $body
            }
            V::Vec3i => {
                type $T = [i32; 3];
                $body
            }
            V::Bool | V::Mask => {
                type $T = bool;
                $body
            }
            V::PointDataIndex32 => {
                type $T = u32;
                $body
            }
            V::Other($name) => $other,
        }
    }};
}

/// As [`with_value_type`], for the types that can be packed.
#[macro_export]
#[doc(hidden)]
macro_rules! __with_scalar_type {
    ($value_type:expr, $T:ident => $body:expr, $other_type:ident => $other:expr) => {{
        use $crate::vdb::ValueType as V;
        match $value_type {
            V::Half => {
                type $T = $crate::vdb::f16;
                $body
            }
            V::Float => {
                type $T = f32;
                $body
            }
            V::Double => {
                type $T = f64;
                $body
            }
            V::Int32 => {
                type $T = i32;
                $body
            }
            V::Int64 => {
                type $T = i64;
                $body
            }
            $other_type => $other,
        }
    }};
}

pub use crate::{__with_scalar_type as with_scalar_type, __with_value_type as with_value_type};
