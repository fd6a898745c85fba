//! Stage 5 over the grids of a pack.

use super::Progress;
use crate::error::{Error, Result};
use crate::settings::{Encoding, Integers, Quality, Settings, whole_range};
use crate::stages::allocate::{self, AdaptiveGrid, AllocateError, Target};
use crate::stages::encodings::{ConstantAim, Encodings, GridCache, Terms};
use crate::stages::serialise::{GridInput, SerialiseError, gpu_bytes, tree_bytes};
use crate::vdb::{GridClass, voxel_size};
use crate::verify;
use crate::volume::ValueRange;

/// Decides how the bricks of every grid are coded.
pub(super) fn allocate(
    grids: &mut [GridInput],
    settings: &Settings,
    caches: Vec<Option<GridCache>>,
    progress: &mut dyn Progress,
) -> Result<()> {
    let mut encodings = Vec::new();
    for (grid, cache) in grids.iter().zip(caches) {
        check_integers(grid, settings)?;
        encodings.push(Encodings::new(&grid.tree, terms(grid, settings), cache).ok_or_else(|| {
            Error::Input(format!(
                "grid {:?}: its values span more than an f32 can hold: scale the grid down before the export",
                grid.name
            ))
        })?);
    }
    match &settings.encoding {
        Encoding::Uniform { codec, clustering } => {
            let codec = codec.codec();
            for (grid, encodings) in grids.iter_mut().zip(encodings) {
                grid.allocation = Some(match clustering {
                    None => allocate::uniform(&grid.tree, encodings, codec),
                    Some(clustering) => {
                        progress.stage("cluster", grid.tree.pool.len().into(), "bricks");
                        allocate::clustered(&mut grid.tree, encodings, codec, settings.range, clustering)
                            .map_err(|e| allocate_error(e, grid))?
                    }
                });
            }
            Ok(())
        }
        Encoding::Adaptive { .. } => adaptive(grids, encodings, settings, progress),
    }
}

fn adaptive(
    grids: &mut [GridInput],
    encodings: Vec<Encodings>,
    settings: &Settings,
    progress: &mut dyn Progress,
) -> Result<()> {
    let size = match settings.quality() {
        Quality::Size(bytes) => Some(bytes),
        Quality::BitsPerVoxel(bits) => Some((bits * 64.0 * leaves(grids) as f64) as u64),
        _ => None,
    };
    let target = Target {
        size,
        min_frame_psnr: settings.min_frame_psnr(),
        fixed_bytes: if size.is_some() { bytes(grids, tree_bytes)? } else { 0 },
    };
    let bricks: u64 = grids.iter().map(|g| u64::from(g.tree.pool.len())).sum();
    progress.stage("allocate", bricks, "bricks");
    let mut candidates = Vec::new();
    for (grid, encodings) in grids.iter_mut().zip(encodings) {
        let (quality, voxel_size) = (quality(grid, settings), smallest_voxel(grid));
        let peak = peak(grid);
        if let Quality::MaxError(bound) = quality
            && bound.absolute(peak, voxel_size) >= peak
        {
            return Err(Error::Usage(format!(
                "grid {:?}: {}",
                grid.name,
                whole_range(bound, peak, voxel_size)
            )));
        }
        candidates.push(AdaptiveGrid { voxel_size, quality, peak, tree: &mut grid.tree, encodings });
    }
    let allocations = allocate::adaptive(candidates, &target, &mut |bricks| progress.advance(bricks));
    let allocations = allocations.map_err(|e| allocate_error(e, &grids[0]))?;
    grids.iter_mut().zip(allocations).for_each(|(grid, allocation)| grid.allocation = Some(allocation));
    check_size(grids, settings.quality())
}

/// A level set whose distances keep a bound keeps its signs where the surface is further than this part of it: its surface
/// is what was asked for, and a wide band has edges along which thousands of voxels are next to 0.
const SIGNED_PART_OF_BOUND: f64 = 0.2;

fn terms(grid: &GridInput, settings: &Settings) -> Terms {
    let is_adaptive = settings.is_adaptive();
    let (quality, voxel_size) = (quality(grid, settings), smallest_voxel(grid));
    let sign_matters = verify::SIGN_MATTERS_VOXELS * voxel_size;
    let (aim, sign_matters) = match quality {
        Quality::MaxError(bound) => {
            let bound = bound.absolute(peak(grid), voxel_size);
            (ConstantAim::Max, sign_matters.min(SIGNED_PART_OF_BOUND * bound))
        }
        _ => (ConstantAim::Squares, sign_matters),
    };
    Terms {
        range: settings.range,
        aim,
        // One codec for all bricks is kept whatever it does to signs and integers: verification says so.
        sign_matters: (grid.class == GridClass::LevelSet && is_adaptive).then_some(sign_matters),
        error_below: (grid.is_integer && settings.integers != Integers::Nearest && is_adaptive)
            .then_some(verify::KEPT_INTEGER_ERROR),
    }
}

/// Integers that no float holds are not kept by any codec.
fn check_integers(grid: &GridInput, settings: &Settings) -> Result<()> {
    let frames = grid.frames.iter().zip(&grid.tree.frames);
    match frames.into_iter().find(|(_, frame)| frame.stats.rounding > 0.0) {
        Some((frame, _)) if grid.is_integer && settings.integers == Integers::Keep => {
            Err(Error::Input(format!(
                "grid {:?} frame {}: it has integers past 16,777,216 that no 32-bit float holds: set integers = \"split\" \
             (--integers split) to pack it as grids of 24 bits that give every integer back exactly, or \"nearest\" to \
             take the nearest floats",
                grid.name, frame.number
            )))
        }
        _ => Ok(()),
    }
}

fn peak(grid: &GridInput) -> f64 {
    ValueRange::peak(grid.tree.active_range(), grid.tree.background)
}

/// What is asked of a grid.
fn quality(grid: &GridInput, settings: &Settings) -> Quality {
    settings.quality().of_grid(grid.class, peak(grid), smallest_voxel(grid))
}

fn smallest_voxel(grid: &GridInput) -> f64 {
    grid.frames.iter().map(|f| voxel_size(&f.transform)).fold(f64::INFINITY, f64::min)
}

fn bytes(grids: &[GridInput], of: fn(&[GridInput]) -> Result<u64, SerialiseError>) -> Result<u64> {
    of(grids).map_err(|e| Error::Unsupported(e.to_string()))
}

/// Leaves of the source over all frames.
fn leaves(grids: &[GridInput]) -> u64 {
    grids.iter().flat_map(|g| &g.tree.frames).map(|f| f.stats.leaves).sum()
}

/// A size that the coarsest choice does not meet is an error that names the least.
fn check_size(grids: &[GridInput], quality: Quality) -> Result<()> {
    let leaves = leaves(grids);
    let bits_of = |bytes: u64| if leaves == 0 { 0.0 } else { bytes as f64 / (64.0 * leaves as f64) };
    if !quality.is_size() {
        return Ok(());
    }
    let bytes = bytes(grids, gpu_bytes)?;
    match quality {
        Quality::Size(asked) if bytes > asked => Err(Error::Usage(format!(
            "size: {asked} bytes on the GPU cannot be reached, the least is {bytes}: raise it, or pack fewer frames"
        ))),
        Quality::BitsPerVoxel(asked) if bits_of(bytes) > asked => Err(Error::Usage(format!(
            "bits_per_voxel: {asked} cannot be reached, the least is {:.4}: raise it, or pack fewer frames",
            bits_of(bytes)
        ))),
        _ => Ok(()),
    }
}

fn allocate_error(error: AllocateError, grid: &GridInput) -> Error {
    match error {
        AllocateError::Io(source) => Error::io(grid.tree.scratch.path())(source),
        AllocateError::OutOfRange(source) => Error::OutOfRange { grid: grid.name.clone(), source },
    }
}
