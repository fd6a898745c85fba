//! Records of one size in an unnamed temporary file: what a sequence has too much of to keep in memory.

use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use bytemuck::Pod;

/// Bytes that are written or read at a time. More than what a call to the system costs, and little enough to stay in
/// a core's own cache between file and use.
const BLOCK: usize = 128 << 10;

/// Bytes between two records that are read through rather than skipped: a call to the system costs about as much.
const GAP: u64 = 16 << 10;

/// Small records are in memory while they are no more than this: those of some thousand bricks, which is a sequence of a
/// second.
pub const SCRATCH_SMALL: usize = 256 << 10;

/// A spill file that could not be made, written or read back.
#[derive(Debug, thiserror::Error)]
#[error("{}: {source}", folder.display())]
pub struct ScratchError {
    /// The folder of the file, which has no name.
    pub folder: PathBuf,
    /// Why.
    pub source: io::Error,
}

/// `Result` with a [`ScratchError`].
pub type ScratchResult<T> = Result<T, ScratchError>;

/// Where scratch files are made. They have no name, so that a process that is killed leaves none.
#[derive(Clone, Debug)]
pub struct ScratchFolder {
    folder: Arc<Path>,
    is_asked_for: bool,
}

impl Default for ScratchFolder {
    /// The system's folder for temporary files.
    fn default() -> Self {
        Self::asked_for(std::env::temp_dir())
    }
}

impl ScratchFolder {
    /// This one and no other.
    pub fn asked_for(folder: PathBuf) -> Self {
        Self { folder: folder.into(), is_asked_for: true }
    }

    /// This one, or the system's where nothing can be written to it.
    pub fn preferred(folder: PathBuf) -> Self {
        Self { folder: folder.into(), is_asked_for: false }
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.folder
    }

    fn file(&self) -> io::Result<File> {
        let file = tempfile::tempfile_in(&self.folder);
        if self.is_asked_for { file } else { file.or_else(|_| tempfile::tempfile()) }
    }
}

/// Records by their places, which may be filled in any order; one after another is the quickest.
pub struct Scratch {
    folder: ScratchFolder,
    record: usize,
    store: Store,
    /// Bytes that may be in memory.
    small: usize,
    /// Put, and not in the file yet.
    buffer: Vec<u8>,
    /// The place of the first of those.
    buffered: u32,
}

enum Store {
    /// While it is little.
    Memory(Vec<u8>),
    File(File),
}

impl Scratch {
    /// None yet, of that many bytes each. Until there are more than `small` bytes they stay in memory: a short sequence
    /// then needs no file for what is small.
    pub fn new(folder: &ScratchFolder, record: usize, small: usize) -> Self {
        Self {
            folder: folder.clone(),
            record,
            store: Store::Memory(Vec::new()),
            small,
            buffer: Vec::new(),
            buffered: 0,
        }
    }

    /// Bytes of each.
    pub fn record(&self) -> usize {
        self.record
    }

    /// Puts records at a place and those after it.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn put(&mut self, place: u32, records: &[u8]) -> ScratchResult<()> {
        debug_assert!(records.len().is_multiple_of(self.record));
        let record = self.record;
        let count = |bytes: &[u8]| (bytes.len() / record) as u32;
        if place != self.buffered + count(&self.buffer) || self.buffer.len() + records.len() > BLOCK {
            self.empty_buffer()?;
            self.buffered = place;
        }
        if records.len() >= BLOCK {
            self.buffered += count(records);
            return self.write(self.at(place), records);
        }
        self.buffer.extend_from_slice(records);
        Ok(())
    }

    /// Writes what was put, so that it can be read.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn flush(&mut self) -> ScratchResult<()> {
        self.empty_buffer()?;
        // There may be nothing more for long.
        self.buffer = Vec::new();
        Ok(())
    }

    fn empty_buffer(&mut self) -> ScratchResult<()> {
        let mut buffer = std::mem::take(&mut self.buffer);
        if !buffer.is_empty() {
            self.write(self.at(self.buffered), &buffer)?;
            self.buffered += (buffer.len() / self.record) as u32;
            buffer.clear();
        }
        self.buffer = buffer;
        Ok(())
    }

    fn write(&mut self, at: u64, bytes: &[u8]) -> ScratchResult<()> {
        let end = at as usize + bytes.len();
        if let Store::Memory(all) = &mut self.store {
            if end <= self.small {
                all.resize(all.len().max(end), 0);
                all[at as usize..end].copy_from_slice(bytes);
                return Ok(());
            }
            let moved = self.folder.file().and_then(|file| write_at(&file, all, 0).map(|()| file));
            let file = moved.map_err(self.failed())?;
            self.store = Store::File(file);
        }
        match &self.store {
            Store::File(file) => write_at(file, bytes, at).map_err(self.failed()),
            Store::Memory(_) => unreachable!("it is a file from now on"),
        }
    }

    fn load(&self, at: u64, bytes: &mut [u8]) -> ScratchResult<()> {
        match &self.store {
            Store::Memory(all) => {
                bytes.copy_from_slice(&all[at as usize..][..bytes.len()]);
                Ok(())
            }
            Store::File(file) => read_at(file, bytes, at).map_err(self.failed()),
        }
    }

    fn load_span(&self, places: &[u32], bytes: &mut Vec<u8>) -> ScratchResult<u64> {
        let first = self.at(places[0]);
        bytes.resize((self.at(places[places.len() - 1]) - first) as usize + self.record, 0);
        self.load(first, bytes)?;
        Ok(first)
    }

    /// Visits the records at some places, in that order. They must have been flushed. Any number of threads may read.
    ///
    /// # Errors
    /// When the file cannot be read back.
    pub fn read(&self, places: &[u32], mut visit: impl FnMut(&[u8])) -> ScratchResult<()> {
        let mut bytes = Vec::new();
        for places in together(self.record, places) {
            let first = self.load_span(places, &mut bytes)?;
            places.iter().for_each(|&p| visit(&bytes[(self.at(p) - first) as usize..][..self.record]));
        }
        Ok(())
    }

    /// The same, to change them.
    ///
    /// # Errors
    /// When the file cannot be read back or written.
    pub fn update(&mut self, places: &[u32], mut visit: impl FnMut(&mut [u8])) -> ScratchResult<()> {
        let mut bytes = Vec::new();
        for places in together(self.record, places) {
            let first = self.load_span(places, &mut bytes)?;
            places.iter().for_each(|&p| visit(&mut bytes[(self.at(p) - first) as usize..][..self.record]));
            self.write(first, &bytes)?;
        }
        Ok(())
    }

    /// The same for records that are values of one type.
    ///
    /// # Errors
    /// When the file cannot be read back.
    pub fn read_as<T: Pod>(&self, places: &[u32]) -> ScratchResult<Vec<T>> {
        let mut values = Vec::with_capacity(places.len());
        self.read(places, |record| values.push(bytemuck::pod_read_unaligned(record)))?;
        Ok(values)
    }

    /// One record as a value, whether it was flushed or not.
    ///
    /// # Errors
    /// When the file cannot be read back.
    pub fn get<T: Pod>(&self, place: u32) -> ScratchResult<T> {
        let mut value = T::zeroed();
        let record = bytemuck::bytes_of_mut(&mut value);
        let buffered = place.checked_sub(self.buffered).map(|i| i as usize * self.record);
        match buffered.and_then(|at| self.buffer.get(at..at + self.record)) {
            Some(bytes) => record.copy_from_slice(bytes),
            None => self.load(self.at(place), record)?,
        }
        Ok(value)
    }

    fn failed(&self) -> impl FnOnce(io::Error) -> ScratchError + use<> {
        let folder = self.folder.path().to_owned();
        move |source| ScratchError { folder, source }
    }

    fn at(&self, place: u32) -> u64 {
        u64::from(place) * self.record as u64
    }
}

/// Splits places into those that are read together.
fn together(record: usize, places: &[u32]) -> impl Iterator<Item = &[u32]> {
    let mut rest = places;
    std::iter::from_fn(move || {
        let first = *rest.first()?;
        let bytes = |from: u32, to: u32| u64::from(to - from) * record as u64;
        let is_near = |&(&a, &b): &(&u32, &u32)| {
            b > a && bytes(a, b) <= record as u64 + GAP && bytes(first, b) < BLOCK as u64
        };
        let near = rest.iter().zip(&rest[1..]).take_while(is_near).count();
        let (now, later) = rest.split_at(1 + near);
        rest = later;
        Some(now)
    })
}

#[cfg(unix)]
fn read_at(file: &File, bytes: &mut [u8], at: u64) -> io::Result<()> {
    std::os::unix::fs::FileExt::read_exact_at(file, bytes, at)
}

#[cfg(unix)]
fn write_at(file: &File, bytes: &[u8], at: u64) -> io::Result<()> {
    std::os::unix::fs::FileExt::write_all_at(file, bytes, at)
}

#[cfg(windows)]
fn write_at(mut file: &File, bytes: &[u8], at: u64) -> io::Result<()> {
    use std::io::{Seek, SeekFrom, Write};
    file.seek(SeekFrom::Start(at))?;
    file.write_all(bytes)
}

#[cfg(windows)]
fn read_at(file: &File, mut bytes: &mut [u8], mut at: u64) -> io::Result<()> {
    while !bytes.is_empty() {
        match std::os::windows::fs::FileExt::seek_read(file, bytes, at)? {
            0 => return Err(io::ErrorKind::UnexpectedEof.into()),
            read => {
                let rest = bytes;
                (bytes, at) = (&mut rest[read..], at + read as u64);
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn records_come_back_in_the_order_asked_for() {
        for small in [0, 100_000, 1 << 20] {
            records_come_back(Scratch::new(&ScratchFolder::default(), 8, small));
        }
    }

    fn records_come_back(mut scratch: Scratch) {
        for first in (0..50_000u64).step_by(100) {
            let records: Vec<u64> = (first..first + 100).collect();
            scratch.put(first as u32, bytemuck::cast_slice(&records)).unwrap();
        }
        scratch.put(7, bytemuck::bytes_of(&70u64)).unwrap();
        scratch.put(50_000, bytemuck::bytes_of(&50_000u64)).unwrap();
        scratch.flush().unwrap();
        let places: Vec<u32> = (0..50_001).step_by(3).chain([7, 50_000, 6, 6, 8]).collect();
        let expected: Vec<u64> = places.iter().map(|&p| if p == 7 { 70 } else { p.into() }).collect();
        assert_eq!(scratch.read_as::<u64>(&places).unwrap(), expected);
        scratch.put(50_001, bytemuck::bytes_of(&50_001u64)).unwrap();
        for place in [7, 8, 12_499, 50_000, 50_001] {
            assert_eq!(scratch.get::<u64>(place).unwrap(), if place == 7 { 70 } else { place.into() });
        }
        scratch.flush().unwrap();
        let changed = [3, 9, 12_499, 12_500, 12_501, 49_998];
        scratch.update(&changed, |record| record[0] ^= 1).unwrap();
        let changed = changed.map(|p| u64::from(p) ^ 1);
        assert_eq!(scratch.read_as::<u64>(&[3, 9, 12_499, 12_500, 12_501, 49_998]).unwrap(), changed);
        assert_eq!(scratch.read_as::<u64>(&[4, 12_502]).unwrap(), [4, 12_502]);
    }
}
