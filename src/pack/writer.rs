//! Writes a pack beside its final place and renames it when it is whole.

use std::fs::File;
use std::io::{self, BufWriter, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use rayon::prelude::*;
use tempfile::NamedTempFile;
use volpack_format::tables_digest;

use crate::atomic_file::{
    FileError, LEFT_BEHIND, folder_of, is_temporary, make_readable, of_any_length, replace,
};

use super::layout::{ALIGNMENT, Chunk, Header, MAGIC, Section, VERSION, encoding};

/// A section that will be written: everything that is known before its bytes are.
#[derive(Clone, Copy, Debug)]
pub struct SectionSpec {
    /// One of [`super::layout::kind`].
    pub kind: u32,
    /// The codec tag of a texel section, else 0.
    pub codec: u32,
    /// One of [`encoding`].
    pub encoding: u32,
    /// Raw bytes of a chunk.
    pub chunk_bytes: u32,
    /// Raw bytes of the section.
    pub raw_bytes: u64,
}

/// A chunk as it will lie in the file.
pub struct StoredChunk {
    bytes: Vec<u8>,
    raw_bytes: u32,
    digest: [u8; 32],
}

/// Encodes one chunk. What does not shrink is stored raw. `level` is zstd's.
///
/// # Errors
/// When zstd fails, which it does for want of memory only.
pub fn compress_chunk(raw: Vec<u8>, encoding: u32, level: i32) -> io::Result<StoredChunk> {
    let raw_bytes = u32::try_from(raw.len()).expect("chunks are about 256 KiB");
    let bytes = if encoding == encoding::RAW {
        raw
    } else {
        let packed = match encoding::shuffle_width(encoding) {
            1 => zstd::bulk::compress(&raw, level)?,
            width => zstd::bulk::compress(&shuffle(&raw, width), level)?,
        };
        if packed.len() < raw.len() { packed } else { raw }
    };
    let digest = *blake3::hash(&bytes).as_bytes();
    Ok(StoredChunk { bytes, raw_bytes, digest })
}

/// Gathers the first bytes of all words, then the second bytes, and so on. Bytes past the last whole
/// word stay at the end.
pub(super) fn shuffle(raw: &[u8], width: usize) -> Vec<u8> {
    let words = raw.len() / width;
    let mut out = Vec::with_capacity(raw.len());
    for plane in 0..width {
        out.extend(raw[..words * width].iter().skip(plane).step_by(width));
    }
    out.extend(&raw[words * width..]);
    out
}

/// Writes sections one after another, in the order in which they were announced.
pub struct PackWriter {
    out: BufWriter<NamedTempFile>,
    path: PathBuf,
    specs: Vec<SectionSpec>,
    sections: Vec<Section>,
    chunks: Vec<Chunk>,
    chunk_total: usize,
    at: u64,
}

impl PackWriter {
    /// Begins a pack that will be at `path`. Nothing is there before [`PackWriter::finish`].
    ///
    /// # Errors
    /// When no file can be made beside `path`.
    pub fn create(path: &Path, specs: Vec<SectionSpec>) -> io::Result<Self> {
        let file = beside(path)?;
        let chunk_total = specs.iter().map(|s| s.raw_bytes.div_ceil(s.chunk_bytes.into()) as usize).sum();
        let tables =
            size_of::<Header>() + specs.len() * size_of::<Section>() + chunk_total * size_of::<Chunk>();
        let mut writer = Self {
            out: BufWriter::with_capacity(1 << 20, file),
            path: path.to_owned(),
            sections: Vec::with_capacity(specs.len()),
            specs,
            chunks: Vec::with_capacity(chunk_total),
            chunk_total,
            at: 0,
        };
        writer.zeros(tables as u64)?;
        Ok(writer)
    }

    fn zeros(&mut self, count: u64) -> io::Result<()> {
        io::copy(&mut io::Read::take(io::repeat(0), count), &mut self.out)?;
        self.at += count;
        Ok(())
    }

    /// Begins the next announced section. Its chunks follow.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn begin(&mut self) -> io::Result<()> {
        let spec = self.specs[self.sections.len()];
        self.zeros(self.at.next_multiple_of(ALIGNMENT) - self.at)?;
        self.sections.push(Section {
            kind: spec.kind,
            codec: spec.codec,
            encoding: spec.encoding,
            chunk_bytes: spec.chunk_bytes,
            first_chunk: self.chunks.len() as u32,
            chunks: 0,
            offset: self.at,
            stored_bytes: 0,
            raw_bytes: 0,
            digest: [0; 32],
        });
        Ok(())
    }

    /// Writes the next chunk of the section that was begun last.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn chunk(&mut self, chunk: &StoredChunk) -> io::Result<()> {
        let _span = crate::profile::span("write");
        self.out.write_all(&chunk.bytes)?;
        let stored = chunk.bytes.len() as u32;
        self.chunks.push(Chunk {
            offset: self.at,
            stored_bytes: stored,
            raw_bytes: chunk.raw_bytes,
            digest: chunk.digest,
        });
        self.at += u64::from(stored);
        let section = self.sections.last_mut().expect("a section was begun");
        section.chunks += 1;
        section.stored_bytes += u64::from(stored);
        section.raw_bytes += u64::from(chunk.raw_bytes);
        Ok(())
    }

    /// Writes the next announced section whole.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn section(&mut self, raw: &[u8], level: i32) -> io::Result<()> {
        self.begin()?;
        let chunk_bytes = self.specs[self.sections.len() - 1].chunk_bytes as usize;
        self.compressed(raw.chunks(chunk_bytes).map(<[u8]>::to_vec).collect(), level)
    }

    /// The same for words that `write` makes as they are written, and gives some at a time.
    ///
    /// # Errors
    /// When the file cannot be written, or `write` fails.
    pub fn words<E: From<io::Error>>(
        &mut self,
        level: i32,
        write: impl FnOnce(&mut dyn FnMut(&[u32]) -> io::Result<()>) -> Result<(), E>,
    ) -> Result<(), E> {
        self.begin()?;
        let chunk_bytes = self.specs[self.sections.len() - 1].chunk_bytes as usize;
        let mut chunks: Vec<Vec<u8>> = Vec::new();
        let mut left = 0;
        write(&mut |words| {
            let mut bytes: &[u8] = bytemuck::cast_slice(words);
            while !bytes.is_empty() {
                if left == 0 {
                    if chunks.len() == rayon::current_num_threads() {
                        self.compressed(std::mem::take(&mut chunks), level)?;
                    }
                    chunks.push(Vec::with_capacity(chunk_bytes));
                    left = chunk_bytes;
                }
                let (now, later) = bytes.split_at(left.min(bytes.len()));
                chunks.last_mut().expect("one was begun").extend_from_slice(now);
                left -= now.len();
                bytes = later;
            }
            Ok(())
        })?;
        Ok(self.compressed(chunks, level)?)
    }

    /// Writes the next chunks, which are encoded side by side.
    fn compressed(&mut self, chunks: Vec<Vec<u8>>, level: i32) -> io::Result<()> {
        let encoding = self.specs[self.sections.len() - 1].encoding;
        let stored = chunks.into_par_iter().map(|raw| compress_chunk(raw, encoding, level));
        stored.collect::<io::Result<Vec<_>>>()?.iter().try_for_each(|chunk| self.chunk(chunk))
    }

    /// Fills in the tables and syncs. The file is whole then, but not yet in its place.
    ///
    /// # Errors
    /// When the file cannot be written.
    ///
    /// # Panics
    /// When what was written is not what was announced.
    pub fn finish(mut self) -> io::Result<FinishedPack> {
        assert_eq!(self.sections.len(), self.specs.len(), "every announced section is written");
        assert_eq!(self.chunks.len(), self.chunk_total, "every announced chunk is written");
        for (section, spec) in self.sections.iter_mut().zip(&self.specs) {
            assert_eq!(section.raw_bytes, spec.raw_bytes, "section {} is as long as announced", spec.kind);
            let first = section.first_chunk as usize;
            let entries = &self.chunks[first..first + section.chunks as usize];
            section.digest = *blake3::hash(bytemuck::cast_slice(entries)).as_bytes();
        }
        let mut header = Header {
            magic: MAGIC,
            major: VERSION,
            minor: 0,
            sections: self.sections.len() as u32,
            chunks: self.chunks.len() as u32,
            reserved: 0,
            file_bytes: self.at,
            digest: [0; 32],
        };
        header.digest = tables_digest(&header, &self.sections, &self.chunks);

        self.out.seek(SeekFrom::Start(0))?;
        self.out.write_all(bytemuck::bytes_of(&header))?;
        self.out.write_all(bytemuck::cast_slice(&self.sections))?;
        self.out.write_all(bytemuck::cast_slice(&self.chunks))?;
        let file = self.out.into_inner().map_err(io::IntoInnerError::into_error)?;
        let _span = crate::profile::span("sync");
        file.as_file().sync_all()?;
        make_readable(file.as_file())?;
        Ok(FinishedPack { file, path: self.path })
    }
}

/// A new file in the folder of `path`, which is made if need be.
fn beside(path: &Path) -> io::Result<NamedTempFile> {
    let folder = folder_of(path);
    std::fs::create_dir_all(folder)?;
    remove_left_behind(folder);
    tempfile::Builder::new().prefix(PREFIX).tempfile_in(of_any_length(folder))
}

/// What the names of unfinished packs begin with.
const PREFIX: &str = ".volpack-";

fn remove_left_behind(folder: &Path) {
    let is_old = |entry: &std::fs::DirEntry| {
        let modified = entry.metadata().and_then(|m| m.modified()).ok();
        modified.and_then(|m| m.elapsed().ok()).is_some_and(|age| age > LEFT_BEHIND)
    };
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    for entry in entries.filter(|entry| is_temporary(&entry.path(), PREFIX) && is_old(entry)) {
        // Tidying up must not keep anyone from building.
        let _ = std::fs::remove_file(entry.path());
    }
}

/// A pack that is whole and lies beside its final place. It is gone if it is dropped.
pub struct FinishedPack {
    file: NamedTempFile,
    path: PathBuf,
}

impl FinishedPack {
    /// One that `fill` writes, which says whether it could.
    ///
    /// # Errors
    /// When no file can be made beside `path`, or `fill` fails.
    pub fn filled(path: &Path, fill: impl FnOnce(&mut File) -> io::Result<bool>) -> io::Result<Option<Self>> {
        let mut file = beside(path)?;
        if !fill(file.as_file_mut())? {
            return Ok(None);
        }
        file.as_file().sync_all()?;
        make_readable(file.as_file())?;
        Ok(Some(Self { file, path: path.to_owned() }))
    }

    /// Where it lies for now.
    pub fn path(&self) -> &Path {
        self.file.path()
    }

    /// Moves it to its place, in one step over whatever was there.
    ///
    /// # Errors
    /// When it cannot be renamed, such as over a pack that another program has open on Windows.
    pub fn persist(self) -> Result<(), FileError> {
        replace(self.file, &self.path)
    }
}
