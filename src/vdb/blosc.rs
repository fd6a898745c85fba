//! Decoder of Blosc 1 containers, as far as OpenVDB writes them: LZ4 with or without byte shuffle.
//!
//! Written against c-blosc's `README_HEADER.rst`. Every header field is checked: the C library
//! trusts some of them and can be led to overflow the heap.

use std::borrow::Cow;

const HEADER: usize = 16;
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
const FLAG_DONT_SPLIT: u8 = 0x10;

/// Buffers that are kept between calls, so that a leaf costs no allocation.
#[derive(Default)]
pub(super) struct Scratch {
    whole: Vec<u8>,
    shuffled: Vec<u8>,
}

/// Unpacks a container into `out`, whose length is what the caller expects.
pub(super) fn decompress(src: &[u8], out: &mut [u8], scratch: &mut Scratch) -> Result<(), Cow<'static, str>> {
    let header: &[u8; HEADER] =
        src.first_chunk().ok_or_else(|| format!("blosc data of {} bytes has no header", src.len()))?;
    let flags = header[2];
    let type_size = usize::from(header[3]).max(1);
    let field =
        |i: usize| u32::from_le_bytes(*header[i..].first_chunk().expect("inside the header")) as usize;
    let (raw_len, block_len, stored_len) = (field(4), field(8), field(12));

    if stored_len > src.len() {
        return Err(format!("blosc header claims {stored_len} of {} bytes", src.len()).into());
    }
    let src = &src[..stored_len];
    if raw_len != out.len() && !(out.len() < OPENVDB_PAD && (out.len()..=OPENVDB_PAD).contains(&raw_len)) {
        return Err(format!("blosc data unpacks to {raw_len} bytes, not {}", out.len()).into());
    }
    if raw_len == 0 {
        return Ok(());
    }
    if flags & FLAG_STORED != 0 {
        let raw = src.get(HEADER..HEADER + out.len()).ok_or("blosc's stored data is too short")?;
        out.copy_from_slice(raw);
        return Ok(());
    }
    if flags & FLAG_BIT_SHUFFLE != 0 {
        return Err("blosc bit shuffle, which OpenVDB does not write".into());
    }
    // Codec 1 is LZ4 and LZ4HC; OpenVDB asks for nothing else.
    if flags >> 5 != 1 {
        return Err(format!("blosc codec {}, where OpenVDB writes LZ4 (1)", flags >> 5).into());
    }
    if block_len == 0 || block_len > raw_len {
        return Err(format!("blosc block size {block_len} in {raw_len} bytes").into());
    }

    let Scratch { whole, shuffled } = scratch;
    whole.resize(raw_len, 0);
    for (i, block) in whole.chunks_mut(block_len).enumerate() {
        let start = src
            .get(HEADER + 4 * i..)
            .and_then(|s| s.first_chunk())
            .map(|s| u32::from_le_bytes(*s) as usize)
            .filter(|&s| s >= HEADER && s <= src.len())
            .ok_or("blosc block offset outside the data")?;
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
        if flags & FLAG_SHUFFLE != 0 && type_size > 1 {
            shuffled.resize(block.len(), 0);
            unpack_streams(&src[start..], shuffled, splits)?;
            unshuffle(shuffled, block, type_size);
        } else {
            unpack_streams(&src[start..], block, splits)?;
        }
    }
    out.copy_from_slice(&whole[..out.len()]);
    Ok(())
}

fn unpack_streams(mut src: &[u8], out: &mut [u8], splits: usize) -> Result<(), Cow<'static, str>> {
    if !out.len().is_multiple_of(splits) {
        return Err("blosc block is not a whole number of values".into());
    }
    for stream in out.chunks_mut(out.len() / splits) {
        let (len, rest) = src.split_first_chunk().ok_or("blosc stream without a length")?;
        let len = u32::from_le_bytes(*len) as usize;
        let packed = rest.get(..len).ok_or("blosc stream longer than the data")?;
        src = &rest[len..];
        if len == stream.len() {
            stream.copy_from_slice(packed);
        } else {
            match lz4_flex::block::decompress_into(packed, stream) {
                Ok(n) if n == stream.len() => {}
                Ok(n) => return Err(format!("LZ4 data unpacks to {n} bytes, not {}", stream.len()).into()),
                Err(e) => return Err(format!("LZ4: {e}").into()),
            }
        }
    }
    Ok(())
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
