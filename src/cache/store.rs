//! The two maps on disk.

use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use super::artefact;
use super::{Blob, Key};

/// Which of the maps.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Map {
    /// From a key to the digest of a result. A later entry replaces an earlier one.
    Actions,
    /// From a digest to the bytes that it names.
    Blobs,
}

impl Map {
    pub(super) const ALL: [Self; 2] = [Self::Actions, Self::Blobs];

    /// The folder of its entries, in a store and in a bucket.
    pub(super) fn folder(self) -> &'static str {
        match self {
            Self::Actions => "actions",
            Self::Blobs => "blobs",
        }
    }
}

/// Where files are written before they are renamed.
pub(super) const ASIDE: &str = "tmp";
/// Where the digests of sources are remembered.
pub(super) const STAMPS: &str = "stamps";

/// What tells backup tools that a folder can be made again (<https://bford.info/cachedir>).
const TAG: &str = "Signature: 8a477f597d28d172789f06886806bc55\n# What volpack made, to be made once. \
                   May be deleted at any time.\n";

/// An entry's last use is noted when the last note is older than this, so that a read costs no write.
const USE_NOTED: Duration = Duration::from_secs(3600);

/// The first bytes of an action, the last of them its layout's version.
const MAGIC: [u8; 8] = *b"vpcache\x01";
/// Letters of a stage's name in an action.
const NAME_BYTES: usize = 16;
/// Magic, stage, digest, length, and BLAKE3 of those.
pub(super) const ACTION_BYTES: usize = 8 + NAME_BYTES + 32 + 8 + 32;

/// What stands in an action.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Entry {
    stage: [u8; NAME_BYTES],
    pub blob: Blob,
}

impl Entry {
    pub fn new(key: &Key, blob: Blob) -> Self {
        let mut stage = [0; NAME_BYTES];
        stage[..key.stage().len()].copy_from_slice(key.stage().as_bytes());
        Self { stage, blob }
    }

    /// The name of the stage whose result it is.
    pub fn stage(&self) -> String {
        String::from_utf8_lossy(&self.stage).trim_end_matches('\0').to_owned()
    }

    pub fn to_bytes(self) -> Vec<u8> {
        seal([&MAGIC[..], &self.stage, &self.blob.digest, &self.blob.bytes.to_le_bytes()].concat())
    }

    /// The entry of a key.
    pub fn of(key: &Key, bytes: &[u8]) -> Result<Self, &'static str> {
        let entry = Self::from_bytes(bytes)?;
        let is_ours = entry.stage == Self::new(key, entry.blob).stage;
        if is_ours { Ok(entry) } else { Err("it is another stage's") }
    }

    pub fn from_bytes(bytes: &[u8]) -> Result<Self, &'static str> {
        let mut body = unseal(bytes)?;
        let mut take = |buffer: &mut [u8]| body.read_exact(buffer).map_err(|_| "it is cut short");
        let (mut magic, mut stage, mut digest, mut length) = ([0; 8], [0; NAME_BYTES], [0; 32], [0; 8]);
        take(&mut magic)?;
        if magic != MAGIC {
            return Err("it is of another version");
        }
        take(&mut stage)?;
        take(&mut digest)?;
        take(&mut length)?;
        Ok(Self { stage, blob: Blob { digest, bytes: u64::from_le_bytes(length) } })
    }
}

impl Blob {
    /// Whether bytes are the blob's.
    pub(super) fn check(&self, bytes: &[u8]) -> Result<(), &'static str> {
        let is_whole = bytes.len() as u64 == self.bytes && blake3::hash(bytes) == self.digest;
        if is_whole { Ok(()) } else { Err(NOT_ITS_DIGEST) }
    }
}

/// What is wrong with most damaged entries.
const NOT_ITS_DIGEST: &str = "its digest is not that of its bytes";

/// Bytes with their BLAKE3 behind them.
pub(super) fn seal(mut bytes: Vec<u8>) -> Vec<u8> {
    bytes.extend(blake3::hash(&bytes).as_bytes());
    bytes
}

/// The inverse of [`seal`].
pub(super) fn unseal(bytes: &[u8]) -> Result<&[u8], &'static str> {
    let (body, digest) = bytes.split_last_chunk::<32>().ok_or("it is cut short")?;
    if blake3::hash(body) == *digest { Ok(body) } else { Err(NOT_ITS_DIGEST) }
}

/// An entry that cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("the cache entry {} cannot be used, it is made anew: {why}", path.display())]
pub(super) struct Unusable {
    path: PathBuf,
    why: String,
}

/// The folder with both maps.
#[derive(Clone)]
pub(super) struct Store {
    root: PathBuf,
}

impl Store {
    pub fn open(root: &Path) -> io::Result<Self> {
        fs::create_dir_all(root.join(ASIDE))?;
        let tag = root.join("CACHEDIR.TAG");
        if !tag.exists() {
            fs::write(tag, TAG)?;
        }
        Ok(Self { root: root.to_owned() })
    }

    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Where files are written before they are renamed.
    pub fn aside(&self) -> PathBuf {
        self.root.join(ASIDE)
    }

    pub fn path(&self, map: Map, digest: &[u8; 32]) -> PathBuf {
        self.place(map.folder(), &blake3::Hash::from(*digest))
    }

    /// The file that a digest names in one of the store's folders.
    pub fn place(&self, folder: &str, digest: &blake3::Hash) -> PathBuf {
        let name = digest.to_hex();
        // 256 folders, so that none of them has more files than file systems like.
        let (part, name) = name.split_at(2);
        self.root.join(folder).join(part).join(name)
    }

    /// The action of a key; `None` where there is none.
    pub fn read_action(&self, key: &Key) -> Result<Option<Entry>, Unusable> {
        let path = self.path(Map::Actions, key.digest());
        self.read(&path, ACTION_BYTES as u64, |bytes| Entry::of(key, &bytes))
    }

    /// A blob's bytes; `None` where they are not there.
    pub fn read_blob(&self, blob: &Blob) -> Result<Option<Vec<u8>>, Unusable> {
        let path = self.path(Map::Blobs, &blob.digest);
        if blob.bytes > artefact::MOST as u64 {
            return Err(Unusable { path, why: format!("{} bytes are more than a result has", blob.bytes) });
        }
        self.read(&path, blob.bytes, |bytes| blob.check(&bytes).map(|()| bytes))
    }

    pub fn has_blob(&self, blob: &Blob) -> bool {
        fs::metadata(self.path(Map::Blobs, &blob.digest)).is_ok_and(|m| m.is_file() && m.len() == blob.bytes)
    }

    /// Reads a file of a known length and makes something of it. What cannot be used is removed, so that it is
    /// written anew.
    fn read<T>(
        &self,
        path: &Path,
        length: u64,
        parse: impl FnOnce(Vec<u8>) -> Result<T, &'static str>,
    ) -> Result<Option<T>, Unusable> {
        let unreadable = |e: io::Error| Unusable { path: path.to_owned(), why: e.to_string() };
        let unusable = |why: String| {
            let _ = fs::remove_file(path);
            Unusable { path: path.to_owned(), why }
        };
        let mut file = match File::open(path) {
            Ok(file) => file,
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(e) => return Err(unreadable(e)),
        };
        let metadata = file.metadata().map_err(unreadable)?;
        if metadata.len() != length {
            return Err(unusable(format!("it has {} bytes, not {length}", metadata.len())));
        }
        let mut bytes = Vec::with_capacity(length as usize);
        io::Read::by_ref(&mut file).take(length).read_to_end(&mut bytes).map_err(unreadable)?;
        note_use(path, &metadata);
        parse(bytes).map(Some).map_err(|why| unusable(why.to_owned()))
    }

    /// Opens a blob of the right length, to be checked by who reads it.
    pub fn open_blob(&self, blob: &Blob) -> Option<File> {
        let path = self.path(Map::Blobs, &blob.digest);
        let file = File::open(&path).ok()?;
        let metadata = file.metadata().ok()?;
        note_use(&path, &metadata);
        (metadata.len() == blob.bytes).then_some(file)
    }

    /// Takes a blob away that turned out to be damaged.
    pub fn discard(&self, blob: &Blob) -> Unusable {
        let path = self.path(Map::Blobs, &blob.digest);
        let _ = fs::remove_file(&path);
        Unusable { path, why: NOT_ITS_DIGEST.to_owned() }
    }

    /// Puts an entry in its place, in one step.
    pub fn write(&self, map: Map, digest: &[u8; 32], bytes: &[u8]) -> io::Result<()> {
        self.write_with(map, digest, bytes.len() as u64, |file| file.write_all(bytes))
    }

    /// The same with what is in a file.
    pub fn write_file(&self, map: Map, digest: &[u8; 32], mut from: File) -> io::Result<()> {
        self.write_with(map, digest, from.metadata()?.len(), |file| io::copy(&mut from, file).map(drop))
    }

    fn write_with(
        &self,
        map: Map,
        digest: &[u8; 32],
        bytes: u64,
        fill: impl FnOnce(&mut File) -> io::Result<()>,
    ) -> io::Result<()> {
        let path = self.path(map, digest);
        // A blob is what its name says, or it is found out and removed when it is read.
        if map == Map::Blobs && fs::metadata(&path).is_ok_and(|m| m.len() == bytes) {
            return Ok(());
        }
        fs::create_dir_all(path.parent().unwrap_or(&self.root))?;
        let mut file = tempfile::NamedTempFile::new_in(crate::atomic_file::of_any_length(&self.aside()))?;
        fill(file.as_file_mut())?;
        file.as_file().sync_all()?;
        // Others may share the store.
        crate::atomic_file::make_readable(file.as_file())?;
        Ok(crate::atomic_file::replace(file, &path)?)
    }
}

fn note_use(path: &Path, metadata: &fs::Metadata) {
    let now = SystemTime::now();
    let noted = metadata.modified().ok().and_then(|then| now.duration_since(then).ok());
    if noted.is_some_and(|age| age > USE_NOTED) {
        // A store that can only be read is as good.
        let _ = open_to_set_times(path).and_then(|file| file.set_modified(now));
    }
}

/// Opens a file to set its times. Windows asks for a right of its own, which opening to read does not give, and grants it
/// whoever has the file open.
fn open_to_set_times(path: &Path) -> io::Result<File> {
    let mut options = File::options();
    options.read(true);
    #[cfg(windows)]
    {
        use std::os::windows::fs::OpenOptionsExt;
        use windows_sys::Win32::Storage::FileSystem::FILE_WRITE_ATTRIBUTES;
        options.access_mode(FILE_WRITE_ATTRIBUTES);
    }
    options.open(path)
}
