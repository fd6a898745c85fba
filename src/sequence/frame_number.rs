//! Which number in some file names is the frame number.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

use super::name::{FileName, NumberContext, NumberField};
use super::time::{FRAME, Time};

/// A fraction that divides a frame into more steps than this is a number of its own, unless the number before it is padded
/// and has more digits. Simulations take a few substeps per frame.
const MOST_SUBFRAMES: i128 = 64;
/// The fewest digits of a padded frame number behind another number and a point (`wedge3.0001`).
const PADDED_DIGITS: usize = 3;

/// Which number of some names is the frame number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Choice {
    /// This one.
    Frame(NumberField),
    /// A version or resolution, where nothing else differs.
    Version(NumberField),
    /// No number.
    None,
}

impl Choice {
    /// The chosen number.
    pub fn field(self) -> Option<NumberField> {
        match self {
            Self::Frame(field) | Self::Version(field) => Some(field),
            Self::None => None,
        }
    }
}

/// Groups names by their shape and chooses the frame number of each group. A group has the places of its names.
pub(super) fn choose_by_shape(names: &[FileName]) -> Vec<(Vec<usize>, Choice)> {
    let choose = |group: Vec<usize>| {
        let choice = choose(&of_group(names, &group));
        (group, choice)
    };
    groups(names).into_iter().map(choose).collect()
}

fn of_group<'a>(names: &'a [FileName], group: &[usize]) -> Vec<&'a FileName> {
    group.iter().map(|&i| &names[i]).collect()
}

/// The names of each shape: equal texts, and as many parts in each run but for fractions that whole frames lack.
fn groups(names: &[FileName]) -> Vec<Vec<usize>> {
    let mut by_texts: BTreeMap<Vec<&str>, Vec<usize>> = BTreeMap::new();
    for (i, name) in names.iter().enumerate() {
        by_texts.entry(name.texts().collect()).or_default().push(i);
    }
    let mut out = Vec::new();
    for group in by_texts.into_values() {
        let of_one = of_group(names, &group);
        let is_one_shape = (0..of_one[0].runs.len()).all(|run| {
            let (least, most) = part_counts(&of_one, run);
            least == most || least + 1 == most && is_fraction(&of_one, run, least - 1)
        });
        if is_one_shape {
            out.push(group);
            continue;
        }
        let mut by_counts: BTreeMap<Vec<usize>, Vec<usize>> = BTreeMap::new();
        for i in group {
            by_counts.entry(names[i].runs.iter().map(|run| run.parts.len()).collect()).or_default().push(i);
        }
        out.extend(by_counts.into_values());
    }
    out
}

/// The fewest and the most parts that a run has in names of one shape.
fn part_counts(names: &[&FileName], run: usize) -> (usize, usize) {
    let counts = names.iter().map(|name| name.runs[run].parts.len());
    (counts.clone().min().unwrap_or(0), counts.max().unwrap_or(0))
}

/// Whether the part behind part `part` of a run is that part's fraction in names of one shape.
fn is_fraction(names: &[&FileName], run: usize, part: usize) -> bool {
    let field = NumberField { run, part, has_fraction: true };
    let whole_field = NumberField { has_fraction: false, ..field };
    if names[0].context(&whole_field) == NumberContext::Version {
        return false;
    }
    let wholes: Vec<&str> = names.iter().filter_map(|name| name.part(run, part)).collect();
    let digits = wholes.iter().map(|whole| whole.len());
    let (fewest, most) = (digits.clone().min().unwrap_or(0), digits.max().unwrap_or(0));
    let fractions: Vec<&str> = names.iter().filter_map(|name| name.part(run, part + 1)).collect();
    let fraction_digits = fractions.iter().map(|fraction| fraction.len()).max().unwrap_or(0);
    let is_below_padded = wholes.iter().any(|whole| is_padded(whole)) && fraction_digits < fewest;
    if names.len() == 1 {
        return is_below_padded;
    }

    let mut times = Vec::new();
    for name in names {
        let Some(time) = name.time(&field) else { return false };
        times.push((time, name.part(run, part + 1)));
    }
    times.sort_unstable();
    let steps = times.windows(2).map(|w| w[1].0.0 - w[0].0.0).filter(|step| *step > 0);
    let least_step = steps.clone().min().unwrap_or(FRAME);
    if least_step * MOST_SUBFRAMES < FRAME && !is_below_padded {
        return false;
    }
    // Houdini leaves out the fraction of whole frames.
    if fractions.len() < names.len() {
        return true;
    }
    // 3.1 and 3.10 are one time: if both occur, the digits are numbers of their own.
    let spellings: BTreeSet<_> =
        names.iter().map(|name| (name.text_around(&field), name.number_text(&field))).collect();
    let distinct: BTreeSet<_> =
        names.iter().map(|name| (name.text_around(&field), name.time(&field))).collect();
    if spellings.len() > distinct.len() || fractions.iter().all(|fraction| *fraction == fractions[0]) {
        return false;
    }
    if wholes.iter().all(|whole| *whole == wholes[0]) {
        // Fractions of one frame (`1.25`, `1.5`, `1.75`), or a number before the frame number (`3.8`, `3.9`, `3.10`).
        let divides = |step: i128| step == least_step && times[0].0.0 % step == 0;
        let mut counted: Vec<i32> = fractions.iter().filter_map(|digits| digits.parse().ok()).collect();
        counted.sort_unstable();
        let counts_up = counted.windows(2).all(|w| w[1] - w[0] <= 1);
        return is_padded(wholes[0]) && fraction_digits <= fewest || steps.clone().all(divides) && !counts_up;
    }
    let is_frame_number = fraction_digits >= PADDED_DIGITS.max(most + 1)
        && fractions.iter().all(|fraction| fraction.len() == fraction_digits)
        && times.windows(2).all(|w| w[0].1 < w[1].1);
    !is_frame_number
}

fn is_padded(digits: &str) -> bool {
    digits.len() > 1 && digits.starts_with('0')
}

/// The numbers in names of one shape.
fn fields(names: &[&FileName]) -> Vec<NumberField> {
    let mut fields = Vec::new();
    for run in 0..names[0].runs.len() {
        let (least, most) = part_counts(names, run);
        let mut part = 0;
        while part < least {
            let has_fraction = part + 1 < most && is_fraction(names, run, part);
            fields.push(NumberField { run, part, has_fraction });
            part += 1 + usize::from(has_fraction);
        }
    }
    fields
}

/// Chooses the frame number in names of one shape. Of the numbers that vary it is the one with the most values; ties go to
/// the smallest range, then to the first [`NumberContext`], then to the last number. If none varies, it is the last padded
/// number, or else the last one.
fn choose(names: &[&FileName]) -> Choice {
    let mut candidates = Vec::new();
    for field in fields(names) {
        let times: Option<BTreeSet<Time>> = names.iter().map(|name| name.time(&field)).collect();
        candidates.extend(times.map(|times| (field, names[0].context(&field), times)));
    }
    let varying = |is_version: bool| {
        let varying = candidates.iter().filter(|(_, context, times)| {
            (*context == NumberContext::Version) == is_version && times.len() > 1
        });
        let best = varying.min_by_key(|(field, context, times)| {
            let span = times.last().zip(times.first()).map(|(last, first)| (last.0 - first.0) / FRAME);
            (Reverse(times.len()), span, *context, Reverse(*field))
        });
        best.map(|(field, ..)| *field)
    };
    let constant = |wanted: NumberContext| {
        let mut fields =
            candidates.iter().filter(|(_, context, _)| *context == wanted).map(|(field, ..)| *field);
        let padded =
            fields.clone().rfind(|field| names[0].part(field.run, field.part).is_some_and(is_padded));
        padded.or(fields.next_back())
    };
    let frame = varying(false).or_else(|| constant(NumberContext::Alone)).map(Choice::Frame);
    let version = || varying(true).map(Choice::Version);
    let letter = || constant(NumberContext::AfterLetter).map(Choice::Frame);
    frame.or_else(version).or_else(letter).unwrap_or(Choice::None)
}
