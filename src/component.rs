//! What of a grid's values goes into a pack: all of it, or some bits of an integer.
//!
//! A pack holds 32-bit floats, which hold every integer up to 2^24 and few above. With [`Integers::Split`] an integer grid
//! becomes several grids of 24 bits each, which together give every value back exactly.

use crate::settings::Integers;
use crate::vdb::{GridInfo, Scalar, ValueType, find_grid};

/// Bits of a part: as many as an `f32` holds of any integer.
const PART_BITS: u32 = 24;

/// Which part of a value.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, serde::Serialize)]
pub enum Component {
    /// The value as it is.
    Whole,
    /// 24 bits of an integer from this bit on, as a number that is not negative.
    Bits(u32),
    /// All bits of an integer from this bit on, with its sign.
    Top(u32),
}

/// The parts of a grid of some type: what is added to its name, and which bits they are. The value is the sum of each
/// part times two to the power of its first bit.
fn parts(value_type: &ValueType) -> &'static [(&'static str, Component)] {
    const TWO: u32 = 2 * PART_BITS;
    match value_type {
        ValueType::Int32 => &[(".low", Component::Bits(0)), (".high", Component::Top(PART_BITS))],
        ValueType::Int64 => &[
            (".low", Component::Bits(0)),
            (".middle", Component::Bits(PART_BITS)),
            (".high", Component::Top(TWO)),
        ],
        _ => &[],
    }
}

impl Component {
    fn of_integer(self, value: i64) -> i64 {
        match self {
            Self::Whole => value,
            Self::Bits(first) => value >> first & ((1 << PART_BITS) - 1),
            Self::Top(first) => value >> first,
        }
    }

    /// The nearest `f32` of it: exact for parts.
    #[inline]
    pub fn to_f32<T: Scalar>(self, value: T) -> f32 {
        match self {
            Self::Whole => value.to_f32(),
            part => part.of_integer(value.to_integer()) as f32,
        }
    }

    /// How far a decoded value is from it; 0 only where they are equal.
    pub fn error_of<T: Scalar>(self, value: T, decoded: f32) -> f64 {
        match self {
            Self::Whole => value.error_of(decoded),
            part => part.of_integer(value.to_integer()).error_of(decoded),
        }
    }
}

/// The grids that a grid of a file becomes in a pack: their names, and which part of its values each has.
pub fn packed_as(info: &GridInfo, integers: Integers) -> Vec<(String, Component)> {
    let parts = if integers == Integers::Split { parts(&info.value_type) } else { &[] };
    match parts {
        [] => vec![(info.name.clone(), Component::Whole)],
        parts => parts.iter().map(|(suffix, part)| (format!("{}{suffix}", info.name), *part)).collect(),
    }
}

/// The grid of a file that a grid of a pack was made from, and which part of its values.
pub fn find_packed<'a>(
    grids: &'a [GridInfo],
    name: &str,
    integers: Integers,
) -> Option<(&'a GridInfo, Component)> {
    let part = || {
        let (base, _) = name.rsplit_once('.').filter(|_| integers == Integers::Split)?;
        let info = find_grid(grids, base)?;
        let (_, part) =
            parts(&info.value_type).iter().find(|(suffix, _)| name.strip_prefix(base) == Some(suffix))?;
        Some((info, *part))
    };
    part().or_else(|| Some((find_grid(grids, name)?, Component::Whole)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn together(value: i64, value_type: &ValueType) -> i64 {
        let add = |sum: i64, (_, part): &(&str, Component)| {
            let number = part.to_f32(value);
            assert_eq!(part.error_of(value, number), 0.0, "{value}: {part:?}");
            let first = match *part {
                Component::Bits(first) | Component::Top(first) => first,
                Component::Whole => 0,
            };
            sum.wrapping_add((number as i64) << first)
        };
        parts(value_type).iter().fold(0, add)
    }

    #[test]
    fn parts_give_every_integer_back() {
        let small = [0, 1, -1, 16_777_215, 16_777_216, 16_777_217, -16_777_217, i32::MAX, i32::MIN];
        for value in small.map(i64::from) {
            assert_eq!(together(value, &ValueType::Int32), value);
            assert_eq!(together(value, &ValueType::Int64), value);
        }
        for value in [i64::MAX, i64::MIN, 1 << 53 | 1, -(1 << 48) - 1, 0x0123_4567_89ab_cdef] {
            assert_eq!(together(value, &ValueType::Int64), value);
        }
    }

    #[test]
    fn what_is_past_a_float_is_not_called_equal() {
        for value in [16_777_217i64, i64::MAX, i64::MIN + 1, (1 << 53) + 1] {
            assert_ne!(value.error_of(value.to_f32()), 0.0, "{value}");
        }
        for value in [16_777_216i64, i64::MIN, 1 << 62, -3] {
            assert_eq!(value.error_of(value.to_f32()), 0.0, "{value}");
        }
        assert_eq!(7i32.error_of(7.5), 0.5);
        assert_ne!(1e-300f64.error_of(0.0), 0.0);
        assert_ne!(0.1f64.error_of(0.1), 0.0);
    }
}
