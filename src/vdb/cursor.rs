//! A bounds-checked reader over bytes that knows their place in the file.

use super::{Result, VdbError};

/// Names longer than this are taken for damage: OpenVDB's own are a few dozen bytes.
const MAX_STRING: u32 = 1 << 16;

/// Reads little-endian values from `bytes`, which begin at byte `base` of the file.
#[derive(Clone)]
pub(super) struct Cursor<'a> {
    bytes: &'a [u8],
    pos: usize,
    base: u64,
}

impl<'a> Cursor<'a> {
    pub fn new(bytes: &'a [u8], base: u64) -> Self {
        Self { bytes, pos: 0, base }
    }

    /// Position in the file.
    pub fn at(&self) -> u64 {
        self.base + self.pos as u64
    }

    pub fn remaining(&self) -> usize {
        self.bytes.len() - self.pos
    }

    /// A cursor at `pos` bytes from this one's first byte.
    pub fn seek(&self, pos: usize) -> Self {
        Self { bytes: self.bytes, pos: pos.min(self.bytes.len()), base: self.base }
    }

    /// Position from this cursor's first byte, for [`Cursor::seek`].
    pub fn pos(&self) -> usize {
        self.pos
    }

    /// The next `n` bytes, or as many as there are.
    pub fn peek(&self, n: usize) -> &'a [u8] {
        &self.bytes[self.pos..self.bytes.len().min(self.pos + n)]
    }

    pub fn take(&mut self, n: u64, what: &'static str) -> Result<&'a [u8]> {
        if n > self.remaining() as u64 {
            return Err(VdbError::Truncated { what, at: self.at(), need: n, left: self.remaining() as u64 });
        }
        let slice = &self.bytes[self.pos..self.pos + n as usize];
        self.pos += n as usize;
        Ok(slice)
    }

    pub fn array<const N: usize>(&mut self, what: &'static str) -> Result<&'a [u8; N]> {
        Ok(self.take(N as u64, what)?.try_into().expect("take returns N bytes"))
    }

    pub fn u8(&mut self, what: &'static str) -> Result<u8> {
        Ok(self.array::<1>(what)?[0])
    }

    pub fn u32(&mut self, what: &'static str) -> Result<u32> {
        Ok(u32::from_le_bytes(*self.array(what)?))
    }

    pub fn i32(&mut self, what: &'static str) -> Result<i32> {
        Ok(i32::from_le_bytes(*self.array(what)?))
    }

    pub fn i64(&mut self, what: &'static str) -> Result<i64> {
        Ok(i64::from_le_bytes(*self.array(what)?))
    }

    pub fn f64(&mut self, what: &'static str) -> Result<f64> {
        Ok(f64::from_le_bytes(*self.array(what)?))
    }

    /// A length-prefixed string. Bytes that are not UTF-8 are replaced, so that a name in another
    /// encoding can still be shown.
    pub fn string(&mut self, what: &'static str) -> Result<String> {
        let at = self.at();
        let len = self.u32(what)?;
        if len > MAX_STRING {
            return Err(VdbError::corrupt(at, format!("{what} claims {len} bytes")));
        }
        Ok(String::from_utf8_lossy(self.take(len.into(), what)?).into_owned())
    }
}
