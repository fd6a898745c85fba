//! A file: its header, its grids, and the way to one grid's tree.

use std::borrow::Cow;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::ops::Range;
use std::path::Path;
use std::sync::Mutex;

use super::cursor::Cursor;
use super::error::NEWEST;
use super::grid::{Descriptor, GridInfo, read_metadata};
use super::other_format::{HEAD, OtherFormat};
use super::tree::{Tree, TreeSize};
use super::tree_read::{read_background, read_leaves, read_topology, skip_leaves};
use super::value::{Scalar, Value, ValueType, with_scalar_type, with_value_type};
use super::{Result, VdbError};

/// `OPENVDB_MAGIC` as a little-endian 64-bit word.
const MAGIC: u64 = 0x5644_4220;
/// `NODE_MASK_COMPRESSION`: older files order a node's data otherwise.
const OLDEST: u32 = 222;
/// First guess of how many bytes a header needs; a grid's metadata can be longer.
const WINDOW: u64 = 16 << 10;

/// An open OpenVDB file.
#[derive(Debug)]
pub struct VdbFile {
    /// The file format's version, 222 or later.
    pub version: u32,
    /// The version of the OpenVDB library that wrote it.
    pub library: (u32, u32),
    /// File-level metadata that is text, for instance `creator`.
    pub metadata: Vec<(String, String)>,
    /// The grids, in the order of the file.
    pub grids: Vec<GridInfo>,
    /// What may keep some of it from being read, without the file's name.
    pub warnings: Vec<String>,
    /// Whether it says where each grid ends.
    has_offsets: bool,
    source: FileBytes,
}

#[derive(Debug)]
enum FileBytes {
    File { file: Mutex<File>, len: u64 },
    Memory(Vec<u8>),
}

impl VdbFile {
    /// Opens a file and reads everything but trees.
    ///
    /// # Errors
    /// [`VdbError`] for a file that cannot be read, is not OpenVDB, or contradicts itself.
    pub fn open(path: &Path) -> Result<Self> {
        // Asked before it is opened: not every system opens a folder.
        if path.is_dir() {
            return Err(VdbError::NotVdb(OtherFormat::Folder));
        }
        let file = File::open(path)?;
        let len = file.metadata()?.len();
        Self::from_source(FileBytes::File { file: Mutex::new(file), len })
    }

    /// The same for a file that is in memory.
    ///
    /// # Errors
    /// As [`VdbFile::open`].
    pub fn from_bytes(bytes: Vec<u8>) -> Result<Self> {
        Self::from_source(FileBytes::Memory(bytes))
    }

    fn from_source(source: FileBytes) -> Result<Self> {
        let (version, at) = source.parse(0, read_version)?;
        Self::read_contents(source, version, at).map_err(|e| e.in_version(version))
    }

    /// Reads what lies behind the version.
    fn read_contents(source: FileBytes, version: u32, at: u64) -> Result<Self> {
        let (Header { library, has_offsets, metadata, grid_count }, at) = source.parse(at, Header::read)?;
        let mut warnings = Vec::new();
        if version > NEWEST {
            warnings.push(format!(
                "OpenVDB file version {version} is newer than {NEWEST}, the newest that this volpack knows: \
                 it is read as if it were {NEWEST}"
            ));
        }
        let (grids, source) = if has_offsets {
            (read_grids(&source, at, grid_count)?, source)
        } else {
            // Without offsets the only way to a grid is through all before it.
            let bytes = source.range(0..source.len())?.into_owned();
            (read_streamed_grids(&bytes, at, grid_count, &mut warnings)?, FileBytes::Memory(bytes))
        };
        Ok(Self { version, library, metadata, grids, warnings, has_offsets, source })
    }

    /// How large a grid's tree is, without reading its voxels. It must be of scalars.
    ///
    /// # Errors
    /// As [`VdbFile::read_topology`].
    pub fn tree_size(&self, grid: &GridInfo) -> Result<TreeSize> {
        with_scalar_type!(&grid.value_type,
            T => Ok(TreeSize::of(&self.read_topology::<T>(grid)?, self.owner(grid).tree.clone())),
            other => Err(VdbError::Unsupported(format!("the voxels of {} grids are not read", other.name())))
        )
    }

    /// A grid's background, which lies before everything else in its tree. It must be of scalars.
    ///
    /// # Errors
    /// As [`VdbFile::read_topology`].
    pub fn background(&self, grid: &GridInfo) -> Result<f64> {
        let tree = self.owner(grid).tree.clone();
        let read = with_scalar_type!(&grid.value_type,
            T => self.source.parse_in(tree, |c| Ok(read_background::<T>(c)?.to_f64())),
            other => Err(VdbError::Unsupported(format!("the voxels of {} grids are not read", other.name())))
        );
        Ok(read.map_err(|e| self.in_grid(grid, e))?.0)
    }

    /// Reads a grid's masks and tiles, but not its leaves' values.
    ///
    /// # Errors
    /// [`VdbError::Grid`] around what is wrong.
    pub fn read_topology<T: Value>(&self, grid: &GridInfo) -> Result<Tree<T>> {
        let owner = self.owner(grid);
        let read = self.source.parse_in(owner.tree.clone(), |c| read_topology(c, owner));
        Ok(read.map_err(|e| self.in_grid(grid, e))?.0)
    }

    /// Reads a grid's whole tree. `T` must be its value type. The leaves are decoded on the current
    /// rayon pool.
    ///
    /// # Errors
    /// [`VdbError::Grid`] around what is wrong.
    pub fn read_tree<T: Value>(&self, grid: &GridInfo) -> Result<Tree<T>> {
        let owner = self.owner(grid);
        let read = |bytes: &[u8]| {
            let mut c = Cursor::new(bytes, owner.tree.start);
            let mut tree = read_topology(&mut c, owner)?;
            read_leaves(&mut c, owner, &mut tree)?;
            // What OpenVDB writes ends where it says. Bytes that are left were written in another way than they were read.
            if self.has_offsets && c.remaining() > 0 {
                return Err(VdbError::corrupt(
                    c.at(),
                    format!(
                        "{} bytes are left over between the last voxel and the grid's end: \
                         the file is damaged or its exporter is faulty: export it again",
                        c.remaining()
                    ),
                ));
            }
            Ok(tree)
        };
        let tree = self.source.range(owner.tree.clone()).and_then(|bytes| read(&bytes));
        tree.map_err(|e| self.in_grid(grid, e))
    }

    fn in_grid(&self, grid: &GridInfo, error: VdbError) -> VdbError {
        error.in_grid(&grid.name).in_version(self.version)
    }

    /// The grid whose tree a grid has: itself, or the one that it is an instance of.
    fn owner<'a>(&'a self, grid: &'a GridInfo) -> &'a GridInfo {
        grid.instance_of.map_or(grid, |i| &self.grids[i])
    }
}

/// The file's version, behind its magic number.
fn read_version(c: &mut Cursor) -> Result<u32> {
    let head = c.peek(HEAD);
    match c.array::<8>("the magic number") {
        Ok(magic) if u64::from_le_bytes(*magic) == MAGIC => {}
        _ => return Err(VdbError::NotVdb(OtherFormat::of(head))),
    }
    match c.u32("the file version")? {
        version if version < OLDEST => Err(VdbError::TooOld(version)),
        version => Ok(version),
    }
}

struct Header {
    library: (u32, u32),
    has_offsets: bool,
    metadata: Vec<(String, String)>,
    grid_count: u32,
}

impl Header {
    /// OpenVDB's `Archive::readHeader` from the library's version on, then the file's metadata and grid count.
    fn read(c: &mut Cursor) -> Result<Self> {
        let library = (c.u32("the library version")?, c.u32("the library version")?);
        let has_offsets = c.u8("the offsets flag")? != 0;
        c.take(36, "the file's UUID")?;
        let metadata = read_metadata(c)?;
        let metadata = metadata.iter().filter_map(|m| Some((m.name.clone(), m.text()?))).collect();
        let at = c.at();
        let grid_count = u32::try_from(c.i32("the grid count")?)
            .map_err(|_| VdbError::corrupt(at, "the grid count is negative"))?;
        Ok(Self { library, has_offsets, metadata, grid_count })
    }
}

fn read_grids(source: &FileBytes, mut at: u64, count: u32) -> Result<Vec<GridInfo>> {
    let mut grids = Vec::new();
    for _ in 0..count {
        let (descriptor, behind) = source.parse(at, Descriptor::read)?;
        let [start, _, end] = descriptor.offsets.map(|o| u64::try_from(o).unwrap_or(u64::MAX));
        let name = descriptor.display_name();
        // Offsets that only ever grow end the loop on any file.
        if start < behind || end < start || end > source.len() {
            return Err(VdbError::corrupt(
                at,
                format!(
                    "its offsets {start} to {end} lie outside the file's {} bytes: \
                     it was cut short or is damaged: copy or export it again",
                    source.len()
                ),
            )
            .in_grid(&name));
        }
        let (grid, _) = source
            .parse(start, |c| GridInfo::read(c, &descriptor, &grids, end))
            .map_err(|e| e.in_grid(&name))?;
        if grid.tree.start > end {
            return Err(VdbError::corrupt(start, "its header runs past its end").in_grid(&name));
        }
        grids.push(grid);
        at = end;
    }
    Ok(grids)
}

fn read_streamed_grids(
    bytes: &[u8],
    at: u64,
    count: u32,
    warnings: &mut Vec<String>,
) -> Result<Vec<GridInfo>> {
    let mut c = Cursor::new(bytes, 0).seek(at as usize);
    let mut grids = Vec::new();
    for behind in (0..count).rev() {
        let descriptor = Descriptor::read(&mut c)?;
        let name = descriptor.display_name();
        let mut grid =
            GridInfo::read(&mut c, &descriptor, &grids, bytes.len() as u64).map_err(|e| e.in_grid(&name))?;
        // The last grid may be of any type, since nothing has to be found behind it.
        if grid.instance_of.is_none() && behind > 0 {
            if !skip_tree(&mut c, &grid).map_err(|e| e.in_grid(&name))? {
                let grids_are = if behind == 1 { "grid is" } else { "grids are" };
                warnings.push(format!(
                    "{behind} {grids_are} not found: the file has no grid offsets, and where grid {name:?} ends is not \
                     known, which is of type {}: write the file with offsets (OpenVDB's io::File)",
                    grid.value_type.name()
                ));
                grids.push(grid);
                break;
            }
            grid.tree.end = c.at();
        }
        grids.push(grid);
    }
    Ok(grids)
}

/// Moves the cursor behind a grid's tree. Whether its type is one whose end can be found.
fn skip_tree(c: &mut Cursor, grid: &GridInfo) -> Result<bool> {
    with_value_type!(&grid.value_type,
        T => {
            // Points are written in passes.
            if grid.value_type == ValueType::PointDataIndex32 {
                return Ok(false);
            }
            let tree = read_topology::<T>(c, grid)?;
            skip_leaves(c, grid, &tree)?;
            Ok(true)
        },
        _name => Ok(false)
    )
}

impl FileBytes {
    fn len(&self) -> u64 {
        match self {
            Self::File { len, .. } => *len,
            Self::Memory(bytes) => bytes.len() as u64,
        }
    }

    /// The bytes of `range`, which must lie inside the file.
    fn range(&self, range: Range<u64>) -> Result<Cow<'_, [u8]>> {
        match self {
            Self::Memory(bytes) => Ok(Cow::Borrowed(&bytes[range.start as usize..range.end as usize])),
            Self::File { file, .. } => {
                let mut bytes = vec![0; (range.end - range.start) as usize];
                let mut file = file.lock().expect("no reader panics while it holds the file");
                file.seek(SeekFrom::Start(range.start))?;
                file.read_exact(&mut bytes)?;
                Ok(Cow::Owned(bytes))
            }
        }
    }

    /// Parses at byte `at` with as much of the file as that takes, and says where it ended.
    fn parse<R>(&self, at: u64, parse: impl Fn(&mut Cursor) -> Result<R>) -> Result<(R, u64)> {
        self.parse_in(at..self.len(), parse)
    }

    /// The same with no more than a part of the file.
    fn parse_in<R>(&self, part: Range<u64>, parse: impl Fn(&mut Cursor) -> Result<R>) -> Result<(R, u64)> {
        let (at, left) = (part.start, part.end.saturating_sub(part.start));
        let mut window = WINDOW.min(left);
        loop {
            let bytes = self.range(at..at + window)?;
            let mut c = Cursor::new(&bytes, at);
            match parse(&mut c) {
                Err(VdbError::Truncated { .. }) if window < left => {
                    window = (window * 4).min(left);
                }
                result => return result.map(|r| (r, c.at())),
            }
        }
    }
}
