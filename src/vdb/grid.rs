//! What a file says of a grid before its voxels are read.

use std::ops::Range;

use super::block::Compression;
use super::cursor::Cursor;
use super::transform::Transform;
use super::value::ValueType;
use super::{GridClass, Result, VdbError};

/// One grid of a file.
#[derive(Clone, Debug)]
pub struct GridInfo {
    /// The name to show and to ask for: `density`, or `density[1]` for the second of that name.
    pub name: String,
    /// The type of its voxels.
    pub value_type: ValueType,
    /// Whether real values are stored as 16-bit floats; of other types it says nothing.
    pub half: bool,
    /// What kind of field it holds.
    pub class: GridClass,
    /// Its map from index to world space.
    pub transform: Transform,
    /// The grid, by its place in [`super::VdbFile::grids`], whose tree this one shares.
    pub instance_of: Option<usize>,
    /// The name as the file has it, which instances refer to.
    pub(super) unique_name: String,
    pub(super) compression: Compression,
    /// Where the tree lies in the file.
    pub(super) tree: Range<u64>,
}

/// Separates a repeated name from its number (`GridDescriptor`'s `SEP`).
const SUFFIX: char = '\x1e';
/// Behind the type of a grid that is saved as half floats. OpenVDB takes it off and believes the metadata alone, also
/// where there is none: then values are stored in full.
const HALF_SUFFIX: &str = "_HalfFloat";
/// Metadata: whether real values are stored as half floats.
const SAVED_AS_HALF: &str = "is_saved_as_half_float";

/// A grid's descriptor: OpenVDB's `GridDescriptor`.
pub(super) struct Descriptor {
    pub unique_name: String,
    pub tree_type: String,
    pub instance_parent: String,
    /// Where the grid begins and ends; zero in a file without offsets.
    pub offsets: [i64; 3],
    pub at: u64,
}

impl Descriptor {
    pub fn read(c: &mut Cursor) -> Result<Self> {
        let at = c.at();
        Ok(Self {
            unique_name: c.string("a grid's name")?,
            tree_type: c.string("a grid's type")?,
            instance_parent: c.string("a grid's instance parent")?,
            offsets: [c.i64("a grid's offsets")?, c.i64("a grid's offsets")?, c.i64("a grid's offsets")?],
            at,
        })
    }

    /// `name[n]` for the unique name `name\x1en` (`GridDescriptor::nameAsString`).
    pub fn display_name(&self) -> String {
        match self.unique_name.split_once(SUFFIX) {
            Some((name, number)) => format!("{name}[{number}]"),
            None => self.unique_name.clone(),
        }
    }
}

impl GridInfo {
    /// Why the grid cannot be packed, to be said of it; `None` if it can be.
    pub fn obstacle(&self) -> Option<String> {
        match &self.value_type {
            ValueType::Other(tree) => {
                Some(format!("is of type {tree}, and volpack does not know how such trees are laid out"))
            }
            other if !other.is_scalar() => Some(format!(
                "is {}, and only half, float, double, int32 and int64 grids can be packed",
                other.name()
            )),
            _ if self.transform.matrix.is_none() => Some(format!(
                "has a {}, and only grids with linear maps can be packed: resample it to a uniform grid",
                self.transform.map
            )),
            _ => None,
        }
    }

    /// Reads what stands between a descriptor and its tree: compression, metadata, transform. The
    /// tree's range is left from there to `end`.
    pub(super) fn read(c: &mut Cursor, descriptor: &Descriptor, earlier: &[Self], end: u64) -> Result<Self> {
        let compression = Compression::read(c)?;
        let metadata = read_metadata(c)?;
        // Of several entries of a name OpenVDB keeps the last.
        let last = |name: &str| metadata.iter().rfind(|entry| entry.name == name);
        let class = last("class").and_then(Metadata::text);
        let class = class.map_or(GridClass::Unknown, |class| GridClass::from_name(&class));
        let half = last(SAVED_AS_HALF).is_some_and(Metadata::is_true);
        let transform = Transform::read(c)?;
        let tree_type = &*descriptor.tree_type;
        let value_type = ValueType::from_tree_type(tree_type.strip_suffix(HALF_SUFFIX).unwrap_or(tree_type));
        let parent = &descriptor.instance_parent;
        let instance_of = if parent.is_empty() {
            None
        } else {
            let owner = earlier.iter().position(|g| {
                g.unique_name == *parent && g.instance_of.is_none() && g.value_type == value_type
            });
            Some(owner.ok_or_else(|| {
                VdbError::corrupt(
                    descriptor.at,
                    format!("it shares the tree of {parent:?}, which is not there, or of another type"),
                )
            })?)
        };
        Ok(Self {
            name: descriptor.display_name(),
            value_type,
            half,
            class,
            transform,
            instance_of,
            unique_name: descriptor.unique_name.clone(),
            compression,
            tree: c.at()..end,
        })
    }
}

/// The grid of that name among a file's grids. `density` also finds the first of several of that name, `density[0]`.
pub fn find_grid<'a>(grids: &'a [GridInfo], name: &str) -> Option<&'a GridInfo> {
    grids
        .iter()
        .find(|g| g.name == name)
        .or_else(|| grids.iter().find(|g| g.name.strip_prefix(name).is_some_and(|rest| rest == "[0]")))
}

/// An entry of a `MetaMap`.
pub(super) struct Metadata<'a> {
    pub name: String,
    kind: String,
    value: &'a [u8],
}

impl Metadata<'_> {
    /// The value if it is text.
    pub fn text(&self) -> Option<String> {
        (self.kind == "string").then(|| String::from_utf8_lossy(self.value).into_owned())
    }

    /// OpenVDB's `Metadata::asBool`: of a number of any type, whether it is not zero.
    fn is_true(&self) -> bool {
        self.value.iter().any(|&byte| byte != 0)
    }
}

/// Reads a `MetaMap` and keeps what is text, and whether values are halves.
pub(super) fn read_metadata<'a>(c: &mut Cursor<'a>) -> Result<Vec<Metadata<'a>>> {
    let mut out = Vec::new();
    for _ in 0..c.u32("the metadata count")? {
        let name = c.string("a metadata name")?;
        let kind = c.string("a metadata type")?;
        let size = c.u32("a metadata size")?;
        let value = c.take(size.into(), "a metadata value")?;
        if kind == "string" || name == SAVED_AS_HALF {
            out.push(Metadata { name, kind, value });
        }
    }
    Ok(out)
}
