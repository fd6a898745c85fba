//! Stage 5: which codec each brick gets, and what its texels' 0 and 1 stand for.
//!
//! Every format here is uniform, one codec for all bricks of a grid that are not constant.

use half::f16;

use super::dedup::SequenceTree;
use crate::codec::{BrickRange, Codec, SequenceRange};
use crate::settings::{Format, RangeMode};
use crate::volume::ValueRange;

/// The codecs and ranges of one grid's bricks.
pub struct Allocation {
    /// The codec of every brick that is not constant.
    pub codec: Codec,
    /// The range that brick ranges are fractions of.
    pub sequence: SequenceRange,
    /// The range of each brick of the pool.
    pub ranges: Vec<BrickRange>,
}

/// Gives every brick of `tree` the format's codec. `None` when the sequence's values span more than an
/// `f32` can hold.
pub fn allocate(tree: &SequenceTree, format: Format, mode: RangeMode) -> Option<Allocation> {
    let codec = format.codec();
    let sequence = match tree.value_range() {
        Some(range) => SequenceRange::around(range.min, range.max)?,
        None => SequenceRange { lo: 0.0, span: 1.0 },
    };
    // Raw texels need no range to be decoded; theirs is the tight one, for the majorant in it.
    let ranges = if mode == RangeMode::Sequence && codec.is_normalised() {
        vec![BrickRange::SEQUENCE; tree.brick_ranges.len()]
    } else {
        // What bounds a voxel is what its texel decodes to.
        let decoded = |v: f32| if codec == Codec::F16 { f16::from_f32(v).to_f32() } else { v };
        let fit = |r: &ValueRange| sequence.fit(decoded(r.min), decoded(r.max));
        tree.brick_ranges.iter().map(fit).collect()
    };
    Some(Allocation { codec, sequence, ranges })
}
