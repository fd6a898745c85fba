//! The sound files that are damaged: every fixture, and packs of some of them in every format.

use std::ffi::OsStr;
use std::io;
use std::mem::offset_of;
use std::ops::Range;
use std::path::{Path, PathBuf};

use volpack::error::Result;
use volpack::pack::layout::{Header, Section};
use volpack::pipeline::{Job, Silent, VerifyLevel, build};
use volpack::settings::{Format, Settings};

/// Bytes at the start of a file in which most of its lengths and counts are.
const HEAD: usize = 4096;
/// Bytes before and behind a grid's type in which its descriptor and header lie.
const AROUND_TYPE: usize = 512;

/// A sound file.
pub struct Seed {
    /// Its name.
    pub name: String,
    /// Its bytes.
    pub bytes: Vec<u8>,
    /// Where it is dense with lengths and counts.
    pub hot: Vec<Range<usize>>,
}

/// Every `.vdb` in a folder.
///
/// # Errors
/// When the folder cannot be read.
pub fn vdbs(folder: &Path) -> io::Result<Vec<Seed>> {
    load(folder, "vdb", |bytes| {
        let grids = bytes.windows(5).enumerate().filter(|(_, w)| w == b"Tree_");
        let around = |at: usize| at.saturating_sub(AROUND_TYPE)..(at + AROUND_TYPE).min(bytes.len());
        grids.map(|(at, _)| around(at)).collect()
    })
}

/// Every `.volpack` in a folder.
///
/// # Errors
/// When the folder cannot be read.
pub fn packs(folder: &Path) -> io::Result<Vec<Seed>> {
    load(folder, "volpack", |bytes| {
        let u32_at = |at: usize| u32::from_le_bytes(*bytes[at..].first_chunk().expect("a pack"));
        let u64_at = |at: usize| u64::from_le_bytes(*bytes[at..].first_chunk().expect("a pack")) as usize;
        let mut hot = Vec::new();
        for i in 0..u32_at(offset_of!(Header, sections)) as usize {
            let entry = size_of::<Header>() + i * size_of::<Section>();
            let start = u64_at(entry + offset_of!(Section, offset));
            let end = start + u64_at(entry + offset_of!(Section, stored_bytes));
            // The beginning of each, so that the tree's header and the small tables get their share.
            hot.extend([start..end, start..end.min(start + 256)]);
        }
        hot.retain(|range| !range.is_empty());
        hot
    })
}

fn load(folder: &Path, extension: &str, hot: impl Fn(&[u8]) -> Vec<Range<usize>>) -> io::Result<Vec<Seed>> {
    let entries = std::fs::read_dir(folder)?.map(|entry| entry.map(|e| e.path()));
    let mut paths = entries.collect::<io::Result<Vec<_>>>()?;
    paths.retain(|path| path.extension() == Some(OsStr::new(extension)));
    // The order of a folder differs between machines; a case's number must not.
    paths.sort();
    let read = |path: &PathBuf| {
        let bytes = std::fs::read(path)?;
        let special = hot(&bytes);
        // Half of the hot damage goes to the head.
        let mut hot = vec![0..bytes.len().min(HEAD); special.len().max(1)];
        hot.extend(special);
        let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        Ok(Seed { name, bytes, hot })
    };
    paths.iter().map(read).collect()
}

/// Builds packs into `out`: an animation of two grids, a level set, tiles and negative coordinates, each
/// in every format, raw and with zstd.
///
/// # Errors
/// When one of them cannot be built.
pub fn build_packs(fixtures: &Path, out: &Path) -> Result<()> {
    let animation: Vec<String> = (1..=3).map(|frame| format!("anim_{frame:04}")).collect();
    let one = |name: &str| vec![name.to_owned()];
    let both = ["density", "temperature"].map(str::to_owned).to_vec();
    let sources = [
        ("anim", animation, both),
        ("levelset_half", one("levelset_half"), Vec::new()),
        ("tiles", one("tiles"), Vec::new()),
        ("negative", one("negative"), Vec::new()),
    ];
    for (name, files, grids) in sources {
        for format in Format::ALL {
            for zstd in [0, 3] {
                let job = Job::new(
                    files.iter().map(|file| fixtures.join(format!("{file}.vdb"))).collect(),
                    out.join(format!("{name}_{}_{zstd}.volpack", format.name())),
                    Settings { grids: grids.clone(), encoding: format.into(), zstd, ..Settings::default() },
                    VerifyLevel::None,
                );
                build(&job, &mut Silent)?;
            }
        }
    }
    Ok(())
}
