//! Stage 1: read every file's header and grid descriptors, no voxels.

use std::fs::File;
use std::path::{Path, PathBuf};

use rayon::prelude::*;

use crate::cache::{Cache, Stamp};
use crate::error::{Error, Result};
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
    /// What is odd about the sequence: missing numbers, names without one.
    pub warnings: Vec<String>,
}

/// Where the digests of sources come from.
#[derive(Clone, Copy, Default)]
pub struct Digests<'a> {
    /// What remembers them.
    pub cache: Option<&'a Cache>,
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
    let mut warnings = Vec::new();
    let numbers = frame_numbers(paths, &mut warnings)?;
    let mut frames = paths
        .par_iter()
        .zip(numbers)
        .map(|(path, number)| read_one(path, number, digests))
        .collect::<Vec<_>>()
        .into_iter()
        .collect::<Result<Vec<_>>>()?;
    frames.sort_by_key(|f| f.number);
    if let Some(pair) = frames.windows(2).find(|w| w[0].number == w[1].number) {
        return Err(Error::Input(format!(
            "{} and {} are both frame {}: name the files of one sequence",
            pair[0].path.display(),
            pair[1].path.display(),
            pair[0].number
        )));
    }
    let numbers: Vec<i32> = frames.iter().map(|f| f.number).collect();
    warnings.extend(missing_frames(&numbers));
    Ok(SequenceInfo { frames, warnings })
}

fn read_one(path: &Path, number: i32, digests: Digests) -> Result<FrameSource> {
    let stamp = Stamp::of(path).map_err(Error::io(path))?;
    let file = VdbFile::open(path).map_err(Error::vdb(path))?;
    let is_settled = stamp.is_settled();
    let digest = digests.of(path, &stamp, is_settled)?;
    let source = FrameSource { path: path.to_owned(), number, digest, stamp, is_settled, grids: file.grids };
    // What was read and what was hashed are one file.
    source.check_stamp()?;
    Ok(source)
}

impl Digests<'_> {
    /// The digest of a file with this stamp, which was settled or not when it was taken.
    ///
    /// # Errors
    /// When the file cannot be read.
    pub fn of(self, path: &Path, stamp: &Stamp, is_settled: bool) -> Result<blake3::Hash> {
        let remembered = self.cache.filter(|_| !self.paranoid).and_then(|c| c.remembered(path, stamp));
        if let Some(digest) = remembered {
            return Ok(digest);
        }
        let (digest, _) = digest(path)?;
        if let Some(cache) = self.cache.filter(|_| is_settled) {
            cache.remember(path, stamp, &digest);
        }
        Ok(digest)
    }
}

/// BLAKE3 of a file's bytes, and how many there are.
///
/// # Errors
/// When the file cannot be read.
pub fn digest(path: &Path) -> Result<(blake3::Hash, u64)> {
    let mut hasher = blake3::Hasher::new();
    File::open(path).and_then(|file| hasher.update_reader(file).map(drop)).map_err(Error::io(path))?;
    Ok((hasher.finalize(), hasher.count()))
}

fn file_name(path: &Path) -> String {
    path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default()
}

/// Each file's frame number: the last run of digits in its name. A single file without one is frame
/// 0; several are numbered in the given order.
fn frame_numbers(paths: &[PathBuf], warnings: &mut Vec<String>) -> Result<Vec<i32>> {
    let found: Vec<_> = paths.iter().map(|p| frame_number(p)).collect();
    if let Some(numbers) = found.iter().copied().collect::<Option<Vec<_>>>() {
        return Ok(numbers);
    }
    if paths.len() > 1 {
        let unnumbered = found.iter().position(Option::is_none).expect("not every name has a number");
        warnings.push(format!(
            "{} has no frame number in its name: the files are numbered in the order given",
            file_name(&paths[unnumbered])
        ));
    }
    (0..paths.len())
        .map(|i| i32::try_from(i).map_err(|_| Error::Usage("too many frames".to_owned())))
        .collect()
}

fn frame_number(path: &Path) -> Option<i32> {
    let stem = path.file_stem()?.to_string_lossy();
    let digits_end = stem.rfind(|c: char| c.is_ascii_digit())? + 1;
    let digits = stem[..digits_end].rsplit(|c: char| !c.is_ascii_digit()).next()?;
    digits.parse().ok()
}

/// Numbers listed in one warning; more are only counted.
const LISTED: usize = 10;

fn missing_frames(numbers: &[i32]) -> Option<String> {
    let gaps = numbers.windows(2).map(|w| (w[0] + 1, w[1] - 1)).filter(|(first, last)| first <= last);
    let mut count = 0i64;
    let mut names = Vec::new();
    for (first, last) in gaps {
        count += i64::from(last) - i64::from(first) + 1;
        names.push(if first == last { first.to_string() } else { format!("{first}-{last}") });
    }
    let rest = names.len().saturating_sub(LISTED);
    names.truncate(LISTED);
    let more = if rest > 0 { format!(" and {rest} more gaps") } else { String::new() };
    let frames = if count == 1 { "frame is" } else { "frames are" };
    (count > 0).then(|| format!("{count} {frames} missing from the sequence: {}{more}", names.join(", ")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_last_digits_of_a_name_are_its_frame() {
        let number = |name: &str| frame_number(Path::new(name));
        assert_eq!(number("shot2/plume_0012.vdb"), Some(12));
        assert_eq!(number("fire2_v03.0100.vdb"), Some(100));
        assert_eq!(number("take7_smoke.vdb"), Some(7));
        assert_eq!(number("smoke.vdb"), None);
        assert_eq!(number("99999999999.vdb"), None);
    }

    #[test]
    fn gaps_are_named() {
        assert_eq!(missing_frames(&[1, 2, 3]), None);
        assert_eq!(missing_frames(&[1, 3]).unwrap(), "1 frame is missing from the sequence: 2");
        assert_eq!(missing_frames(&[1, 3, 7]).unwrap(), "4 frames are missing from the sequence: 2, 4-6");
    }
}
