//! Which files are one sequence and which frame each of them is, as their names say.
//!
//! A name is text with runs of digits in it. Which run is the frame's number is decided over all names together: it is one
//! that varies, and not a version (`_v2`) or a resolution (`_128x128`). A minus sign belongs to a number behind `_`, `.`,
//! a space, `-` or nothing: `smoke_-0003` is frame -3, `smoke-0003` is frame 3. Digits behind a point are a part of the
//! frame (Houdini's `$FF`) if the names read as times that way.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::ops::Range;
use std::path::{Path, PathBuf};

use crate::error::{Error, Result};

/// Words before a number that is not a frame's.
const VERSION_WORDS: [&str; 5] = ["v", "ver", "version", "rev", "lod"];
/// What stands between the numbers of a resolution.
const BY: [&str; 3] = ["x", "X", "×"];
/// Behind one of these, or at the beginning of a name, a dash is a minus sign.
const BEFORE_SIGN: [char; 4] = ['_', '.', ' ', '-'];
/// Digits behind a point that would cut frames into more parts than this are numbers of their own, unless the number before
/// them is padded and has more digits. Simulations take a few substeps.
const MOST_SUBFRAMES: i128 = 64;
/// As many digits at least has a padded frame number that stands behind another number and a point (`wedge3.0001`).
const PADDED_DIGITS: usize = 3;
/// Missing frames listed in one warning; more are only counted.
const LISTED: usize = 10;

/// The frame numbers of a sequence's files.
#[derive(Debug)]
pub struct Numbering {
    /// A number for each file, in the order of the files. Sub-frames count in the smallest decimal unit that all of them
    /// share: 1.5 and 1.75 are 150 and 175. Decimals that an `i32` has no room for are rounded.
    pub numbers: Vec<i32>,
    /// What is odd about the names: missing frames, files of another sequence, names without a number.
    pub warnings: Vec<String>,
}

/// Numbers the files of one sequence. Files without a frame number are numbered in the given order; one alone is frame 0.
///
/// # Errors
/// Two files of one frame.
pub fn number(paths: &[PathBuf]) -> Result<Numbering> {
    let names: Vec<Name> = paths.iter().map(|path| Name::of(path)).collect();
    let mut warnings = Vec::new();
    let mut fields = vec![None; names.len()];
    for group in groups(&names) {
        let choice = choose(&of_group(&names, &group));
        if let Choice::Version(_) = choice {
            warnings.push(format!(
                "the names from {} to {} differ in a version or resolution alone: it is taken as the frame number",
                names[group[0]].file,
                names[group[group.len() - 1]].file
            ));
        }
        group.iter().for_each(|&i| fields[i] = choice.field());
    }
    let found = names.iter().zip(&fields).map(|(name, field)| name.time(field.as_ref()?));
    let Some(times) = found.collect::<Option<Vec<Time>>>() else {
        let unnumbered = fields.iter().position(Option::is_none).unwrap_or_default();
        let warning = (names.len() > 1).then(|| {
            format!(
                "{} has no frame number in its name: the files are numbered in the order given",
                names[unnumbered].file
            )
        });
        return Ok(Numbering { numbers: in_order(0..names.len())?, warnings: warning.into_iter().collect() });
    };

    let mut order: Vec<usize> = (0..names.len()).collect();
    order.sort_by_key(|&i| times[i]);
    if let Some(pair) = order.windows(2).find(|w| times[w[0]] == times[w[1]]) {
        let [a, b] = [pair[0], pair[1]].map(|i| paths[i].display());
        return Err(Error::Input(format!(
            "{a} and {b} are both frame {}: give one file for each frame",
            times[pair[0]]
        )));
    }
    let rest = |i: usize| fields[i].as_ref().map(|field| names[i].rest(field));
    if let Some(other) = (1..names.len()).find(|&i| rest(i) != rest(0)) {
        warnings.push(format!(
            "the names of {} and {} differ in more than the frame number: check that they are one sequence",
            names[0].file, names[other].file
        ));
    }
    let sorted: Vec<Time> = order.iter().map(|&i| times[i]).collect();
    warnings.extend(missing(&sorted));
    let numbers = match in_units(&times) {
        Some(numbers) => numbers,
        None => {
            warnings.push(format!(
                "the sub-frames of {} have too many decimals for a frame number: the files are numbered in order, from 0",
                names[order[0]].file
            ));
            let mut place = vec![0; order.len()];
            order.iter().enumerate().for_each(|(at, &i)| place[i] = at);
            in_order(place)?
        }
    };
    Ok(Numbering { numbers, warnings })
}

/// Different times as numbers of the smallest decimal unit that they share, rounded to as many decimals as an `i32` has
/// room for; `None` if that makes two of them equal.
fn in_units(times: &[Time]) -> Option<Vec<i32>> {
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

fn in_order(places: impl IntoIterator<Item = usize>) -> Result<Vec<i32>> {
    let number = |place| i32::try_from(place).map_err(|_| Error::Usage("too many frames".to_owned()));
    places.into_iter().map(number).collect()
}

/// Files of one folder whose names differ in the frame number alone.
#[derive(Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Sequence {
    /// Their folder.
    pub folder: PathBuf,
    /// What their names have before the frame number.
    pub before: String,
    /// And behind it, with the extension.
    pub after: String,
    /// The files, by frame; at least one.
    pub files: Vec<PathBuf>,
    /// What stands for the frame number in globs: a class for each digit, and no `*`, which would take in the files of
    /// `smoke_low_0001.vdb` with those of `smoke_0001.vdb`. Numbers of different lengths have one each.
    pub number_globs: Vec<String>,
}

/// Sorts files into sequences.
pub fn sequences(paths: &[PathBuf]) -> Vec<Sequence> {
    let mut folders: BTreeMap<&Path, Vec<&PathBuf>> = BTreeMap::new();
    for path in paths {
        folders.entry(path.parent().unwrap_or(Path::new(""))).or_default().push(path);
    }
    folders.into_iter().flat_map(|(folder, paths)| in_folder(folder, &paths)).collect()
}

/// The sequences of one folder's files.
fn in_folder(folder: &Path, paths: &[&PathBuf]) -> Vec<Sequence> {
    let names: Vec<Name> = paths.iter().map(|path| Name::of(path)).collect();
    // A file, by its time and its place among all, and its frame number.
    type File<'a> = (Option<Time>, usize, &'a str);
    let mut sequences: BTreeMap<(&str, String), Vec<File>> = BTreeMap::new();
    for group in groups(&names) {
        let field = match choose(&of_group(&names, &group)) {
            Choice::Frame(field) => Some(field),
            // Versions of a volume are no sequence.
            Choice::Version(_) | Choice::None => None,
        };
        for i in group {
            let name = &names[i];
            let ((before, after), number, time) = match &field {
                Some(field) => (name.rest(field), &name.stem[name.span(field)], name.time(field)),
                None => ((&*name.stem, ""), "", None),
            };
            let after = format!("{after}{}", &name.file[name.stem.len()..]);
            sequences.entry((before, after)).or_default().push((time, i, number));
        }
    }
    let sequence = |((before, after), mut files): ((&str, String), Vec<File>)| {
        files.sort_unstable();
        let globs: BTreeSet<(usize, String)> =
            files.iter().map(|(.., number)| (number.len(), glob_of(number))).collect();
        Sequence {
            folder: folder.to_owned(),
            before: before.to_owned(),
            after,
            files: files.iter().map(|(_, i, _)| paths[*i].clone()).collect(),
            number_globs: globs.into_iter().map(|(_, glob)| glob).collect(),
        }
    };
    sequences.into_iter().map(sequence).collect()
}

fn glob_of(number: &str) -> String {
    number.chars().map(|c| if c.is_ascii_digit() { "[0-9]".to_owned() } else { c.to_string() }).collect()
}

/// A time in 10⁻¹⁸ frames, so that every decimal that fits into a name is exact.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
struct Time(i128);

const DECIMALS: usize = 18;
const FRAME: i128 = 10i128.pow(DECIMALS as u32);

impl Time {
    /// `None` for more digits than fit, or more frames than an `i32` counts.
    fn parse(is_negative: bool, whole: &str, fraction: &str) -> Option<Self> {
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

/// Says which frames are missing between sorted times. The parts that any frame has are expected of every frame.
fn missing(times: &[Time]) -> Option<String> {
    let parts: BTreeSet<i128> = times.iter().map(|time| time.0.rem_euclid(FRAME)).collect();
    let parts: Vec<i128> = parts.into_iter().collect();
    let steps = times.windows(2).map(|w| w[1].0 - w[0].0);
    let (least, most) = (steps.clone().min()?, steps.max()?);
    // Every one and a half frames, for instance; of rounded decimals too.
    if parts.len() > 1 && most < 2 * least {
        return None;
    }
    let count = parts.len() as i128;
    let index = |time: &Time| {
        let part = parts.binary_search(&time.0.rem_euclid(FRAME)).expect("every time has one of the parts");
        time.0.div_euclid(FRAME) * count + part as i128
    };
    let time = |index: i128| Time(index.div_euclid(count) * FRAME + parts[index.rem_euclid(count) as usize]);
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
    let rest = gaps.len().saturating_sub(LISTED);
    gaps.truncate(LISTED);
    let more = if rest > 0 { format!(" and {rest} more gaps") } else { String::new() };
    let frames = if total == 1 { "frame is" } else { "frames are" };
    (total > 0).then(|| format!("{total} {frames} missing from the sequence: {}{more}", gaps.join(", ")))
}

/// A file's name.
struct Name {
    file: String,
    /// The name without its extension.
    stem: String,
    runs: Vec<Run>,
}

/// Digits with points between them: `0001`, `-3`, `0001.25`.
struct Run {
    /// Where its sign is, or its first digit.
    start: usize,
    /// The digits between the points. At least one range.
    parts: Vec<Range<usize>>,
}

/// A number in names of one shape.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct DecodedFrame {
    run: usize,
    part: usize,
    /// Whether the next part is its fraction, in the names that have one.
    has_fraction: bool,
}

/// How much a number looks like a frame's, most first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Look {
    /// It stands alone.
    Plain,
    /// A letter is before it: `take7`.
    BehindLetter,
    /// A letter is behind it: `24fps`.
    BeforeLetter,
    /// A version or a part of a resolution.
    Version,
}

/// Which number of some names is the frame's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Choice {
    Frame(DecodedFrame),
    /// A version or resolution, where nothing else differs.
    Version(DecodedFrame),
    None,
}

impl Choice {
    fn field(self) -> Option<DecodedFrame> {
        match self {
            Self::Frame(field) | Self::Version(field) => Some(field),
            Self::None => None,
        }
    }
}

impl Name {
    fn of(path: &Path) -> Self {
        let file = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        // What is all digits behind the last point is a number and no extension.
        let stem = match file.rsplit_once('.') {
            Some((stem, extension)) if !extension.bytes().all(|b| b.is_ascii_digit()) => stem.to_owned(),
            _ => file.clone(),
        };
        let runs = runs(&stem);
        Self { file, stem, runs }
    }

    /// The texts before, between and behind the runs.
    fn texts(&self) -> impl Iterator<Item = &str> {
        let starts = [0].into_iter().chain(self.runs.iter().map(|run| run.parts[run.parts.len() - 1].end));
        let ends = self.runs.iter().map(|run| run.start).chain([self.stem.len()]);
        starts.zip(ends).map(|(start, end)| &self.stem[start..end])
    }

    fn part(&self, run: usize, part: usize) -> Option<&str> {
        self.runs[run].parts.get(part).map(|range| &self.stem[range.clone()])
    }

    /// Where a field lies, with its sign and its fraction.
    fn span(&self, field: &DecodedFrame) -> Range<usize> {
        let run = &self.runs[field.run];
        let start = if field.part == 0 { run.start } else { run.parts[field.part].start };
        let last = (field.part + usize::from(field.has_fraction)).min(run.parts.len() - 1);
        start..run.parts[last].end
    }

    /// What is before and behind a field.
    fn rest(&self, field: &DecodedFrame) -> (&str, &str) {
        let span = self.span(field);
        (&self.stem[..span.start], &self.stem[span.end..])
    }

    fn time(&self, field: &DecodedFrame) -> Option<Time> {
        let run = &self.runs[field.run];
        let is_negative = field.part == 0 && run.start < run.parts[0].start;
        let fraction = field.has_fraction.then(|| self.part(field.run, field.part + 1)).flatten();
        Time::parse(is_negative, self.part(field.run, field.part)?, fraction.unwrap_or_default())
    }

    fn look(&self, field: &DecodedFrame) -> Look {
        let span = self.span(field);
        let (before, behind) = (&self.stem[..span.start], &self.stem[span.end..]);
        let word = before.rsplit(|c: char| !c.is_alphabetic()).next().unwrap_or_default();
        let texts: Vec<&str> = self.texts().collect();
        let is_by = |text: usize| (1..self.runs.len()).contains(&text) && BY.contains(&texts[text]);
        let is_first = field.part == 0;
        let is_last = span.end == self.runs[field.run].parts.last().map_or(0, |part| part.end);
        if VERSION_WORDS.contains(&&*word.to_lowercase())
            || is_first && is_by(field.run)
            || is_last && is_by(field.run + 1)
        {
            Look::Version
        } else if behind.starts_with(char::is_alphabetic) {
            Look::BeforeLetter
        } else if !word.is_empty() {
            Look::BehindLetter
        } else {
            Look::Plain
        }
    }
}

fn runs(stem: &str) -> Vec<Run> {
    let bytes = stem.as_bytes();
    let is_digit = |at: usize| bytes.get(at).is_some_and(u8::is_ascii_digit);
    let mut runs = Vec::new();
    let mut at = 0;
    while at < bytes.len() {
        if !is_digit(at) {
            at += 1;
            continue;
        }
        let before_sign = at.checked_sub(1).filter(|&sign| bytes[sign] == b'-').map(|sign| &stem[..sign]);
        let is_signed = before_sign.is_some_and(|before| before.is_empty() || before.ends_with(BEFORE_SIGN));
        let start = at - usize::from(is_signed);
        let mut parts = Vec::new();
        loop {
            let first = at;
            while is_digit(at) {
                at += 1;
            }
            parts.push(first..at);
            if bytes.get(at) != Some(&b'.') || !is_digit(at + 1) {
                break;
            }
            at += 1;
        }
        runs.push(Run { start, parts });
    }
    runs
}

fn of_group<'a>(names: &'a [Name], group: &[usize]) -> Vec<&'a Name> {
    group.iter().map(|&i| &names[i]).collect()
}

/// The names of each shape: equal texts, and as many parts in each run but for fractions that whole frames lack.
fn groups(names: &[Name]) -> Vec<Vec<usize>> {
    let mut groups: BTreeMap<Vec<&str>, Vec<usize>> = BTreeMap::new();
    for (i, name) in names.iter().enumerate() {
        groups.entry(name.texts().collect()).or_default().push(i);
    }
    let mut out = Vec::new();
    for group in groups.into_values() {
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

fn part_counts(names: &[&Name], run: usize) -> (usize, usize) {
    let counts = names.iter().map(|name| name.runs[run].parts.len());
    (counts.clone().min().unwrap_or(0), counts.max().unwrap_or(0))
}

/// Whether the part behind part `part` of a run is that part's fraction in names of one shape.
fn is_fraction(names: &[&Name], run: usize, part: usize) -> bool {
    let time = DecodedFrame { run, part, has_fraction: true };
    let whole = DecodedFrame { has_fraction: false, ..time };
    if names[0].look(&whole) == Look::Version {
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
        let Some(time) = name.time(&time) else { return false };
        times.push((time, name.part(run, part + 1)));
    }
    times.sort_unstable();
    let steps = times.windows(2).map(|w| w[1].0.0 - w[0].0.0).filter(|step| *step > 0);
    let least_step = steps.clone().min().unwrap_or(FRAME);
    if least_step * MOST_SUBFRAMES < FRAME && !is_below_padded {
        return false;
    }
    // Whole frames have none, as Houdini writes them.
    if fractions.len() < names.len() {
        return true;
    }
    // 3.1 and 3.10 are one time: if both are there, they are numbers of their own.
    let spelt: BTreeSet<_> =
        names.iter().map(|name| (name.rest(&time), &name.stem[name.span(&time)])).collect();
    let told_apart: BTreeSet<_> = names.iter().map(|name| (name.rest(&time), name.time(&time))).collect();
    if spelt.len() > told_apart.len() || fractions.iter().all(|fraction| *fraction == fractions[0]) {
        return false;
    }
    if wholes.iter().all(|whole| *whole == wholes[0]) {
        // Parts of one frame, or a number before the frame's: `1.25`, `1.5`, `1.75`, but `3.8`, `3.9`, `3.10`.
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
fn fields(names: &[&Name]) -> Vec<DecodedFrame> {
    let mut fields = Vec::new();
    for run in 0..names[0].runs.len() {
        let (least, most) = part_counts(names, run);
        let mut part = 0;
        while part < least {
            let has_fraction = part + 1 < most && is_fraction(names, run, part);
            fields.push(DecodedFrame { run, part, has_fraction });
            part += 1 + usize::from(has_fraction);
        }
    }
    fields
}

/// Chooses the frame number in names of one shape: of those that vary the one with the most values, of equals the one with
/// the fewest gaps, then the one that looks most like it, then the last. Where none varies, the last that is padded, or
/// the last of all.
fn choose(names: &[&Name]) -> Choice {
    let mut candidates = Vec::new();
    for field in fields(names) {
        let times: Option<BTreeSet<Time>> = names.iter().map(|name| name.time(&field)).collect();
        candidates.extend(times.map(|times| (field, names[0].look(&field), times)));
    }
    let varying = |is_version: bool| {
        let varying = candidates
            .iter()
            .filter(|(_, look, times)| (*look == Look::Version) == is_version && times.len() > 1);
        let best = varying.min_by_key(|(field, look, times)| {
            let span = times.last().zip(times.first()).map(|(last, first)| (last.0 - first.0) / FRAME);
            (Reverse(times.len()), span, *look, Reverse(*field))
        });
        best.map(|(field, ..)| *field)
    };
    let constant = |wanted: Look| {
        let mut looks = candidates.iter().filter(|(_, look, _)| *look == wanted).map(|(field, ..)| *field);
        let padded = looks.clone().rfind(|field| names[0].part(field.run, field.part).is_some_and(is_padded));
        padded.or(looks.next_back())
    };
    let frame = varying(false).or_else(|| constant(Look::Plain)).map(Choice::Frame);
    let version = || varying(true).map(Choice::Version);
    let letter = || constant(Look::BehindLetter).map(Choice::Frame);
    frame.or_else(version).or_else(letter).unwrap_or(Choice::None)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn paths(names: &[&str]) -> Vec<PathBuf> {
        names.iter().map(|name| PathBuf::from(format!("{name}.vdb"))).collect()
    }

    /// The numbers of some files, and what is odd about them.
    fn numbers(names: &[&str]) -> (Vec<i32>, Vec<String>) {
        let Numbering { numbers, warnings } = number(&paths(names)).unwrap();
        (numbers, warnings)
    }

    /// The numbers of files that nothing is odd about.
    fn plain(names: &[&str]) -> Vec<i32> {
        let (numbers, warnings) = numbers(names);
        assert_eq!(warnings, [""; 0], "{names:?}");
        numbers
    }

    #[test]
    fn the_number_that_varies_is_the_frame() {
        assert_eq!(plain(&["smoke_0001_v2", "smoke_0002_v2", "smoke_0003_v2"]), [1, 2, 3]);
        assert_eq!(plain(&["smoke_8_128x128", "smoke_9_128x128", "smoke_10_128x128"]), [8, 9, 10]);
        assert_eq!(plain(&["fire2_v03.0100", "fire2_v03.0101"]), [100, 101]);
        assert_eq!(plain(&["wedge.3.0001", "wedge.3.0002"]), [1, 2]);
        assert_eq!(plain(&["wedge.3.8", "wedge.3.9", "wedge.3.10"]), [8, 9, 10]);
        assert_eq!(plain(&["take9", "take10"]), [9, 10]);
        assert_eq!(plain(&["0002", "0001"]), [2, 1]);
        // The other number has gaps, or fewer values.
        let other = |names| numbers(names).0;
        assert_eq!(other(&["smoke_0001_812", "smoke_0002_977", "smoke_0003_990"]), [1, 2, 3]);
        assert_eq!(other(&["shot1_0001", "shot1_0002", "shot2_0003"]), [1, 2, 3]);
        assert_eq!(other(&["smoke_0001_v1", "smoke_0002_v2", "smoke_0003_v3"]), [1, 2, 3]);
    }

    #[test]
    fn a_dash_behind_a_separator_is_a_minus_sign() {
        assert_eq!(plain(&["smoke_-0001", "smoke_0000", "smoke_0001"]), [-1, 0, 1]);
        assert_eq!(plain(&["smoke-0003", "smoke-0004"]), [3, 4]);
        assert_eq!(plain(&["smoke--001", "smoke-0000"]), [-1, 0]);
        assert_eq!(plain(&["smoke.-2", "smoke.-1"]), [-2, -1]);
        assert_eq!(plain(&["smoke_-0001.5", "smoke_-0001.0", "smoke_-0000.5"]), [-15, -10, -5]);
        let (_, warnings) = numbers(&["smoke_-0005", "smoke_-0001"]);
        assert_eq!(warnings, ["3 frames are missing from the sequence: -4 to -2"]);
    }

    #[test]
    fn sub_frames_count_in_the_unit_that_they_share() {
        let quarters = ["smoke.0001.25", "smoke.0001.50", "smoke.0001.75", "smoke.0002.00"];
        assert_eq!(plain(&quarters), [125, 150, 175, 200]);
        assert_eq!(plain(&quarters[..3]), [125, 150, 175]);
        assert_eq!(plain(&["a.1.25", "a.1.5", "a.1.75"]), [125, 150, 175]);
        assert_eq!(plain(&["a.0001.0", "a.0001.5", "a.0002.0", "a.0002.5"]), [10, 15, 20, 25]);
        // Houdini's $FF leaves out what is zero.
        assert_eq!(plain(&["a.1", "a.1.5", "a.2", "a.2.5"]), [10, 15, 20, 25]);
        assert_eq!(plain(&["a.9.75_v2", "a.10_v2", "a.10.25_v2"]), [975, 1000, 1025]);
        assert_eq!(
            plain(&["a_1.33333", "a_1.66667", "a_2", "a_2.33333"]),
            [133_333, 166_667, 200_000, 233_333]
        );
        assert_eq!(plain(&["a.1.0417", "a.1.0833", "a.2.0000", "a.2.0417", "a.2.0833"])[2], 20_000);
        assert_eq!(plain(&["a.0001.25"]), [125]);
        // The numbers of parts, as they count up in each frame.
        assert_eq!(
            plain(&["a.0001.0", "a.0001.1", "a.0001.2", "a.0002.0", "a.0002.1"]),
            [10, 11, 12, 20, 21]
        );
        // Numbers behind a point that are no fractions.
        assert_eq!(numbers(&["smoke1.0001", "smoke2.0002"]).0, [1, 2]);
        assert_eq!(plain(&["shot.010.0100", "shot.010.0101"]), [100, 101]);

        let (_, warnings) = numbers(&["a.1", "a.1.5", "a.2.5", "a.3"]);
        assert_eq!(warnings, ["1 frame is missing from the sequence: 2"]);
        assert_eq!(
            plain(&["a_2000.1234567890", "a_2000.6", "a_2001.1"]),
            [2_000_123_457, 2_000_600_000, 2_001_100_000]
        );
        let (fine, warnings) = numbers(&["a_2000000000.3", "a_2000000000.2", "a_2000000001.1"]);
        assert!(
            fine == [1, 0, 2] && warnings[warnings.len() - 1].contains("too many decimals"),
            "{warnings:?}"
        );
    }

    #[test]
    fn one_file_has_the_number_that_looks_most_like_a_frame() {
        let one = |name| plain(&[name])[0];
        assert_eq!(one("plume_0012"), 12);
        assert_eq!(one("fire2_v03.0100"), 100);
        assert_eq!(one("take7_smoke"), 7);
        assert_eq!(one("smoke_0001_v2"), 1);
        assert_eq!(one("smoke_0001_128x128"), 1);
        assert_eq!(one("smoke_0007_512"), 7);
        assert_eq!(one("20240105_smoke_0003"), 3);
        for none in ["smoke", "smoke_v2", "smoke_128x128x128", "cloud_lod0", "smoke_2k", "99999999999"] {
            assert_eq!(one(none), 0, "{none}");
        }
        assert_eq!(number(&["smoke.0004".into()]).unwrap().numbers, [4]);
    }

    #[test]
    fn oddities_name_the_files() {
        let odd = |names| numbers(names).1.join("\n");
        let stems = odd(&["a_0001", "b_0002"]);
        assert!(stems.contains("a_0001.vdb and b_0002.vdb differ in more than the frame number"), "{stems}");
        assert!(odd(&["smoke_0001_v1", "smoke_0002_v2"]).contains("smoke_0001_v1.vdb and smoke_0002_v2.vdb"));
        let (versions, warnings) = numbers(&["smoke_v1", "smoke_v2"]);
        assert!(versions == [1, 2] && warnings[0].contains("a version"), "{warnings:?}");
        let (in_order, warnings) = numbers(&["noise", "smoke_0001"]);
        assert!(
            in_order == [0, 1] && warnings[0].starts_with("noise.vdb has no frame number"),
            "{warnings:?}"
        );

        let twice = |names: &[&str]| number(&paths(names)).unwrap_err().to_string();
        for names in [["a_1", "a_0001"], ["a_0001_v1", "a_0001_v2"], ["a.1.5", "a.1.50"], ["a_1", "b_1"]] {
            let names = [&names[..], &["a.2"][..usize::from(names[0] == "a.1.5")]].concat();
            let error = twice(&names);
            assert!(names[..2].iter().all(|name| error.contains(&format!("{name}.vdb"))), "{error}");
        }
    }

    #[test]
    fn gaps_are_named() {
        let gaps = |names| numbers(names).1.join("\n");
        assert_eq!(gaps(&["a1", "a3"]), "1 frame is missing from the sequence: 2");
        assert_eq!(gaps(&["a1", "a3", "a7"]), "4 frames are missing from the sequence: 2, 4-6");
        // As fast as it would be without them.
        assert!(gaps(&["a_0.5", "a_1", "a_2000000000.5"]).starts_with("3999999998 frames are missing"));
    }

    proptest::proptest! {
        #[test]
        fn any_names_are_sorted_and_numbered(
            names in proptest::collection::btree_set("[ab_.xv -]{0,2}[0-9]{0,3}[._-]{0,2}[0-9]{0,9}[._-]{0,2}[0-9]{0,30}v?[0-9]?", 1..9)
        ) {
            let files = paths(&names.iter().map(String::as_str).collect::<Vec<_>>());
            if let Ok(Numbering { numbers, .. }) = number(&files) {
                assert_eq!(numbers.iter().collect::<BTreeSet<_>>().len(), files.len());
            }
            let found = sequences(&files);
            assert_eq!(found.iter().flat_map(|s| &s.files).collect::<BTreeSet<_>>(), files.iter().collect());
            for sequence in found.iter().filter(|s| s.files.len() > 1) {
                // What is one sequence has numbers in its order, unless two files are one frame.
                match number(&sequence.files) {
                    Ok(Numbering { numbers, .. }) => assert!(numbers.is_sorted(), "{:?}: {numbers:?}", sequence.files),
                    Err(error) => assert!(error.to_string().contains("both frame"), "{error}"),
                }
            }
        }
    }

    #[test]
    fn a_folder_is_sorted_into_sequences() {
        let names = [
            "b/smoke_0001_v1",
            "b/smoke_0002_v1",
            "b/smoke_0001_v2",
            "b/smoke_0002_v2",
            "a/smoke_-1",
            "a/smoke_0",
            "a/smoke_10",
            "a/smoke_low_10",
            "a/cloud_v1",
            "a/cloud_v2",
            "a/sub.0001.50",
            "a/sub.0002.00",
        ];
        let found = sequences(&paths(&names));
        let shown: Vec<_> = found
            .iter()
            .map(|s| (s.before.as_str(), s.after.as_str(), s.files.len(), s.number_globs.join(" ")))
            .collect();
        let digit = "[0-9]";
        let expected = [
            ("cloud_v1", ".vdb", 1, String::new()),
            ("cloud_v2", ".vdb", 1, String::new()),
            ("smoke_", ".vdb", 3, format!("{digit} -{digit} {digit}{digit}")),
            ("smoke_low_", ".vdb", 1, digit.repeat(2)),
            ("sub.", ".vdb", 2, format!("{}.{}", digit.repeat(4), digit.repeat(2))),
            ("smoke_", "_v1.vdb", 2, digit.repeat(4)),
            ("smoke_", "_v2.vdb", 2, digit.repeat(4)),
        ];
        assert_eq!(shown, expected);
        assert_eq!(found[2].files[0], Path::new("a/smoke_-1.vdb"));
    }
}
