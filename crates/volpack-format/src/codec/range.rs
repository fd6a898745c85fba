//! What a normalised texel's 0 and 1 stand for, and the majorant an engine gets from it.
//!
//! A texel `t` reads as `lo + span · (m + e · t)`: `lo` and `span` are the sequence's, `m` is 16-bit
//! unorm and `e` is half float, in word 2 of the brick's L3 record. `m` is rounded down and `e` up, so
//! that a brick's values always lie inside, and `t = 1` is a bound that no voxel of it exceeds.

use crate::Half;

/// The range that a whole sequence's values lie in.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SequenceRange {
    /// The value of code 0.
    pub lo: f32,
    /// What is added to it for code 1.
    pub span: f32,
}

/// A brick's part of its sequence's range.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BrickRange {
    /// The minimum as 65535ths of the span.
    pub min: u16,
    /// The extent as a fraction of the span.
    pub extent: Half,
}

impl BrickRange {
    /// The whole sequence's range.
    pub const SEQUENCE: Self = Self { min: 0, extent: Half::ONE };

    /// Word 2 of an L3 record.
    pub fn to_word(self) -> u32 {
        u32::from(self.min) | u32::from(self.extent.to_bits()) << 16
    }

    /// The inverse of [`BrickRange::to_word`].
    pub fn from_word(word: u32) -> Self {
        Self { min: word as u16, extent: Half::from_bits((word >> 16) as u16) }
    }
}

/// Both ends of a sequence's range are rounded outward to this many significant bits, so that an
/// edit which moves an extreme by a few percent leaves every other brick's bytes alone. Five bits
/// widen a range by at most 1/16 at either end.
const SIGNIFICANT_BITS: i32 = 5;

impl Default for SequenceRange {
    /// That of no values.
    fn default() -> Self {
        Self { lo: 0.0, span: 1.0 }
    }
}

impl SequenceRange {
    /// The range to use for values from `min` to `max`; `None` if it is wider than an `f32`.
    pub fn around(min: f32, max: f32) -> Option<Self> {
        let lo = round_outward(min, f64::floor);
        let span = round_outward(max, f64::ceil) - lo;
        // A range of no width still needs a span that can be divided by.
        let mut span_f32 = if span > 0.0 { span as f32 } else { 1.0 };
        let lo = lo as f32;
        while lo + span_f32 < max {
            span_f32 = span_f32.next_up();
        }
        (span_f32.is_finite() && lo.is_finite()).then_some(Self { lo, span: span_f32 })
    }

    /// What texel `t` of a brick reads as, in the arithmetic and the order that `docs/format.md`
    /// asks of every reader.
    #[inline]
    pub fn decode(&self, brick: BrickRange, t: f32) -> f32 {
        self.decoder(brick)(t)
    }

    /// The same for many texels of a brick.
    #[inline]
    pub fn decoder(&self, brick: BrickRange) -> impl Fn(f32) -> f32 + use<> {
        let Self { lo, span } = *self;
        let (min, extent) = (f32::from(brick.min) / 65535.0, brick.extent.to_f32());
        move |t| lo + span * (min + extent * t)
    }

    /// The tightest [`BrickRange`] around values from `min` to `max`.
    pub fn fit(&self, min: f32, max: f32) -> BrickRange {
        let fraction = |v: f32| (f64::from(v) - f64::from(self.lo)) / f64::from(self.span);
        let mut brick = BrickRange {
            min: (fraction(min) * 65535.0).floor().clamp(0.0, 65535.0) as u16,
            extent: Half::ZERO,
        };
        while brick.min > 0 && self.decode(brick, 0.0) > min {
            brick.min -= 1;
        }
        brick.extent = Half::from_f64((fraction(max) - f64::from(brick.min) / 65535.0).max(0.0));
        while self.decode(brick, 1.0) < max {
            // The next half up; positive halves are ordered as their bits are.
            brick.extent = Half::from_bits(brick.extent.to_bits() + 1);
        }
        brick
    }
}

fn round_outward(value: f32, outward: fn(f64) -> f64) -> f64 {
    let value = f64::from(value);
    if value == 0.0 {
        return 0.0;
    }
    let step = f64::exp2(value.abs().log2().floor() - f64::from(SIGNIFICANT_BITS - 1));
    outward(value / step) * step
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn value() -> impl Strategy<Value = f32> {
        prop_oneof![
            -10f32..10.0,
            Just(0.0),
            Just(1e-40),
            any::<f32>().prop_filter("finite and not so wide", |v| v.is_finite() && v.abs() < 1e38),
        ]
    }

    proptest! {
        #[test]
        fn a_fitted_range_holds_every_value(values in proptest::array::uniform4(value())) {
            let mut v = values;
            v.sort_by(f32::total_cmp);
            let [lo, min, max, hi] = v;
            let sequence = SequenceRange::around(lo, hi).unwrap();
            prop_assert!(sequence.lo <= lo && sequence.lo + sequence.span >= hi);
            let brick = sequence.fit(min, max);
            prop_assert!(sequence.decode(brick, 0.0) <= min);
            prop_assert!(sequence.decode(brick, 1.0) >= max);
            prop_assert_eq!(BrickRange::from_word(brick.to_word()), brick);
        }

        #[test]
        fn a_fitted_range_is_tight(min in 0f32..1.0, extent in 0f32..1.0) {
            let sequence = SequenceRange::around(0.0, 1.0).unwrap();
            let max = (min + extent).min(1.0);
            let brick = sequence.fit(min, max);
            // One 65535th below and one half-float step (2^-10) above, with room for f32.
            prop_assert!(min - sequence.decode(brick, 0.0) < 1.01 / 65535.0 + 1e-6);
            prop_assert!(sequence.decode(brick, 1.0) - max < 1e-3 * (max - min) + 3e-5);
        }
    }

    #[test]
    fn small_edits_leave_the_range_alone() {
        assert_eq!(SequenceRange::around(0.0, 5.71), SequenceRange::around(0.0, 5.73));
        assert_eq!(SequenceRange::around(0.0, 1.0).unwrap(), SequenceRange { lo: 0.0, span: 1.0 });
        assert_eq!(SequenceRange::around(3.0, 3.0).unwrap().span, 1.0);
        assert_eq!(SequenceRange::around(-3e38, 3e38), None);
    }
}
