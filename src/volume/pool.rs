//! The unique bricks of a sequence: small records in memory, values in a scratch file.

use std::collections::HashMap;
use std::fs::File;
use std::io::{self, BufWriter, Read, Seek, SeekFrom, Write};

use xxhash_rust::xxh3::{Xxh3Default, xxh3_128};

use super::{BRICK_VOXELS, Brick, Mask512};

/// Bytes of one brick in the scratch file: values, mask, and whether there is one.
const SCRATCH_BRICK_BYTES: usize = BRICK_VOXELS * 4 + 64 + 1;

/// Bricks that are read back at a time: 8 MB of voxels, enough batches of an encoder for every core.
pub const BRICKS_IN_FLIGHT: u32 = 4096;

/// Stores bricks so that equal ones are kept once, and gives them back by number.
///
/// Memory is about 50 bytes a unique brick; the 2 KB of voxels go to an unnamed temporary file.
pub struct BrickPool {
    by_hash: HashMap<u128, u32>,
    /// The active voxels of bricks of which the scratch file has only the first one's.
    widened: HashMap<u32, Mask512>,
    writer: BufWriter<File>,
    reader: File,
    len: u32,
    /// Bricks up to this number have reached the file and can be read back.
    flushed: u32,
}

impl BrickPool {
    /// An empty pool with its scratch file in the platform's temporary directory.
    ///
    /// # Errors
    /// When no temporary file can be made.
    pub fn new() -> io::Result<Self> {
        let file = tempfile::tempfile()?;
        let reader = file.try_clone()?;
        let writer = BufWriter::with_capacity(1 << 20, file);
        Ok(Self { by_hash: HashMap::new(), widened: HashMap::new(), writer, reader, len: 0, flushed: 0 })
    }

    /// How many unique bricks there are.
    pub fn len(&self) -> u32 {
        self.len
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// The hash that [`BrickPool::insert`] wants; separate so that it can be taken on many threads.
    pub fn hash(brick: &Brick) -> u128 {
        let mut hasher = Xxh3Default::new();
        hasher.update(bytemuck::bytes_of(&brick.values));
        if brick.keeps_mask {
            hasher.update(bytemuck::bytes_of(&brick.active));
        }
        hasher.digest128()
    }

    /// The number of this brick, and whether it is new.
    ///
    /// # Errors
    /// When the scratch file cannot be written or read back.
    pub fn insert(&mut self, hash: u128, brick: &Brick) -> io::Result<(u32, bool)> {
        if let Some(&id) = self.by_hash.get(&hash) {
            // Equal hashes are compared: a collision costs a second copy, never a wrong voxel.
            let known = self.get(id)?;
            if known.same_bits(brick) {
                if known.active != brick.active {
                    // Without a kept mask bricks are one if their values are. The pool's counts as
                    // active what is active in any of them.
                    self.widened.insert(id, known.active.union(&brick.active));
                }
                return Ok((id, false));
            }
        }
        let id = self.len;
        self.by_hash.entry(hash).or_insert(id);
        self.writer.write_all(bytemuck::bytes_of(&brick.values))?;
        self.writer.write_all(bytemuck::bytes_of(&brick.active))?;
        self.writer.write_all(&[u8::from(brick.keeps_mask)])?;
        self.len += 1;
        Ok((id, true))
    }

    fn get(&mut self, id: u32) -> io::Result<Brick> {
        let mut one = Vec::with_capacity(1);
        self.read(id..id + 1, &mut one)?;
        Ok(one.pop().expect("one brick was read"))
    }

    /// Appends the bricks of some numbers, ascending, to `out`.
    ///
    /// # Errors
    /// When the scratch file cannot be read back.
    pub fn read_each(&mut self, ids: &[u32], out: &mut Vec<Brick>) -> io::Result<()> {
        ids.chunk_by(|a, b| a + 1 == *b).try_for_each(|run| self.read(run[0]..run[0] + run.len() as u32, out))
    }

    /// Appends the bricks of a range of numbers to `out`.
    ///
    /// # Errors
    /// When the scratch file cannot be read back.
    pub fn read(&mut self, ids: std::ops::Range<u32>, out: &mut Vec<Brick>) -> io::Result<()> {
        if ids.end > self.flushed {
            self.writer.flush()?;
            self.flushed = self.len;
        }
        let mut bytes = vec![0; ids.len() * SCRATCH_BRICK_BYTES];
        // Reader and writer share one file position.
        self.reader.seek(SeekFrom::Start(u64::from(ids.start) * SCRATCH_BRICK_BYTES as u64))?;
        self.reader.read_exact(&mut bytes)?;
        self.reader.seek(SeekFrom::End(0))?;
        out.extend(bytes.chunks_exact(SCRATCH_BRICK_BYTES).zip(ids).map(|(b, id)| {
            let (values, rest) = b.split_at(BRICK_VOXELS * 4);
            let widened = self.widened.get(&id).copied();
            Brick {
                values: bytemuck::pod_read_unaligned(values),
                active: widened.unwrap_or_else(|| bytemuck::pod_read_unaligned(&rest[..64])),
                keeps_mask: rest[64] != 0,
            }
        }));
        Ok(())
    }
}

impl Brick {
    fn same_bits(&self, other: &Self) -> bool {
        bytemuck::bytes_of(&self.values) == bytemuck::bytes_of(&other.values)
            && self.keeps_mask == other.keeps_mask
            && (!self.keeps_mask || self.active == other.active)
    }
}

/// Keeps one copy of each run of values, in one growing array, and gives back where it lies.
pub struct Interner<T> {
    by_hash: HashMap<u128, u32>,
    items: Vec<T>,
}

impl<T> Default for Interner<T> {
    fn default() -> Self {
        Self { by_hash: HashMap::new(), items: Vec::new() }
    }
}

impl<T: bytemuck::Pod> Interner<T> {
    /// The place of the first element of `run` in [`Interner::items`].
    pub fn intern(&mut self, run: &[T]) -> u32 {
        let bytes: &[u8] = bytemuck::cast_slice(run);
        let hash = xxh3_128(bytes);
        if let Some(&at) = self.by_hash.get(&hash) {
            let known = self.items.get(at as usize..at as usize + run.len());
            if known.is_some_and(|k| bytemuck::cast_slice::<T, u8>(k) == bytes) {
                return at;
            }
        }
        let at = self.items.len() as u32;
        self.by_hash.entry(hash).or_insert(at);
        self.items.extend_from_slice(run);
        at
    }

    /// Every run, one after another.
    pub fn items(&self) -> &[T] {
        &self.items
    }
}
