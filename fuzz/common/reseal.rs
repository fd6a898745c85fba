//! Makes the digests of a damaged pack anew, as one who forges a pack would.

use std::mem::offset_of;

use volpack::pack::layout::{Chunk, Header, Section};

const HEADER: usize = size_of::<Header>();
const SECTION: usize = size_of::<Section>();
const CHUNK: usize = size_of::<Chunk>();
const DIGEST: usize = 32;

/// Recomputes the length in the header and every digest, as far as the tables lie inside the bytes.
/// Nothing else is made right.
pub fn reseal(bytes: &mut [u8]) {
    if bytes.len() < HEADER {
        return;
    }
    let len = bytes.len() as u64;
    bytes[offset_of!(Header, file_bytes)..][..8].copy_from_slice(&len.to_le_bytes());

    let sections = u32_at(bytes, offset_of!(Header, sections)) as usize;
    let chunks = u32_at(bytes, offset_of!(Header, chunks)) as usize;
    let chunks_at = HEADER + sections * SECTION;
    let end = chunks_at + chunks * CHUNK;
    if end > bytes.len() {
        return;
    }
    for entry in (chunks_at..end).step_by(CHUNK) {
        let offset = u64_at(bytes, entry + offset_of!(Chunk, offset)) as usize;
        let stored = u32_at(bytes, entry + offset_of!(Chunk, stored_bytes)) as usize;
        let payload = offset.checked_add(stored).and_then(|end| bytes.get(offset..end));
        if let Some(digest) = payload.map(blake3::hash) {
            put(bytes, entry + offset_of!(Chunk, digest), &digest);
        }
    }
    for entry in (HEADER..chunks_at).step_by(SECTION) {
        let first = u32_at(bytes, entry + offset_of!(Section, first_chunk)) as usize;
        let count = u32_at(bytes, entry + offset_of!(Section, chunks)) as usize;
        let table = &bytes[chunks_at..end];
        if let Some(digest) = table.get(first * CHUNK..(first + count) * CHUNK).map(blake3::hash) {
            put(bytes, entry + offset_of!(Section, digest), &digest);
        }
    }
    let at = offset_of!(Header, digest);
    bytes[at..at + DIGEST].fill(0);
    let digest = blake3::hash(&bytes[..end]);
    put(bytes, at, &digest);
}

fn put(bytes: &mut [u8], at: usize, digest: &blake3::Hash) {
    bytes[at..at + DIGEST].copy_from_slice(digest.as_bytes());
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(*bytes[at..].first_chunk().expect("inside the tables"))
}

fn u64_at(bytes: &[u8], at: usize) -> u64 {
    u64::from_le_bytes(*bytes[at..].first_chunk().expect("inside the tables"))
}
