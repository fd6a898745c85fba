//! Stage 5 over the grids of a pack.

use super::Progress;
use crate::error::{Error, Result};
use crate::settings::{Format, Quality, Settings};
use crate::stages::allocate::{self, AdaptiveGrid, AllocateError, Target};
use crate::stages::encodings::{ConstantAim, Encodings, GridCache, Terms};
use crate::stages::serialise::{GridInput, SerialiseError, gpu_bytes, tree_bytes};
use crate::vdb::{GridClass, voxel_size};
use crate::verify;

/// Decides how the bricks of every grid are coded.
pub(super) fn allocate(
    grids: &mut [GridInput],
    settings: &Settings,
    caches: Vec<Option<GridCache>>,
    progress: &mut dyn Progress,
) -> Result<()> {
    let mut encodings = Vec::new();
    for (grid, cache) in grids.iter().zip(caches) {
        encodings.push(Encodings::new(&grid.tree, terms(grid, settings), cache).ok_or_else(|| {
            Error::Input(format!(
                "grid {:?}: its values span more than an f32 can hold: scale the grid down before the export",
                grid.name
            ))
        })?);
    }
    match settings.format.codec() {
        Some(codec) => {
            for (grid, encodings) in grids.iter_mut().zip(encodings) {
                grid.allocation = Some(match &settings.clustering {
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
        None => adaptive(grids, encodings, settings, progress),
    }
}

fn adaptive(
    grids: &mut [GridInput],
    encodings: Vec<Encodings>,
    settings: &Settings,
    progress: &mut dyn Progress,
) -> Result<()> {
    let target = Target {
        quality: settings.quality,
        min_frame_psnr: settings.min_frame_psnr,
        fixed_bytes: if is_size(settings.quality) { bytes(grids, tree_bytes)? } else { 0 },
    };
    let bricks: u64 = grids.iter().map(|g| u64::from(g.tree.pool.len())).sum();
    progress.stage("allocate", bricks, "bricks");
    let candidates = grids.iter_mut().zip(encodings).map(|(grid, encodings)| AdaptiveGrid {
        voxel_size: smallest_voxel(grid),
        tree: &mut grid.tree,
        encodings,
    });
    let allocations =
        allocate::adaptive(candidates.collect(), &target, &mut |bricks| progress.advance(bricks));
    let allocations = allocations.map_err(|e| allocate_error(e, &grids[0]))?;
    grids.iter_mut().zip(allocations).for_each(|(grid, allocation)| grid.allocation = Some(allocation));
    check_size(grids, settings.quality)
}

fn terms(grid: &GridInput, settings: &Settings) -> Terms {
    Terms {
        range: settings.range,
        aim: match settings.quality {
            Quality::MaxError(_) => ConstantAim::Max,
            _ => ConstantAim::Squares,
        },
        // One codec for all bricks is kept whatever it does to signs: verification says so.
        sign_matters: (grid.class == GridClass::LevelSet && settings.format == Format::Adaptive)
            .then(|| verify::SIGN_MATTERS_VOXELS * smallest_voxel(grid)),
    }
}

fn smallest_voxel(grid: &GridInput) -> f64 {
    grid.frames.iter().map(|f| voxel_size(&f.transform)).fold(f64::INFINITY, f64::min)
}

/// Whether it is bytes that are asked for, one way or another.
fn is_size(quality: Quality) -> bool {
    matches!(quality, Quality::Size(_) | Quality::BitsPerVoxel(_))
}

fn bytes(grids: &[GridInput], of: fn(&[GridInput]) -> Result<u64, SerialiseError>) -> Result<u64> {
    of(grids).map_err(|e| Error::Unsupported(e.to_string()))
}

/// A size that the coarsest choice does not meet is an error that names the least.
fn check_size(grids: &[GridInput], quality: Quality) -> Result<()> {
    let leaves: u64 = grids.iter().flat_map(|g| &g.tree.frames).map(|f| f.stats.leaves).sum();
    let bits_of = |bytes: u64| if leaves == 0 { 0.0 } else { bytes as f64 / (64.0 * leaves as f64) };
    if !is_size(quality) {
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
