//! Turns a panic into a value that says where it was, without printing it.

use std::cell::Cell;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Mutex, Once, PoisonError};

static INSTALL: Once = Once::new();
/// What the last guarded panic said, and where.
static LAST: Mutex<String> = Mutex::new(String::new());

thread_local! {
    static GUARDED: Cell<bool> = const { Cell::new(false) };
}

/// Runs `f`; a panic in it, or in a rayon job of it, is an error with its message and place.
///
/// # Errors
/// When `f` panics.
pub fn guarded<R>(f: impl FnOnce() -> R) -> Result<R, String> {
    INSTALL.call_once(|| {
        let others = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |info| {
            // Rayon's threads have no names; those of tests, which shall print their panics, do.
            if GUARDED.get() || std::thread::current().name().is_none() {
                *LAST.lock().unwrap_or_else(PoisonError::into_inner) = info.to_string().replace('\n', " ");
            } else {
                others(info);
            }
        }));
    });
    GUARDED.set(true);
    let result = catch_unwind(AssertUnwindSafe(f));
    GUARDED.set(false);
    result.map_err(|_| LAST.lock().unwrap_or_else(PoisonError::into_inner).clone())
}
