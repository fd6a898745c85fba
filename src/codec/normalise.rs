//! From values to the fractions of a range that normalised texels hold.

use super::{BrickRange, SequenceRange};

/// The fractions that some values are of a brick's range, 0 to 1.
pub(super) fn normalise<const N: usize>(
    sequence: &SequenceRange,
    brick: BrickRange,
    values: &[f32; N],
) -> [f32; N] {
    let (lo, span) = (f64::from(sequence.lo), f64::from(sequence.span));
    let (min, extent) = (f64::from(brick.min) / 65535.0, brick.extent.to_f64());
    if extent == 0.0 {
        return [0.0; N];
    }
    values.map(|v| (((f64::from(v) - lo) / span - min) / extent).clamp(0.0, 1.0) as f32)
}
