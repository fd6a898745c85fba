//! Stage 2: choose the grids, check that all frames agree.

use std::path::Path;

use crate::component::{Component, packed_as};
use crate::error::{Error, Result};
use crate::settings::Integers;
use crate::stages::metadata::SequenceInfo;
use crate::vdb::{GridClass, GridInfo, find_grid, voxel_size};

/// The grid that is packed when none is named and several could be.
const DEFAULT_GRID: &str = "density";

/// The grids to pack.
#[derive(Clone, Debug)]
pub struct Selection {
    /// In the order asked for.
    pub grids: Vec<SelectedGrid>,
    /// Frames in which a grid is missing.
    pub warnings: Vec<String>,
}

/// One grid and the frames that have it.
#[derive(Clone, Debug)]
pub struct SelectedGrid {
    /// Its name in the pack.
    pub name: String,
    /// Its name in the files.
    pub source: String,
    /// What of its values is packed.
    pub component: Component,
    /// Whether its values are integers.
    pub is_integer: bool,
    /// What kind of field it holds.
    pub class: GridClass,
    /// The frames, by their place in the sequence, in which it exists.
    pub frames: Vec<usize>,
}

/// What is known of a grid before a voxel is read.
pub struct GridFacts {
    /// Its name in the pack.
    pub name: String,
    /// What kind of field it holds.
    pub class: GridClass,
    /// Whether its source's values are integers.
    pub is_integer: bool,
    /// Frames per second; 0 when not stated.
    pub fps: f32,
    /// Its frames, in order.
    pub frames: Vec<FrameFacts>,
}

/// What is known of one frame of a grid before a voxel is read.
#[derive(Clone, Debug)]
pub struct FrameFacts {
    /// Its number.
    pub number: i32,
    /// Its source's place in the sequence.
    pub source: u32,
    /// Index space to world space.
    pub transform: [f64; 16],
}

impl GridFacts {
    /// The smallest side of a voxel in any frame, in world units.
    pub fn smallest_voxel(&self) -> f64 {
        self.frames.iter().map(|frame| voxel_size(&frame.transform)).fold(f64::INFINITY, f64::min)
    }
}

impl SelectedGrid {
    /// What is known of it.
    pub fn facts(&self, sequence: &SequenceInfo, fps: Option<f32>) -> GridFacts {
        let frame = |&i: &usize| {
            let frame = &sequence.frames[i];
            let info = find_grid(&frame.grids, &self.source).expect("the grid was selected in this frame");
            let transform = info.transform.matrix.expect("the grid was selected for its linear map");
            FrameFacts { number: frame.number, source: i as u32, transform }
        };
        GridFacts {
            name: self.name.clone(),
            class: self.class,
            is_integer: self.is_integer,
            fps: fps.unwrap_or(0.0),
            frames: self.frames.iter().map(frame).collect(),
        }
    }
}

/// One file of a sequence, as far as grids are chosen by it.
#[derive(Clone, Copy)]
pub struct FrameGrids<'a> {
    /// The file.
    pub path: &'a Path,
    /// Its frame number.
    pub number: i32,
    /// The grids in it.
    pub grids: &'a [GridInfo],
}

/// Chooses `names`, or where there are none `density`, or else the only grid that can be packed.
///
/// # Errors
/// A grid that no frame has, that cannot be packed, or whose frames disagree about what it is.
pub fn select(sequence: &SequenceInfo, names: &[String], integers: Integers) -> Result<Selection> {
    let frames = sequence.frames.iter();
    let frames = frames.map(|f| FrameGrids { path: &f.path, number: f.number, grids: &f.grids });
    select_from(&frames.collect::<Vec<_>>(), names, integers)
}

/// The same from frames, of which there is at least one, in their order.
///
/// # Errors
/// As [`select`].
pub fn select_from(frames: &[FrameGrids], names: &[String], integers: Integers) -> Result<Selection> {
    let names = if names.is_empty() { vec![default_grid(frames)?] } else { names.to_vec() };
    let mut selection = Selection { grids: Vec::new(), warnings: Vec::new() };
    for (i, name) in names.iter().enumerate() {
        if names[..i].contains(name) {
            return Err(Error::Usage(format!("grid {name:?} is asked for twice")));
        }
        let whole = select_one(frames, name, &mut selection.warnings)?;
        let first = find_grid(frames[whole.frames[0]].grids, name).expect("it was selected in this frame");
        for (name, component) in packed_as(first, integers) {
            if selection.grids.iter().any(|grid| grid.name == name) {
                return Err(Error::Usage(format!(
                    "two grids of the pack would be {name:?}: choose one of them"
                )));
            }
            selection.grids.push(SelectedGrid { name, component, ..whole.clone() });
        }
    }
    Ok(selection)
}

fn default_grid(frames: &[FrameGrids]) -> Result<String> {
    let all = frames.iter().flat_map(|f| f.grids);
    if frames.iter().any(|f| find_grid(f.grids, DEFAULT_GRID).is_some()) {
        return Ok(DEFAULT_GRID.to_owned());
    }
    let obstacle = all.clone().find_map(|g| Some(format!("; {:?} {}", g.name, g.obstacle()?)));
    let mut packable: Vec<&str> = all.filter(|g| g.obstacle().is_none()).map(|g| g.name.as_str()).collect();
    packable.sort_unstable();
    packable.dedup();
    match packable[..] {
        [one] => Ok(one.to_owned()),
        [] => Err(Error::Unsupported(format!(
            "{}: no grid can be packed: the file has {}{}",
            frames[0].path.display(),
            listing(frames[0].grids),
            obstacle.unwrap_or_default()
        ))),
        _ => Err(Error::Usage(format!(
            "{}: there is no grid \"density\" and more than one other could be packed: \
             choose with --grid (or grid = \"…\" in the manifest) from {}",
            frames[0].path.display(),
            packable.join(", ")
        ))),
    }
}

fn select_one(frames: &[FrameGrids], name: &str, warnings: &mut Vec<String>) -> Result<SelectedGrid> {
    let mut selected = SelectedGrid {
        name: name.to_owned(),
        source: name.to_owned(),
        component: Component::Whole,
        is_integer: false,
        class: GridClass::Unknown,
        frames: Vec::new(),
    };
    let mut first: Option<&GridInfo> = None;
    let mut missing = Vec::new();
    for (i, frame) in frames.iter().enumerate() {
        let Some(grid) = find_grid(frame.grids, name) else {
            missing.push(frame.number.to_string());
            continue;
        };
        if let Some(obstacle) = grid.obstacle() {
            let packable = frame.grids.iter().filter(|g| g.obstacle().is_none());
            let packable: Vec<_> = packable.map(|g| g.name.as_str()).collect();
            let instead = match packable[..] {
                [] => String::new(),
                _ => format!("; choose from {}", packable.join(", ")),
            };
            return Err(Error::Unsupported(format!(
                "{}: grid {name:?} {obstacle}{instead}",
                frame.path.display()
            )));
        }
        let before = first.get_or_insert(grid);
        if grid.value_type.is_integer() != before.value_type.is_integer()
            || grid.value_type.is_integer() && grid.value_type != before.value_type
        {
            return Err(Error::Input(format!(
                "{}: grid {name:?} is {} here and {} in an earlier frame",
                frame.path.display(),
                grid.value_type.name(),
                before.value_type.name()
            )));
        }
        selected.is_integer = grid.value_type.is_integer();
        match (selected.class, grid.class) {
            (GridClass::Unknown, class) => selected.class = class,
            (_, GridClass::Unknown) => {}
            (a, b) if a == b => {}
            (a, b) => {
                return Err(Error::Input(format!(
                    "{}: grid {name:?} is a {} here and a {} in an earlier frame",
                    frame.path.display(),
                    b.name(),
                    a.name()
                )));
            }
        }
        selected.frames.push(i);
    }
    if selected.frames.is_empty() {
        let first = &frames[0];
        return Err(Error::Usage(format!(
            "{}: no grid {name:?}: the file has {}",
            first.path.display(),
            listing(first.grids)
        )));
    }
    if !missing.is_empty() {
        warnings.push(format!("grid {name:?} is missing from frame {}", missing.join(", ")));
    }
    Ok(selected)
}

/// The names and types of a file's grids.
pub fn listing(grids: &[GridInfo]) -> String {
    if grids.is_empty() {
        return "no grids".to_owned();
    }
    let names: Vec<_> = grids.iter().map(|g| format!("{} ({})", g.name, g.value_type.name())).collect();
    names.join(", ")
}
