//! How results lie in blobs: the one place that knows bincode (2.0.1, frozen: RUSTSEC-2025-0141).

use bincode::config::{self, Config};
use serde::Serialize;
use serde::de::DeserializeOwned;

/// Bytes that a result may have: the frame index of a frame of six million bricks. Larger things are files.
pub(super) const MOST: usize = 1 << 30;

fn config() -> impl Config {
    // Fixed integers, for speed: blobs are mostly texels anyway.
    config::standard().with_fixed_int_encoding().with_limit::<MOST>()
}

pub(super) fn encode<T: Serialize + ?Sized>(value: &T) -> Vec<u8> {
    bincode::serde::encode_to_vec(value, config())
        .expect("artefacts are plain data, and memory takes any of them")
}

/// `None` for bytes that are no such value. A length in them that is past [`MOST`] is one of the ways.
pub(super) fn decode<T: DeserializeOwned>(bytes: &[u8]) -> Option<T> {
    let (value, read) = bincode::serde::decode_from_slice(bytes, config()).ok()?;
    (read == bytes.len()).then_some(value)
}
