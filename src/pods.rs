//! Lists of plain data as they lie in memory, for serde's `with`: an element is not decoded by itself.

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
