//! The errors that a comparison measures: sums, histogram and failures of a frame.

use crate::codec::Codec;
use crate::volume::ValueRange;

/// The number of codecs, constants among them; sums by codec are indexed by its tag.
pub(super) const CODECS: usize = Codec::WITH_TEXELS.len() + 1;

/// Squared errors of some voxels, summed, and what else is counted of them.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct ErrorSums {
    pub voxels: u64,
    pub squares: f64,
    pub max: f64,
    pub sign_flips: u64,
}

impl ErrorSums {
    pub fn add(&mut self, other: &Self) {
        self.voxels += other.voxels;
        self.squares += other.squares;
        self.max = self.max.max(other.max);
        self.sign_flips += other.sign_flips;
    }

    pub fn add_voxel(&mut self, error: f64, flipped: bool) {
        self.voxels += 1;
        self.squares += error * error;
        // `f64::max` ignores NaN, and a NaN must not pass as a small error.
        self.max = if error.is_nan() { f64::INFINITY } else { self.max.max(error.abs()) };
        self.sign_flips += u64::from(flipped);
    }
}

/// Bins of [`Histogram`]: no error, below 2⁻¹⁵ of the range, fourteen octaves, and half of the range and more.
pub const ERROR_BINS: usize = 17;

/// How many voxels have an error of 0, of less than 2⁻¹⁵ of the range of values, and so on by octaves to 2⁻¹ and more.
pub type Histogram = [u64; ERROR_BINS];

/// The bin of an error that is given as a fraction of the range.
pub(super) fn error_bin(error: f64) -> usize {
    if error == 0.0 {
        return 0;
    }
    // The octave is the float's exponent; infinities and NaNs have the greatest.
    let octave = (error.to_bits() >> 52 & 0x7ff) as i32 - 1023;
    (octave + ERROR_BINS as i32).clamp(1, ERROR_BINS as i32 - 1) as usize
}

/// What differs in one frame.
#[derive(Clone, Debug, Default)]
pub(super) struct FrameError {
    /// Over active leaf voxels, in the source's own type.
    pub active: ErrorSums,
    /// The same over all leaf voxels.
    pub all: ErrorSums,
    /// Of active leaf voxels.
    pub histogram: Histogram,
    /// The range of the source's active values, tiles included.
    pub active_range: Option<ValueRange>,
    /// Active voxels of the source, tiles in full.
    pub active_voxels: u64,
    /// Whether the pack has anything but background.
    pub has_regions: bool,
    /// Squared error over the voxels that texels give, by the codec that gives them, against the nearest floats of the
    /// source: what the encoder saw.
    pub codec_squares: [f64; CODECS],
    /// Squared error over active leaf voxels, likewise.
    pub active_float_squares: f64,
    failures: u64,
    first_failure: Option<String>,
}

impl FrameError {
    pub fn fail(&mut self, what: impl FnOnce() -> String) {
        self.failures += 1;
        self.first_failure.get_or_insert_with(what);
    }

    pub fn add(&mut self, other: Self) {
        self.active.add(&other.active);
        self.all.add(&other.all);
        self.histogram.iter_mut().zip(other.histogram).for_each(|(sum, count)| *sum += count);
        self.codec_squares.iter_mut().zip(other.codec_squares).for_each(|(sum, squares)| *sum += squares);
        self.active_float_squares += other.active_float_squares;
        self.active_range = ValueRange::union_all(self.active_range.into_iter().chain(other.active_range));
        self.failures += other.failures;
        self.first_failure = self.first_failure.take().or(other.first_failure);
    }

    pub fn add_active_value(&mut self, value: f32) {
        let value = ValueRange::of(value);
        self.active_range = Some(self.active_range.map_or(value, |range| range.union(value)));
    }

    /// The first thing that failed, and how many more did.
    pub fn failure(&self) -> Option<String> {
        let more = self.failures.saturating_sub(1);
        self.first_failure
            .as_ref()
            .map(|f| if more > 0 { format!("{f} (and {more} more)") } else { f.clone() })
    }
}
