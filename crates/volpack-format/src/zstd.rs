//! zstd: the C library, or a decoder in Rust where there is no C.

/// Decodes `stored`, which has to be exactly one zstd frame of at most `raw_bytes` bytes (rule 16). No more than about
/// three times `raw_bytes` and 13 MB for tables is in memory at a time.
///
/// Both decoders give the same bytes for frames that an encoder made. Of forged ones each refuses some that the other
/// takes, and a few decode differently: ruzstd checks the lengths of Huffman streams in sum only.
///
/// # Errors
/// What is wrong, to put behind "does not unpack: ".
#[cfg(not(target_arch = "wasm32"))]
pub(crate) fn decompress(stored: &[u8], raw_bytes: usize) -> Result<Vec<u8>, String> {
    // zstd's own decoder takes several frames too, which other readers do not.
    let frame = zstd::zstd_safe::find_frame_compressed_size(stored);
    if frame.is_ok_and(|bytes| bytes == stored.len()) {
        zstd::bulk::decompress(stored, raw_bytes).map_err(|e| e.to_string())
    } else {
        Err(NOT_ONE_FRAME.to_owned())
    }
}

#[cfg(target_arch = "wasm32")]
pub(crate) use in_rust::decompress;

const NOT_ONE_FRAME: &str = "it is not one zstd frame";

/// Built where it is used, and natively for the tests, which compare both decoders.
#[cfg(any(target_arch = "wasm32", test))]
mod in_rust {
    use std::io::Read;

    use ruzstd::decoding::{BlockDecodingStrategy, FrameDecoder};

    use super::NOT_ONE_FRAME;

    const SINGLE_SEGMENT: u8 = 1 << 5;
    const RESERVED: u8 = 1 << 3;
    const TOO_LONG: &str = "it is longer than its chunk";

    pub(crate) fn decompress(stored: &[u8], raw_bytes: usize) -> Result<Vec<u8>, String> {
        // Magic number, descriptor, and what is a window's size or something else (RFC 8878, 3.1.1.1).
        let Some((&head, blocks)) = stored.split_first_chunk::<6>() else {
            return Err(NOT_ONE_FRAME.to_owned());
        };
        if head[4] & RESERVED != 0 {
            return Err(NOT_ONE_FRAME.to_owned());
        }
        let mut head = head;
        if head[4] & SINGLE_SEGMENT == 0 {
            // A window keeps that much of the output in memory. One that is longer than the chunk is of no use.
            head[5] = head[5].min(least_window(raw_bytes));
        }
        let mut decoder = FrameDecoder::new();
        decoder.set_max_window_size(u64::MAX);
        let mut rest = (&head[..]).chain(blocks);
        // Skippable frames are an error here too.
        decoder.init(&mut rest).map_err(|_| NOT_ONE_FRAME.to_owned())?;
        // 0 stands for a length that the frame does not state, too.
        let stated = decoder.content_size();
        if stated > raw_bytes as u64 {
            return Err(TOO_LONG.to_owned());
        }
        let mut raw = Vec::new();
        while !decoder.is_finished() {
            decoder
                .decode_blocks(&mut rest, BlockDecodingStrategy::UptoBlocks(1))
                .map_err(|e| e.to_string())?;
            let left = (raw_bytes - raw.len()) as u64;
            decoder.by_ref().take(left).read_to_end(&mut raw).map_err(|e| e.to_string())?;
            if decoder.can_collect() != 0 {
                return Err(TOO_LONG.to_owned());
            }
        }
        if decoder.bytes_read_from_source() != stored.len() as u64 {
            return Err(NOT_ONE_FRAME.to_owned());
        }
        if stated != 0 && stated != raw.len() as u64 {
            return Err("it is not as long as it says".to_owned());
        }
        if decoder.get_checksum_from_data().is_some_and(|sum| decoder.get_calculated_checksum() != Some(sum))
        {
            return Err("it does not match its checksum".to_owned());
        }
        Ok(raw)
    }

    /// The descriptor of the smallest window of a power of two that holds so many bytes.
    fn least_window(bytes: usize) -> u8 {
        let log2 = bytes.next_power_of_two().trailing_zeros().clamp(10, 41);
        ((log2 - 10) << 3) as u8
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    type Decompress = fn(&[u8], usize) -> Result<Vec<u8>, String>;
    const BOTH: [Decompress; 2] = [decompress, in_rust::decompress];

    #[test]
    fn both_decoders_take_one_frame_and_no_more() {
        let noise = |n: usize| (0..n).map(|i| (i * i / 97 % 251) as u8).collect::<Vec<u8>>();
        for raw in [vec![0; 1 << 20], noise(1), noise(300_000), noise(2_000_003)] {
            for level in [1, 3, 19] {
                let packed = zstd::bulk::compress(&raw, level).unwrap();
                for decode in BOTH {
                    assert!(decode(&packed, raw.len()).unwrap() == raw);
                    // One byte less than it takes.
                    decode(&packed, raw.len() - 1).unwrap_err();
                    decode(&packed[..packed.len() - 1], raw.len()).unwrap_err();
                    let trailing = [&packed[..], b"x"].concat();
                    assert_eq!(decode(&trailing, raw.len()).unwrap_err(), NOT_ONE_FRAME);
                    let twice = [&packed[..], &packed].concat();
                    assert_eq!(decode(&twice, 2 * raw.len()).unwrap_err(), NOT_ONE_FRAME);
                    // A skippable frame of no bytes, before or alone.
                    let skip = [0x50, 0x2a, 0x4d, 0x18, 0, 0, 0, 0];
                    assert_eq!(decode(&[&skip[..], &packed].concat(), raw.len()).unwrap_err(), NOT_ONE_FRAME);
                }
            }
        }
    }

    #[test]
    fn frames_without_a_stated_length_are_bounded_too() {
        let raw = vec![7u8; 3 << 20];
        // A stream's frame states no length.
        let packed = zstd::stream::encode_all(&raw[..], 3).unwrap();
        for decode in BOTH {
            assert!(decode(&packed, raw.len()).unwrap() == raw);
            decode(&packed, raw.len() - 1).unwrap_err();
            decode(&packed, 10).unwrap_err();
        }
    }

    #[test]
    fn damaged_frames_are_errors_or_no_longer_than_allowed() {
        let raw: Vec<u8> = (0..50_000u32).map(|i| (i.wrapping_mul(i) >> 9) as u8 & 0x3f).collect();
        let packed = zstd::bulk::compress(&raw, 3).unwrap();
        for at in (0..packed.len()).step_by(packed.len() / 400 + 1) {
            for flip in [1, 0x80] {
                let mut broken = packed.clone();
                broken[at] ^= flip;
                for decoded in BOTH.map(|decode| decode(&broken, raw.len())) {
                    assert!(decoded.map_or(0, |bytes| bytes.len()) <= raw.len(), "byte {at} ^ {flip}");
                }
            }
        }
    }
}
