//! Pictures as numbers, as PNG, and how far two are apart.

use std::io::{self, Write};

use super::Mode;
use super::scene::Scene;
use super::traverse::Real;

/// A traced picture.
#[derive(Clone, Debug, PartialEq)]
pub struct Image {
    /// Width and height.
    pub size: [u32; 2],
    /// Row by row from the top: three numbers, then the steps that the ray took.
    pub pixels: Vec<[f32; 4]>,
}

/// What lies behind the volume.
pub const BACKDROP: [f32; 3] = [0.055, 0.07, 0.10];

impl Image {
    /// As 8-bit RGB for people. Depths and steps are scaled to the picture's own range.
    pub fn to_rgb8(&self, scene: &Scene) -> Vec<u8> {
        let values = || self.pixels.iter().map(|p| p[0]);
        let largest = values().fold(0.0, f32::max).max(1e-30);
        let nearest = values().filter(|v| *v >= 0.0).fold(f32::INFINITY, f32::min);
        let color = |p: &[f32; 4]| -> [f32; 3] {
            match scene.mode {
                Mode::Density => std::array::from_fn(|c| BACKDROP[c] * (1.0 - p[0]) + p[c] * 0.95),
                Mode::Depth if p[0] < 0.0 => BACKDROP,
                Mode::Depth => [1.0 - 0.9 * (p[0] - nearest) / (largest - nearest).max(1e-30); 3],
                Mode::Steps => heat(p[0] / largest),
                Mode::First => [p[0] / largest; 3],
                Mode::Lit if !scene.level_set => [p[0], p[1], p[2]].map(shoulder),
                _ if p[..3] == [0.0; 3] => BACKDROP,
                _ => [p[0], p[1], p[2]],
            }
        };
        self.pixels.iter().flat_map(|p| color(p).map(to_srgb8)).collect()
    }

    /// The opacity of fog from the density along the ray of each pixel, by Beer and Lambert. Nothing is said of steps.
    pub fn of_optical_depths(size: [u32; 2], depths: &[f32], extinction: f64) -> Self {
        let pixel = |depth: &f32| {
            let opacity = opacity(*depth, extinction as f32);
            [opacity, opacity, opacity, 0.0]
        };
        Self { size, pixels: depths.iter().map(pixel).collect() }
    }

    /// The mean number of steps a ray took.
    pub fn mean_steps(&self) -> f64 {
        self.pixels.iter().map(|p| f64::from(p[3])).sum::<f64>() / self.pixels.len().max(1) as f64
    }
}

/// How much of what is behind is hidden by so much density along a ray.
pub fn opacity<F: Real>(depth: F, extinction: F) -> F {
    F::from_i32(1) - (-(depth * extinction)).exp()
}

/// The largest difference of two pixels' numbers, of the larger of the two or of 1. A number that is none is far from any.
pub fn apart(a: &[f32], b: &[f32]) -> f32 {
    let apart = |(a, b): (&f32, &f32)| {
        let apart = (a - b).abs() / a.abs().max(b.abs()).max(1.0);
        if a == b {
            0.0
        } else if apart.is_finite() {
            apart
        } else {
            f32::MAX
        }
    };
    a.iter().zip(b).map(apart).fold(0.0, f32::max)
}

/// Radiance above which the tone curve flattens.
const SHOULDER: f32 = 0.7;

/// The tone curve of lit fog: linear, then flattening towards 1, so that a fire does not clip to white.
fn shoulder(v: f32) -> f32 {
    let over = (v - SHOULDER).max(0.0) / (1.0 - SHOULDER);
    v.min(SHOULDER) + (1.0 - SHOULDER) * (over / (1.0 + over))
}

fn to_srgb8(v: f32) -> u8 {
    let v = v.clamp(0.0, 1.0);
    let s = if v <= 0.003_130_8 { v * 12.92 } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 };
    (s * 255.0).round() as u8
}

/// Black, violet, orange, white.
fn heat(v: f32) -> [f32; 3] {
    let stops = [[0.0, 0.0, 0.02], [0.25, 0.02, 0.35], [0.9, 0.25, 0.05], [1.0, 0.95, 0.7]];
    let at = v.clamp(0.0, 1.0) * 3.0;
    let i = (at as usize).min(2);
    std::array::from_fn(|c| stops[i][c] + (stops[i + 1][c] - stops[i][c]) * (at - i as f32))
}

fn encoder<W: Write>(out: W, size: [u32; 2]) -> png::Encoder<'static, W> {
    let mut encoder = png::Encoder::new(out, size[0], size[1]);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    encoder
}

/// Writes one 8-bit RGB picture.
///
/// # Errors
/// When `out` cannot be written.
pub fn write_png(out: impl Write, size: [u32; 2], rgb: &[u8]) -> io::Result<()> {
    let mut writer = encoder(out, size).write_header().map_err(io::Error::from)?;
    writer.write_image_data(rgb).map_err(io::Error::from)?;
    writer.finish().map_err(io::Error::from)
}

/// Writes several as an animated PNG, `fps` of them a second.
///
/// # Errors
/// When `out` cannot be written.
pub fn write_apng(out: impl Write, size: [u32; 2], frames: &[&[u8]], fps: u16) -> io::Result<()> {
    let mut encoder = encoder(out, size);
    encoder.set_animated(frames.len() as u32, 0).map_err(io::Error::from)?;
    encoder.set_frame_delay(1, fps.max(1)).map_err(io::Error::from)?;
    let mut writer = encoder.write_header().map_err(io::Error::from)?;
    for frame in frames {
        writer.write_image_data(frame).map_err(io::Error::from)?;
    }
    writer.finish().map_err(io::Error::from)
}

/// How far two pictures are apart.
#[derive(Clone, Copy, Debug, serde::Serialize, serde::Deserialize, schemars::JsonSchema)]
pub struct Difference {
    /// Root mean square over pixels and channels of the displayed picture, of 1.
    pub rmse: f64,
    /// Decibels under 1; null where they are the same.
    pub psnr: Option<f64>,
    /// Mean FLIP error: 0 is no visible difference, 1 the greatest.
    pub flip: f64,
}

/// Compares two pictures as they are displayed.
///
/// # Panics
/// When their sizes differ.
pub fn difference(size: [u32; 2], a: &[u8], b: &[u8]) -> Difference {
    assert_eq!(a.len(), b.len(), "pictures of one size");
    let square = |(a, b): (&u8, &u8)| ((f64::from(*a) - f64::from(*b)) / 255.0).powi(2);
    let rmse = (a.iter().zip(b).map(square).sum::<f64>() / a.len().max(1) as f64).sqrt();
    let image = |rgb| nv_flip::FlipImageRgb8::with_data(size[0], size[1], rgb);
    let map = nv_flip::flip(image(a), image(b), nv_flip::DEFAULT_PIXELS_PER_DEGREE);
    let flip = f64::from(nv_flip::FlipPool::from_image(&map).mean());
    Difference { rmse, psnr: (rmse > 0.0).then(|| -20.0 * rmse.log10()), flip }
}
