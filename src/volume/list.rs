//! Lists that grow with a sequence.

use std::ops::{Index, IndexMut};

/// Entries of a block: 16 to 64 KiB of what is kept of a brick.
const BLOCK: usize = 4096;

/// A list with as many entries as a sequence has bricks, in blocks that stay where they are. An array that doubles
/// takes twice what it needs, and leaves a hole as large as it was.
pub struct List<T>(Vec<Vec<T>>);

impl<T> Default for List<T> {
    fn default() -> Self {
        Self(Vec::new())
    }
}

impl<T> List<T> {
    /// Appends an entry.
    pub fn push(&mut self, entry: T) {
        match self.0.last_mut() {
            Some(block) if block.len() < BLOCK => block.push(entry),
            _ => {
                let mut block = Vec::with_capacity(BLOCK);
                block.push(entry);
                self.0.push(block);
            }
        }
    }

    /// How many there are.
    pub fn len(&self) -> usize {
        self.0.last().map_or(0, |last| (self.0.len() - 1) * BLOCK + last.len())
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// All of them, in order.
    pub fn iter(&self) -> impl Iterator<Item = &T> {
        self.0.iter().flatten()
    }
}

impl<T> Index<u32> for List<T> {
    type Output = T;

    fn index(&self, place: u32) -> &T {
        &self.0[place as usize / BLOCK][place as usize % BLOCK]
    }
}

impl<T> IndexMut<u32> for List<T> {
    fn index_mut(&mut self, place: u32) -> &mut T {
        &mut self.0[place as usize / BLOCK][place as usize % BLOCK]
    }
}
