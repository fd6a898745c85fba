//! `volpack init`.

use std::fmt::Write as _;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use clap::Args;
use rayon::prelude::*;

use super::style::{TITLE, WARNING};
use super::{Common, exit_code, outln};
use crate::error::{Error, Result};
use crate::file_name::{check_name, portable};
use crate::manifest::DEFAULT_NAME;
use crate::sequence::{Numbering, Sequence, number, sequences};
use crate::settings::Integers;
use crate::stages::flatten::nonfinite_background;
use crate::stages::select::{FrameGrids, listing, select_from};
use crate::units::count;
use crate::vdb::{GridInfo, VdbFile, find_grid};

/// What every key of a manifest means: the head of the project's own.
fn keys() -> &'static str {
    let own = include_str!("../../pipeline.toml");
    own.split_once("\n\n").map_or(own, |(head, _)| head)
}

/// Folders are entered to this depth: exports lie a few below, and a loop of links ends here.
const MAX_DEPTH: usize = 16;

#[derive(Args)]
pub struct InitArgs {
    /// Folder with the .vdb files; the manifest is written there
    #[arg(default_value = ".")]
    folder: PathBuf,
}

/// Grids of a liquid's surface, as Blender and FLIP Fluids call them.
const LIQUID_GRIDS: [&str; 2] = ["phi", "surface"];

/// A sequence that a pack can be built of.
struct Buildable {
    /// The grids of its first frame.
    grids: Vec<GridInfo>,
    /// Those of them that can be packed.
    packable: Vec<String>,
    /// The grid to name; none where the one that a build chooses is meant.
    grid: Option<String>,
}

pub fn run(args: &InitArgs, common: Common) -> Result<()> {
    let manifest = args.folder.join(DEFAULT_NAME);
    let mut files = Vec::new();
    find(&args.folder, Path::new(""), 0, &mut files)?;
    if files.is_empty() {
        return Err(Error::Input(format!("{}: there is no .vdb file in it", args.folder.display())));
    }
    let mut text = format!("{}\n", keys());
    let mut names = Vec::new();
    let mut refusals = Vec::new();
    for sequence in sequences(&files) {
        let name = unique(&sequence, &names);
        let asset = asset(&name, &sequence);
        match buildable(&args.folder, &sequence) {
            Ok(found) => {
                if !common.quiet {
                    let unit = if sequence.files.len() == 1 { "file" } else { "files" };
                    let files = count(sequence.files.len() as u64);
                    outln!("{TITLE}{name}{TITLE:#}: {files} {unit}: {}", listing(&found.grids));
                }
                let _ = write!(text, "\n{asset}{}", found.settings());
            }
            Err(error) => {
                anstream::eprintln!("{WARNING}warning{WARNING:#}: left out: {error}");
                let lines = asset.lines().map(|line| format!("# {line}\n")).collect::<String>();
                let _ = write!(text, "\n# Left out: {}\n{lines}", one_line(&error.to_string()));
                refusals.push(error);
            }
        }
        names.push(name);
    }
    if refusals.len() == names.len() {
        let nothing =
            Error::Unsupported(format!("{}: no .vdb file in it can be packed", args.folder.display()));
        let all_are_unsupported = refusals.iter().all(|e| exit_code::of(e) == exit_code::of(&nothing));
        return Err(if all_are_unsupported { nothing } else { Error::Input(nothing.to_string()) });
    }
    // Another manifest is someone's work.
    let created = std::fs::OpenOptions::new().write(true).create_new(true).open(&manifest);
    created.and_then(|mut file| file.write_all(text.as_bytes())).map_err(|e| match e.kind() {
        std::io::ErrorKind::AlreadyExists => {
            Error::Usage(format!("{} exists: move it away, or add to it by hand", manifest.display()))
        }
        _ => Error::io(&manifest)(e),
    })?;
    if !common.quiet {
        outln!("{}: build with: volpack build -m {}", manifest.display(), manifest.display());
    }
    Ok(())
}

/// The .vdb files under `folder`, by their paths from `root`.
fn find(root: &Path, folder: &Path, depth: usize, out: &mut Vec<PathBuf>) -> Result<()> {
    let at = root.join(folder);
    for entry in std::fs::read_dir(&at).map_err(Error::io(&at))? {
        let entry = entry.map_err(Error::io(&at))?;
        let name = entry.file_name();
        let path = folder.join(&name);
        if name.to_string_lossy().starts_with('.') {
            continue;
        }
        let is_folder = root.join(&path).is_dir();
        if is_folder && depth < MAX_DEPTH {
            find(root, &path, depth + 1, out)?;
        } else if !is_folder && path.extension().is_some_and(|e| e.eq_ignore_ascii_case("vdb")) {
            out.push(path);
        }
    }
    Ok(())
}

/// What a pack could be built of, as far as the files' headers tell.
fn buildable(root: &Path, sequence: &Sequence) -> Result<Buildable> {
    let files: Vec<PathBuf> = sequence.files.iter().map(|file| root.join(file)).collect();
    let Numbering { numbers, .. } = number(&files)?;
    let grids = in_each(&files, |file, _| Ok(file.grids))?;
    let frames: Vec<FrameGrids> = files
        .iter()
        .zip(&numbers)
        .zip(&grids)
        .map(|((path, &number), grids)| FrameGrids { path, number, grids })
        .collect();
    let can_be_packed = |grid: &&str| select_from(&frames, &[(*grid).to_owned()], Integers::Keep).is_ok();
    let in_file = || frames[0].grids.iter().map(|g| &*g.name);
    let (grid, selection) = match select_from(&frames, &[], Integers::Keep) {
        Ok(selection) => (None, selection),
        Err(error) => {
            let chosen = LIQUID_GRIDS.into_iter().chain(in_file()).find(can_be_packed).ok_or(error)?;
            (Some(chosen.to_owned()), select_from(&frames, &[chosen.to_owned()], Integers::Keep)?)
        }
    };
    in_each(&files, |file, path| {
        for grid in selection.grids.iter().filter_map(|selected| find_grid(&file.grids, &selected.name)) {
            let background = file.background(grid).map_err(Error::vdb(path))? as f32;
            if !background.is_finite() {
                return Err(nonfinite_background(path, grid, background));
            }
        }
        Ok(())
    })?;
    let packable = in_file().filter(can_be_packed).map(str::to_owned).collect();
    Ok(Buildable { packable, grid, grids: frames[0].grids.to_vec() })
}

/// What `read` makes of each file, or the error of the first that is wrong.
fn in_each<T: Send>(files: &[PathBuf], read: impl Fn(VdbFile, &Path) -> Result<T> + Sync) -> Result<Vec<T>> {
    let read =
        |path: &PathBuf| VdbFile::open(path).map_err(Error::vdb(path)).and_then(|file| read(file, path));
    files.par_iter().map(read).collect::<Vec<_>>().into_iter().collect()
}

impl Buildable {
    /// Its grids in a manifest.
    fn settings(&self) -> String {
        let mut out = format!("# grids: {}\n", one_line(&listing(&self.grids)));
        match &self.grid {
            Some(grid) => {
                let _ = writeln!(out, "grid = {}", quoted(grid));
            }
            None if self.packable.len() > 1 => {
                let all: Vec<_> = self.packable.iter().map(|g| quoted(g)).collect();
                let _ = writeln!(out, "# grids = [{}]", all.join(", "));
            }
            None => {}
        }
        out
    }
}

/// A sequence as an asset of a manifest, without its grids.
fn asset(name: &str, sequence: &Sequence) -> String {
    let frames = match &frames(sequence)[..] {
        [one] => quoted(one),
        several => format!("[{}]", several.iter().map(|f| quoted(f)).collect::<Vec<_>>().join(", ")),
    };
    format!("[asset.{name}]\nframes = {frames}\noutput = \"packs/{name}.volpack\"\n")
}

/// What stands for a sequence's files: one file by its name, several by globs.
fn frames(sequence: &Sequence) -> Vec<String> {
    if let [only] = &sequence.files[..] {
        return vec![portable(only)];
    }
    let escaped = |part: &str| glob::Pattern::escape(part);
    let [before, after] = [&sequence.before, &sequence.after].map(|part| escaped(part));
    let folder = PathBuf::from(escaped(&sequence.folder.to_string_lossy()));
    sequence
        .number_globs
        .iter()
        .map(|number| portable(&folder.join(format!("{before}{number}{after}"))))
        .collect()
}

/// A name for an asset: that of the files without the frame number, or the folder's. What is a part of one file's name may
/// not be a frame number: digits go only from behind a separator at its end.
fn unique(sequence: &Sequence, taken: &[String]) -> String {
    let separators = ['_', '-', '.', ' '];
    let without_extension = |name: &str| name.rsplit_once('.').map_or("", |(stem, _)| stem).to_owned();
    let (before, after) = match &sequence.files[..] {
        [only] => {
            let stem = only.file_stem().unwrap_or_default().to_string_lossy();
            let name = stem.trim_end_matches(|c: char| c.is_ascii_digit());
            let is_numbered = name.is_empty() || name.ends_with(separators);
            (if is_numbered { name } else { &stem }.to_owned(), String::new())
        }
        _ => (sequence.before.clone(), without_extension(&sequence.after)),
    };
    let of_folder = sequence.folder.file_name().unwrap_or_default().to_string_lossy();
    let name = match (before.trim_matches(separators), after.trim_matches(separators)) {
        ("", "") => of_folder.into_owned(),
        ("", one) | (one, "") => one.to_owned(),
        (before, after) => format!("{before}_{after}"),
    };
    let bare = |c: char| if c.is_ascii_alphanumeric() || c == '_' || c == '-' { c } else { '_' };
    let name: String = name.chars().map(bare).collect();
    let name = if name.is_empty() { "volume".to_owned() } else { name };
    let numbered = (2..).map(|n| format!("{name}-{n}"));
    let mut candidates = std::iter::once(name.clone()).chain(numbered);
    candidates.find(|c| !taken.contains(c) && check_name(c).is_ok()).expect("numbers do not end")
}

/// Text as it can stand in a comment.
fn one_line(text: &str) -> String {
    text.replace(|c: char| c.is_control(), " ")
}

fn quoted(text: &str) -> String {
    toml::Value::String(text.to_owned()).to_string()
}
