//! Cancelling long work: it ends at its next step as it does after an error, so that nothing half-made is left behind
//! and what was done stays in the cache.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Work was cancelled by whoever asked for it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("interrupted: output files were not changed; the next build continues from the cache")]
pub struct Cancelled;

/// Tells work to end. Clones share one state: a caller keeps one and gives the work another.
#[derive(Clone, Debug, Default)]
pub struct CancelToken(Arc<AtomicBool>);

impl CancelToken {
    /// Asks the work to end. Whether it had been asked before.
    pub fn cancel(&self) -> bool {
        self.0.swap(true, Ordering::Relaxed)
    }

    /// Whether the work is to end.
    pub fn is_cancelled(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }

    /// For the steps of long work.
    ///
    /// # Errors
    /// [`Cancelled`] when the work is to end.
    pub fn check(&self) -> Result<(), Cancelled> {
        if self.is_cancelled() { Err(Cancelled) } else { Ok(()) }
    }
}
