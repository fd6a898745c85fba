//! Ctrl-C: cancels the work of this process.

use std::sync::LazyLock;

use crate::cancel::CancelToken;

/// That of everything this process does.
pub static TOKEN: LazyLock<CancelToken> = LazyLock::new(CancelToken::default);

/// From now on Ctrl-C and signals that ask a process to end cancel its work; the second one ends the process at once.
/// Commands that have nothing to lose do without, and end at once.
pub fn catch() {
    let token = TOKEN.clone();
    // Where signals cannot be caught they end the process, as they always did.
    let _ = ctrlc::set_handler(move || {
        if token.cancel() {
            std::process::exit(i32::from(super::exit_code::INTERRUPTED));
        }
    });
}
