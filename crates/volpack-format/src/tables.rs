//! The header and the tables of a pack, checked against the file and each other.
//!
//! Numbers of rules are those of `docs/format.md`, "What a reader checks".

use bytemuck::Zeroable;
use bytemuck::allocation::pod_collect_to_vec;

use crate::PackError;
use crate::error::{corrupt, ensure};
use crate::layout::{ALIGNMENT, Chunk, Header, MAGIC, Section, VERSION, encoding, kind};
use crate::pack_bytes::PackBytes;

/// Rule 10: what one chunk may take in memory. Those that volpack writes have at most 256 KiB.
const MAX_CHUNK: u32 = 16 << 20;

/// Rule 14: what is decoded as a whole takes at most this much memory ...
const MAX_WHOLE: u64 = 256 << 20;
/// ... or this many times its bytes in the file. Trees shrink 2 to 10 times.
const MAX_EXPANSION: u64 = 512;

/// Rule 14: keeps a small file from taking all memory.
pub(crate) fn fits_memory(raw_bytes: u64, stored_bytes: u64) -> bool {
    raw_bytes <= MAX_WHOLE.max(stored_bytes.saturating_mul(MAX_EXPANSION))
}

/// BLAKE3 of the tables with the header's digest zero: what [`Header::digest`] has to be.
pub fn tables_digest(header: &Header, sections: &[Section], chunks: &[Chunk]) -> [u8; 32] {
    let header = Header { digest: [0; 32], ..*header };
    let mut hasher = blake3::Hasher::new();
    hasher.update(bytemuck::bytes_of(&header));
    hasher.update(bytemuck::cast_slice(sections));
    hasher.update(bytemuck::cast_slice(chunks));
    *hasher.finalize().as_bytes()
}

/// Reads header, sections and chunks and checks that they agree with the file and each other.
pub(crate) fn read_tables(source: &PackBytes) -> Result<(Vec<Section>, Vec<Chunk>), PackError> {
    let have = source.len();
    let first = source.read(0, have.min(size_of::<Header>() as u64))?;
    if !first.starts_with(&MAGIC) {
        return Err(PackError::NotPack); // Rule 1.
    }
    let cut = || PackError::Corrupt("the file ends inside its tables".to_owned());
    let mut header = Header::zeroed();
    let bytes = bytemuck::bytes_of_mut(&mut header);
    bytes.copy_from_slice(first.get(..bytes.len()).ok_or_else(cut)?);
    if header.major != VERSION {
        return Err(PackError::Version(header.major)); // Rule 2.
    }
    if header.file_bytes != have {
        return Err(PackError::Length { have, says: header.file_bytes }); // Rule 3.
    }
    let sections_bytes = u64::from(header.sections) * size_of::<Section>() as u64;
    let chunks_bytes = u64::from(header.chunks) * size_of::<Chunk>() as u64;
    let sections_end = size_of::<Header>() as u64 + sections_bytes;
    let tables_end = sections_end + chunks_bytes;
    if tables_end > have {
        return Err(cut()); // Rule 4.
    }
    let sections: Vec<Section> =
        pod_collect_to_vec(&source.read(size_of::<Header>() as u64, sections_bytes)?);
    let chunks: Vec<Chunk> = pod_collect_to_vec(&source.read(sections_end, chunks_bytes)?);
    if tables_digest(&header, &sections, &chunks) != header.digest {
        return Err(PackError::Digest { what: "the header".to_owned() }); // Rule 5.
    }
    let (mut next_chunk, mut at) = (0, tables_end);
    for section in &sections {
        at = check_section(section, &chunks, next_chunk, at, have)?;
        next_chunk += section.chunks as usize;
    }
    if next_chunk != chunks.len() {
        return corrupt("the chunk table has chunks of no section"); // Rule 6.
    }
    Ok((sections, chunks))
}

/// Checks the next section, whose first chunk is `next_chunk` and which begins at byte `at` or later. Returns where it
/// ends in a file of `have` bytes.
fn check_section(
    section: &Section,
    chunks: &[Chunk],
    next_chunk: usize,
    at: u64,
    have: u64,
) -> Result<u64, PackError> {
    let name = kind::name(section.kind);
    // Rule 6.
    let entries = chunks.get(section.chunk_range()).filter(|_| section.first_chunk as usize == next_chunk);
    let Some(entries) = entries else {
        return corrupt(format!("the {name} has chunks outside the chunk table"));
    };
    // Rule 7. That it begins inside also keeps every sum of an offset and a length below from wrapping.
    ensure(section.offset.is_multiple_of(ALIGNMENT), || {
        format!("the {name} does not begin at a multiple of {ALIGNMENT}")
    })?;
    ensure(section.offset >= at, || format!("the {name} overlaps what is before it"))?;
    ensure(section.offset <= have, || format!("the {name} begins behind the end of the file"))?;
    if *blake3::hash(bytemuck::cast_slice(entries)).as_bytes() != section.digest {
        return Err(PackError::Digest { what: format!("the {name}'s chunk table") }); // Rule 8.
    }
    // Rule 9.
    ensure(section.encoding <= encoding::ZSTD_SHUFFLE_4 || !kind::is_known(section.kind), || {
        format!("the {name} has the unknown encoding {}", section.encoding)
    })?;
    // Rule 10.
    ensure((1..=MAX_CHUNK).contains(&section.chunk_bytes), || {
        format!("the {name} has chunks of {} bytes, not of 1 to {MAX_CHUNK}", section.chunk_bytes)
    })?;
    let (mut end, mut raw) = (section.offset, 0);
    for (i, chunk) in entries.iter().enumerate() {
        let least = if i + 1 == entries.len() { 1 } else { section.chunk_bytes };
        ensure((least..=section.chunk_bytes).contains(&chunk.raw_bytes), || {
            format!("chunk {i} of the {name} decodes to {} bytes", chunk.raw_bytes) // Rule 10.
        })?;
        // Rule 11. Chunks lie one behind another, so no bytes serve twice.
        let least = if section.encoding == encoding::RAW { chunk.raw_bytes } else { 0 };
        ensure(chunk.offset == end && (least..=chunk.raw_bytes).contains(&chunk.stored_bytes), || {
            format!("chunk {i} of the {name} does not lie where it should")
        })?;
        end += u64::from(chunk.stored_bytes);
        raw += u64::from(chunk.raw_bytes);
        ensure(end <= have, || format!("chunk {i} of the {name} ends behind the file"))?;
    }
    // Rule 12.
    ensure(raw == section.raw_bytes && end - section.offset == section.stored_bytes, || {
        format!("the {name} is not as long as its chunks")
    })?;
    Ok(end)
}
