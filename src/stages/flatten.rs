//! Stage 3: one grid of one frame, from OpenVDB's tree to cells and bricks in absolute coordinates.

use rayon::prelude::*;

use crate::component::Component;
use crate::error::{Error, Result};
use crate::settings::NonFinite;
use crate::vdb::{GridInfo, LEAVES_IN_BLOCK, Scalar, Tree, VdbFile, with_scalar_type};
use crate::volume::{
    BRICK_VOXELS, Brick, Cell, CellContent, Child, Constant, Coord, FlatFrame, FrameStats, L2_DIM, Mask512,
    ValueRange,
};

/// A flattened frame, and the value outside everything in it.
pub struct Flattened {
    /// The frame.
    pub frame: FlatFrame,
    /// The grid's background as `f32`.
    pub background: f32,
}

/// Reads one grid of an open file and flattens what is to be packed of its values. What is not `f32` becomes the nearest one.
///
/// # Errors
/// When the tree cannot be read, or has infinities or NaNs and `nonfinite` refuses them.
pub fn flatten(
    file: &VdbFile,
    path: &std::path::Path,
    grid: &GridInfo,
    component: Component,
    nonfinite: NonFinite,
) -> Result<Flattened> {
    let flat = with_scalar_type!(&grid.value_type,
        T => flatten_tree(file.read_tree::<T>(grid).map_err(Error::vdb(path))?, Reading { component, nonfinite }),
        other => unreachable!("{} grids are refused when grids are selected", other.name())
    );
    let count = flat.frame.stats.nonfinite;
    if nonfinite == NonFinite::Refuse && !flat.background.is_finite() {
        return Err(nonfinite_background(path, grid, flat.background));
    }
    if count > 0 && nonfinite == NonFinite::Refuse {
        let voxels = if count == 1 { "value that is" } else { "values that are" };
        return Err(Error::Input(format!(
            "{}: grid {:?} has {count} {voxels} infinite or not a number: \
             repair the export, or take 0 for each (--nonfinite zero, or nonfinite = \"zero\" in the manifest)",
            path.display(),
            grid.name
        )));
    }
    Ok(flat)
}

/// A background that is infinite or not a number.
pub fn nonfinite_background(path: &std::path::Path, grid: &GridInfo, background: f32) -> Error {
    Error::Input(format!(
        "{}: grid {:?} has the background {background}: repair the export, or take 0 for every value that is infinite \
         or not a number (--nonfinite zero, or nonfinite = \"zero\" in the manifest)",
        path.display(),
        grid.name
    ))
}

/// What becomes of a leaf.
enum LeafKind {
    /// All inactive background: nothing.
    Background,
    Constant(Constant),
    Brick,
}

struct LeafSummary {
    kind: LeafKind,
    active_range: Option<ValueRange>,
    nonfinite: u64,
    rounding: f64,
}

/// How values are read.
#[derive(Clone, Copy)]
struct Reading {
    component: Component,
    nonfinite: NonFinite,
}

impl Reading {
    fn finite(self, value: f32) -> f32 {
        if value.is_finite() || self.nonfinite == NonFinite::Refuse { value } else { 0.0 }
    }

    /// How far the nearest `f32` is from a value.
    fn rounding<T: Scalar>(self, value: T) -> f64 {
        if T::FITS_F32 {
            return 0.0;
        }
        let error = self.component.error_of(value, self.component.to_f32(value)).abs();
        if error.is_finite() { error } else { 0.0 }
    }
}

/// An inactive value: 0 and -0 are one background.
fn inactive(value: f32) -> f32 {
    value + 0.0
}

fn flatten_tree<T: Scalar>(mut tree: Tree<T>, reading: Reading) -> Flattened {
    let mut f = Flattener { background: 0.0, reading, nonfinite_count: 0, rounding: 0.0, active_range: None };
    f.background = inactive(f.value(tree.background));
    let background = f.background;

    // A block of leaves is gone as soon as its bricks are made.
    let blocks = std::mem::take(&mut tree.leaves.blocks).into_par_iter();
    let (summaries, bricks): (Vec<Vec<LeafSummary>>, Vec<Vec<Brick>>) = blocks
        .zip(tree.leaves.masks.par_chunks(LEAVES_IN_BLOCK))
        .map(|(values, masks)| bricks(values, masks, background, reading))
        .unzip();
    let summaries: Vec<LeafSummary> = summaries.into_iter().flatten().collect();

    let mut roots = Vec::new();
    for tile in &tree.tiles {
        roots.extend(f.tile(tile.value, tile.active).map(|c| (tile.origin, c)));
    }
    let mut cells = Vec::new();
    let mut brick_count = 0;
    for l1 in &tree.l1 {
        let mut l2 = l1.first_child;
        for i in 0..l1.tiles.len() {
            let content = if l1.is_child(i) {
                let children = f.children(&tree.l2[l2], &summaries, &mut brick_count);
                l2 += 1;
                (!children.is_empty()).then_some(CellContent::Node(children))
            } else {
                f.tile(l1.tiles[i], l1.is_active(i)).map(CellContent::Constant)
            };
            let origin = l1.origin.offset_by(Coord::child_offset(i, 5, L2_DIM));
            cells.extend(content.map(|content| Cell { origin, content }));
        }
    }
    let topology = tree.topology_stats();
    let leaf_range = ValueRange::union_all(summaries.iter().filter_map(|s| s.active_range));
    let stats = FrameStats {
        leaves: topology.leaves,
        active_voxels: topology.active_voxels,
        active_leaf_voxels: tree.leaves.masks.iter().map(|m| u64::from(m.count())).sum(),
        bbox: topology.bbox,
        active_range: ValueRange::union_all(leaf_range.into_iter().chain(f.active_range)),
        nonfinite: f.nonfinite_count + summaries.iter().map(|s| s.nonfinite).sum::<u64>(),
        rounding: summaries.iter().map(|s| s.rounding).fold(f.rounding, f64::max),
    };
    // A file may list its root entries in any order, and cells are numbered within one entry.
    let mut frame = FlatFrame { roots, cells, bricks: bricks.into(), stats };
    frame.sort();
    Flattened { frame, background }
}

struct Flattener {
    background: f32,
    reading: Reading,
    nonfinite_count: u64,
    rounding: f64,
    active_range: Option<ValueRange>,
}

impl Flattener {
    fn value<T: Scalar>(&mut self, value: T) -> f32 {
        self.rounding = self.rounding.max(self.reading.rounding(value));
        let value = self.reading.component.to_f32(value);
        self.nonfinite_count += u64::from(!value.is_finite());
        self.reading.finite(value)
    }

    /// A tile as a constant region, unless it is inactive background.
    fn tile<T: Scalar>(&mut self, value: T, active: bool) -> Option<Constant> {
        let value = self.value(value);
        let value = if active { value } else { inactive(value) };
        if active {
            self.active_range =
                ValueRange::union_all(self.active_range.into_iter().chain([ValueRange::of(value)]));
        }
        (active || value.to_bits() != self.background.to_bits()).then_some(Constant { value, active })
    }

    /// The children of an L2 node by their place; leaves that are bricks are numbered as they come, which is the order of
    /// leaves.
    fn children<T: Scalar>(
        &mut self,
        node: &crate::vdb::Internal<T>,
        summaries: &[LeafSummary],
        brick_count: &mut u32,
    ) -> Vec<(u16, Child)> {
        let mut leaf = node.first_child;
        let mut children = Vec::new();
        for i in 0..node.tiles.len() {
            let child = if node.is_child(i) {
                leaf += 1;
                match summaries[leaf - 1].kind {
                    LeafKind::Background => None,
                    LeafKind::Constant(constant) => Some(Child::Constant(constant)),
                    LeafKind::Brick => {
                        *brick_count += 1;
                        Some(Child::Brick(*brick_count - 1))
                    }
                }
            } else {
                self.tile(node.tiles[i], node.is_active(i)).map(Child::Constant)
            };
            children.extend(child.map(|child| (i as u16, child)));
        }
        children
    }
}

/// What becomes of a block of leaves, and those that are bricks.
fn bricks<T: Scalar>(
    values: Vec<T>,
    masks: &[Mask512],
    background: f32,
    reading: Reading,
) -> (Vec<LeafSummary>, Vec<Brick>) {
    let mut bricks = Vec::with_capacity(masks.len());
    let leaves = values.as_chunks::<BRICK_VOXELS>().0.iter().zip(masks);
    let summary = |(values, &active): (&[T; BRICK_VOXELS], &Mask512)| {
        // Made where it stays if it is one: copying it costs as much as looking at it.
        let rounding = values.iter().map(|v| reading.rounding(*v)).fold(0.0, f64::max);
        let values = std::array::from_fn(|i| reading.component.to_f32(values[i]));
        bricks.push(Brick { values, active, keeps_mask: true });
        let brick = bricks.last_mut().expect("one was pushed");
        let odd = brick.values.iter().filter(|v| !v.is_finite()).count() as u64;
        if odd > 0 {
            brick.values.iter_mut().for_each(|v| *v = reading.finite(*v));
        }
        if background == 0.0 {
            (0..BRICK_VOXELS)
                .filter(|&i| !active.get(i))
                .for_each(|i| brick.values[i] = inactive(brick.values[i]));
        }
        let active_range = brick.range_over(&active).map(|(min, max)| ValueRange { min, max });
        let kind = match brick.constant() {
            Some(c) if !c.active && c.value.to_bits() == background.to_bits() => LeafKind::Background,
            Some(constant) => LeafKind::Constant(constant),
            None => LeafKind::Brick,
        };
        if !matches!(kind, LeafKind::Brick) {
            bricks.pop();
        }
        LeafSummary { kind, active_range, nonfinite: odd, rounding }
    };
    let summaries = leaves.map(summary).collect();
    (summaries, bricks)
}

impl FlatFrame {
    /// Orders cells by their origin and renumbers the bricks in the order of their cells.
    fn sort(&mut self) {
        self.roots.sort_by_key(|(origin, _)| *origin);
        if self.cells.is_sorted_by_key(|c| c.origin) {
            return;
        }
        self.cells.sort_by_key(|c| c.origin);
        let bricks = std::mem::replace(&mut self.bricks, Vec::new().into());
        let mut moved: Vec<Option<Brick>> = bricks.into_iter().map(Some).collect();
        let mut bricks = Vec::with_capacity(moved.len());
        for cell in &mut self.cells {
            let CellContent::Node(children) = &mut cell.content else { continue };
            for (_, child) in children {
                if let Child::Brick(brick) = child {
                    let taken = moved[*brick as usize].take().expect("each brick is named once");
                    *brick = bricks.len() as u32;
                    bricks.push(taken);
                }
            }
        }
        self.bricks = vec![bricks].into();
    }
}
