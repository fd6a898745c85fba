//! Records of one size in an unnamed temporary file: what a sequence has too much of to keep in memory.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom, Write};

use bytemuck::Pod;

/// Bytes that are written or read at a time. More than what a call to the system costs, and little enough to stay in
/// a core's own cache between file and use.
const BLOCK: usize = 128 << 10;

/// Bytes between two records that are read through rather than skipped: a call to the system costs about as much.
const GAP: u64 = 16 << 10;

/// Records by the order in which they were appended. The file is made with the first of them.
pub struct Scratch {
    record: usize,
    file: Option<File>,
    /// Appended, and not in the file yet.
    buffer: Vec<u8>,
    /// Records in the file.
    written: u32,
}

impl Scratch {
    /// None yet, of that many bytes each.
    pub fn new(record: usize) -> Self {
        Self { record, file: None, buffer: Vec::new(), written: 0 }
    }

    /// How many there are.
    pub fn len(&self) -> u32 {
        self.written + (self.buffer.len() / self.record) as u32
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Appends whole records.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn append(&mut self, records: &[u8]) -> io::Result<()> {
        debug_assert!(records.len().is_multiple_of(self.record));
        self.buffer.extend_from_slice(records);
        if self.buffer.len() >= BLOCK { self.flush() } else { Ok(()) }
    }

    /// Writes a record anew.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn replace(&mut self, place: u32, record: &[u8]) -> io::Result<()> {
        self.flush()?;
        let at = self.at(place);
        let mut file = self.file()?;
        file.seek(SeekFrom::Start(at))?;
        file.write_all(record)
    }

    /// Visits the records at some places, in that order.
    ///
    /// # Errors
    /// When the file cannot be read back.
    pub fn read(&mut self, places: &[u32], mut visit: impl FnMut(&[u8])) -> io::Result<()> {
        self.flush()?;
        let (at, record) = (|place: u32| u64::from(place) * self.record as u64, self.record as u64);
        let near = |a: &u32, b: &u32| b > a && at(*b) - at(*a) <= record + GAP;
        let mut bytes = Vec::new();
        for mut run in places.chunk_by(near) {
            while let Some(&first) = run.first() {
                let fits = |&&place: &&u32| at(place) - at(first) < BLOCK as u64;
                let (now, later) = run.split_at(run.iter().take_while(fits).count());
                bytes.resize((at(now[now.len() - 1]) - at(first) + record) as usize, 0);
                let mut file = self.file.as_ref().expect("places are of records that were appended");
                file.seek(SeekFrom::Start(at(first)))?;
                file.read_exact(&mut bytes)?;
                now.iter().for_each(|&p| visit(&bytes[(at(p) - at(first)) as usize..][..self.record]));
                run = later;
            }
        }
        Ok(())
    }

    /// The same for records that are values of one type.
    ///
    /// # Errors
    /// When the file cannot be read back.
    pub fn read_as<T: Pod>(&mut self, places: &[u32]) -> io::Result<Vec<T>> {
        let mut values = Vec::with_capacity(places.len());
        self.read(places, |record| values.push(bytemuck::pod_read_unaligned(record)))?;
        Ok(values)
    }

    fn at(&self, place: u32) -> u64 {
        u64::from(place) * self.record as u64
    }

    fn file(&mut self) -> io::Result<&File> {
        match &mut self.file {
            Some(file) => Ok(file),
            none => Ok(none.insert(tempfile::tempfile()?)),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        if self.buffer.is_empty() {
            return Ok(());
        }
        let at = self.at(self.written);
        let buffer = std::mem::take(&mut self.buffer);
        let mut file = self.file()?;
        file.seek(SeekFrom::Start(at))?;
        file.write_all(&buffer)?;
        self.written += (buffer.len() / self.record) as u32;
        self.buffer = buffer;
        self.buffer.clear();
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn records_come_back_in_the_order_asked_for() {
        let mut scratch = Scratch::new(8);
        for first in (0..50_000u64).step_by(100) {
            let records: Vec<u64> = (first..first + 100).collect();
            scratch.append(bytemuck::cast_slice(&records)).unwrap();
        }
        scratch.replace(7, bytemuck::bytes_of(&70u64)).unwrap();
        scratch.append(bytemuck::bytes_of(&50_000u64)).unwrap();
        assert_eq!(scratch.len(), 50_001);
        let places: Vec<u32> = (0..50_001).step_by(3).chain([7, 50_000, 6, 6, 8]).collect();
        let expected: Vec<u64> = places.iter().map(|&p| if p == 7 { 70 } else { p.into() }).collect();
        assert_eq!(scratch.read_as::<u64>(&places).unwrap(), expected);
    }
}
