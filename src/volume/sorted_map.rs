//! A map for what few bricks of a sequence have.

/// A map from bricks to entries, sorted by brick: about eight bytes an entry, and nothing for bricks without one.
#[derive(Debug)]
pub struct SortedMap<T>(Vec<(u32, T)>);

impl<T> Default for SortedMap<T> {
    fn default() -> Self {
        Self(Vec::new())
    }
}

impl<T: Copy> SortedMap<T> {
    /// Adds the entry of a brick that comes after all that have one.
    ///
    /// # Panics
    /// When it does not.
    pub fn push(&mut self, brick: u32, entry: T) {
        assert!(self.0.last().is_none_or(|(last, _)| *last < brick), "bricks come in ascending order");
        self.0.push((brick, entry));
    }

    /// The entry of a brick, if it has one.
    pub fn get(&self, brick: u32) -> Option<T> {
        let place = self.0.binary_search_by_key(&brick, |(brick, _)| *brick).ok()?;
        Some(self.0[place].1)
    }
}
