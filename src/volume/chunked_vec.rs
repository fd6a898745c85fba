//! An array that grows, or comes from several threads, without being moved.

use std::ops::{Index, IndexMut};

use rayon::iter::{IntoParallelRefMutIterator, ParallelIterator};

/// Entries of a chunk that [`ChunkedVec::push`] begins: 16 to 64 KiB of what is stored for a brick.
const CHUNK_LEN: usize = 4096;

/// An array in chunks, each an allocation of its own. A `Vec` reserves up to twice what it needs and moves its entries as
/// it grows; and to join a frame's voxels into one `Vec` would copy megabytes for every frame.
#[derive(Clone)]
pub struct ChunkedVec<T> {
    chunks: Vec<Vec<T>>,
    /// The place of each chunk's first entry. Empty if all chunks but the last have [`CHUNK_LEN`] entries: a division then
    /// finds an entry quicker than a search.
    firsts: Vec<u32>,
    len: usize,
}

impl<T> ChunkedVec<T> {
    /// Appends an entry.
    pub fn push(&mut self, entry: T) {
        match self.chunks.last_mut() {
            Some(last) if last.len() < CHUNK_LEN => last.push(entry),
            _ => {
                if !self.firsts.is_empty() {
                    self.firsts.push(self.len as u32);
                }
                let mut chunk = Vec::with_capacity(CHUNK_LEN);
                chunk.push(entry);
                self.chunks.push(chunk);
            }
        }
        self.len += 1;
    }

    /// The number of entries.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// The entry at `place`; `None` past the end.
    pub fn get(&self, place: u32) -> Option<&T> {
        let (chunk, offset) = self.locate(place);
        self.chunks.get(chunk)?.get(offset)
    }

    /// All entries, in order.
    pub fn iter(&self) -> impl Iterator<Item = &T> {
        self.chunks.iter().flatten()
    }

    /// All entries, in order, to change them.
    pub fn iter_mut(&mut self) -> impl Iterator<Item = &mut T> {
        self.chunks.iter_mut().flatten()
    }

    /// The chunk of an entry, and its place in the chunk.
    fn locate(&self, place: u32) -> (usize, usize) {
        if self.firsts.is_empty() {
            return (place as usize / CHUNK_LEN, place as usize % CHUNK_LEN);
        }
        // An empty chunk has the same first place as the next chunk, which is the one that is found.
        let chunk = self.firsts.partition_point(|first| *first <= place) - 1;
        (chunk, (place - self.firsts[chunk]) as usize)
    }
}

impl<T: Send> ChunkedVec<T> {
    /// All entries, in order, for several threads to change.
    pub fn par_iter_mut(&mut self) -> impl ParallelIterator<Item = &mut T> {
        self.chunks.par_iter_mut().flatten_iter()
    }
}

impl<T> Default for ChunkedVec<T> {
    fn default() -> Self {
        Self::from(Vec::new())
    }
}

impl<T> From<Vec<Vec<T>>> for ChunkedVec<T> {
    fn from(chunks: Vec<Vec<T>>) -> Self {
        let mut len = 0;
        let mut firsts = Vec::with_capacity(chunks.len());
        for chunk in &chunks {
            firsts.push(len as u32);
            len += chunk.len();
        }
        Self { chunks, firsts, len }
    }
}

impl<T> Index<u32> for ChunkedVec<T> {
    type Output = T;

    fn index(&self, place: u32) -> &T {
        let (chunk, offset) = self.locate(place);
        &self.chunks[chunk][offset]
    }
}

impl<T> IndexMut<u32> for ChunkedVec<T> {
    fn index_mut(&mut self, place: u32) -> &mut T {
        let (chunk, offset) = self.locate(place);
        &mut self.chunks[chunk][offset]
    }
}

impl<T> IntoIterator for ChunkedVec<T> {
    type Item = T;
    type IntoIter = std::iter::Flatten<std::vec::IntoIter<Vec<T>>>;

    fn into_iter(self) -> Self::IntoIter {
        self.chunks.into_iter().flatten()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn entries_are_found_in_chunks_of_any_length() {
        for lens in [vec![], vec![0], vec![0, 0, 3, 0, 1, 0], vec![2, CHUNK_LEN + 1, 0], vec![CHUNK_LEN, 1]] {
            let mut next = 0;
            let mut chunk = |len: &usize| {
                let first = next;
                next += *len as u32;
                (first..next).collect::<Vec<u32>>()
            };
            let mut array = ChunkedVec::from(lens.iter().map(&mut chunk).collect::<Vec<_>>());
            // Past the end of the chunk that is begun, and of the one after it.
            let len = next + 2 * CHUNK_LEN as u32 + 1;
            (next..len).for_each(|entry| array.push(entry));

            assert_eq!(array.len(), len as usize, "{lens:?}");
            assert!(
                (0..len).all(|place| array[place] == place && array.get(place) == Some(&place)),
                "{lens:?}"
            );
            assert_eq!((array.get(len), array.get(u32::MAX)), (None, None), "{lens:?}");
            assert!(array.iter().copied().eq(0..len), "{lens:?}");
            array.par_iter_mut().for_each(|entry| *entry += 1);
            array[0] += 1;
            assert!(array.into_iter().eq([2].into_iter().chain(2..=len)), "{lens:?}");
        }
        assert!(ChunkedVec::<u8>::default().is_empty() && ChunkedVec::<u8>::default().get(0).is_none());
        assert!(ChunkedVec::<u8>::from(vec![vec![], vec![]]).is_empty());
    }

    #[test]
    fn chunks_stay_where_they_are() {
        let chunk = vec![7u8; 3];
        let address = chunk.as_ptr();
        let array = ChunkedVec::from(vec![vec![], chunk]);
        assert_eq!(&raw const array[0], address);

        let mut array = ChunkedVec::default();
        array.push(0u8);
        let address = &raw const array[0];
        (0..CHUNK_LEN).for_each(|_| array.push(0));
        assert_eq!(&raw const array[0], address);
    }
}
