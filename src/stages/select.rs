//! Stage 2: choose the grids, check that all frames agree.

use crate::error::{Error, Result};
use crate::settings::Integers;
use crate::stages::component::{Component, packed_as};
use crate::stages::metadata::SequenceInfo;
use crate::vdb::{GridClass, GridInfo};

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

/// Chooses `names`, or where there are none `density`, or else the only grid that can be packed.
///
/// # Errors
/// A grid that no frame has, that cannot be packed, or whose frames disagree about what it is.
pub fn select(sequence: &SequenceInfo, names: &[String], integers: Integers) -> Result<Selection> {
    let names = if names.is_empty() { vec![default_grid(sequence)?] } else { names.to_vec() };
    let mut selection = Selection { grids: Vec::new(), warnings: Vec::new() };
    for (i, name) in names.iter().enumerate() {
        if names[..i].contains(name) {
            return Err(Error::Usage(format!("grid {name:?} is asked for twice")));
        }
        let whole = select_one(sequence, name, &mut selection.warnings)?;
        let first =
            find(&sequence.frames[whole.frames[0]].grids, name).expect("it was selected in this frame");
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

/// The grid of that name in one frame. `density` also finds the first of several of that name,
/// `density[0]`.
pub fn find<'a>(grids: &'a [GridInfo], name: &str) -> Option<&'a GridInfo> {
    grids
        .iter()
        .find(|g| g.name == name)
        .or_else(|| grids.iter().find(|g| g.name.strip_prefix(name).is_some_and(|rest| rest == "[0]")))
}

fn default_grid(sequence: &SequenceInfo) -> Result<String> {
    let all = || sequence.frames.iter().flat_map(|f| &f.grids);
    if sequence.frames.iter().any(|f| find(&f.grids, DEFAULT_GRID).is_some()) {
        return Ok(DEFAULT_GRID.to_owned());
    }
    let mut scalar: Vec<&str> = all().filter(|g| g.value_type.is_scalar()).map(|g| g.name.as_str()).collect();
    scalar.sort_unstable();
    scalar.dedup();
    match scalar[..] {
        [one] => Ok(one.to_owned()),
        [] => Err(Error::Input(format!(
            "{}: no grid can be packed: the file has {}",
            sequence.frames[0].path.display(),
            listing(&sequence.frames[0].grids)
        ))),
        _ => Err(Error::Usage(format!(
            "{}: there is no grid \"density\" and more than one other could be packed: \
             choose with --grid (or grid = \"…\" in the manifest) from {}",
            sequence.frames[0].path.display(),
            scalar.join(", ")
        ))),
    }
}

fn select_one(sequence: &SequenceInfo, name: &str, warnings: &mut Vec<String>) -> Result<SelectedGrid> {
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
    for (i, frame) in sequence.frames.iter().enumerate() {
        let Some(grid) = find(&frame.grids, name) else {
            missing.push(frame.number.to_string());
            continue;
        };
        let refuse =
            |why: String| Err(Error::Unsupported(format!("{}: grid {name:?} {why}", frame.path.display())));
        if !grid.value_type.is_scalar() {
            let packable: Vec<_> =
                frame.grids.iter().filter(|g| g.value_type.is_scalar()).map(|g| g.name.as_str()).collect();
            return refuse(format!(
                "is {}, and only float, half, double, int32 and int64 grids can be packed: {}",
                grid.value_type.name(),
                if packable.is_empty() { "this file has none".to_owned() } else { packable.join(", ") }
            ));
        }
        if grid.transform.matrix.is_none() {
            return refuse(format!(
                "has a {}, and only linear maps can be packed: resample it to a uniform grid",
                grid.transform.map
            ));
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
        let first = &sequence.frames[0];
        return Err(Error::Usage(format!(
            "{}: no grid {name:?}: the file has {}",
            first.path.display(),
            listing(&first.grids)
        )));
    }
    if !missing.is_empty() {
        warnings.push(format!("grid {name:?} is missing from frame {}", missing.join(", ")));
    }
    Ok(selected)
}

fn listing(grids: &[GridInfo]) -> String {
    if grids.is_empty() {
        return "no grids".to_owned();
    }
    let names: Vec<_> = grids.iter().map(|g| format!("{} ({})", g.name, g.value_type.name())).collect();
    names.join(", ")
}
