//! What stands for a remote where the feature is off: there is none.

use std::time::Duration;

use super::{Map, Policy, Wanted};

/// A remote that nobody has.
pub enum Remote {}

#[allow(missing_docs)] // As those of the remote that the feature has.
impl Remote {
    pub fn open(_: &str, _: Policy) -> Result<Self, String> {
        Err("this volpack was built without remote caches (feature \"remote\")".to_owned())
    }

    pub fn get_many(&self, _: Map, _: &[Wanted]) -> Vec<Option<Vec<u8>>> {
        match *self {}
    }

    pub fn distrust(&self, _: [u8; 32]) {
        match *self {}
    }

    pub fn is_written(&self) -> bool {
        match *self {}
    }

    pub fn put(&self, _: Map, _: [u8; 32], _: Vec<u8>) {
        match *self {}
    }

    pub fn waiting(&self) -> u64 {
        match *self {}
    }

    pub fn warnings(&self) -> Vec<String> {
        match *self {}
    }

    pub fn finish(&self, _: Duration, _: impl FnMut(u64) -> bool) -> Vec<String> {
        match *self {}
    }
}
