//! An OpenVDB file in figures.

use std::path::Path;

use serde::Serialize;
use serde_json::{Value as Json, json};

use crate::error::{Error, Result};
use crate::vdb::{GridInfo, Scalar, Tree, Value, VdbFile, with_scalar_type, with_value_type};

/// What a file holds.
#[derive(Clone, Debug, Serialize)]
pub struct VdbSummary {
    /// The file format's version.
    pub version: u32,
    /// The version of the OpenVDB library that wrote it.
    pub library: String,
    /// What wrote it, if it says.
    pub creator: Option<String>,
    /// What may keep some of it from being read.
    pub warnings: Vec<String>,
    /// Its grids.
    pub grids: Vec<GridSummary>,
}

/// What a grid holds.
#[derive(Clone, Debug, Serialize)]
pub struct GridSummary {
    /// The name to ask for.
    pub name: String,
    /// OpenVDB's name of the value type.
    #[serde(rename = "type")]
    pub value_type: String,
    /// Whether the file has real values as 16-bit floats.
    pub half: bool,
    /// OpenVDB's name of the class.
    pub class: &'static str,
    /// OpenVDB's name of the map.
    pub map: String,
    /// Index space to world space, row-major, row vectors; null for a map that is not linear.
    pub matrix: Option<[f64; 16]>,
    /// Whether volpack can pack it.
    pub packable: bool,
    /// Why not, to be said of the grid.
    pub obstacle: Option<String>,
    /// What its tree holds; not there for a tree whose layout is not known.
    #[serde(flatten, skip_serializing_if = "Option::is_none")]
    pub topology: Option<TopologySummary>,
    /// What the voxels say, where they were asked for.
    #[serde(flatten, skip_serializing_if = "Option::is_none")]
    pub values: Option<ValueSummary>,
}

/// What a grid's tree holds.
#[derive(Clone, Debug, Serialize)]
pub struct TopologySummary {
    /// The background value.
    pub background: Json,
    /// Leaf nodes.
    pub leaves: u64,
    /// Active voxels, tiles in full.
    pub active_voxels: u64,
    /// Active tiles of the root.
    pub root_tiles: u64,
    /// Active tiles of 32³ nodes.
    pub l1_tiles: u64,
    /// Active tiles of 16³ nodes.
    pub l2_tiles: u64,
    /// The active voxels' box: minimum, then maximum, inclusive; OpenVDB's empty box if there are
    /// none.
    pub bbox: [i32; 6],
}

/// What a grid's voxels say, over active values with tiles included.
#[derive(Clone, Debug, Serialize)]
pub struct ValueSummary {
    /// Active voxels in leaves.
    pub active_leaf_voxels: u64,
    /// The smallest finite value; null for none, and for grids that are not scalar.
    pub min: Json,
    /// The largest finite value; null likewise.
    pub max: Json,
    /// The sum of finite values, a tile's for each of its voxels; null likewise.
    pub sum: Json,
    /// Values that are infinite or not a number, a tile counted once; null for grids that are not
    /// scalar.
    pub nonfinite: Json,
}

impl VdbSummary {
    /// Reads a file's topology, and with `values` its voxels.
    ///
    /// # Errors
    /// When it cannot be read.
    pub fn read(path: &Path, values: bool) -> Result<Self> {
        let file = VdbFile::open(path).map_err(Error::vdb(path))?;
        let grids =
            file.grids.iter().map(|grid| summarise(&file, path, grid, values)).collect::<Result<_>>()?;
        let creator =
            file.metadata.iter().find(|(name, _)| name == "creator").map(|(_, value)| value.clone());
        let (major, minor) = file.library;
        let library = format!("{major}.{minor}");
        Ok(Self { version: file.version, library, creator, warnings: file.warnings, grids })
    }
}

fn summarise(file: &VdbFile, path: &Path, grid: &GridInfo, values: bool) -> Result<GridSummary> {
    let obstacle = grid.obstacle();
    let mut summary = GridSummary {
        name: grid.name.clone(),
        value_type: grid.value_type.name().to_owned(),
        half: grid.half,
        class: grid.class.name(),
        map: grid.transform.map.clone(),
        matrix: grid.transform.matrix,
        packable: obstacle.is_none(),
        obstacle,
        topology: None,
        values: None,
    };
    let read_error = || Error::vdb(path);
    if values && grid.value_type.is_scalar() {
        with_scalar_type!(&grid.value_type,
            T => {
                let tree = file.read_tree::<T>(grid).map_err(read_error())?;
                summary.topology = Some(topology_summary(&tree));
                summary.values = Some(value_summary(&tree));
            },
            _other => unreachable!("the type is scalar")
        );
    } else {
        with_value_type!(&grid.value_type,
            T => {
                let tree = file.read_topology::<T>(grid).map_err(read_error())?;
                summary.topology = Some(topology_summary(&tree));
            },
            _name => {}
        );
    }
    Ok(summary)
}

fn topology_summary<T: Value>(tree: &Tree<T>) -> TopologySummary {
    let stats = tree.topology_stats();
    TopologySummary {
        background: tree.background.to_json(),
        leaves: stats.leaves,
        active_voxels: stats.active_voxels,
        root_tiles: stats.root_tiles,
        l1_tiles: stats.l1_tiles,
        l2_tiles: stats.l2_tiles,
        bbox: stats.bbox.to_array(),
    }
}

fn value_summary<T: Scalar>(tree: &Tree<T>) -> ValueSummary {
    let stats = tree.value_stats();
    let value = |v: Option<T>| v.map_or(Json::Null, T::to_json);
    ValueSummary {
        active_leaf_voxels: tree.topology_stats().active_leaf_voxels,
        min: value(stats.min),
        max: value(stats.max),
        sum: json!(stats.sum),
        nonfinite: json!(stats.nonfinite),
    }
}
