//! The picture ring: a pack as an engine shows it.
//!
//! Two halves, reported apart. (a) The wgpu tracer on the pack against the CPU tracer on the decoded
//! pack: the same numbers, or the shader, the upload or the file's layout is wrong. (b) The CPU tracer on
//! the pack against the CPU tracer on the source: what the format costs the eye.

use std::path::{Path, PathBuf};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::Sources;
use crate::codec::Codec;
use crate::error::{Error, Result};
use crate::pack::Pack;
use crate::render::{
    Device, Difference, Field, Image, Mode, Renderer, Scene, View, difference, trace, write_png,
};
use crate::settings::{DEFAULT_PSNR, Format, Quality, Settings};
use crate::stages::flatten::flatten;
use crate::stages::select::find;
use crate::vdb::VdbFile;

/// Pixels of a picture's side.
const SIDE: u32 = 256;
/// Frames of a grid that are shown: the first, the last and the one between.
const FRAMES: usize = 3;
/// How far the two tracers may be apart, of the larger number or of 1: `f32` sums a few hundred
/// segments.
const TRACER_TOLERANCE: f32 = 1e-5;
/// The same for BC4, whose interpolation is each GPU's own: 0.03 of the distance of a block's endpoints.
const BC4_TOLERANCE: f32 = 0.03;
/// The part of pixels that may be further apart: rays that meet an edge, where rounding decides.
const TIE_PIXELS: f64 = 0.001;
/// The same for BC4, which moves edges.
const BC4_TIE_PIXELS: f64 = 0.01;

/// How pictures are compared.
#[derive(Clone, Debug, Default)]
pub struct PictureSettings {
    /// The largest mean FLIP; by format where none is given.
    pub max_flip: Option<f64>,
    /// A folder for source, pack and difference side by side.
    pub images: Option<PathBuf>,
    /// What traces half (a).
    pub device: Device,
}

/// What the picture ring found.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
pub struct PicturesReport {
    /// What traced the pack for half (a); null where there is no GPU and no software Vulkan, and half (a)
    /// was left out.
    pub device: Option<String>,
    /// Why it was left out.
    pub skipped: Option<String>,
    /// The largest mean FLIP that passes.
    pub max_flip: f64,
    /// The pictures.
    pub pictures: Vec<PictureReport>,
    /// What failed.
    pub failures: Vec<String>,
}

/// One picture.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
pub struct PictureReport {
    /// The grid.
    pub grid: String,
    /// The frame's number.
    pub frame: i32,
    /// Half (a).
    pub tracers: Option<TracerDifference>,
    /// Half (b).
    pub source: Difference,
}

/// How far the wgpu tracer is from the CPU tracer.
#[derive(Clone, Copy, Debug, Serialize, Deserialize, JsonSchema)]
pub struct TracerDifference {
    /// Pixels that differ by more than the tolerance.
    pub pixels: u64,
    /// The largest difference, of the larger number or of 1.
    pub largest: f32,
}

/// The mean FLIP that a pack may cost. Twice to three times what the worst of nine real volumes
/// costs (docs/benchmarks/pictures.md), so that a pack past it is odd. What an adaptive pack was asked for says how
/// much it may cost; where that is a size, nothing is promised of its pictures.
fn default_max_flip(settings: &Settings) -> f64 {
    /// The most that FLIP gives.
    const ANYTHING: f64 = 1.0;
    /// At 45 dB; six decibels less are twice the error.
    const AT_DEFAULT_PSNR: f64 = 0.04;
    let at_psnr = |db: f64| (AT_DEFAULT_PSNR * ((DEFAULT_PSNR - db) / 6.0).exp2()).clamp(0.001, ANYTHING);
    match (settings.format, settings.quality) {
        _ if settings.clustering.is_some() => ANYTHING,
        (Format::F32 | Format::F16, _) => 0.001,
        (Format::Unorm8, _) => 0.006,
        (Format::Bc4 | Format::Bc7, _) => 0.04,
        (Format::Adaptive, Quality::Psnr(db)) => at_psnr(db),
        // An error that every voxel may have is a PSNR that the whole has at least.
        (Format::Adaptive, Quality::MaxError(bound)) => {
            bound.fraction().map_or(ANYTHING, |fraction| at_psnr(-20.0 * fraction.log10()))
        }
        (Format::Adaptive, Quality::BitsPerVoxel(_) | Quality::Size(_)) => ANYTHING,
    }
}

/// Traces the first, a middle and the last frame of each grid and compares.
///
/// # Errors
/// When a source or a chunk of the pack cannot be read, a picture not be written, or a device fails.
/// Differences are no error: they are in the report.
pub fn pictures(pack: &Pack, sources: &Sources, settings: &PictureSettings) -> Result<PicturesReport> {
    let has_bc4 = pack.atlas(Codec::Bc4).is_some();
    let renderer = Renderer::new(pack, settings.device).map_err(|e| Error::Unsupported(e.to_string()))?;
    let mut report = PicturesReport {
        device: renderer.is_gpu().then(|| renderer.device_name().to_owned()),
        skipped: renderer.fallback.clone(),
        max_flip: settings.max_flip.unwrap_or(default_max_flip(&sources.settings)),
        pictures: Vec::new(),
        failures: Vec::new(),
    };
    if let Some(folder) = &settings.images {
        std::fs::create_dir_all(folder).map_err(Error::io(folder))?;
    }
    for (g, grid) in pack.grids.iter().enumerate() {
        for f in shown_frames(grid.frames.len()) {
            crate::interrupt::check()?;
            let picture = compare(pack, sources, &renderer, [g, f], settings)?;
            let Some(picture) = picture else { continue };
            let what = format!("grid {:?} frame {}", grid.name, picture.frame);
            let ties = if has_bc4 { BC4_TIE_PIXELS } else { TIE_PIXELS };
            if let Some(t) = picture.tracers.filter(|t| t.pixels as f64 > ties * f64::from(SIDE * SIDE)) {
                report.failures.push(format!(
                    "{what}: {} pixels differ between {} and the CPU tracer, by up to {:.2e}",
                    t.pixels,
                    renderer.device_name(),
                    t.largest
                ));
            }
            if picture.source.flip > report.max_flip {
                report.failures.push(format!(
                    "{what}: FLIP {:.4} is above {:.4} (max_flip): choose a finer format",
                    picture.source.flip, report.max_flip
                ));
            }
            report.pictures.push(picture);
        }
    }
    Ok(report)
}

/// The places of the frames of a sequence that are shown.
pub fn shown_frames(count: usize) -> Vec<usize> {
    let mut frames: Vec<usize> =
        (0..FRAMES.min(count)).map(|i| i * (count - 1) / (FRAMES - 1).max(1)).collect();
    frames.dedup();
    frames
}

/// `None` for a frame without a voxel.
fn compare(
    pack: &Pack,
    sources: &Sources,
    renderer: &Renderer,
    [g, f]: [usize; 2],
    settings: &PictureSettings,
) -> Result<Option<PictureReport>> {
    let (grid, frame) = (&pack.grids[g], &pack.grids[g].frames[f]);
    let Some((scene, of_pack)) = trace_pack(pack, [g, f])? else { return Ok(None) };
    let tracers = if renderer.is_gpu() {
        let of_gpu = renderer.render(g, f, &scene).map_err(|e| Error::Other(e.to_string()))?;
        let has_bc4 = pack.atlas(Codec::Bc4).is_some();
        Some(tracer_difference(&of_gpu, &of_pack, if has_bc4 { BC4_TOLERANCE } else { TRACER_TOLERANCE }))
    } else {
        None
    };
    let of_source = trace_source(pack, sources, [g, f], &scene)?;
    let (a, b) = (of_source.to_rgb8(scene.mode), of_pack.to_rgb8(scene.mode));
    if let Some(folder) = &settings.images {
        let name = format!("{}-{:04}.png", file_name(&grid.name), frame.record.number);
        write_side_by_side(&folder.join(name), &a, &b)?;
    }
    Ok(Some(PictureReport {
        grid: grid.name.clone(),
        frame: frame.record.number,
        tracers,
        source: difference([SIDE; 2], &a, &b),
    }))
}

/// What the CPU tracer makes of a frame, and the scene it is in; `None` for one without a voxel.
fn trace_pack(pack: &Pack, [g, f]: [usize; 2]) -> Result<Option<(Scene, Image)>> {
    let (grid, frame) = (&pack.grids[g], &pack.grids[g].frames[f]);
    let damaged = |e: &dyn std::fmt::Display| {
        Error::Verify(format!("grid {:?} frame {}: {e}", grid.name, frame.record.number))
    };
    let packed = Field::from_pack(&pack.frame(g, f).map_err(|e| damaged(&e))?).map_err(|e| damaged(&e))?;
    if packed.bounds.is_empty() {
        return Ok(None);
    }
    let scene = Scene::new(grid, frame, packed.bounds, &View::default(), Mode::of_grid(grid), [SIDE; 2]);
    let image = trace::<f32>(&packed, &scene).ok_or_else(|| damaged(&"its transform cannot be inverted"))?;
    Ok(Some((scene, image)))
}

fn trace_source(pack: &Pack, sources: &Sources, [g, f]: [usize; 2], scene: &Scene) -> Result<Image> {
    let grid = &pack.grids[g];
    let source = source_field(sources, grid.frames[f].record.source, &grid.name)?;
    Ok(trace::<f32>(&source, scene).expect("the transform was inverted before"))
}

/// A frame as people see it, 8-bit RGB.
#[derive(Clone, Debug)]
pub struct Seen {
    /// Pixels of a side.
    pub side: u32,
    /// The pack.
    pub pack: Vec<u8>,
    /// Its source, where that is at hand.
    pub source: Option<Vec<u8>>,
}

/// Traces a frame of a grid on the CPU, with the picture ring's camera; `None` for one without a voxel.
///
/// # Errors
/// When the source or a chunk of the pack cannot be read.
pub fn look(pack: &Pack, sources: Option<&Sources>, place: [usize; 2]) -> Result<Option<Seen>> {
    let Some((scene, of_pack)) = trace_pack(pack, place)? else { return Ok(None) };
    let source = sources.map(|sources| trace_source(pack, sources, place, &scene)).transpose()?;
    let source = source.map(|image| image.to_rgb8(scene.mode));
    Ok(Some(Seen { side: SIDE, pack: of_pack.to_rgb8(scene.mode), source }))
}

fn source_field(sources: &Sources, source: u32, grid: &str) -> Result<Field> {
    let path = sources.path(source);
    let file = VdbFile::open(path).map_err(Error::vdb(path))?;
    let info = find(&file.grids, grid).ok_or_else(|| {
        Error::Verify(format!("{}: grid {grid:?} is in the pack, but not in the file", path.display()))
    })?;
    let flat = flatten(&file, path, info, sources.settings.nonfinite)?;
    Ok(Field::from_flat(flat.frame, flat.background))
}

fn tracer_difference(a: &Image, b: &Image, tolerance: f32) -> TracerDifference {
    let mut out = TracerDifference { pixels: 0, largest: 0.0 };
    for (a, b) in a.pixels.iter().zip(&b.pixels) {
        let apart = |c: usize| (a[c] - b[c]).abs() / a[c].abs().max(b[c].abs()).max(1.0);
        let apart = (0..3).map(apart).fold(0.0, f32::max);
        out.pixels += u64::from(apart > tolerance);
        out.largest = out.largest.max(apart);
    }
    out
}

/// A grid's name without what file systems do not take.
fn file_name(grid: &str) -> String {
    grid.chars().map(|c| if c.is_alphanumeric() || "._-".contains(c) { c } else { '_' }).collect()
}

/// How much the difference is brightened.
pub const DIFFERENCE_GAIN: u32 = 8;

/// How far two pictures are apart, brightened.
pub fn difference_map(a: &[u8], b: &[u8]) -> Vec<u8> {
    let apart = |(a, b): (&u8, &u8)| (u32::from(a.abs_diff(*b)) * DIFFERENCE_GAIN).min(255) as u8;
    a.iter().zip(b).map(apart).collect()
}

fn write_side_by_side(path: &Path, source: &[u8], pack: &[u8]) -> Result<()> {
    let stride = SIDE as usize * 3;
    let mut out = Vec::with_capacity(3 * source.len());
    for (a, b) in source.chunks_exact(stride).zip(pack.chunks_exact(stride)) {
        out.extend_from_slice(a);
        out.extend_from_slice(b);
        out.extend(difference_map(a, b));
    }
    let file = std::fs::File::create(path).map_err(Error::io(path))?;
    write_png(std::io::BufWriter::new(file), [3 * SIDE, SIDE], &out).map_err(Error::io(path))
}
