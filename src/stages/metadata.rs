//! Stage 1: read every file's header and grid descriptors, no voxels.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use rayon::prelude::*;

use crate::digest::digest;
use crate::error::{Error, Result};
use crate::file_stamp::Stamp;
use crate::sequence::{Numbering, number};
use crate::vdb::{GridInfo, VdbFile};

/// One file of a sequence.
#[derive(Clone, Debug)]
pub struct FrameSource {
    /// The file.
    pub path: PathBuf,
    /// Its frame number.
    pub number: i32,
    /// BLAKE3 of its bytes.
    pub digest: blake3::Hash,
    /// What tells whether it is still the file that it was.
    pub stamp: Stamp,
    /// Whether that tells it for sure: not of a file that was changed a moment before.
    pub is_settled: bool,
    /// The grids in it.
    pub grids: Vec<GridInfo>,
}

impl FrameSource {
    /// The file's name without its folder, as it goes into a pack.
    pub fn file_name(&self) -> String {
        file_name(&self.path)
    }

    /// Nothing that was read of a file counts if it changed meanwhile.
    ///
    /// # Errors
    /// When it did.
    pub fn check_unchanged(&self) -> Result<()> {
        self.check_stamp()?;
        if !self.is_settled && digest(&self.path)?.0 != self.digest {
            return Err(Error::Changed(self.path.clone()));
        }
        Ok(())
    }

    fn check_stamp(&self) -> Result<()> {
        let now = Stamp::of(&self.path).map_err(Error::io(&self.path))?;
        if now == self.stamp { Ok(()) } else { Err(Error::Changed(self.path.clone())) }
    }
}

/// The files of a sequence in the order of their frames.
#[derive(Clone, Debug)]
pub struct SequenceInfo {
    /// At least one.
    pub frames: Vec<FrameSource>,
    /// What is odd about the sequence: missing frames, names without a number, files that may not be read right.
    pub warnings: Vec<String>,
}

/// Remembers the digests of files, so that gigabytes are not hashed to find that nothing changed.
pub trait KnownDigests: Sync {
    /// The digest that a file had when it had this stamp, if it is remembered.
    fn remembered(&self, path: &Path, stamp: &Stamp) -> Option<blake3::Hash>;
    /// Remembers the digest that a file has under a stamp that was [settled](Stamp::is_settled) when it was taken.
    fn remember(&self, path: &Path, stamp: &Stamp, digest: &blake3::Hash);
}

/// Where the digests of sources come from.
#[derive(Clone, Copy, Default)]
pub struct Digests<'a> {
    /// What remembers them.
    pub known: Option<&'a dyn KnownDigests>,
    /// Whether files that seem unchanged are hashed all the same.
    pub paranoid: bool,
}

/// Reads the metadata of every file and orders the files by frame number.
///
/// # Errors
/// The first file, in the given order, that cannot be read; two files of one frame.
pub fn read(paths: &[PathBuf], digests: Digests) -> Result<SequenceInfo> {
    if paths.is_empty() {
        return Err(Error::Input("there are no frames to read".to_owned()));
    }
    let Numbering { numbers, mut warnings } = number(paths)?;
    let read = paths
        .par_iter()
        .zip(numbers)
        .map(|(path, number)| read_one(path, number, digests))
        .collect::<Vec<_>>()
        .into_iter()
        .collect::<Result<Vec<_>>>()?;
    warnings.extend(file_warnings(&read));
    let mut frames: Vec<FrameSource> = read.into_iter().map(|(frame, _)| frame).collect();
    frames.sort_by_key(|f| f.number);
    Ok(SequenceInfo { frames, warnings })
}

/// What is odd about files, once for all of which the same is.
fn file_warnings(files: &[(FrameSource, Vec<String>)]) -> Vec<String> {
    let mut files_of: BTreeMap<&str, Vec<&FrameSource>> = BTreeMap::new();
    for (file, warnings) in files {
        warnings.iter().for_each(|warning| files_of.entry(warning).or_default().push(file));
    }
    let one = |(warning, files): (&str, Vec<&FrameSource>)| {
        let first = files[0].path.display();
        match files.len() - 1 {
            0 => format!("{first}: {warning}"),
            1 => format!("{first} and another file: {warning}"),
            others => format!("{first} and {others} other files: {warning}"),
        }
    };
    files_of.into_iter().map(one).collect()
}

/// One file, and what is odd about it.
fn read_one(path: &Path, number: i32, digests: Digests) -> Result<(FrameSource, Vec<String>)> {
    let stamp = Stamp::of(path).map_err(Error::io(path))?;
    let file = VdbFile::open(path).map_err(Error::vdb(path))?;
    let is_settled = stamp.is_settled();
    let digest = digests.of(path, &stamp, is_settled)?;
    let source = FrameSource { path: path.to_owned(), number, digest, stamp, is_settled, grids: file.grids };
    // What was read and what was hashed are one file.
    source.check_stamp()?;
    Ok((source, file.warnings))
}

impl Digests<'_> {
    /// The digest of a file with this stamp, which was settled or not when it was taken.
    ///
    /// # Errors
    /// When the file cannot be read.
    pub fn of(self, path: &Path, stamp: &Stamp, is_settled: bool) -> Result<blake3::Hash> {
        let remembered =
            self.known.filter(|_| !self.paranoid).and_then(|known| known.remembered(path, stamp));
        if let Some(digest) = remembered {
            return Ok(digest);
        }
        let (digest, _) = digest(path)?;
        if let Some(known) = self.known.filter(|_| is_settled) {
            known.remember(path, stamp, &digest);
        }
        Ok(digest)
    }
}

fn file_name(path: &Path) -> String {
    path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default()
}
