//! Recognises what a file is that should be an OpenVDB file and is not.

use std::fmt;

/// What a file is instead of an OpenVDB file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs)] // Each is described by its message.
pub enum OtherFormat {
    Empty,
    Folder,
    GitLfsPointer,
    NanoVdb,
    Volpack,
    Gzip,
    Zip,
    Zstd,
    Bzip2,
    Xz,
    SevenZip,
    WebPage,
    Text,
    Unknown,
}

/// Bytes from the start of a file that are enough to tell.
pub(super) const HEAD: usize = 64;

/// The formats that begin with bytes of their own.
const BEGINNINGS: [(&[u8], OtherFormat); 12] = [
    (b"version https://git-lfs", OtherFormat::GitLfsPointer),
    // The magic numbers of a grid in memory, of a grid alone and of a file.
    (b"NanoVDB0", OtherFormat::NanoVdb),
    (b"NanoVDB1", OtherFormat::NanoVdb),
    (b"NanoVDB2", OtherFormat::NanoVdb),
    (b"\x89VOLPK\r\n", OtherFormat::Volpack),
    (b"\x1f\x8b", OtherFormat::Gzip),
    (b"PK\x03\x04", OtherFormat::Zip),
    (b"PK\x05\x06", OtherFormat::Zip),
    (b"\x28\xb5\x2f\xfd", OtherFormat::Zstd),
    (b"BZh", OtherFormat::Bzip2),
    (b"\xfd7zXZ\0", OtherFormat::Xz),
    (b"7z\xbc\xaf\x27\x1c", OtherFormat::SevenZip),
];

impl OtherFormat {
    /// Tells from a file's first [`HEAD`] bytes, or all of them if it is shorter.
    pub(super) fn of(head: &[u8]) -> Self {
        if head.is_empty() {
            return Self::Empty;
        }
        if let Some((_, format)) = BEGINNINGS.iter().find(|(beginning, _)| head.starts_with(beginning)) {
            return *format;
        }
        match text(head) {
            Some(text) if text.trim_start_matches('\u{feff}').trim_start().starts_with('<') => Self::WebPage,
            Some(_) => Self::Text,
            None => Self::Unknown,
        }
    }
}

/// The head of a text file, whose last character may be cut off; `None` for anything else.
fn text(head: &[u8]) -> Option<&str> {
    let text = std::str::from_utf8(head).or_else(|e| match e.error_len() {
        None => std::str::from_utf8(&head[..e.valid_up_to()]),
        Some(_) => Err(e),
    });
    text.ok().filter(|text| !text.chars().any(|c| c.is_control() && !c.is_whitespace()))
}

impl fmt::Display for OtherFormat {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            Self::Empty => "it is empty: export it again",
            Self::Folder => "it is a folder: name the .vdb files in it",
            Self::GitLfsPointer => "it is a Git LFS pointer, not the file: run `git lfs pull`",
            Self::NanoVdb => "it is a NanoVDB file: convert it with `nanovdb_convert IN.nvdb OUT.vdb`",
            Self::Volpack => "it is a volume pack: packs are built from .vdb files",
            Self::Gzip => "it is compressed with gzip: unpack it with `gunzip`",
            Self::Zip => "it is a ZIP archive: unpack it with `unzip`",
            Self::Zstd => "it is compressed with Zstandard: unpack it with `unzstd`",
            Self::Bzip2 => "it is compressed with bzip2: unpack it with `bunzip2`",
            Self::Xz => "it is compressed with xz: unpack it with `unxz`",
            Self::SevenZip => "it is a 7-Zip archive: unpack it with `7z x`",
            Self::WebPage => {
                "it is a web page or XML, as a failed download leaves one: download the file again"
            }
            Self::Text => "it is a text file: export or download it again",
            Self::Unknown => "it does not begin with OpenVDB's magic number",
        })
    }
}
