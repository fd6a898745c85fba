//! Any bytes as an OpenVDB file.

#![no_main]

#[path = "../common/entry.rs"]
#[allow(dead_code)] // The other target's entry.
mod entry;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    entry::vdb(bytes.to_vec());
});
