//! Axes with round ticks, and how numbers are written on them.

use std::ops::Range;

use plotters::coord::ranged1d::{DefaultFormatting, KeyPointHint, Ranged};
use plotters::coord::types::RangedCoordf64;

/// An axis whose positions are the values, or their logarithms.
#[derive(Clone)]
pub(super) struct Axis {
    pub(super) lo: f64,
    pub(super) hi: f64,
    pub(super) ticks: Vec<f64>,
    pub(super) log: bool,
}

impl Axis {
    pub(super) fn linear(values: impl Iterator<Item = f64>, from_zero: bool, max_ticks: usize) -> Axis {
        let (mut lo, mut hi) = ends(values).unwrap_or((0.0, 1.0));
        // Equal values still need a width: a tenth of the value, or one unit about zero.
        if hi - lo < 1e-9 * hi.abs().max(1e-9) {
            let half = if hi.abs() < 1e-9 { 1.0 } else { hi.abs() * 0.1 };
            (lo, hi) = (lo - half, hi + half);
        }
        let pad = (hi - lo) * 0.07;
        (lo, hi) = if from_zero { (0.0, hi + hi * 0.07) } else { (lo - pad, hi + pad) };
        let rough = (hi - lo) / max_ticks as f64;
        let unit = 10f64.powf(rough.log10().floor());
        let step = unit * [1.0, 2.0, 5.0, 10.0].into_iter().find(|m| m * unit >= rough).unwrap_or(10.0);
        let first = (lo / step).ceil();
        let count = ((hi / step).floor() - first).clamp(0.0, 50.0) as usize;
        // `+ 0.0` turns a negative zero into zero.
        Axis { lo, hi, ticks: (0..=count).map(|i| (first + i as f64) * step + 0.0).collect(), log: false }
    }

    /// `base` 2 ticks at powers of two, 10 at 1, 2, 5 or at powers of ten. Values must be above zero.
    pub(super) fn log(values: impl Iterator<Item = f64>, base: f64, max_ticks: usize) -> Axis {
        let (lo, hi) = ends(values.map(f64::ln)).unwrap_or((0.0, 1.0));
        // A factor of four at least, so that there are always two ticks to read the scale from.
        let wide = (4f64.ln() - (hi - lo)).max(0.0) / 2.0 + (hi - lo) * 0.06;
        Axis {
            lo: lo - wide,
            hi: hi + wide,
            ticks: log_ticks(lo - wide, hi + wide, base, max_ticks),
            log: true,
        }
    }

    /// The axis of the same points in another unit, the factor between them given as a logarithm.
    pub(super) fn log_shifted(other: &Axis, by: f64) -> Axis {
        let (lo, hi) = (other.lo + by, other.hi + by);
        Axis { lo, hi, ticks: log_ticks(lo, hi, 10.0, 9), log: true }
    }

    pub(super) fn at(&self, value: f64) -> f64 {
        if self.log { value.ln() } else { value }
    }

    pub(super) fn label(&self, position: f64) -> String {
        number(if self.log { position.exp() } else { position })
    }
}

impl Ranged for Axis {
    type FormatOption = DefaultFormatting;
    type ValueType = f64;

    fn map(&self, position: &f64, limit: (i32, i32)) -> i32 {
        RangedCoordf64::from(self.range()).map(position, limit)
    }

    fn key_points<Hint: KeyPointHint>(&self, hint: Hint) -> Vec<f64> {
        if hint.weight().allow_light_points() { vec![] } else { self.ticks.clone() }
    }

    fn range(&self) -> Range<f64> {
        self.lo..self.hi
    }
}

/// Positions (logarithms) of round numbers between two positions.
pub(super) fn log_ticks(lo: f64, hi: f64, base: f64, max_ticks: usize) -> Vec<f64> {
    let marks: &[f64] = if base == 10.0 { &[1.0, 2.0, 5.0] } else { &[1.0] };
    let (from, to) = ((lo / base.ln()).floor() as i32, (hi / base.ln()).ceil() as i32);
    let pick = |every: i32, marks: &[f64]| -> Vec<f64> {
        let decades = (from..=to).filter(|e| e.rem_euclid(every) == 0);
        let all = decades.flat_map(|e| marks.iter().map(move |m| f64::from(e) * base.ln() + m.ln()));
        all.filter(|t| (lo..=hi).contains(t)).collect()
    };
    // One or two ticks are too few to read a scale from.
    let every_digit = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0];
    let dense = pick(1, marks);
    if base == 10.0 && dense.len() < 3 {
        return pick(1, &every_digit);
    }
    if dense.len() <= max_ticks {
        return dense;
    }
    (1..).map(|every| pick(every, &[1.0])).find(|t| t.len() <= max_ticks).unwrap_or_default()
}

pub(super) fn ends(values: impl Iterator<Item = f64>) -> Option<(f64, f64)> {
    values.fold(None, |e, v| Some(e.map_or((v, v), |(lo, hi): (f64, f64)| (lo.min(v), hi.max(v)))))
}

/// Three significant digits, the most a reader can use from a chart.
pub(super) fn number(v: f64) -> String {
    let size = v.abs();
    if size == 0.0 {
        return "0".into();
    }
    if !(0.9e-4..1e5).contains(&size) {
        return format!("{v:.1e}").replace(".0e", "e");
    }
    let digits = (2.0 - size.log10().floor()).max(0.0) as usize;
    let text = format!("{v:.digits$}");
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').into() } else { text }
}
