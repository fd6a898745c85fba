//! Index-to-world maps.

use super::cursor::Cursor;
use super::{Result, VdbError};

/// A grid's map from index space to world space.
#[derive(Clone, Debug, PartialEq)]
pub struct Transform {
    /// OpenVDB's name of the map, for instance `UniformScaleMap`.
    pub map: String,
    /// The affine matrix, row-major in OpenVDB's row-vector convention (`world = index · M`, the
    /// translation in the last row). `None` for a map that is not linear.
    pub matrix: Option<[f64; 16]>,
}

/// Deepest chain of maps inside a frustum map: OpenVDB writes one.
const MAX_NESTING: u32 = 2;

impl Transform {
    /// Reads a map's type name and parameters (OpenVDB `math/Maps.h`).
    pub(super) fn read(c: &mut Cursor) -> Result<Self> {
        read_nested(c, 0)
    }
}

fn read_nested(c: &mut Cursor, depth: u32) -> Result<Transform> {
    let at = c.at();
    let map = c.string("the transform's map type")?;
    let matrix = match map.as_str() {
        // Scale, voxel size and three inverses derived from the scale.
        "ScaleMap" | "UniformScaleMap" => {
            let [scale, ..] = vectors::<5>(c)?;
            Some(scale_translate(scale, [0.0; 3]))
        }
        // Translation, then the same five.
        "ScaleTranslateMap" | "UniformScaleTranslateMap" => {
            let [translation, scale, ..] = vectors::<6>(c)?;
            Some(scale_translate(scale, translation))
        }
        "TranslationMap" => {
            let [translation] = vectors::<1>(c)?;
            Some(scale_translate([1.0; 3], translation))
        }
        "AffineMap" | "UnitaryMap" => {
            let mut matrix = [0.0; 16];
            for v in &mut matrix {
                *v = c.f64("the transform's matrix")?;
            }
            Some(matrix)
        }
        "NonlinearFrustumMap" if depth < MAX_NESTING => {
            c.take((6 + 2) * 8, "the frustum's box, taper and depth")?;
            read_nested(c, depth + 1)?;
            None
        }
        other => {
            return Err(VdbError::corrupt(at, format!("unknown transform map {other:?}")));
        }
    };
    Ok(Transform { map, matrix })
}

fn vectors<const N: usize>(c: &mut Cursor) -> Result<[[f64; 3]; N]> {
    let mut out = [[0.0; 3]; N];
    for v in out.iter_mut().flatten() {
        *v = c.f64("the transform's parameters")?;
    }
    Ok(out)
}

fn scale_translate([x, y, z]: [f64; 3], [tx, ty, tz]: [f64; 3]) -> [f64; 16] {
    [x, 0.0, 0.0, 0.0, 0.0, y, 0.0, 0.0, 0.0, 0.0, z, 0.0, tx, ty, tz, 1.0]
}
