//! Checks a pack on every core.

use rayon::prelude::*;

use super::{Pack, PackError};

/// [`Pack::check_chunks`] on the current rayon pool.
///
/// # Errors
/// A chunk that is damaged.
pub fn check_chunks(pack: &Pack) -> Result<(), PackError> {
    (0..pack.chunk_count()).into_par_iter().try_for_each(|chunk| pack.check_chunk(chunk))
}
