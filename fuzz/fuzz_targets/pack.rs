//! Any bytes as a pack, as they are and with digests that hold.

#![no_main]

#[path = "../common/entry.rs"]
#[allow(dead_code)] // The other target's entry.
mod entry;
#[path = "../common/reseal.rs"]
mod reseal;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let mut sealed = bytes.to_vec();
    entry::pack(bytes.to_vec());
    reseal::reseal(&mut sealed);
    entry::pack(sealed);
});
