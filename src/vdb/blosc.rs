//! Decoder of Blosc 1 containers.
//!
//! OpenVDB writes LZ4 with byte shuffle and reads whatever the C library reads: every codec and shuffle of it is read here too,
//! but for BloscLZ, which has no implementation apart from that library. Written against c-blosc's `README_HEADER.rst`
//! and `blosc.c`. Every header field is checked: the C library trusts some of them and can be led to overflow the heap.

use super::codec::{Codec, Decompressors};
use super::{Result, VdbError};

const HEADER: usize = 16;
/// The container format's version (c-blosc `BLOSC_VERSION_FORMAT`), and that of each codec's streams in it.
const FORMAT: u8 = 2;
const CODEC_FORMAT: u8 = 1;
/// Streams shorter than this are not split by byte plane (c-blosc `MIN_BUFFERSIZE`).
const MIN_SPLIT: usize = 128;
/// Types wider than this are not split (c-blosc `MAX_SPLITS`).
const MAX_SPLITS: usize = 16;
/// OpenVDB pads what it compresses to this many bytes (`BLOSC_PAD_BYTES` in `io/Compression.cc`), so
/// a short buffer may unpack to more than was asked for.
const OPENVDB_PAD: usize = 128;

const FLAG_SHUFFLE: u8 = 0x01;
const FLAG_STORED: u8 = 0x02;
const FLAG_BIT_SHUFFLE: u8 = 0x04;
const FLAG_LATER_FORMAT: u8 = 0x08;
const FLAG_DONT_SPLIT: u8 = 0x10;

/// Buffers that are kept between calls, so that a leaf costs no allocation.
#[derive(Default)]
pub(super) struct BloscBuffers {
    whole: Vec<u8>,
    shuffled: Vec<u8>,
}

/// Unpacks the container at byte `at` of the file into `out`, whose length is what the caller expects.
pub(super) fn decompress(
    at: u64,
    src: &[u8],
    out: &mut [u8],
    buffers: &mut BloscBuffers,
    decompressors: &mut Decompressors,
) -> Result<()> {
    let damaged = |what: String| Err(VdbError::corrupt(at, what));
    let Some(header) = src.first_chunk::<HEADER>() else {
        return damaged(format!("Blosc data of {} bytes has no header", src.len()));
    };
    let [format, codec_format, flags, type_size, ..] = *header;
    let type_size = usize::from(type_size).max(1);
    let field =
        |i: usize| u32::from_le_bytes(*header[i..].first_chunk().expect("inside the header")) as usize;
    let (raw_len, block_len, stored_len) = (field(4), field(8), field(12));

    if format != FORMAT || flags & FLAG_LATER_FORMAT != 0 {
        return Err(VdbError::Unsupported(format!(
            "byte {at}: a Blosc container of format {format}, and OpenVDB writes and reads format {FORMAT}"
        )));
    }
    if stored_len > src.len() {
        return damaged(format!("the Blosc header claims {stored_len} of {} bytes", src.len()));
    }
    let src = &src[..stored_len];
    if raw_len != out.len() && !(out.len() < OPENVDB_PAD && (out.len()..=OPENVDB_PAD).contains(&raw_len)) {
        return damaged(format!("Blosc data unpacks to {raw_len} bytes, not {}", out.len()));
    }
    if raw_len == 0 {
        return Ok(());
    }
    if flags & FLAG_STORED != 0 {
        let Some(raw) = src.get(HEADER..HEADER + out.len()) else {
            return damaged("Blosc's stored data is too short".to_owned());
        };
        out.copy_from_slice(raw);
        return Ok(());
    }
    let codec = codec(at, flags >> 5, codec_format)?;
    if block_len == 0 || block_len > raw_len {
        return damaged(format!("Blosc blocks of {block_len} in {raw_len} bytes"));
    }

    let BloscBuffers { whole, shuffled } = buffers;
    whole.resize(raw_len, 0);
    for (i, block) in whole.chunks_mut(block_len).enumerate() {
        let start = src
            .get(HEADER + 4 * i..)
            .and_then(|s| s.first_chunk())
            .map(|s| u32::from_le_bytes(*s) as usize)
            .filter(|&s| s >= HEADER && s <= src.len());
        let Some(start) = start else {
            return damaged("a Blosc block begins outside the data".to_owned());
        };
        let whole_block = block.len() == block_len;
        let splits = if flags & FLAG_DONT_SPLIT == 0
            && type_size <= MAX_SPLITS
            && block_len / type_size >= MIN_SPLIT
            && whole_block
        {
            type_size
        } else {
            1
        };
        let mut unpack = |out: &mut [u8]| {
            unpack_streams(codec, &src[start..], out, splits, decompressors)
                .map_err(|what| VdbError::corrupt(at, what))
        };
        if flags & FLAG_SHUFFLE != 0 && type_size > 1 {
            shuffled.resize(block.len(), 0);
            unpack(shuffled)?;
            unshuffle(shuffled, block, type_size);
        } else if flags & FLAG_BIT_SHUFFLE != 0 {
            shuffled.resize(block.len(), 0);
            unpack(shuffled)?;
            unshuffle_bits(shuffled, block, type_size);
        } else {
            unpack(block)?;
        }
    }
    out.copy_from_slice(&whole[..out.len()]);
    Ok(())
}

/// The codec that a header names.
fn codec(at: u64, number: u8, format: u8) -> Result<Codec> {
    let known = match number {
        0 => Err("codec BloscLZ".to_owned()),
        // LZ4HC too: it has LZ4's format.
        1 => Ok(Codec::Lz4),
        2 => Ok(Codec::Snappy),
        3 => Ok(Codec::Zlib),
        4 => Ok(Codec::Zstd),
        other => Err(format!("codec {other}")),
    };
    let known = match known {
        Ok(codec) if format != CODEC_FORMAT => Err(format!("codec {codec:?} in format {format}")),
        known => known,
    };
    known.map_err(|what| {
        VdbError::Unsupported(format!(
            "byte {at}: it is compressed with Blosc's {what}, which volpack does not read: \
             write the file with OpenVDB, which takes LZ4"
        ))
    })
}

fn unpack_streams(
    codec: Codec,
    mut src: &[u8],
    out: &mut [u8],
    splits: usize,
    decompressors: &mut Decompressors,
) -> std::result::Result<(), String> {
    if !out.len().is_multiple_of(splits) {
        return Err("a Blosc block is not a whole number of values".to_owned());
    }
    for stream in out.chunks_mut(out.len() / splits) {
        let (len, rest) = src.split_first_chunk().ok_or("a Blosc stream has no length")?;
        let len = u32::from_le_bytes(*len) as usize;
        let packed = rest.get(..len).ok_or("a Blosc stream is longer than the data")?;
        src = &rest[len..];
        if len == stream.len() {
            stream.copy_from_slice(packed);
        } else {
            codec.decompress(packed, stream, decompressors)?;
        }
    }
    Ok(())
}

/// Gathers bit plane after bit plane back into values. A block whose values are not a multiple of eight is not shuffled.
fn unshuffle_bits(src: &[u8], out: &mut [u8], type_size: usize) {
    let count = src.len() / type_size;
    if !count.is_multiple_of(8) {
        return out.copy_from_slice(src);
    }
    let (shuffled, rest) = src.split_at(count * type_size);
    let (values, out_rest) = out.split_at_mut(shuffled.len());
    values.fill(0);
    // A plane has one bit of every value, the first value's lowest.
    for (plane, bits) in shuffled.chunks_exact((count / 8).max(1)).enumerate() {
        for (i, value) in values.chunks_exact_mut(type_size).enumerate() {
            value[plane / 8] |= (bits[i / 8] >> (i % 8) & 1) << (plane % 8);
        }
    }
    out_rest.copy_from_slice(rest);
}

/// Gathers byte plane after byte plane back into values; bytes past the last whole value are not
/// shuffled.
fn unshuffle(src: &[u8], out: &mut [u8], type_size: usize) {
    let count = src.len() / type_size;
    let whole = count * type_size;
    match type_size {
        2 => {
            let (lo, hi) = src[..whole].split_at(count);
            for ((o, &a), &b) in out[..whole].as_chunks_mut::<2>().0.iter_mut().zip(lo).zip(hi) {
                *o = [a, b];
            }
        }
        4 => {
            let (ab, cd) = src[..whole].split_at(2 * count);
            let ((a, b), (c, d)) = (ab.split_at(count), cd.split_at(count));
            for (i, o) in out[..whole].as_chunks_mut::<4>().0.iter_mut().enumerate() {
                *o = [a[i], b[i], c[i], d[i]];
            }
        }
        _ => {
            for (i, o) in out[..whole].chunks_exact_mut(type_size).enumerate() {
                for (plane, byte) in o.iter_mut().enumerate() {
                    *byte = src[plane * count + i];
                }
            }
        }
    }
    out[whole..].copy_from_slice(&src[whole..]);
}
