//! What a grid of a pack was asked for, as far as its voxels can keep it or not.

use crate::pack::Grid;
use crate::settings::{Integers, Quality, Settings};
use crate::vdb::GridClass;

/// A level set's sign may flip where the surface is nearer than this many voxels: there the sign is
/// within what any quantisation of the distance moves the surface by.
pub const SIGN_MATTERS_VOXELS: f64 = 0.1;

/// An integer is kept where rounding what a GPU reads gives it back.
pub const KEPT_INTEGER_ERROR: f64 = 0.5;

/// What one grid has to keep.
pub(super) struct Promise<'a> {
    /// The settings that the pack was made with.
    pub settings: &'a Settings,
    /// What was asked of the grid.
    pub quality: Quality,
    /// What its errors are measured against.
    pub peak: f64,
    /// The error that no voxel may have on any GPU, if that was promised, in the grid's units.
    pub max_error: Option<f64>,
    /// The error that every voxel has to be below on any GPU, if it is integers that are kept.
    pub error_below: Option<f64>,
    /// The distance above which a level set's sign counts; `None` for other grids.
    pub sign_matters: Option<f64>,
}

impl<'a> Promise<'a> {
    /// What a grid has to keep whose source's values are integers, or are not.
    pub fn new(grid: &Grid, settings: &'a Settings, is_integer: bool) -> Self {
        let (peak, voxel_size) = (grid.peak(), grid.voxel_size());
        let is_level_set = grid.is_level_set();
        let class = if is_level_set { GridClass::LevelSet } else { GridClass::Unknown };
        let quality = settings.quality().of_grid(class, peak, voxel_size);
        Self {
            settings,
            quality,
            peak,
            max_error: match quality {
                Quality::MaxError(bound) if settings.is_adaptive() => Some(bound.absolute(peak, voxel_size)),
                _ => None,
            },
            error_below: (is_integer && settings.integers != Integers::Nearest).then_some(KEPT_INTEGER_ERROR),
            sign_matters: is_level_set.then_some(SIGN_MATTERS_VOXELS * voxel_size),
        }
    }

    /// Whether it says of each voxel how far it may be off.
    pub fn bounds_voxels(&self) -> bool {
        self.max_error.is_some() || self.error_below.is_some()
    }
}
