//! The header and the tables of a pack, checked against the file and each other.

use std::ops::Range;

use bytemuck::Zeroable;
use bytemuck::allocation::pod_collect_to_vec;

use super::PackError;
use super::error::corrupt;
use super::layout::{Chunk, Header, MAGIC, Section, VERSION, encoding, kind};
use super::writer::tables_digest;

/// A chunk is about 256 KiB; one larger than this is damage.
const MAX_CHUNK: u32 = 16 << 20;

/// A section's chunks, by their places in the table.
pub(super) fn chunk_range(section: &Section) -> Range<usize> {
    section.first_chunk as usize..section.first_chunk as usize + section.chunks as usize
}

/// Reads header, sections and chunks and checks that they agree with the file and each other.
pub(super) fn read_tables(bytes: &[u8]) -> Result<(Vec<Section>, Vec<Chunk>), PackError> {
    if !bytes.starts_with(&MAGIC) {
        return Err(PackError::NotPack);
    }
    let mut header = Header::zeroed();
    let header_bytes = bytes.get(..size_of::<Header>());
    let cut = || PackError::Corrupt("the file ends inside its tables".to_owned());
    bytemuck::bytes_of_mut(&mut header).copy_from_slice(header_bytes.ok_or_else(cut)?);
    if header.major != VERSION {
        return Err(PackError::Version(header.major));
    }
    let have = bytes.len() as u64;
    if header.file_bytes != have {
        return Err(PackError::Length { have, says: header.file_bytes });
    }
    let sections_end = size_of::<Header>() + header.sections as usize * size_of::<Section>();
    let tables_end = sections_end as u64 + u64::from(header.chunks) * size_of::<Chunk>() as u64;
    if tables_end > have {
        return Err(cut());
    }
    let tables_end = tables_end as usize;
    let sections: Vec<Section> = pod_collect_to_vec(&bytes[size_of::<Header>()..sections_end]);
    let chunks: Vec<Chunk> = pod_collect_to_vec(&bytes[sections_end..tables_end]);
    if tables_digest(&header, &sections, &chunks) != header.digest {
        return Err(PackError::Digest { what: "the header".to_owned() });
    }

    let mut at = tables_end as u64;
    let mut next_chunk = 0u64;
    for section in &sections {
        let name = kind::name(section.kind);
        let first = u64::from(section.first_chunk);
        if first != next_chunk || first + u64::from(section.chunks) > chunks.len() as u64 {
            return corrupt(format!("the {name} has chunks outside the chunk table"));
        }
        next_chunk += u64::from(section.chunks);
        if section.offset < at || section.chunk_bytes == 0 || section.chunk_bytes > MAX_CHUNK {
            return corrupt(format!("the {name} overlaps what is before it"));
        }
        // Also keeps every sum of an offset and a length below from wrapping.
        if section.offset > have {
            return corrupt(format!("the {name} begins behind the end of the file"));
        }
        let entries = &chunks[chunk_range(section)];
        if *blake3::hash(bytemuck::cast_slice(entries)).as_bytes() != section.digest {
            return Err(PackError::Digest { what: format!("the {name}'s chunk table") });
        }
        if section.encoding > encoding::ZSTD_SHUFFLE_4 && section.kind <= kind::PROVENANCE {
            return corrupt(format!("the {name} has the unknown encoding {}", section.encoding));
        }
        // Chunks lie one behind another, so no bytes serve twice.
        at = section.offset;
        let mut raw = 0u64;
        for (i, chunk) in entries.iter().enumerate() {
            let last = i + 1 == entries.len();
            let size_fits = if last {
                (1..=section.chunk_bytes).contains(&chunk.raw_bytes)
            } else {
                chunk.raw_bytes == section.chunk_bytes
            };
            let stored_fits = if section.encoding == encoding::RAW {
                chunk.stored_bytes == chunk.raw_bytes
            } else {
                chunk.stored_bytes <= chunk.raw_bytes
            };
            if chunk.offset != at || !size_fits || !stored_fits {
                return corrupt(format!("chunk {i} of the {name} does not lie where it should"));
            }
            at += u64::from(chunk.stored_bytes);
            raw += u64::from(chunk.raw_bytes);
            if at > have {
                return corrupt(format!("chunk {i} of the {name} ends behind the file"));
            }
        }
        if raw != section.raw_bytes || at - section.offset != section.stored_bytes {
            return corrupt(format!("the {name} is not as long as its chunks"));
        }
    }
    Ok((sections, chunks))
}
