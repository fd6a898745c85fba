//! Ctrl-C: work ends at its next step as it does after an error, so that nothing half-made is left behind and what was
//! done is kept.

use std::io;
use std::sync::atomic::{AtomicBool, Ordering};

use crate::error::Error;

static REQUESTED: AtomicBool = AtomicBool::new(false);

/// Asks all work to end. The second time it ends at once.
pub fn request() {
    if REQUESTED.swap(true, Ordering::Relaxed) {
        std::process::exit(i32::from(Error::Interrupted.exit_code()));
    }
}

/// Whether work is to end.
pub fn is_requested() -> bool {
    REQUESTED.load(Ordering::Relaxed)
}

/// For the steps of long work.
///
/// # Errors
/// [`Error::Interrupted`], inside, when work is to end.
pub fn check() -> io::Result<()> {
    if is_requested() { Err(io::Error::other(Error::Interrupted)) } else { Ok(()) }
}
