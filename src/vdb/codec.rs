//! Decompressors of single streams: what zip grids and Blosc containers are made of.

/// How a stream is compressed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Codec {
    Lz4,
    Snappy,
    Zlib,
    Zstd,
}

/// Decompressors that have a state, kept between calls so that a leaf costs no allocation.
pub(super) struct Decompressors {
    zlib: flate2::Decompress,
    zstd: Option<zstd::bulk::Decompressor<'static>>,
}

impl Default for Decompressors {
    fn default() -> Self {
        Self { zlib: flate2::Decompress::new(true), zstd: None }
    }
}

impl Codec {
    /// Decompresses `src`, which must give exactly as many bytes as `out` has.
    ///
    /// # Errors
    /// What is wrong with the stream.
    pub fn decompress(
        self,
        src: &[u8],
        out: &mut [u8],
        decompressors: &mut Decompressors,
    ) -> Result<(), String> {
        let len = match self {
            Self::Lz4 => lz4_flex::block::decompress_into(src, out).map_err(|e| e.to_string()),
            Self::Snappy => snap::raw::Decoder::new().decompress(src, out).map_err(|e| e.to_string()),
            Self::Zlib => decompressors.zlib(src, out),
            Self::Zstd => decompressors.zstd(src, out).map_err(|e| e.to_string()),
        };
        match len {
            Ok(len) if len == out.len() => Ok(()),
            Ok(len) => Err(format!("{self:?} data unpacks to {len} bytes, not {}", out.len())),
            Err(e) => Err(format!("{self:?} data does not unpack to {} bytes: {e}", out.len())),
        }
    }
}

impl Decompressors {
    fn zlib(&mut self, src: &[u8], out: &mut [u8]) -> Result<usize, String> {
        self.zlib.reset(true);
        match self.zlib.decompress(src, out, flate2::FlushDecompress::Finish) {
            Ok(flate2::Status::StreamEnd) => Ok(self.zlib.total_out() as usize),
            Ok(_) => Err("it has no end there".to_owned()),
            Err(e) => Err(e.to_string()),
        }
    }

    fn zstd(&mut self, src: &[u8], out: &mut [u8]) -> std::io::Result<usize> {
        let decompressor = match &mut self.zstd {
            Some(decompressor) => decompressor,
            None => self.zstd.insert(zstd::bulk::Decompressor::new()?),
        };
        decompressor.decompress_to_buffer(src, out)
    }
}
