//! The unique bricks of a sequence: small records in memory, values in a scratch file.

use std::collections::HashMap;
use std::fs::File;
use std::io::{self, BufWriter, Read, Seek, SeekFrom, Write};

use xxhash_rust::xxh3::xxh3_128;

use super::{BRICK_VOXELS, Brick, Mask512};

/// Bytes of one brick in the scratch file.
const SCRATCH_BRICK_BYTES: usize = BRICK_VOXELS * 4;

/// Bricks that are read back at a time: 8 MB of voxels, enough batches of an encoder for every core.
pub const BRICKS_IN_FLIGHT: u32 = 4096;

/// Where a brick comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Home {
    /// The frame that had it first, by its place among the frames that were added.
    pub frame: u32,
    /// Its place among that frame's bricks.
    pub brick: u32,
}

/// Stores bricks so that equal ones are kept once, and gives them back by number.
///
/// A brick may be known before its values are: they are put in when someone has need of them. Memory is about 160
/// bytes a unique brick; the 2 KB of voxels go to an unnamed temporary file.
pub struct BrickPool {
    by_hash: HashMap<[u8; 32], u32>,
    bricks: Vec<Known>,
    writer: BufWriter<File>,
    reader: File,
    /// Bricks in the scratch file.
    written: u32,
    /// Those of them that have reached it and can be read back.
    flushed: u32,
}

struct Known {
    active: Mask512,
    keeps_mask: bool,
    home: Home,
    /// Its place in the scratch file.
    slot: Option<u32>,
}

impl BrickPool {
    /// An empty pool with its scratch file in the platform's temporary directory.
    ///
    /// # Errors
    /// When no temporary file can be made.
    pub fn new() -> io::Result<Self> {
        let file = tempfile::tempfile()?;
        Ok(Self {
            by_hash: HashMap::new(),
            bricks: Vec::new(),
            reader: file.try_clone()?,
            writer: BufWriter::with_capacity(1 << 20, file),
            written: 0,
            flushed: 0,
        })
    }

    /// How many unique bricks there are.
    pub fn len(&self) -> u32 {
        self.bricks.len() as u32
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.bricks.is_empty()
    }

    /// BLAKE3 of what makes a brick: its values, and its mask where that is kept. Two bricks of one digest are one:
    /// nobody has ever found two texts of one.
    pub fn digest(brick: &Brick) -> [u8; 32] {
        let mut hasher = blake3::Hasher::new();
        hasher.update(bytemuck::bytes_of(&brick.values));
        if brick.keeps_mask {
            hasher.update(bytemuck::bytes_of(&brick.active));
        }
        hasher.finalize().into()
    }

    /// The number of the brick with this digest, and whether it is new. Its values are still to be put in.
    pub fn insert(
        &mut self,
        digest: &[u8; 32],
        active: &Mask512,
        keeps_mask: bool,
        home: Home,
    ) -> (u32, bool) {
        let next = self.bricks.len() as u32;
        let id = *self.by_hash.entry(*digest).or_insert(next);
        if id == next {
            self.bricks.push(Known { active: *active, keeps_mask, home, slot: None });
            return (id, true);
        }
        // Without a kept mask bricks are one if their values are. The pool's counts as active what is
        // active in any of them.
        let known = &mut self.bricks[id as usize];
        known.active = known.active.union(active);
        (id, false)
    }

    /// Whether a brick of the source is the one that this number stands for.
    pub fn is_digest_of(&self, id: u32, brick: &Brick) -> bool {
        let brick = Brick { keeps_mask: self.bricks[id as usize].keeps_mask, ..brick.clone() };
        self.by_hash.get(&Self::digest(&brick)) == Some(&id)
    }

    /// Where a brick comes from.
    pub fn home(&self, id: u32) -> Home {
        self.bricks[id as usize].home
    }

    /// Which voxels of a brick are active, in any of the bricks of the source that it stands for.
    pub fn active(&self, id: u32) -> &Mask512 {
        &self.bricks[id as usize].active
    }

    /// Whether a brick's values were put in.
    pub fn is_there(&self, id: u32) -> bool {
        self.bricks[id as usize].slot.is_some()
    }

    /// Puts a brick's values in.
    ///
    /// # Errors
    /// When the scratch file cannot be written.
    pub fn put(&mut self, id: u32, values: &[f32; BRICK_VOXELS]) -> io::Result<()> {
        self.writer.write_all(bytemuck::bytes_of(values))?;
        self.bricks[id as usize].slot = Some(self.written);
        self.written += 1;
        Ok(())
    }

    /// Appends some bricks, whose values are there, to `out`.
    ///
    /// # Errors
    /// When the scratch file cannot be read back.
    pub fn read(&mut self, ids: &[u32], out: &mut Vec<Brick>) -> io::Result<()> {
        if self.flushed < self.written {
            self.writer.flush()?;
            self.flushed = self.written;
        }
        let slot = |id: &u32| self.bricks[*id as usize].slot.expect("the brick's values were put in");
        let mut bytes = Vec::new();
        for run in ids.chunk_by(|a, b| slot(a) + 1 == slot(b)) {
            bytes.resize(run.len() * SCRATCH_BRICK_BYTES, 0);
            // Reader and writer share one file position.
            self.reader.seek(SeekFrom::Start(u64::from(slot(&run[0])) * SCRATCH_BRICK_BYTES as u64))?;
            self.reader.read_exact(&mut bytes)?;
            out.extend(bytes.chunks_exact(SCRATCH_BRICK_BYTES).zip(run).map(|(values, &id)| {
                let Known { active, keeps_mask, .. } = self.bricks[id as usize];
                Brick { values: bytemuck::pod_read_unaligned(values), active, keeps_mask }
            }));
        }
        self.reader.seek(SeekFrom::End(0)).map(drop)
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
