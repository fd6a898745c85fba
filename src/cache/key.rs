//! What a stage's result is found by.

use serde::Serialize;

use super::artefact;

/// The entries of one kind that a stage keeps.
#[derive(Clone, Copy, Debug)]
pub struct Namespace {
    /// Its name, at most 16 ASCII letters.
    pub name: &'static str,
    /// To be raised whenever the same inputs give another result, or the result another layout.
    pub version: u32,
    /// Whether its results go to a remote too.
    pub travels: bool,
}

/// BLAKE3 of a stage, its version and everything that its result depends on: no paths and no times.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Key {
    stage: &'static str,
    digest: [u8; 32],
    travels: bool,
}

impl Key {
    /// The key of a stage's result for some inputs.
    pub fn new(namespace: &Namespace, inputs: &(impl Serialize + ?Sized)) -> Self {
        let mut hasher = blake3::Hasher::new();
        for part in [namespace.name, env!("CARGO_PKG_VERSION")] {
            hasher.update(&(part.len() as u64).to_le_bytes()).update(part.as_bytes());
        }
        hasher.update(&namespace.version.to_le_bytes()).update(&artefact::encode(inputs));
        Self { stage: namespace.name, digest: hasher.finalize().into(), travels: namespace.travels }
    }

    /// Whether the result goes to a remote too.
    pub(super) fn travels(&self) -> bool {
        self.travels
    }

    /// The stage's name.
    pub fn stage(&self) -> &'static str {
        self.stage
    }

    /// The key itself; an input of stages that go on from this one's result.
    pub fn digest(&self) -> &[u8; 32] {
        &self.digest
    }
}
