//! What a file says of a grid before its voxels are read.

use std::ops::Range;

use super::block::Compression;
use super::cursor::Cursor;
use super::transform::Transform;
use super::value::ValueType;
use super::{Result, VdbError};

/// What kind of field a grid holds, from its `class` metadata.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum GridClass {
    /// Not stated.
    #[default]
    Unknown,
    /// A narrow band signed distance.
    LevelSet,
    /// A density.
    FogVolume,
    /// A staggered velocity.
    Staggered,
}

impl GridClass {
    /// OpenVDB's name of the class (`GridBase::gridClassToString`).
    pub fn name(self) -> &'static str {
        match self {
            Self::Unknown => "unknown",
            Self::LevelSet => "level set",
            Self::FogVolume => "fog volume",
            Self::Staggered => "staggered",
        }
    }

    fn from_name(name: &str) -> Self {
        match name {
            "level set" => Self::LevelSet,
            "fog volume" => Self::FogVolume,
            "staggered" => Self::Staggered,
            _ => Self::Unknown,
        }
    }
}

/// One grid of a file.
#[derive(Clone, Debug)]
pub struct GridInfo {
    /// The name to show and to ask for: `density`, or `density[1]` for the second of that name.
    pub name: String,
    /// The type of its voxels.
    pub value_type: ValueType,
    /// Whether the file has its real values as 16-bit floats.
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
/// Marks a grid type whose values are stored as half floats.
const HALF: &str = "_HalfFloat";

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
    /// Reads what stands between a descriptor and its tree: compression, metadata, transform. The
    /// tree's range is left from there to `end`.
    pub(super) fn read(c: &mut Cursor, descriptor: &Descriptor, earlier: &[Self], end: u64) -> Result<Self> {
        let compression = Compression::read(c)?;
        let class = read_metadata(c)?
            .into_iter()
            .find(|(name, _)| name == "class")
            .map_or(GridClass::Unknown, |(_, class)| GridClass::from_name(&class));
        let transform = Transform::read(c)?;
        let tree_type = &descriptor.tree_type;
        let (tree_type, half) =
            tree_type.strip_suffix(HALF).map_or((tree_type.as_str(), false), |tree_type| (tree_type, true));
        let value_type = ValueType::from_tree_type(tree_type);
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

/// Reads a `MetaMap` and keeps what is text.
pub(super) fn read_metadata(c: &mut Cursor) -> Result<Vec<(String, String)>> {
    let mut out = Vec::new();
    for _ in 0..c.u32("the metadata count")? {
        let name = c.string("a metadata name")?;
        let kind = c.string("a metadata type")?;
        let size = c.u32("a metadata size")?;
        let value = c.take(size.into(), "a metadata value")?;
        if kind == "string" {
            out.push((name, String::from_utf8_lossy(value).into_owned()));
        }
    }
    Ok(out)
}
