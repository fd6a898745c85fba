//! Records of one size in an unnamed temporary file: what a sequence has too much of to keep in memory.

use std::fs::File;
use std::io;

use bytemuck::Pod;

/// Bytes that are written or read at a time. More than what a call to the system costs, and little enough to stay in
/// a core's own cache between file and use.
const BLOCK: usize = 128 << 10;

/// Bytes between two records that are read through rather than skipped: a call to the system costs about as much.
const GAP: u64 = 16 << 10;

/// Records by their places, which may be filled in any order; one after another is the quickest. The file is made with
/// the first of them.
pub struct Scratch {
    record: usize,
    file: Option<File>,
    /// Put, and not in the file yet.
    buffer: Vec<u8>,
    /// The place of the first of those.
    buffered: u32,
}

impl Scratch {
    /// None yet, of that many bytes each.
    pub fn new(record: usize) -> Self {
        Self { record, file: None, buffer: Vec::new(), buffered: 0 }
    }

    /// Bytes of each.
    pub fn record(&self) -> usize {
        self.record
    }

    /// Puts records at a place and those after it.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn put(&mut self, place: u32, records: &[u8]) -> io::Result<()> {
        debug_assert!(records.len().is_multiple_of(self.record));
        let next = self.buffered as usize + self.buffer.len() / self.record;
        if place as usize != next {
            self.flush()?;
            self.buffered = place;
        }
        self.buffer.extend_from_slice(records);
        if self.buffer.len() >= BLOCK { self.flush() } else { Ok(()) }
    }

    /// Writes what was put, so that it can be read.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn flush(&mut self) -> io::Result<()> {
        let mut buffer = std::mem::take(&mut self.buffer);
        if !buffer.is_empty() {
            self.write(self.at(self.buffered), &buffer)?;
            self.buffered += (buffer.len() / self.record) as u32;
            buffer.clear();
            self.buffer = buffer;
        }
        Ok(())
    }

    fn write(&mut self, at: u64, bytes: &[u8]) -> io::Result<()> {
        let file = match &mut self.file {
            Some(file) => file,
            none => none.insert(tempfile::tempfile()?),
        };
        write_at(file, bytes, at)
    }

    /// Visits the records at some places, in that order. They must have been flushed. Any number of threads may read.
    ///
    /// # Errors
    /// When the file cannot be read back.
    pub fn read(&self, places: &[u32], mut visit: impl FnMut(&[u8])) -> io::Result<()> {
        let near = |a: &u32, b: &u32| b > a && self.at(*b) - self.at(*a) <= self.record as u64 + GAP;
        let mut bytes = Vec::new();
        for mut run in places.chunk_by(near) {
            while let Some(&first) = run.first() {
                let first = self.at(first);
                let fits = |&&place: &&u32| self.at(place) - first < BLOCK as u64;
                let (now, later) = run.split_at(run.iter().take_while(fits).count());
                bytes.resize((self.at(now[now.len() - 1]) - first) as usize + self.record, 0);
                let file = self.file.as_ref().expect("records are flushed before they are read");
                read_at(file, &mut bytes, first)?;
                now.iter().for_each(|&p| visit(&bytes[(self.at(p) - first) as usize..][..self.record]));
                run = later;
            }
        }
        Ok(())
    }

    /// The same for records that are values of one type.
    ///
    /// # Errors
    /// When the file cannot be read back.
    pub fn read_as<T: Pod>(&self, places: &[u32]) -> io::Result<Vec<T>> {
        let mut values = Vec::with_capacity(places.len());
        self.read(places, |record| values.push(bytemuck::pod_read_unaligned(record)))?;
        Ok(values)
    }

    fn at(&self, place: u32) -> u64 {
        u64::from(place) * self.record as u64
    }
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
        let mut scratch = Scratch::new(8);
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
    }
}
