//! Times in frames, exact for every number in a file name, and the gaps between them.

use std::collections::BTreeSet;
use std::fmt;

/// Gaps that a warning lists; more are only counted.
const MOST_LISTED_GAPS: usize = 10;

/// A time in 10⁻¹⁸ frames, so that every decimal that fits into a name is exact.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub(super) struct Time(pub i128);

const DECIMALS: usize = 18;
/// One frame, in the unit of [`Time`].
pub(super) const FRAME: i128 = 10i128.pow(DECIMALS as u32);

impl Time {
    /// `None` for more decimals than fit, or more frames than an `i32` counts.
    pub fn parse(is_negative: bool, whole: &str, fraction: &str) -> Option<Self> {
        let whole = i128::from(whole.parse::<i32>().ok()?) * FRAME;
        let missing = DECIMALS.checked_sub(fraction.len())?;
        let fraction = if fraction.is_empty() { 0 } else { fraction.parse::<i128>().ok()? };
        let time = whole + fraction * 10i128.pow(missing as u32);
        Some(Self(if is_negative { -time } else { time }))
    }
}

impl fmt::Display for Time {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let sign = if self.0 < 0 { "-" } else { "" };
        let time = self.0.abs();
        let fraction = format!(".{:0DECIMALS$}", time % FRAME);
        write!(f, "{sign}{}{}", time / FRAME, fraction.trim_end_matches('0').trim_end_matches('.'))
    }
}

/// Different times as numbers of the smallest decimal unit that they share, rounded to as many decimals as an `i32` has
/// room for; `None` if that makes two of them equal.
pub(super) fn in_shared_unit(times: &[Time]) -> Option<Vec<i32>> {
    let mut unit = FRAME;
    while times.iter().any(|time| time.0 % unit != 0) {
        unit /= 10;
    }
    let largest = times.iter().map(|time| time.0.abs()).max().unwrap_or(0);
    while largest / unit >= i128::from(i32::MAX) {
        unit *= 10;
    }
    let rounded = |time: &Time| i32::try_from((time.0 + unit / 2).div_euclid(unit));
    let numbers = times.iter().map(rounded).collect::<Result<Vec<_>, _>>().ok()?;
    let different: BTreeSet<&i32> = numbers.iter().collect();
    (different.len() == times.len()).then_some(numbers)
}

/// A warning that names the frames missing between sorted times. A fraction that any frame has is expected of every
/// frame.
pub(super) fn missing_frames(times: &[Time]) -> Option<String> {
    let fractions: BTreeSet<i128> = times.iter().map(|time| time.0.rem_euclid(FRAME)).collect();
    let fractions: Vec<i128> = fractions.into_iter().collect();
    let steps = times.windows(2).map(|w| w[1].0 - w[0].0);
    let (least, most) = (steps.clone().min()?, steps.max()?);
    // Equal steps that are no whole frames, such as one and a half; rounded decimals make them differ a little.
    if fractions.len() > 1 && most < 2 * least {
        return None;
    }
    let count = fractions.len() as i128;
    let index = |time: &Time| {
        let fraction =
            fractions.binary_search(&time.0.rem_euclid(FRAME)).expect("every time has one of the fractions");
        time.0.div_euclid(FRAME) * count + fraction as i128
    };
    let time =
        |index: i128| Time(index.div_euclid(count) * FRAME + fractions[index.rem_euclid(count) as usize]);
    let mut total = 0;
    let mut gaps = Vec::new();
    for pair in times.windows(2) {
        let (first, last) = (index(&pair[0]) + 1, index(&pair[1]) - 1);
        if first <= last {
            total += last - first + 1;
            gaps.push(match (time(first), time(last)) {
                (first, last) if first == last => first.to_string(),
                (first, last) if first.0 < 0 || count > 1 => format!("{first} to {last}"),
                (first, last) => format!("{first}-{last}"),
            });
        }
    }
    let unlisted = gaps.len().saturating_sub(MOST_LISTED_GAPS);
    gaps.truncate(MOST_LISTED_GAPS);
    let more = if unlisted > 0 { format!(" and {unlisted} more gaps") } else { String::new() };
    let frames = if total == 1 { "frame is" } else { "frames are" };
    (total > 0).then(|| format!("{total} {frames} missing from the sequence: {}{more}", gaps.join(", ")))
}
