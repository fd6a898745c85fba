//! Lists that come in pieces.

use std::ops::Index;

/// A list as several threads made it: in pieces of any length, which are never moved together. A frame's voxels as one
/// array would be a megabyte or more that comes and goes with each frame.
#[derive(Clone)]
pub struct Blocks<T> {
    blocks: Vec<Vec<T>>,
    /// How many entries there are before each.
    firsts: Vec<u32>,
}

impl<T> From<Vec<Vec<T>>> for Blocks<T> {
    fn from(blocks: Vec<Vec<T>>) -> Self {
        let mut next = 0;
        let first = |block: &Vec<T>| {
            let first = next;
            next += block.len() as u32;
            first
        };
        let firsts = blocks.iter().map(first).collect();
        Self { blocks, firsts }
    }
}

impl<T> Blocks<T> {
    /// The pieces.
    pub fn blocks_mut(&mut self) -> &mut [Vec<T>] {
        &mut self.blocks
    }

    /// The entry at a place.
    pub fn get(&self, place: u32) -> Option<&T> {
        // Pieces without an entry begin where the next one does.
        let block = self.firsts.partition_point(|first| *first <= place).checked_sub(1)?;
        self.blocks[block].get((place - self.firsts[block]) as usize)
    }

    /// All of them, in order.
    pub fn iter(&self) -> impl Iterator<Item = &T> {
        self.blocks.iter().flatten()
    }

    /// The same, to change them.
    pub fn iter_mut(&mut self) -> impl Iterator<Item = &mut T> {
        self.blocks.iter_mut().flatten()
    }
}

impl<T> Index<u32> for Blocks<T> {
    type Output = T;

    fn index(&self, place: u32) -> &T {
        self.get(place).expect("the list is that long")
    }
}

impl<T> IntoIterator for Blocks<T> {
    type Item = T;
    type IntoIter = std::iter::Flatten<std::vec::IntoIter<Vec<T>>>;

    fn into_iter(self) -> Self::IntoIter {
        self.blocks.into_iter().flatten()
    }
}
