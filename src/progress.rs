//! How long work tells its caller how it is getting on, and hears whether it is to end.

use crate::cancel::CancelToken;

/// Hears how a build is getting on, of what it cares for. Called from one thread at a time, not always the same.
pub trait Progress: Send {
    /// A stage begins, which has that many steps of that kind.
    fn stage(&mut self, _name: &'static str, _steps: u64, _unit: &'static str) {}
    /// That many more steps of the stage are done.
    fn advance(&mut self, _steps: u64) {}
    /// Something is odd but does not stop the build.
    fn warn(&mut self, _warning: &str) {}
    /// By what the caller may cancel the work. It is asked for once, when the work begins.
    fn cancel_token(&self) -> CancelToken {
        CancelToken::default()
    }
}

/// Progress that nobody hears of.
pub struct Silent;

impl Progress for Silent {}
