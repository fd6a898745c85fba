//! Looks after a store: what is in it, what may go, whether it is sound.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use rayon::prelude::*;
use serde::Serialize;

use super::Cache;
use super::store::{ASIDE, Entry, Map, STAMPS};
use crate::atomic_file::{LEFT_BEHIND, is_temporary};

/// What is in a store.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Stats {
    /// Results by stage.
    pub stages: BTreeMap<String, StageStats>,
    /// Files of both maps.
    pub entries: u64,
    /// Their bytes.
    pub bytes: u64,
    /// Sources whose digests are remembered.
    pub sources: u64,
}

/// The results of one stage.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct StageStats {
    /// How many there are.
    pub results: u64,
    /// Their bytes; a result that stages share counts for each.
    pub bytes: u64,
}

/// An entry with which something is wrong.
#[derive(Clone, Debug, Serialize)]
pub struct Fault {
    /// The file.
    pub path: PathBuf,
    /// What is wrong with it.
    pub why: String,
}

/// What [`Cache::verify`] found.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Verified {
    /// Damaged entries, which are gone.
    pub removed: Vec<Fault>,
    /// Entries that cannot be read, or are damaged and cannot be removed: another program has them open, or the user has
    /// no permission. They stay.
    pub left: Vec<Fault>,
}

impl Verified {
    /// Whether every entry was read and is sound.
    pub fn is_sound(&self) -> bool {
        self.removed.is_empty() && self.left.is_empty()
    }
}

/// What was removed from a store.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Removed {
    /// The number of files.
    pub files: u64,
    /// Their bytes.
    pub bytes: u64,
    /// Files that could not be removed.
    pub left: Vec<Fault>,
}

/// Why an entry cannot be used.
enum Unsound {
    /// It was read, and is not what was written.
    Damaged(String),
    /// Nobody can tell.
    Unreadable(io::Error),
}

/// One file of the store.
struct Found {
    path: PathBuf,
    bytes: u64,
    used: SystemTime,
}

impl Cache {
    /// Counts what is in the store.
    ///
    /// # Errors
    /// When a folder of it cannot be listed.
    pub fn stats(&self) -> io::Result<Stats> {
        let mut stats = Stats { sources: self.files(STAMPS)?.len() as u64, ..Stats::default() };
        for map in Map::ALL {
            for found in self.files(map.folder())? {
                stats.entries += 1;
                stats.bytes += found.bytes;
                if map == Map::Actions
                    && let Ok(entry) = Entry::read(&found.path)
                {
                    let stage = stats.stages.entry(entry.stage()).or_default();
                    stage.results += 1;
                    stage.bytes += entry.blob.bytes;
                }
            }
        }
        Ok(stats)
    }

    /// Removes what was not used for `max_age`, then what was not used for longest until the rest takes at most
    /// `max_bytes`.
    ///
    /// # Errors
    /// When a folder of the store cannot be listed.
    pub fn collect(&self, max_bytes: Option<u64>, max_age: Option<Duration>) -> io::Result<Removed> {
        let now = SystemTime::now();
        let age = |found: &Found| now.duration_since(found.used).unwrap_or_default();
        let mut files = Vec::new();
        for map in Map::ALL {
            files.extend(self.files(map.folder())?);
        }
        // Of what was used together, blobs go last: an action without its blob is of no use.
        files.sort_by(|a, b| a.used.cmp(&b.used).then(a.bytes.cmp(&b.bytes)));
        let mut left: u64 = files.iter().map(|f| f.bytes).sum();
        let mut gone: Vec<Found> = Vec::new();
        for found in files {
            let is_old = max_age.is_some_and(|max| age(&found) > max);
            if is_old || max_bytes.is_some_and(|max| left > max) {
                left -= found.bytes;
                gone.push(found);
            }
        }
        gone.extend(self.files(ASIDE)?.into_iter().filter(|found| age(found) > LEFT_BEHIND));
        gone.extend(self.files(STAMPS)?.into_iter().filter(|f| max_age.is_some_and(|max| age(f) > max)));
        Ok(remove(&gone))
    }

    /// Reads every entry, and removes those that are damaged. One that cannot be read may be sound, and stays.
    ///
    /// # Errors
    /// When a folder of the store cannot be listed.
    pub fn verify(&self) -> io::Result<Verified> {
        let actions = self.files(Map::Actions.folder())?;
        let blobs = self.files(Map::Blobs.folder())?;
        let sound_action = |found: &Found| Entry::read(&found.path).map(drop);
        let sound_blob = |found: &Found| {
            let mut hasher = blake3::Hasher::new();
            hasher.update_mmap(&found.path).map_err(Unsound::Unreadable)?;
            let is_named = digest_in_name(&found.path) == Some(hasher.finalize());
            if is_named { Ok(()) } else { Err(Unsound::Damaged("its digest is not its name".to_owned())) }
        };
        let mut unsound: Vec<(PathBuf, Unsound)> = Vec::new();
        let if_unsound = |found: &Found, sound: Result<(), Unsound>| {
            // What another process removed meanwhile is not damaged.
            sound.err().filter(|_| found.path.exists()).map(|why| (found.path.clone(), why))
        };
        unsound.par_extend(actions.par_iter().filter_map(|f| if_unsound(f, sound_action(f))));
        unsound.par_extend(blobs.par_iter().filter_map(|f| if_unsound(f, sound_blob(f))));
        let mut verified = Verified::default();
        for (path, why) in unsound {
            match why {
                Unsound::Unreadable(e) => verified.left.push(Fault { path, why: e.to_string() }),
                Unsound::Damaged(why) => match remove_file(&path) {
                    Ok(_) => verified.removed.push(Fault { path, why }),
                    Err(e) => {
                        verified.left.push(Fault { path, why: format!("{why}; it cannot be removed: {e}") });
                    }
                },
            }
        }
        Ok(verified)
    }

    /// Removes everything that the store made, and nothing else.
    ///
    /// # Errors
    /// When a folder of the store cannot be listed.
    pub fn clear(&self) -> io::Result<Removed> {
        let mut all = Vec::new();
        for folder in [Map::Actions.folder(), Map::Blobs.folder(), STAMPS, ASIDE] {
            all.extend(self.files(folder)?);
        }
        Ok(remove(&all))
    }

    /// The store's own files in one of its folders: whatever else someone put there is not touched.
    fn files(&self, map: &str) -> io::Result<Vec<Found>> {
        let mut files = Vec::new();
        let root = self.folder().join(map);
        let mut folders = vec![root.clone()];
        while let Some(folder) = folders.pop() {
            let entries = match fs::read_dir(&folder) {
                Ok(entries) => entries,
                Err(e) if e.kind() == io::ErrorKind::NotFound => continue,
                Err(e) => return Err(e),
            };
            for entry in entries {
                let entry = entry?;
                // What goes away while it is looked at is not there. Links are not followed.
                let Ok(metadata) = entry.metadata() else { continue };
                if metadata.is_dir() {
                    if folder == root {
                        folders.push(entry.path());
                    }
                } else if is_ours(&entry.path(), map) {
                    let used = metadata.modified().unwrap_or(SystemTime::UNIX_EPOCH);
                    files.push(Found { path: entry.path(), bytes: metadata.len(), used });
                }
            }
        }
        files.sort_by(|a, b| a.path.cmp(&b.path));
        Ok(files)
    }
}

/// Removes files, as far as another process was not quicker.
fn remove(files: &[Found]) -> Removed {
    let mut removed = Removed::default();
    for found in files {
        match remove_file(&found.path) {
            Ok(was_there) => {
                removed.files += u64::from(was_there);
                removed.bytes += if was_there { found.bytes } else { 0 };
            }
            Err(e) => removed.left.push(Fault { path: found.path.clone(), why: e.to_string() }),
        }
    }
    removed
}

/// Removes a file; whether it was still there.
fn remove_file(path: &Path) -> io::Result<bool> {
    match fs::remove_file(path) {
        Ok(()) => Ok(true),
        Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(false),
        Err(e) => Err(e),
    }
}

impl Entry {
    fn read(path: &Path) -> Result<Self, Unsound> {
        let bytes = fs::read(path).map_err(Unsound::Unreadable)?;
        Self::from_bytes(&bytes).map_err(|why| Unsound::Damaged(why.to_owned()))
    }
}

/// Whether a file has a name that the store gives: a digest's, or what `tempfile` calls one that is being written.
fn is_ours(path: &Path, map: &str) -> bool {
    if map == ASIDE { is_temporary(path, ".tmp") } else { digest_in_name(path).is_some() }
}

/// The digest that a blob's file and folder are named by.
fn digest_in_name(path: &Path) -> Option<blake3::Hash> {
    let name = path.file_name()?.to_str()?;
    let folder = path.parent()?.file_name()?.to_str()?;
    blake3::Hash::from_hex(format!("{folder}{name}")).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_cannot_be_removed_is_told_and_what_is_gone_is_not() {
        let folder = tempfile::tempdir().unwrap();
        let found =
            |name: &str| Found { path: folder.path().join(name), bytes: 7, used: SystemTime::UNIX_EPOCH };
        // A folder is what `remove_file` refuses on every system, as Windows does a file that is open.
        fs::create_dir(folder.path().join("folder")).unwrap();
        fs::write(folder.path().join("file"), "1234567").unwrap();
        let removed = remove(&["folder", "file", "gone"].map(found));
        assert_eq!((removed.files, removed.bytes), (1, 7));
        assert_eq!(removed.left.iter().map(|f| &*f.path).collect::<Vec<_>>(), [folder.path().join("folder")]);
    }
}
