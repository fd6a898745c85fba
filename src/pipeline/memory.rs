//! How many frames are in memory at a time, where a limit is set.
//!
//! Frames are by far the largest thing that a build holds, and how large they are is known before a voxel is read. All
//! else is either the same for any sequence, or some bytes for each of its bricks.

use std::path::{Path, PathBuf};

use rayon::prelude::*;

use super::{Plan, Resources};
use crate::component::find_packed;
use crate::error::{Error, Result};
use crate::pack::{Pack, Provenance};
use crate::settings::Integers;
use crate::units::bytes;
use crate::vdb::{TreeSize, VdbFile};
use crate::volume::{BRICK_VOXELS, Brick};

/// What the program takes whatever it builds: its own pages, and what each thread encodes, packs and compares. Measured:
/// 14 MiB with 2 threads. A Vulkan driver's memory is not in it.
const PROGRAM: u64 = 12 << 20;
const OF_A_THREAD: u64 = 4 << 20;
/// What is kept of each leaf of a sequence while it is built. Measured: 75 (docs/decisions/0012-scale.md).
const OF_A_LEAF: u64 = 96;
/// What there is of a leaf of a frame beside its values: its part of a frame index, or what a comparison found.
const BESIDE_VALUES: u64 = 512;

/// How many frames of a plan may be in memory together; twice the threads where nothing is said.
pub(super) fn frames_at_once(plan: &Plan, resources: &Resources) -> Result<usize> {
    let most = 2 * rayon::current_num_threads();
    let Some(limit) = resources.memory else { return Ok(most) };
    let files: Vec<&Path> = plan.sequence.frames.iter().map(|frame| &*frame.path).collect();
    let grids: Vec<&str> = plan.selection.grids.iter().map(|grid| &*grid.source).collect();
    let sizes = sizes(&files, &grids, Integers::Keep)?;
    let leaves: u64 = sizes.iter().map(|size| size.leaves).sum();
    Ok(at_once(limit, leaves * OF_A_LEAF, &files, &sizes)?.min(most))
}

/// How many of a pack's sources may be compared with it together; as many as there are threads where nothing is said.
pub(super) fn compared_at_once(pack: &Pack, sources: &[PathBuf], resources: &Resources) -> Result<usize> {
    let most = rayon::current_num_threads();
    let Some(limit) = resources.memory else { return Ok(most) };
    let files: Vec<&Path> = sources.iter().map(|path| &**path).collect();
    let grids: Vec<&str> = pack.grids().iter().map(|grid| &*grid.name).collect();
    let integers = Provenance::of(pack).map_err(Error::provenance(pack))?.settings.integers;
    Ok(at_once(limit, size_of_val(pack.tree()) as u64, &files, &sizes(&files, &grids, integers)?)?.min(most))
}

/// How many of the largest file's frames fit beside what is kept.
fn at_once(limit: u64, kept: u64, files: &[&Path], sizes: &[TreeSize]) -> Result<usize> {
    // Values become bricks block by block.
    let brick = (size_of::<Brick>() - BRICK_VOXELS * size_of::<f32>()) as u64 + BESIDE_VALUES;
    let need = |size: &TreeSize| size.bytes + size.leaves * brick;
    let always = PROGRAM + OF_A_THREAD * rayon::current_num_threads() as u64 + kept;
    let Some((largest, file)) = sizes.iter().map(need).zip(files).max() else { return Ok(1) };
    match limit.saturating_sub(always) / largest.max(1) {
        0 => Err(Error::Usage(format!(
            "--memory {}: {} takes {} and all else {}: give it {}, fewer --threads, or smaller frames",
            bytes(limit),
            file.display(),
            bytes(largest),
            bytes(always),
            bytes(always + largest),
        ))),
        frames => Ok(usize::try_from(frames).unwrap_or(usize::MAX)),
    }
}

/// For each file the trees of some grids together: they are read one after another, and kept until all are.
fn sizes(files: &[&Path], grids: &[&str], integers: Integers) -> Result<Vec<TreeSize>> {
    let size = |path: &&Path| {
        let file = VdbFile::open(path).map_err(Error::vdb(path))?;
        let mut all = TreeSize::default();
        for (info, _) in grids.iter().filter_map(|grid| find_packed(&file.grids, grid, integers)) {
            let size = file.tree_size(info).map_err(Error::vdb(path))?;
            all = TreeSize { leaves: all.leaves + size.leaves, bytes: all.bytes + size.bytes };
        }
        Ok(all)
    };
    files.par_iter().map(size).collect()
}
