//! Half floats, as IEEE 754 has them (binary16).
//!
//! The `half` crate does the same and more, and brings as many crates with it as the rest of this one needs. Beside it
//! this file is tested on every half, and on floats of every exponent.

use std::fmt;

/// A 16-bit float: 1 bit of sign, 5 of exponent, 10 of mantissa.
#[derive(Clone, Copy, Default, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(transparent)]
pub struct Half(u16);

impl Half {
    /// 0.
    pub const ZERO: Self = Self(0);
    /// 1.
    pub const ONE: Self = Self(0x3c00);
    /// The largest finite one, 65,504.
    pub const MAX: Self = Self(0x7bff);

    /// The half with these bits.
    pub const fn from_bits(bits: u16) -> Self {
        Self(bits)
    }

    /// Its bits.
    pub const fn to_bits(self) -> u16 {
        self.0
    }

    /// Whether it is neither infinite nor NaN.
    pub const fn is_finite(self) -> bool {
        self.0 & 0x7c00 != 0x7c00
    }

    /// The same number; every half is an `f32`. NaNs become quiet and keep the rest of their bits, as processors do it.
    #[inline]
    pub fn to_f32(self) -> f32 {
        let sign = u32::from(self.0 & 0x8000) << 16;
        let magnitude = u32::from(self.0 & 0x7fff) << 13;
        // The exponents' biases are 112 apart. A multiplication also puts right halves that have no exponent, exactly.
        let scaled = (f32::from_bits(magnitude) * f32::from_bits((112 + 127) << 23)).to_bits();
        let special = magnitude | 0x7f80_0000 | if self.0 & 0x3ff != 0 { 1 << 22 } else { 0 };
        f32::from_bits(sign | if self.is_finite() { scaled } else { special })
    }

    /// The same number.
    pub fn to_f64(self) -> f64 {
        self.to_f32().into()
    }

    /// The nearest half, the even one of two that are as near; infinity from 65,520 on.
    pub fn from_f32(value: f32) -> Self {
        let bits = value.to_bits();
        let (sign, magnitude) = ((bits >> 16) as u16 & 0x8000, bits & 0x7fff_ffff);
        let half = if magnitude > 0x7f80_0000 {
            0x7e00 | (magnitude >> 13) as u16 & 0x3ff
        } else if magnitude >= (127 + 16) << 23 {
            0x7c00
        } else if magnitude >= (127 - 14) << 23 {
            // A carry out of the mantissa raises the exponent, up to infinity.
            round_shift(magnitude - (112 << 23), 13)
        } else {
            let exponent = magnitude >> 23;
            let mantissa = magnitude & 0x007f_ffff | 0x0080_0000;
            // In units of 2^-24, the smallest half. What is less than half of one is 0.
            if exponent < 127 - 25 { 0 } else { round_shift(mantissa, 127 - 1 - exponent) }
        };
        Self(sign | half)
    }

    /// The nearest half to the nearest `f32`. Rounding twice is what processors do that have an instruction for it.
    pub fn from_f64(value: f64) -> Self {
        Self::from_f32(value as f32)
    }
}

/// Drops bits, to the nearest, of two the even one.
fn round_shift(value: u32, shift: u32) -> u16 {
    let (kept, rest, middle) = (value >> shift, value & ((1 << shift) - 1), 1 << (shift - 1));
    (kept + u32::from(rest > middle || rest == middle && kept & 1 == 1)) as u16
}

impl PartialEq for Half {
    fn eq(&self, other: &Self) -> bool {
        self.to_f32() == other.to_f32()
    }
}

impl PartialOrd for Half {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        self.to_f32().partial_cmp(&other.to_f32())
    }
}

impl fmt::Display for Half {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.to_f32().fmt(f)
    }
}

impl fmt::Debug for Half {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Debug::fmt(&self.to_f32(), f)
    }
}

#[cfg(test)]
mod tests {
    use half::f16;

    use super::*;

    #[test]
    fn every_half_is_the_same_float_as_in_the_half_crate() {
        for bits in 0..=u16::MAX {
            let (ours, theirs) = (Half::from_bits(bits), f16::from_bits(bits));
            assert_eq!(ours.to_f32().to_bits(), theirs.to_f32().to_bits(), "{bits:#x}");
            assert_eq!(ours.is_finite(), theirs.is_finite());
            assert_eq!(ours.to_string(), theirs.to_string());
        }
    }

    #[test]
    fn floats_round_as_in_the_half_crate() {
        // Around every half and around the middles between two, at every exponent.
        let ends = (0..=u16::MAX).map(|bits| f16::from_bits(bits).to_f32().to_bits());
        let near = ends.flat_map(|bits| [0, 0x1000].map(|middle| bits ^ middle));
        let near = near.flat_map(|bits| (-2i32..=2).map(move |step| bits.wrapping_add_signed(step)));
        let spread = (0..=u32::MAX).step_by(7919);
        for bits in near.chain(spread) {
            let value = f32::from_bits(bits);
            assert_eq!(
                Half::from_f32(value).to_bits(),
                f16::from_f32(value).to_bits(),
                "{value:e} {bits:#x}"
            );
        }
    }
}
