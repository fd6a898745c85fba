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

/// Lists of plain data as they lie in memory: an element is not decoded by itself. For serde's `with`.
pub mod pods {
    use bytemuck::Pod;
    use serde::de::{Error, Visitor};
    use serde::{Deserializer, Serializer};

    /// Writes them as bytes.
    ///
    /// # Errors
    /// Those of the serialiser.
    pub fn serialize<T: Pod, S: Serializer>(list: &[T], serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_bytes(bytemuck::cast_slice(list))
    }

    /// Reads them back.
    ///
    /// # Errors
    /// Those of the deserialiser, and bytes that are no whole number of elements.
    pub fn deserialize<'de, T: Pod, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<T>, D::Error> {
        struct Bytes<T>(std::marker::PhantomData<T>);
        impl<T: Pod> Visitor<'_> for Bytes<T> {
            type Value = Vec<T>;
            fn expecting(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
                write!(f, "elements of {} bytes", size_of::<T>())
            }
            fn visit_bytes<E: Error>(self, bytes: &[u8]) -> Result<Vec<T>, E> {
                if !bytes.len().is_multiple_of(size_of::<T>()) {
                    return Err(E::invalid_length(bytes.len(), &self));
                }
                Ok(bytemuck::allocation::pod_collect_to_vec(bytes))
            }
        }
        deserializer.deserialize_bytes(Bytes(std::marker::PhantomData))
    }
}
