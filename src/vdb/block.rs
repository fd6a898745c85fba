//! One node's values: OpenVDB's `io::readCompressedValues`.
//!
//! Finding where a block ends is separate from decoding it, so that a file is walked once by one
//! thread and its leaves are then decoded by all of them.

use super::blosc;
use super::codec::{Codec, Decompressors};
use super::cursor::Cursor;
use super::value::Value;
use super::{Result, VdbError};
use crate::volume::bits;

/// The `io::COMPRESS_*` flags of a grid.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Compression(pub u32);

impl Compression {
    const ZIP: u32 = 1;
    const ACTIVE_MASK: u32 = 2;
    const BLOSC: u32 = 4;

    pub fn read(c: &mut Cursor) -> Result<Self> {
        let at = c.at();
        let flags = c.u32("the grid's compression flags")?;
        if flags & !(Self::ZIP | Self::ACTIVE_MASK | Self::BLOSC) != 0 {
            return Err(VdbError::corrupt(at, format!("unknown compression flags {flags:#x}")));
        }
        Ok(Self(flags))
    }
}

/// How every block of one grid is stored.
#[derive(Clone, Copy)]
pub(super) struct BlockLayout<T> {
    pub compression: Compression,
    pub half: bool,
    pub background: T,
}

/// What stands for the inactive values that mask compression left out: one of two values each,
/// chosen by a mask where there is one.
struct Inactive<'a, T> {
    values: [T; 2],
    selection: Option<&'a [u8]>,
}

/// One node's stored values, found but not yet decoded.
pub(super) struct Block<'a, T> {
    inactive: Inactive<'a, T>,
    /// How many values are stored: all of the node's, or its active ones.
    count: usize,
    packing: Packing,
    payload: &'a [u8],
    at: u64,
}

enum Packing {
    Raw,
    Zip,
    Blosc,
}

/// A thread's buffers for [`Block::decode`].
#[derive(Default)]
pub(super) struct DecodeBuffers {
    bytes: Vec<u8>,
    blosc: blosc::BloscBuffers,
    decompressors: Decompressors,
}

impl<'a, T: Value> Block<'a, T> {
    /// Finds the block at the cursor and leaves the cursor behind it. `active` is the node's value
    /// mask, `total` its number of values.
    pub fn find(c: &mut Cursor<'a>, layout: &BlockLayout<T>, active: &[u64], total: usize) -> Result<Self> {
        let at = c.at();
        // The enum at the top of io/Compression.h:
        // 0 inactive values are the background, or there are none; 1 all minus the background;
        // 2 all one stored value; 3 a mask selects background, else minus it; 4 a mask selects the
        // background, else one stored value; 5 a mask selects the second of two stored values;
        // 6 every value is stored.
        let mode = c.u8("a node's value mode")?;
        if mode > 6 {
            return Err(VdbError::corrupt(at, format!("node value mode {mode}, known are 0 to 6")));
        }
        let background = layout.background;
        let mut values = [if mode == 0 { background } else { background.negative() }, background];
        let stored = match mode {
            2 | 4 => 1,
            5 => 2,
            _ => 0,
        };
        for value in &mut values[..stored] {
            *value = T::from_le(c.take(T::SIZE as u64, "an inactive value")?);
        }
        let selection = if (3..=5).contains(&mode) {
            Some(c.take(total as u64 / 8, "an inactive value mask")?)
        } else {
            None
        };

        let flags = layout.compression.0;
        let count = if flags & Compression::ACTIVE_MASK != 0 && mode != 6 {
            active.iter().map(|w| w.count_ones() as usize).sum()
        } else {
            total
        };
        let size = if layout.half { T::HALF_SIZE } else { T::SIZE };
        let raw_len = (count * size) as u64;
        let (packing, payload) = if count == 0 && layout.half && T::HALF_SIZE != T::SIZE {
            // HalfWriter returns before it writes even a length.
            (Packing::Raw, &[][..])
        } else if flags & (Compression::BLOSC | Compression::ZIP) != 0 {
            let at = c.at();
            let len = c.i64("a compressed block's length")?;
            if len > 0 {
                let packing = if flags & Compression::BLOSC != 0 { Packing::Blosc } else { Packing::Zip };
                (packing, c.take(len as u64, "a compressed block")?)
            } else if len.unsigned_abs() == raw_len {
                // What did not shrink is stored, and its length is negative.
                (Packing::Raw, c.take(raw_len, "a stored block")?)
            } else {
                return Err(VdbError::corrupt(
                    at,
                    format!("stored block of {} bytes, not {raw_len}", -(len as i128)),
                ));
            }
        } else {
            (Packing::Raw, c.take(raw_len, "a node's values")?)
        };
        Ok(Self { inactive: Inactive { values, selection }, count, packing, payload, at })
    }

    /// Decodes into `out`, the node's whole table. `active` as in [`Block::find`].
    pub fn decode(
        &self,
        layout: &BlockLayout<T>,
        active: &[u64],
        out: &mut [T],
        buffers: &mut DecodeBuffers,
    ) -> Result<()> {
        let size = if layout.half { T::HALF_SIZE } else { T::SIZE };
        let bytes = self.unpack(self.count * size, buffers)?;
        let read = if layout.half { T::from_half_le } else { T::from_le };
        if self.count == out.len() {
            for (value, bytes) in out.iter_mut().zip(bytes.chunks_exact(size)) {
                *value = read(bytes);
            }
            return Ok(());
        }
        let [off, on] = self.inactive.values;
        match self.inactive.selection {
            None => out.fill(off),
            Some(mask) => {
                for (i, value) in out.iter_mut().enumerate() {
                    *value = if mask[i >> 3] >> (i & 7) & 1 != 0 { on } else { off };
                }
            }
        }
        for (i, bytes) in bits(active).zip(bytes.chunks_exact(size)) {
            out[i] = read(bytes);
        }
        Ok(())
    }

    fn unpack<'s>(&'s self, len: usize, buffers: &'s mut DecodeBuffers) -> Result<&'s [u8]> {
        let DecodeBuffers { bytes, blosc, decompressors } = buffers;
        match self.packing {
            Packing::Raw => return Ok(self.payload),
            Packing::Blosc => {
                bytes.resize(len, 0);
                blosc::decompress(self.at, self.payload, bytes, blosc, decompressors)?;
            }
            Packing::Zip => {
                bytes.resize(len, 0);
                let unpacked = Codec::Zlib.decompress(self.payload, bytes, decompressors);
                unpacked.map_err(|what| VdbError::corrupt(self.at, what))?;
            }
        }
        Ok(bytes)
    }
}
