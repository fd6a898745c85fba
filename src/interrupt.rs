//! Ctrl-C: work ends at its next step as it does after an error, so that nothing half-made is left behind and what was
//! done is kept.

use std::sync::atomic::{AtomicBool, Ordering};

use crate::error::{Error, Result};

static REQUESTED: AtomicBool = AtomicBool::new(false);

/// From now on Ctrl-C and what asks a process to end ask its work to end. Commands that have nothing to lose do
/// without, and end at once.
pub fn catch() {
    // Where signals cannot be caught they end the process, as they always did.
    let _ = ctrlc::set_handler(request);
}

/// Asks all work to end. The second time it ends at once.
fn request() {
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
/// [`Error::Interrupted`] when work is to end.
pub fn check() -> Result<()> {
    if is_requested() { Err(Error::Interrupted) } else { Ok(()) }
}
