//! Sorts files into sequences and finds each file's frame number, by their names alone.
//!
//! - `name.rs` splits a file name into text and numbers.
//! - `frame_number.rs` chooses which of the numbers is the frame number, over all names together: one that varies, and not
//!   a version (`_v2`) or a resolution (`_128x128`).
//! - `time.rs` computes with frame numbers and finds gaps.
//!
//! A minus sign belongs to a number behind `_`, `.`, a space, `-` or nothing: `smoke_-0003` is frame -3, `smoke-0003` is
//! frame 3. Digits behind a point are a part of the frame (Houdini's `$FF`) if the names read as times that way.

mod frame_number;
mod name;
#[cfg(test)]
mod tests;
mod time;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use crate::error::{Error, Result};
use frame_number::{Choice, choose_by_shape};
use name::FileName;
use time::{Time, in_shared_unit, missing_frames};

/// The frame numbers of a sequence's files.
#[derive(Debug)]
pub struct Numbering {
    /// A number for each file, in the order of the files. Sub-frames count in the smallest decimal unit that all of them
    /// share: 1.5 and 1.75 are 150 and 175. Decimals that an `i32` has no room for are rounded.
    pub numbers: Vec<i32>,
    /// Oddities of the names: missing frames, files of another sequence, names without a number.
    pub warnings: Vec<String>,
}

/// Numbers the files of one sequence. Files without a frame number are numbered in the given order; one alone is frame 0.
///
/// # Errors
/// Two files of one frame.
pub fn number(paths: &[PathBuf]) -> Result<Numbering> {
    let names: Vec<FileName> = paths.iter().map(|path| FileName::parse(path)).collect();
    let mut warnings = Vec::new();
    let mut fields = vec![None; names.len()];
    for (group, choice) in choose_by_shape(&names) {
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
    let other_text = |i: usize| fields[i].as_ref().map(|field| names[i].text_around(field));
    if let Some(other) = (1..names.len()).find(|&i| other_text(i) != other_text(0)) {
        warnings.push(format!(
            "the names of {} and {} differ in more than the frame number: check that they are one sequence",
            names[0].file, names[other].file
        ));
    }
    let sorted: Vec<Time> = order.iter().map(|&i| times[i]).collect();
    warnings.extend(missing_frames(&sorted));
    let numbers = match in_shared_unit(&times) {
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

fn in_order(places: impl IntoIterator<Item = usize>) -> Result<Vec<i32>> {
    let number = |place| i32::try_from(place).map_err(|_| Error::Usage("too many frames".to_owned()));
    places.into_iter().map(number).collect()
}

/// Files of one folder whose names differ in the frame number alone.
#[derive(Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Sequence {
    /// The folder.
    pub folder: PathBuf,
    /// The text of their names before the frame number.
    pub before: String,
    /// The text behind it, with the extension.
    pub after: String,
    /// The files in the order of their frames; at least one.
    pub files: Vec<PathBuf>,
    /// Globs for the frame number: one for each number of digits, and for each sign or point among them. They have a class
    /// for each digit and no `*`, which would match `smoke_low_0001.vdb` together with `smoke_0001.vdb`.
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
    let names: Vec<FileName> = paths.iter().map(|path| FileName::parse(path)).collect();
    // A file's time, its place in `paths`, and its frame number as it is written.
    type File<'a> = (Option<Time>, usize, &'a str);
    let mut sequences: BTreeMap<(&str, String), Vec<File>> = BTreeMap::new();
    for (group, choice) in choose_by_shape(&names) {
        let field = match choice {
            Choice::Frame(field) => Some(field),
            // Several versions of one volume are not a sequence.
            Choice::Version(_) | Choice::None => None,
        };
        for i in group {
            let name = &names[i];
            let ((before, after), number, time) = match &field {
                Some(field) => (name.text_around(field), name.number_text(field), name.time(field)),
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
