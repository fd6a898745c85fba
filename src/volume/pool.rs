//! The unique bricks of a sequence: little of each in memory, the rest in scratch files.

use std::collections::HashMap;
use std::io;

use bytemuck::{Pod, Zeroable};
use hashbrown::HashTable;
use hashbrown::hash_table::Entry;
use xxhash_rust::xxh3::{xxh3_64, xxh3_128};

use super::{BRICK_VOXELS, Brick, List, Mask512, SCRATCH_HEAD, Scratch};

/// Bricks that are worked on before what was made of them is put away: enough batches of an encoder for every core.
pub const BRICKS_IN_FLIGHT: u32 = 4096;

/// Stores bricks so that equal ones are kept once, and gives them back by number.
///
/// A brick may be known before its values are: they are put in when someone has need of them. Memory is 6 bytes a
/// unique brick, and 30 to 40 more until [`BrickPool::seal`]; voxels, masks and digests are in scratch files.
pub struct BrickPool {
    by_digest: HashTable<u32>,
    digests: List<Key>,
    /// Hashes of the active masks.
    actives: List<u64>,
    /// The place of each among the bricks of the frame that had it first.
    places: List<u32>,
    flags: List<Flags>,
    facts: Scratch,
    values: Scratch,
}

/// Half of a digest tells bricks apart as well: nobody has ever found two texts of one either, and while frames are
/// added the table is the largest thing that grows with them.
type Key = [u8; 16];

/// A digest is its own hash.
fn start(key: &Key) -> u64 {
    u64::from_ne_bytes(*key.first_chunk().expect("a key is 16 bytes"))
}

#[derive(Clone, Copy)]
struct Flags {
    keeps_mask: bool,
    /// Whether its values were put in.
    is_there: bool,
}

/// What is asked of a brick together with its values.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
struct Facts {
    active: Mask512,
    digest: [u8; 32],
}

fn hash(active: &Mask512) -> u64 {
    xxh3_64(bytemuck::bytes_of(active))
}

impl Default for BrickPool {
    fn default() -> Self {
        Self {
            by_digest: HashTable::new(),
            digests: List::default(),
            actives: List::default(),
            places: List::default(),
            flags: List::default(),
            facts: Scratch::new(size_of::<Facts>(), SCRATCH_HEAD),
            values: Scratch::new(BRICK_VOXELS * 4, 0),
        }
    }
}

impl BrickPool {
    /// How many unique bricks there are.
    pub fn len(&self) -> u32 {
        self.places.len() as u32
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.places.is_empty()
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

    /// The number of the brick with this digest, and whether it is new. Its values are still to be put in. `place` is
    /// where it lies among the bricks of its frame.
    ///
    /// # Errors
    /// When the scratch file fails.
    pub fn insert(
        &mut self,
        digest: &[u8; 32],
        active: &Mask512,
        keeps_mask: bool,
        place: u32,
    ) -> io::Result<(u32, bool)> {
        let next = self.len();
        let key: Key = *digest.first_chunk().expect("a digest is 32 bytes");
        let digests = &self.digests;
        let known = |id: &u32| digests[*id] == key;
        let id = match self.by_digest.entry(start(&key), known, |id| start(&digests[*id])) {
            Entry::Occupied(known) => *known.get(),
            Entry::Vacant(place) => *place.insert(next).get(),
        };
        if id == next {
            self.digests.push(key);
            self.places.push(place);
            self.actives.push(hash(active));
            self.flags.push(Flags { keeps_mask, is_there: false });
            self.facts.put(id, bytemuck::bytes_of(&Facts { active: *active, digest: *digest }))?;
            return Ok((id, true));
        }
        // Without a kept mask bricks are one if their values are. The pool's counts as active what is
        // active in any of them.
        let known = &mut self.actives[id];
        if *known != hash(active) {
            self.facts.flush()?;
            let mut facts: Facts = self.facts.read_as(&[id])?[0];
            facts.active = facts.active.union(active);
            *known = hash(&facts.active);
            self.facts.put(id, bytemuck::bytes_of(&facts))?;
        }
        Ok((id, false))
    }

    /// Forgets what only [`BrickPool::insert`] needs: there will be no more bricks.
    ///
    /// # Errors
    /// When the scratch file cannot be written.
    pub fn seal(&mut self) -> io::Result<()> {
        self.by_digest = HashTable::new();
        self.digests = List::default();
        self.actives = List::default();
        self.facts.flush()?;
        self.values.flush()
    }

    /// Sees to it that the values that were put in can be read.
    ///
    /// # Errors
    /// When the scratch file cannot be written.
    pub fn flush(&mut self) -> io::Result<()> {
        self.values.flush()
    }

    /// The digests that some bricks were inserted with.
    ///
    /// # Errors
    /// When the scratch file cannot be read back.
    pub fn digests(&self, ids: &[u32]) -> io::Result<Vec<[u8; 32]>> {
        let facts = self.facts.read_as::<Facts>(ids)?;
        Ok(facts.into_iter().map(|facts| facts.digest).collect())
    }

    /// Whether a brick's mask is part of what it is.
    pub fn keeps_mask(&self, id: u32) -> bool {
        self.flags[id].keeps_mask
    }

    /// The place of a brick among those of the frame that had it first.
    pub fn place(&self, id: u32) -> u32 {
        self.places[id]
    }

    /// For each of some bricks a hash of which voxels are active, in any of the bricks of the source that it stands for.
    ///
    /// # Errors
    /// When the scratch file cannot be read back.
    pub fn active_hashes(&self, ids: &[u32]) -> io::Result<Vec<u64>> {
        let facts = self.facts.read_as::<Facts>(ids)?;
        Ok(facts.iter().map(|facts| hash(&facts.active)).collect())
    }

    /// Whether a brick's values were put in.
    pub fn is_there(&self, id: u32) -> bool {
        self.flags[id].is_there
    }

    /// Puts a brick's values in.
    ///
    /// # Errors
    /// When the scratch file cannot be written.
    pub fn put(&mut self, id: u32, values: &[f32; BRICK_VOXELS]) -> io::Result<()> {
        self.flags[id].is_there = true;
        self.values.put(id, bytemuck::bytes_of(values))
    }

    /// Some bricks, whose values are there.
    ///
    /// # Errors
    /// When the scratch file cannot be read back.
    pub fn read(&self, ids: &[u32]) -> io::Result<Vec<Brick>> {
        let mut out = Vec::with_capacity(ids.len());
        let facts = self.facts.read_as::<Facts>(ids)?;
        let mut each = ids.iter().zip(facts);
        self.values.read(ids, |values| {
            let (&id, facts) = each.next().expect("each brick has facts and values");
            let keeps_mask = self.flags[id].keeps_mask;
            out.push(Brick {
                values: bytemuck::pod_read_unaligned(values),
                active: facts.active,
                keeps_mask,
            });
        })?;
        Ok(out)
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

    /// Forgets what only [`Interner::intern`] needs: there will be no more runs.
    pub fn seal(&mut self) {
        self.by_hash = HashMap::new();
        self.items.shrink_to_fit();
    }

    /// Every run, one after another.
    pub fn items(&self) -> &[T] {
        &self.items
    }
}
