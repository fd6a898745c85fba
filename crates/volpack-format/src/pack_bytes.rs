//! Where a pack's bytes are: in memory, in a mapped file, or behind a stream.

use std::borrow::Cow;
use std::io::{self, Read, Seek, SeekFrom};
use std::sync::{Mutex, PoisonError};

use crate::PackError;

/// What [`PackBytes::Stream`] needs of a stream.
pub(crate) trait ReadSeek: Read + Seek + Send {}
impl<T: Read + Seek + Send> ReadSeek for T {}

/// A pack's bytes.
pub(crate) enum PackBytes {
    /// All of them.
    Memory(Vec<u8>),
    /// The same, by the operating system.
    #[cfg(feature = "mmap")]
    Mapped(memmap2::Mmap),
    /// Whatever is asked for.
    Stream {
        /// Has a place that it reads at, so one reads at a time.
        stream: Mutex<Box<dyn ReadSeek>>,
        /// Its length when it was opened.
        len: u64,
    },
}

impl PackBytes {
    /// Maps a file.
    #[cfg(feature = "mmap")]
    #[allow(unsafe_code)]
    pub(crate) fn map(path: &std::path::Path) -> Result<Self, PackError> {
        let file = std::fs::File::open(path)?;
        // SAFETY: the map is only read. Another process that cuts the file short while it is mapped
        // can kill this one with SIGBUS; packs are replaced by renaming, never written in place.
        let map = unsafe { memmap2::Mmap::map(&file)? };
        Ok(Self::Mapped(map))
    }

    /// Reads from a stream, which begins where the pack does.
    pub(crate) fn stream(mut stream: impl Read + Seek + Send + 'static) -> Result<Self, PackError> {
        let len = stream.seek(SeekFrom::End(0))?;
        Ok(Self::Stream { stream: Mutex::new(Box::new(stream)), len })
    }

    /// How many there are.
    pub(crate) fn len(&self) -> u64 {
        match self {
            Self::Memory(bytes) => bytes.len() as u64,
            #[cfg(feature = "mmap")]
            Self::Mapped(map) => map.len() as u64,
            Self::Stream { len, .. } => *len,
        }
    }

    /// Whether they are the same each time they are read, and reading them costs nothing.
    pub(crate) fn is_in_memory(&self) -> bool {
        !matches!(self, Self::Stream { .. })
    }

    /// The `len` bytes from `offset` on.
    ///
    /// # Errors
    /// When they do not lie inside, or the stream fails.
    pub(crate) fn read(&self, offset: u64, len: u64) -> Result<Cow<'_, [u8]>, PackError> {
        match self {
            Self::Memory(bytes) => within(bytes, offset, len),
            #[cfg(feature = "mmap")]
            Self::Mapped(map) => within(map, offset, len),
            Self::Stream { stream, .. } => {
                // A panic inside a stream leaves nothing of ours half done: every read seeks first.
                let mut stream = stream.lock().unwrap_or_else(PoisonError::into_inner);
                stream.seek(SeekFrom::Start(offset))?;
                // It may be shorter than it said. What it does not have takes no memory.
                let mut bytes = Vec::with_capacity(len.min(1 << 20) as usize);
                stream.as_mut().take(len).read_to_end(&mut bytes)?;
                if (bytes.len() as u64) < len {
                    return Err(io::Error::from(io::ErrorKind::UnexpectedEof).into());
                }
                Ok(Cow::Owned(bytes))
            }
        }
    }
}

fn within(bytes: &[u8], offset: u64, len: u64) -> Result<Cow<'_, [u8]>, PackError> {
    let end = offset.checked_add(len).and_then(|end| usize::try_from(end).ok());
    let bytes = end.and_then(|end| bytes.get(usize::try_from(offset).ok()?..end));
    bytes.map(Cow::Borrowed).ok_or_else(|| io::Error::from(io::ErrorKind::UnexpectedEof).into())
}
