//! The unique bricks of a sequence: little of each in memory, the rest in scratch files.

use std::collections::HashMap;

use bytemuck::{Pod, Zeroable};
use hashbrown::HashTable;
use xxhash_rust::xxh3::{xxh3_64, xxh3_128};

use super::{BRICK_VOXELS, Brick, ChunkedVec, Mask512, SCRATCH_SMALL, Scratch, ScratchFolder, ScratchResult};

/// Bricks that are worked on before what was made of them is put away: enough batches of an encoder for every core.
pub const BRICKS_IN_FLIGHT: u32 = 4096;

/// Stores bricks so that equal ones are kept once, and gives them back by number.
///
/// A brick may be known before its values are: they are put in when someone has need of them. Memory is 4 bytes a
/// unique brick, and 15 to 20 more until [`BrickPool::seal`]; voxels, masks and digests are in scratch files.
pub struct BrickPool {
    by_digest: HashTable<u32>,
    /// The first bytes of each digest. The rest of it is looked at where these are the same.
    digest_starts: ChunkedVec<u64>,
    bricks: ChunkedVec<PlaceAndFlags>,
    masks_and_digests: Scratch,
    values: Scratch,
}

/// A digest is its own hash.
fn start_of(digest: &[u8; 32]) -> u64 {
    u64::from_ne_bytes(*digest.first_chunk().expect("a digest is 32 bytes"))
}

/// What is known of a brick in a word: its place among the bricks of the frame that had it first, of which no frame has
/// 2^30, and two flags.
#[derive(Clone, Copy)]
struct PlaceAndFlags(u32);

impl PlaceAndFlags {
    const KEEPS_MASK: u32 = 1 << 31;
    /// Whether its values were put in.
    const HAS_VALUES: u32 = 1 << 30;

    fn new(place: u32, keeps_mask: bool) -> Self {
        assert!(place < Self::HAS_VALUES, "a frame's bricks are fewer than 2^30");
        Self(place | if keeps_mask { Self::KEEPS_MASK } else { 0 })
    }

    fn place(self) -> u32 {
        self.0 & !(Self::KEEPS_MASK | Self::HAS_VALUES)
    }

    fn is(self, flag: u32) -> bool {
        self.0 & flag != 0
    }
}

/// What is asked of a brick together with its values.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
struct MaskAndDigest {
    active: Mask512,
    digest: [u8; 32],
}

fn hash(active: &Mask512) -> u64 {
    xxh3_64(bytemuck::bytes_of(active))
}

impl BrickPool {
    /// No bricks yet, whose scratch files will be in a folder.
    pub fn new(scratch: &ScratchFolder) -> Self {
        Self {
            by_digest: HashTable::new(),
            digest_starts: ChunkedVec::default(),
            bricks: ChunkedVec::default(),
            masks_and_digests: Scratch::new(scratch, size_of::<MaskAndDigest>(), SCRATCH_SMALL),
            values: Scratch::new(scratch, BRICK_VOXELS * 4, 0),
        }
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
    /// no BLAKE3 collision is known.
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
    ) -> ScratchResult<(u32, bool)> {
        if let Some((id, mut known)) = self.find(digest)? {
            // Without a kept mask bricks are one if their values are. The pool's counts as active what is
            // active in any of them.
            let union = known.active.union(active);
            if union != known.active {
                known.active = union;
                self.masks_and_digests.put(id, bytemuck::bytes_of(&known))?;
            }
            return Ok((id, false));
        }
        let (id, start) = (self.len(), start_of(digest));
        let starts = &self.digest_starts;
        self.by_digest.insert_unique(start, id, |id| starts[*id]);
        self.digest_starts.push(start);
        self.bricks.push(PlaceAndFlags::new(place, keeps_mask));
        self.masks_and_digests
            .put(id, bytemuck::bytes_of(&MaskAndDigest { active: *active, digest: *digest }))?;
        Ok((id, true))
    }

    fn find(&self, digest: &[u8; 32]) -> ScratchResult<Option<(u32, MaskAndDigest)>> {
        let start = start_of(digest);
        for &id in self.by_digest.iter_hash(start).filter(|id| self.digest_starts[**id] == start) {
            let known: MaskAndDigest = self.masks_and_digests.get(id)?;
            if known.digest == *digest {
                return Ok(Some((id, known)));
            }
        }
        Ok(None)
    }

    /// Forgets what only [`BrickPool::insert`] needs: there will be no more bricks.
    ///
    /// # Errors
    /// When the scratch file cannot be written.
    pub fn seal(&mut self) -> ScratchResult<()> {
        self.by_digest = HashTable::new();
        self.digest_starts = ChunkedVec::default();
        self.masks_and_digests.flush()?;
        self.values.flush()
    }

    /// Sees to it that the values that were put in can be read.
    ///
    /// # Errors
    /// When the scratch file cannot be written.
    pub fn flush(&mut self) -> ScratchResult<()> {
        self.values.flush()
    }

    /// The digests that some bricks were inserted with.
    ///
    /// # Errors
    /// When the scratch file cannot be read back.
    pub fn digests(&self, ids: &[u32]) -> ScratchResult<Vec<[u8; 32]>> {
        let known = self.masks_and_digests.read_as::<MaskAndDigest>(ids)?;
        Ok(known.into_iter().map(|known| known.digest).collect())
    }

    /// Whether a brick's mask is part of what it is.
    pub fn keeps_mask(&self, id: u32) -> bool {
        self.bricks[id].is(PlaceAndFlags::KEEPS_MASK)
    }

    /// The place of a brick among those of the frame that had it first.
    pub fn place(&self, id: u32) -> u32 {
        self.bricks[id].place()
    }

    /// For each of some bricks a hash of which voxels are active, in any of the bricks of the source that it stands for.
    ///
    /// # Errors
    /// When the scratch file cannot be read back.
    pub fn active_hashes(&self, ids: &[u32]) -> ScratchResult<Vec<u64>> {
        let known = self.masks_and_digests.read_as::<MaskAndDigest>(ids)?;
        Ok(known.iter().map(|known| hash(&known.active)).collect())
    }

    /// Whether a brick's values were put in.
    pub fn has_values(&self, id: u32) -> bool {
        self.bricks[id].is(PlaceAndFlags::HAS_VALUES)
    }

    /// Puts a brick's values in.
    ///
    /// # Errors
    /// When the scratch file cannot be written.
    pub fn put(&mut self, id: u32, values: &[f32; BRICK_VOXELS]) -> ScratchResult<()> {
        self.bricks[id].0 |= PlaceAndFlags::HAS_VALUES;
        self.values.put(id, bytemuck::bytes_of(values))
    }

    /// Some bricks, whose values are there.
    ///
    /// # Errors
    /// When the scratch file cannot be read back.
    pub fn read(&self, ids: &[u32]) -> ScratchResult<Vec<Brick>> {
        let mut out = Vec::with_capacity(ids.len());
        let known = self.masks_and_digests.read_as::<MaskAndDigest>(ids)?;
        let mut each = ids.iter().zip(known);
        self.values.read(ids, |values| {
            let (&id, known) = each.next().expect("each brick has a mask and values");
            let keeps_mask = self.bricks[id].is(PlaceAndFlags::KEEPS_MASK);
            out.push(Brick {
                values: bytemuck::pod_read_unaligned(values),
                active: known.active,
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
