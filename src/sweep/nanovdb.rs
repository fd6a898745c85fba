//! NanoVDB's quantised grids, to be measured beside ours: runs Debian's `nanovdb_convert` and reads the sizes
//! out of the file that it writes.
//!
//! The layout is that of NanoVDB 32.4.2 (libnanovdb-dev 10.0.1): `Header` and `MetaData` in
//! `nanovdb/util/IO.h`; `GridData`, `TreeData`, `LeafData` and `LeafFnBase` in `nanovdb/NanoVDB.h`. The offsets
//! below were printed by `offsetof` from those headers. All numbers are little-endian.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf, absolute};
use std::process::{Command, ExitStatus, Stdio};
use std::time::Instant;

const TOOL: &str = "nanovdb_convert";
/// `NANOVDB_MAGIC_NUMBER`: at the head of the file, and again of each grid.
const MAGIC: u64 = u64::from_le_bytes(*b"NanoVDB0");
/// `NANOVDB_MAJOR_VERSION_NUMBER`: the part of the version that changes with the layout.
const MAJOR: u64 = 32;
/// `sizeof(Header)`: where the first grid's `MetaData` begins.
const META: u64 = 16;
/// `sizeof(MetaData)`: the grid's name follows, its closing zero included, then the grid.
const META_BYTES: u64 = 176;
/// `sizeof(GridData)`: the tree follows at once, and its offsets count from there.
const GRID_BYTES: u64 = 672;
/// `GridFlags::IsBreadthFirst`: the nodes of a level lie together, so the leaves form one run of bytes.
const BREADTH_FIRST: u64 = 1 << 5;
/// `sizeof(LeafFnBase)`: what a quantised leaf holds beside its codes; also `LeafData<float>` beside its values.
const LEAF_HEAD: u64 = 96;

/// Which quantisation `nanovdb_convert` is asked for.
///
/// All but `Float` scale the codes of a leaf between the least and the greatest of its 512 values, inactive ones
/// included. None is dithered: that is the tool's default, and dithering costs about 3 dB.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Quantise {
    /// 32-bit floats, exact.
    Float,
    /// 4 bits a voxel.
    Fp4,
    /// 8 bits a voxel.
    Fp8,
    /// 16 bits a voxel.
    Fp16,
    /// Per leaf the fewest of 1, 2, 4, 8 or 16 bits that keep every value, inactive ones too, within a tolerance
    /// (`-a`; `AbsDiff` in `util/GridBuilder.h`). 16 bits are taken unchecked.
    FpN {
        /// Greatest error of a value, in the grid's own unit.
        absolute: f64,
    },
}

impl Quantise {
    /// The tool's options, the `GridType` it then writes for floats, and its bits a voxel unless they vary.
    fn asks(&self) -> (String, u64, Option<u64>) {
        match self {
            Quantise::Float => (String::new(), 1, Some(32)),
            Quantise::Fp4 => ("--fp4".into(), 13, Some(4)),
            Quantise::Fp8 => ("--fp8".into(), 14, Some(8)),
            Quantise::Fp16 => ("--fp16".into(), 15, Some(16)),
            // The tolerance has to be an argument of its own: `-a0.01` is refused.
            Quantise::FpN { absolute } => (format!("--fpN -a {absolute}"), 16, None),
        }
    }
}

/// A converted grid's sizes.
#[derive(Debug, Clone, PartialEq)]
pub struct NanoGrid {
    /// The name that the file gives it.
    pub name: String,
    /// Bytes of the whole grid in memory, uncompressed (`GridData::mGridSize`).
    pub grid_bytes: u64,
    /// Bytes of all its leaf nodes, their headers and masks (96 bytes a leaf) included.
    pub leaf_bytes: u64,
    /// How many leaf nodes, of 8×8×8 voxels, it has.
    pub leaf_count: u64,
    /// Wall time of `nanovdb_convert` in seconds: its start, and reading and writing the files, included.
    pub seconds: f64,
}

/// Why a conversion gave no result.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // The fields are what the messages name.
pub enum NanoError {
    /// The tool could not be started (not installed, say).
    #[error("{}: cannot run nanovdb_convert", path.display())]
    Start { path: PathBuf, source: io::Error },
    /// The tool gave up on a file. It may have left its output empty.
    #[error("{}: nanovdb_convert ended with {status}: {message}", path.display())]
    Tool { path: PathBuf, status: ExitStatus, message: String },
    /// The `.nvdb` file that it wrote is not what was asked for, or is damaged.
    #[error("{}: not the NanoVDB file expected", path.display())]
    File { path: PathBuf, source: Flaw },
}

/// What is wrong with a `.nvdb` file.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // The fields are what the messages name.
pub enum Flaw {
    /// It cannot be read.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// Something in it would reach past the end of what holds it.
    #[error("{what} runs past byte {end}")]
    Short { what: &'static str, end: u64 },
    /// A field has a value that this reader does not expect.
    #[error("{what} is {found}, not {expected}")]
    Unexpected { what: &'static str, found: u64, expected: u64 },
}

/// Whether `nanovdb_convert` is installed.
pub fn is_installed() -> bool {
    Command::new(TOOL).arg("--version").output().is_ok_and(|output| output.status.success())
}

/// Converts the grid called `grid` of `vdb` into `nvdb`, which is overwritten, and says its sizes.
///
/// # Errors
/// Those of [`NanoError`]. The tool goes by the names' endings, `.vdb` and `.nvdb`. A grid that is not of floats
/// is an error, since the tool leaves it unquantised; so is FpN of a grid without leaves, which kills
/// `nanovdb_convert` 10.0.1 by a segmentation fault.
pub fn convert(vdb: &Path, grid: &str, quantise: &Quantise, nvdb: &Path) -> Result<NanoGrid, NanoError> {
    let (options, ..) = quantise.asks();
    let options: Vec<&str> = options.split_whitespace().chain(["-g", grid]).collect();
    let seconds = run(&options, vdb, nvdb)?;
    let found = File::open(nvdb).map_err(Flaw::from).and_then(|file| read(file, quantise));
    let sizes = found.map_err(|source| NanoError::File { path: nvdb.to_owned(), source })?;
    Ok(NanoGrid { seconds, ..sizes })
}

/// Converts `nvdb` back to an OpenVDB file of plain floats, which is overwritten, to measure its error.
///
/// Works for every [`Quantise`], and keeps leaves, masks and tiles as they were.
///
/// # Errors
/// Those of [`NanoError`]. The tool goes by the names' endings, `.nvdb` and `.vdb`.
pub fn back_to_vdb(nvdb: &Path, vdb: &Path) -> Result<(), NanoError> {
    run(&[], nvdb, vdb).map(drop)
}

/// Runs the tool; gives its wall time in seconds.
fn run(options: &[&str], from: &Path, to: &Path) -> Result<f64, NanoError> {
    let start = |source| NanoError::Start { path: from.to_owned(), source };
    // Absolute, since the tool takes a name that begins with a dash for an option.
    let files = [absolute(from).map_err(start)?, absolute(to).map_err(start)?];
    let began = Instant::now();
    // Forced, since it would ask before overwriting, and with nobody to answer would take that for a yes.
    let command = &mut Command::new(TOOL);
    let output = command.arg("-f").args(options).args(files).stdin(Stdio::null()).output().map_err(start)?;
    let seconds = began.elapsed().as_secs_f64();
    if output.status.success() {
        return Ok(seconds);
    }
    // The first line says it; after a wrong argument the whole usage follows.
    let text = String::from_utf8_lossy(&output.stderr);
    let message = text.lines().find(|line| !line.trim().is_empty()).unwrap_or("no message").to_owned();
    Err(NanoError::Tool { path: from.to_owned(), status: output.status, message })
}

/// A file read here and there, never whole: a grid of floats may be larger than memory.
struct SeekableFile<R> {
    file: R,
    length: u64,
}

impl<R: Read + Seek> SeekableFile<R> {
    fn fill(&mut self, at: u64, into: &mut [u8]) -> Result<(), Flaw> {
        within("a field", at, into.len() as u64, self.length)?;
        self.file.seek(SeekFrom::Start(at))?;
        Ok(self.file.read_exact(into)?)
    }

    /// The number of `N` bytes at a place.
    fn number<const N: usize>(&mut self, at: u64) -> Result<u64, Flaw> {
        const { assert!(N <= 8) };
        let mut bytes = [0; 8];
        self.fill(at, &mut bytes[..N])?;
        Ok(u64::from_le_bytes(bytes))
    }
}

/// Where something ends that begins at `at`, which may be no further than `end`.
fn within(what: &'static str, at: u64, length: u64, end: u64) -> Result<u64, Flaw> {
    at.checked_add(length).filter(|&reached| reached <= end).ok_or(Flaw::Short { what, end })
}

fn same(what: &'static str, found: u64, expected: u64) -> Result<(), Flaw> {
    if found == expected { Ok(()) } else { Err(Flaw::Unexpected { what, found, expected }) }
}

/// The sizes (in no time) of the one grid in a `.nvdb` file.
fn read<R: Read + Seek>(mut file: R, quantise: &Quantise) -> Result<NanoGrid, Flaw> {
    let length = file.seek(SeekFrom::End(0))?;
    let file = &mut SeekableFile { file, length };
    same("the file's magic number", file.number::<8>(0)?, MAGIC)?;
    same("the major version", file.number::<4>(8)? >> 21, MAJOR)?; // Packed as 11, 11 and 10 bits.
    same("the number of grids", file.number::<2>(12)?, 1)?;
    same("the codec", file.number::<2>(14)?, 0)?; // `Codec::NONE`, which the tool uses unless told otherwise.

    let grid_bytes = file.number::<8>(META)?;
    let name_bytes = file.number::<4>(META + 136)?;
    let grid = META + META_BYTES + name_bytes;
    let end = within("the grid", grid, grid_bytes, length)?;
    same("the file's length", length, end)?; // More follows when the tool was given no name, so took all grids.
    let mut name = vec![0; name_bytes as usize]; // No larger than the file, as has just been seen.
    file.fill(META + META_BYTES, &mut name)?;
    let name = String::from_utf8_lossy(name.split(|&byte| byte == 0).next().unwrap_or_default()).into_owned();

    let (_, grid_type, bits) = quantise.asks();
    same("the grid's magic number", file.number::<8>(grid)?, MAGIC)?;
    same("the breadth-first flag", file.number::<4>(grid + 20)? & BREADTH_FIRST, BREADTH_FIRST)?;
    same("the grid's size", file.number::<8>(grid + 32)?, grid_bytes)?;
    same("the grid's type", file.number::<4>(grid + 636)?, grid_type)?;
    let tree = grid + GRID_BYTES;
    let leaf_count = file.number::<4>(tree + 32)?;
    same("the number of leaves", leaf_count, file.number::<4>(META + 140)?)?;
    if leaf_count == 0 {
        return Ok(NanoGrid { name, grid_bytes, leaf_bytes: 0, leaf_count, seconds: 0.0 });
    }

    // 512 voxels of one bit are 64 bytes, so leaves of every width keep their alignment of 32 without padding.
    let first = within("the first leaf's offset", tree, file.number::<8>(tree)?, end)?;
    let mut at = first;
    if let Some(bits) = bits {
        at = within("the run of leaves", first, leaf_count * (LEAF_HEAD + 64 * bits), end)?;
    } else {
        for _ in 0..leaf_count {
            // `LeafData<FpN>::bitWidth`: the top three bits of `mFlags` are its logarithm, at most 4 for 16 bits.
            let log2 = file.number::<1>(at + 15)? >> 5;
            same("a leaf's width, as a logarithm,", log2, log2.min(4))?;
            at = within("a leaf", at, LEAF_HEAD + (64 << log2), end)?;
        }
    }
    // `OpenToNanoVDB::initHandle` puts the leaves last but for blind data, so where they end can be checked.
    let blind = file.number::<4>(grid + 648)? > 0;
    let last = if blind { file.number::<8>(grid + 640)? } else { grid_bytes };
    same("the end of the leaves", at - grid, last)?;
    Ok(NanoGrid { name, grid_bytes, leaf_bytes: at - first, leaf_count, seconds: 0.0 })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Cursor;

    const FPN: Quantise = Quantise::FpN { absolute: 0.01 };
    /// Where the grid begins: header, metadata and "density" with its zero.
    const GRID: usize = 16 + 176 + 8;
    /// Where the leaves begin, with 64 bytes in place of root and internal nodes.
    const LEAVES: usize = GRID + 672 + 64 + 64;

    fn put(file: &mut [u8], at: usize, bytes: &[u8]) {
        file[at..at + bytes.len()].copy_from_slice(bytes);
    }

    /// A file of one grid; each leaf is given as its flags and its size.
    fn nvdb(grid_type: u32, leaves: &[(u8, usize)]) -> Vec<u8> {
        let mut file = vec![0; LEAVES];
        let count = leaves.len() as u32;
        for &(flags, bytes) in leaves {
            let at = file.len();
            file.resize(at + bytes, 0);
            file[at + 15] = flags;
        }
        let grid_bytes = (file.len() - GRID) as u64;
        put(&mut file, 0, b"NanoVDB0");
        put(&mut file, 8, &(32u32 << 21 | 4 << 10 | 2).to_le_bytes());
        put(&mut file, 12, &1u16.to_le_bytes());
        put(&mut file, 16, &grid_bytes.to_le_bytes());
        put(&mut file, 16 + 136, &8u32.to_le_bytes());
        put(&mut file, 16 + 140, &count.to_le_bytes());
        put(&mut file, 16 + 176, b"density\0");
        put(&mut file, GRID, b"NanoVDB0");
        put(&mut file, GRID + 20, &(BREADTH_FIRST as u32).to_le_bytes());
        put(&mut file, GRID + 32, &grid_bytes.to_le_bytes());
        put(&mut file, GRID + 636, &grid_type.to_le_bytes());
        put(&mut file, GRID + 672, &((LEAVES - GRID - 672) as u64).to_le_bytes());
        put(&mut file, GRID + 672 + 32, &count.to_le_bytes());
        file
    }

    fn fpn() -> Vec<u8> {
        // 1, 4 and 16 bits; the low flags are set, for they say other things.
        nvdb(16, &[(0b000_00011, 160), (0b010_00010, 352), (0b100_00010, 1120)])
    }

    #[test]
    fn reads_sizes() {
        let sizes = [
            (Quantise::Float, 1, 2144),
            (Quantise::Fp4, 13, 352),
            (Quantise::Fp8, 14, 608),
            (Quantise::Fp16, 15, 1120),
        ];
        for (quantise, grid_type, bytes) in sizes {
            let file = nvdb(grid_type, &[(0, bytes), (0, bytes)]);
            let grid = read(Cursor::new(&file), &quantise).unwrap();
            assert_eq!(grid.name, "density");
            assert_eq!(grid.grid_bytes, (file.len() - GRID) as u64);
            assert_eq!((grid.leaf_bytes, grid.leaf_count), (2 * bytes as u64, 2));
        }
        let grid = read(Cursor::new(fpn()), &FPN).unwrap();
        assert_eq!((grid.leaf_bytes, grid.leaf_count), (160 + 352 + 1120, 3));
        let grid = read(Cursor::new(nvdb(1, &[])), &Quantise::Float).unwrap();
        assert_eq!((grid.leaf_bytes, grid.leaf_count), (0, 0));
    }

    #[test]
    fn leaves_may_end_at_blind_data() {
        let mut file = fpn();
        let leaves_end = (file.len() - GRID) as u64;
        file.extend([0; 64]);
        let grid_bytes = (file.len() - GRID) as u64;
        put(&mut file, 16, &grid_bytes.to_le_bytes());
        put(&mut file, GRID + 32, &grid_bytes.to_le_bytes());
        assert!(read(Cursor::new(&file), &FPN).is_err());
        put(&mut file, GRID + 640, &leaves_end.to_le_bytes());
        put(&mut file, GRID + 648, &1u32.to_le_bytes());
        assert_eq!(read(Cursor::new(&file), &FPN).unwrap().leaf_bytes, 160 + 352 + 1120);
    }

    #[test]
    fn a_truncated_file_is_an_error() {
        let file = fpn();
        for length in 0..file.len() {
            assert!(read(Cursor::new(&file[..length]), &FPN).is_err(), "{length} bytes were enough");
        }
    }

    #[test]
    fn a_damaged_field_is_an_error() {
        // Name of the field, where it is, its bytes.
        let fields = [
            ("magic", 0, 8),
            ("version", 8, 4),
            ("grid count", 12, 2),
            ("codec", 14, 2),
            ("grid size", 16, 8),
            ("name size", 16 + 136, 4),
            ("leaf count", 16 + 140, 4),
            ("grid's magic", GRID, 8),
            ("size in grid", GRID + 32, 8),
            ("type", GRID + 636, 4),
            ("blind count", GRID + 648, 4),
            ("leaf offset", GRID + 672, 8),
            ("leaf count in tree", GRID + 672 + 32, 4),
            ("width of second leaf", LEAVES + 160 + 15, 1),
        ];
        for (what, at, length) in fields {
            let mut file = fpn();
            file[at..at + length].fill(0xff);
            assert!(read(Cursor::new(file), &FPN).is_err(), "{what} was not checked");
        }
        let mut file = fpn();
        put(&mut file, GRID + 20, &[0; 4]);
        assert!(read(Cursor::new(file), &FPN).is_err());
    }

    #[test]
    fn a_second_segment_is_an_error() {
        let file = [fpn(), fpn()].concat();
        assert!(read(Cursor::new(&file), &FPN).is_err());
    }

    #[test]
    fn no_byte_makes_it_panic() {
        for at in 0..LEAVES + 160 + 352 {
            for byte in [0, 1, 0x7f, 0x80, 0xff] {
                let mut file = fpn();
                file[at] = byte;
                let _ = read(Cursor::new(file), &FPN);
            }
        }
    }
}
