//! `volpack init`.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use clap::Args;

use super::style::{TITLE, WARNING};
use super::{Common, outln};
use crate::error::{Error, Result};
use crate::manifest::DEFAULT_NAME;
use crate::units::count;
use crate::vdb::{GridInfo, VdbFile};

/// What every key of a manifest means: the head of the project's own.
fn keys() -> &'static str {
    let own = include_str!("../../pipeline.toml");
    own.split_once("\n\n").map_or(own, |(head, _)| head)
}

/// Folders are entered to this depth: exports lie a few below, and a loop of links ends here.
const MAX_DEPTH: usize = 16;

#[derive(Args)]
pub struct InitArgs {
    /// The folder with the .vdb files; the manifest goes there
    #[arg(default_value = ".")]
    folder: PathBuf,
}

/// Files whose names differ in their last run of digits alone.
struct Sequence {
    /// Patterns, or the file if there is one.
    frames: Vec<String>,
    grids: Vec<GridInfo>,
}

/// A file's folder, and what comes before and after the last run of digits of its name.
type Family = (PathBuf, String, String);

pub fn run(args: &InitArgs, common: Common) -> Result<()> {
    let manifest = args.folder.join(DEFAULT_NAME);
    let mut files = Vec::new();
    find(&args.folder, Path::new(""), 0, &mut files)?;
    if files.is_empty() {
        return Err(Error::Input(format!("{}: there is no .vdb file in it", args.folder.display())));
    }
    let mut families: BTreeMap<Family, Vec<(usize, PathBuf)>> = BTreeMap::new();
    for file in files {
        let (family, digits) = family(&file);
        families.entry(family).or_default().push((digits, file));
    }
    let mut text = format!("{}\n", keys());
    let mut names = Vec::new();
    for (family, mut files) in families {
        files.sort();
        let first = args.folder.join(&files[0].1);
        let grids = match VdbFile::open(&first) {
            Ok(file) => file.grids,
            Err(error) => {
                anstream::eprintln!("{WARNING}warning{WARNING:#}: left out: {}: {error}", first.display());
                continue;
            }
        };
        let name = unique(&family, &names);
        let sequence = Sequence { frames: frames(&family, &files), grids };
        if !common.quiet {
            let unit = if files.len() == 1 { "file" } else { "files" };
            outln!("{TITLE}{name}{TITLE:#}: {} {unit}: {}", count(files.len() as u64), sequence.listing());
        }
        text.push_str(&sequence.asset(&name));
        names.push(name);
    }
    if names.is_empty() {
        return Err(Error::Input(format!("{}: no .vdb file in it can be read", args.folder.display())));
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

/// A file's family, and how many digits its number has.
fn family(file: &Path) -> (Family, usize) {
    let folder = file.parent().unwrap_or(Path::new("")).to_owned();
    let name = file.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let stem = name.rsplit_once('.').map_or(&*name, |(stem, _)| stem);
    let end = stem.rfind(|c: char| c.is_ascii_digit()).map_or(0, |at| at + 1);
    let start = stem[..end].trim_end_matches(|c: char| c.is_ascii_digit()).len();
    let (before, after) = if end == 0 { (&*name, "") } else { (&name[..start], &name[end..]) };
    ((folder, before.to_owned(), after.to_owned()), end - start)
}

/// What stands for a family's files: one file by its name, several by a pattern for each number of digits. Not `*`: that
/// would take in the files of `smoke_low_0001.vdb` with those of `smoke_0001.vdb`.
fn frames((folder, before, after): &Family, files: &[(usize, PathBuf)]) -> Vec<String> {
    // A manifest's paths have slashes on every system.
    let text = |path: &Path| path.to_string_lossy().replace('\\', "/");
    if let [(_, only)] = files {
        return vec![text(only)];
    }
    let mut widths: Vec<usize> = files.iter().map(|(digits, _)| *digits).collect();
    widths.dedup();
    let escaped = |part: &str| glob::Pattern::escape(part);
    let pattern = |digits| format!("{}{}{}", escaped(before), "[0-9]".repeat(digits), escaped(after));
    let folder = PathBuf::from(escaped(&folder.to_string_lossy()));
    widths.into_iter().map(|digits| text(&folder.join(pattern(digits)))).collect()
}

/// A name for an asset: what comes before the digits, or the folder's.
fn unique((folder, before, _): &Family, taken: &[String]) -> String {
    let before = before.strip_suffix(".vdb").unwrap_or(before).trim_matches(['_', '-', '.', ' ']);
    let of_folder = folder.file_name().unwrap_or_default().to_string_lossy();
    let name = if before.is_empty() { &*of_folder } else { before };
    let bare = |c: char| if c.is_ascii_alphanumeric() || c == '_' || c == '-' { c } else { '_' };
    let name: String = name.chars().map(bare).collect();
    let name = if name.is_empty() { "volume".to_owned() } else { name };
    let numbered = (2..).map(|n| format!("{name}-{n}"));
    let mut candidates = std::iter::once(name.clone()).chain(numbered);
    candidates.find(|c| !taken.contains(c)).expect("numbers do not end")
}

impl Sequence {
    fn listing(&self) -> String {
        let one = |g: &GridInfo| format!("{} ({})", g.name, g.value_type.name());
        if self.grids.is_empty() {
            return "no grids".to_owned();
        }
        self.grids.iter().map(one).collect::<Vec<_>>().join(", ")
    }

    fn asset(&self, name: &str) -> String {
        let frames = match &self.frames[..] {
            [one] => quoted(one),
            several => format!("[{}]", several.iter().map(|f| quoted(f)).collect::<Vec<_>>().join(", ")),
        };
        let packable: Vec<&str> =
            self.grids.iter().filter(|g| g.value_type.is_scalar()).map(|g| g.name.as_str()).collect();
        let mut out = format!("\n[asset.{name}]\nframes = {frames}\n");
        let _ = writeln!(out, "# grids: {}", self.listing().replace(['\n', '\r'], " "));
        match packable[..] {
            [] => out.push_str("# none of them can be packed\n"),
            [_] => {}
            _ if packable.contains(&"density") => {
                let all: Vec<_> = packable.iter().map(|g| quoted(g)).collect();
                let _ = writeln!(out, "# grids = [{}]", all.join(", "));
            }
            [first, ..] => {
                let _ = writeln!(out, "grid = {}", quoted(first));
            }
        }
        let _ = writeln!(out, "output = \"packs/{name}.volpack\"");
        out
    }
}

fn quoted(text: &str) -> String {
    toml::Value::String(text.to_owned()).to_string()
}
