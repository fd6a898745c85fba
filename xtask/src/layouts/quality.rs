//! What encoding did to a field, computed on the CPU from decoded texels: seams between bricks, PSNR, and pictures.

use rand::{Rng, SeedableRng};
use rand_xoshiro::Xoshiro256PlusPlus;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use volpack::volume::CoordBox;

use super::bricks::Decoded;
use super::view::View;

/// Points at which PSNR is measured.
const POINTS: usize = 200_000;
/// Points along each axis of a face at which seams are measured.
const FACE: usize = 8;

/// A field between voxels.
pub type Field<'a> = &'a (dyn Fn([f64; 3]) -> f64 + Sync);

/// Jumps of the field across the faces between bricks that have texels, as fractions of the grid's range.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct Seams {
    pub mean: f64,
    pub max: f64,
}

/// Measures the seams of a set of bricks with that pitch.
pub fn seams(decoded: &Decoded, pitch: i32, peak: f64) -> Seams {
    let pitch = f64::from(pitch);
    let (mut sum, mut max, mut points) = (0.0, 0.0f64, 0u64);
    for (place, brick) in decoded.with_texels() {
        for axis in 0..3 {
            let mut next = *place;
            next[axis] += 1;
            let Some(neighbour) = decoded.texels_at(next) else { continue };
            for i in 0..FACE * FACE {
                let mut p = [0.0; 3];
                p[(axis + 1) % 3] = ((i % FACE) as f64 + 0.5) / FACE as f64 * pitch;
                p[(axis + 2) % 3] = ((i / FACE) as f64 + 0.5) / FACE as f64 * pitch;
                let there = decoded.in_brick(neighbour, p);
                p[axis] = pitch;
                let jump = (decoded.in_brick(brick, p) - there).abs() / peak;
                sum += jump;
                max = max.max(jump);
                points += 1;
            }
        }
    }
    Seams { mean: sum / points.max(1) as f64, max }
}

/// The PSNR of a field against another at random points of a box, in dB; infinite without a difference.
pub fn psnr(field: Field, source: Field, voxels: CoordBox, peak: f64) -> f64 {
    let mut random = Xoshiro256PlusPlus::seed_from_u64(1);
    let points: Vec<[f64; 3]> = (0..POINTS)
        .map(|_| {
            std::array::from_fn(|a| random.gen_range(f64::from(voxels.min.0[a])..=f64::from(voxels.max.0[a])))
        })
        .collect();
    let squares: f64 = points.par_iter().map(|p| (field(*p) - source(*p)).powi(2)).sum();
    10.0 * (peak * peak * POINTS as f64 / squares).log10()
}

/// The picture of a field: what the shaders compute, in f64 and without hardware filtering.
pub fn march(field: Field, view: &View, size: [u32; 2], step: f64) -> Vec<f32> {
    let pixels: Vec<_> = (0..size[1]).flat_map(|y| (0..size[0]).map(move |x| [x, y])).collect();
    let sum = |pixel: &[u32; 2]| {
        let (direction, [start, end]) = view.ray(*pixel, size);
        let samples = ((end - start) / step).ceil().max(0.0) as u32;
        let at =
            |k: u32| std::array::from_fn(|a| view.origin[a] + direction[a] * (start + f64::from(k) * step));
        ((0..samples).map(|k| field(at(k))).sum::<f64>() * step) as f32
    };
    pixels.par_iter().map(sum).collect()
}

/// How far pictures are apart, as fractions of the largest value of the second. The mean is over pixels that are not 0 in it.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct Apart {
    pub mean: f64,
    pub max: f64,
}

/// The mean of a picture.
pub fn mean(picture: &[f32]) -> f64 {
    picture.iter().map(|v| f64::from(*v)).sum::<f64>() / picture.len() as f64
}

/// Compares a picture with another.
pub fn apart(ours: &[f32], reference: &[f32]) -> Apart {
    let peak = f64::from(reference.iter().copied().fold(f32::MIN_POSITIVE, f32::max));
    let differences = || ours.iter().zip(reference).map(|(a, b)| f64::from((a - b).abs()) / peak);
    let covered = reference.iter().filter(|v| **v != 0.0).count();
    Apart { mean: differences().sum::<f64>() / covered.max(1) as f64, max: differences().fold(0.0, f64::max) }
}
