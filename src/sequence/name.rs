//! A file name as text with numbers in it.

use std::ops::Range;
use std::path::Path;

use super::time::Time;

/// Words before a number that is no frame number.
const VERSION_WORDS: [&str; 5] = ["v", "ver", "version", "rev", "lod"];
/// Texts between the numbers of a resolution.
const RESOLUTION_SIGNS: [&str; 3] = ["x", "X", "×"];
/// A dash is a minus sign after one of these, or at the beginning of a name.
const BEFORE_MINUS_SIGN: [char; 4] = ['_', '.', ' ', '-'];

/// The name of a file.
pub(super) struct FileName {
    /// The whole name.
    pub file: String,
    /// The name without its extension.
    pub stem: String,
    /// The numbers of the stem, in order.
    pub runs: Vec<DigitRun>,
}

/// Digits with points between them: `0001`, `-3`, `0001.25`.
pub(super) struct DigitRun {
    /// Where its sign is, or its first digit.
    start: usize,
    /// The digits between the points. At least one range.
    pub parts: Vec<Range<usize>>,
}

/// A place for a number in names of one shape.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct NumberField {
    /// Which run of digits.
    pub run: usize,
    /// Which part of that run.
    pub part: usize,
    /// Whether the next part is its fraction, in the names that have one.
    pub has_fraction: bool,
}

/// What a number stands next to, from most to least like a frame number.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum NumberContext {
    /// No letter.
    Alone,
    /// A letter is before it: `take7`.
    AfterLetter,
    /// A letter is behind it: `24fps`.
    BeforeLetter,
    /// It is a version or a part of a resolution.
    Version,
}

impl FileName {
    /// Splits the name of a file into text and numbers.
    pub fn parse(path: &Path) -> Self {
        let file = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        // Digits behind the last point are a number, not an extension.
        let stem = match file.rsplit_once('.') {
            Some((stem, extension)) if !extension.bytes().all(|b| b.is_ascii_digit()) => stem.to_owned(),
            _ => file.clone(),
        };
        let runs = digit_runs(&stem);
        Self { file, stem, runs }
    }

    /// The texts before, between and behind the runs.
    pub fn texts(&self) -> impl Iterator<Item = &str> {
        let starts = [0].into_iter().chain(self.runs.iter().map(|run| run.parts[run.parts.len() - 1].end));
        let ends = self.runs.iter().map(|run| run.start).chain([self.stem.len()]);
        starts.zip(ends).map(|(start, end)| &self.stem[start..end])
    }

    /// The digits of one part of a run.
    pub fn part(&self, run: usize, part: usize) -> Option<&str> {
        self.runs[run].parts.get(part).map(|range| &self.stem[range.clone()])
    }

    /// The range of a field in the stem, with its sign and its fraction.
    fn span(&self, field: &NumberField) -> Range<usize> {
        let run = &self.runs[field.run];
        let start = if field.part == 0 { run.start } else { run.parts[field.part].start };
        let last = (field.part + usize::from(field.has_fraction)).min(run.parts.len() - 1);
        start..run.parts[last].end
    }

    /// A field as it is written, with its sign and its fraction.
    pub fn number_text(&self, field: &NumberField) -> &str {
        &self.stem[self.span(field)]
    }

    /// What is before and behind a field.
    pub fn text_around(&self, field: &NumberField) -> (&str, &str) {
        let span = self.span(field);
        (&self.stem[..span.start], &self.stem[span.end..])
    }

    /// The value of a field; `None` if it has too many digits.
    pub fn time(&self, field: &NumberField) -> Option<Time> {
        let run = &self.runs[field.run];
        let is_negative = field.part == 0 && run.start < run.parts[0].start;
        let fraction = field.has_fraction.then(|| self.part(field.run, field.part + 1)).flatten();
        Time::parse(is_negative, self.part(field.run, field.part)?, fraction.unwrap_or_default())
    }

    /// What a field stands next to.
    pub fn context(&self, field: &NumberField) -> NumberContext {
        let (before, behind) = self.text_around(field);
        let word = before.rsplit(|c: char| !c.is_alphabetic()).next().unwrap_or_default();
        let texts: Vec<&str> = self.texts().collect();
        let is_resolution_sign =
            |text: usize| (1..self.runs.len()).contains(&text) && RESOLUTION_SIGNS.contains(&texts[text]);
        let is_first = field.part == 0;
        let is_last = self.span(field).end == self.runs[field.run].parts.last().map_or(0, |part| part.end);
        if VERSION_WORDS.contains(&&*word.to_lowercase())
            || is_first && is_resolution_sign(field.run)
            || is_last && is_resolution_sign(field.run + 1)
        {
            NumberContext::Version
        } else if behind.starts_with(char::is_alphabetic) {
            NumberContext::BeforeLetter
        } else if !word.is_empty() {
            NumberContext::AfterLetter
        } else {
            NumberContext::Alone
        }
    }
}

fn digit_runs(stem: &str) -> Vec<DigitRun> {
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
        let is_signed =
            before_sign.is_some_and(|before| before.is_empty() || before.ends_with(BEFORE_MINUS_SIGN));
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
        runs.push(DigitRun { start, parts });
    }
    runs
}
