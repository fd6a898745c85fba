//! The picture ring: a pack as an engine shows it.
//!
//! Two halves, reported apart. (a) The wgpu tracer on the pack against the CPU tracer on the decoded
//! pack: the same numbers, or the shader, the upload or the file's layout is wrong. (b) The CPU tracer on
//! the pack against the CPU tracer on the source: what the format costs the eye.

use std::path::{Path, PathBuf};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{Reading, Sources, not_packable};
use crate::cancel::CancelToken;
use crate::component::find_packed;
use crate::error::{Error, Result};
use crate::file_name::check_name;
use crate::pack::{Grid, Pack};
use crate::render::{
    DecodedFrame, Device, Difference, Image, Mode, Renderer, Scene, TraceError, View, apart, difference,
    optical_depths, spread, trace, trace_noting_gpu_spread, write_png,
};
use crate::vdb::{VdbFile, with_scalar_type};

/// Pixels of a picture's side.
const SIDE: u32 = 256;
/// Frames of a grid that are shown: the first, the last and the one between.
const FRAMES: usize = 3;
/// How far the two tracers may be apart, of the larger number or of 1: `f32` sums a few hundred
/// segments.
const TRACER_TOLERANCE: f32 = 1e-5;
/// The same for pixels whose rays read texels that GPUs decode differently, which is BC4: 0.03 of the distance of a
/// block's endpoints.
const VARYING_TOLERANCE: f32 = 0.03;
/// How much further, of what moving the ray by rounding changes on the CPU: sixteen ways to move it are not all ways.
const SPREAD_TOLERANCE: f32 = 2.0;
/// The part of pixels that may be further apart: rays that meet an edge, where rounding decides.
const TIE_PIXELS: f64 = 0.001;
/// Where rounding decides more than this part of what is drawn, a picture proves nothing of the shader, which is said.
const DECIDED_PART: f64 = 0.5;
/// A mean FLIP that people notice where nothing was asked: the worst that bc4 and bc7 cost nine real volumes is a third to
/// a half of it (docs/benchmarks/pictures.md).
const NOTICEABLE_FLIP: f64 = 0.04;
/// Where hardly anything of a source would be seen, its pictures are taken at an extinction at which this part of the
/// pixels that it covers has an optical depth of 1 at least: an opacity of 63 %.
const SEEN_PART: f64 = 0.01;
/// Less than half a step of the 8 bits that a picture is shown in.
const BLANK: f32 = 0.5 / 255.0;

/// How pictures are compared.
#[derive(Clone, Debug, Default)]
pub struct PictureSettings {
    /// The largest mean FLIP that passes; none where nothing was asked, and what is noticeable is a warning.
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
    /// The largest mean FLIP that passes; null where none was asked.
    pub max_flip: Option<f64>,
    /// The pictures.
    pub pictures: Vec<PictureReport>,
    /// Frames of which no picture proves anything, and why.
    pub not_compared: Vec<String>,
    /// What is likely to be noticed, where no limit was asked.
    pub warnings: Vec<String>,
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
    /// The optical depth of a density of 1 over a world unit; the same for all pictures of a grid.
    pub extinction: f64,
    /// Half (a).
    pub tracers: Option<TracerDifference>,
    /// Half (b).
    pub source: Difference,
}

/// How far the wgpu tracer is from the CPU tracer.
#[derive(Clone, Copy, Debug, Serialize, Deserialize, JsonSchema)]
pub struct TracerDifference {
    /// Pixels that differ by more than the tolerance, and by more than rounding explains.
    pub pixels: u64,
    /// Pixels that differ by more than the tolerance, and by no more than rounding explains.
    pub undecided: u64,
    /// How many may, since rounding decides on which side of an edge a ray passes.
    pub allowed: u64,
    /// The largest difference that rounding does not explain, of the larger number or of 1.
    pub largest: f32,
}

/// Traces the first, a middle and the last frame of each grid and compares.
///
/// # Errors
/// When a source or a chunk of the pack cannot be read, a picture not be written, or a device fails.
/// Differences are no error: they are in the report.
pub fn pictures(
    pack: &Pack,
    sources: &Sources,
    settings: &PictureSettings,
    cancel: &CancelToken,
) -> Result<PicturesReport> {
    let renderer = Renderer::new(pack, settings.device).map_err(|e| Error::Unsupported(e.to_string()))?;
    let mut report = PicturesReport {
        device: renderer.is_gpu().then(|| renderer.device_name().to_owned()),
        skipped: renderer.fallback.clone(),
        max_flip: settings.max_flip,
        pictures: Vec::new(),
        not_compared: Vec::new(),
        warnings: Vec::new(),
        failures: Vec::new(),
    };
    if let Some(folder) = &settings.images {
        std::fs::create_dir_all(folder).map_err(Error::io(folder))?;
    }
    for g in 0..pack.grids().len() {
        compare_grid(pack, sources, &renderer, g, settings, &mut report, cancel)?;
    }
    Ok(report)
}

/// The places of the frames of a sequence that are shown.
pub fn shown_frames(count: usize) -> Vec<usize> {
    let shown = FRAMES.min(count);
    (0..shown).map(|i| i * (count - 1) / (shown - 1).max(1)).collect()
}

/// What a frame of the source looks like.
enum SourcePicture {
    /// A surface.
    Lit(Image),
    /// The density along the ray of each pixel, before any extinction.
    Fog(Vec<f32>),
}

fn compare_grid(
    pack: &Pack,
    sources: &Sources,
    renderer: &Renderer,
    g: usize,
    settings: &PictureSettings,
    report: &mut PicturesReport,
    cancel: &CancelToken,
) -> Result<()> {
    let grid = &pack.grids()[g];
    let what = |f: usize| format!("grid {:?} frame {}", grid.name, grid.frames[f].record.number);
    let mut shown = Vec::new();
    for f in shown_frames(grid.frames.len()) {
        cancel.check()?;
        let scene = scene(grid, f);
        match source_picture(&source_field(pack, sources, [g, f])?, &scene) {
            Ok(picture) => shown.push((f, scene, picture)),
            Err(e) => report.not_compared.push(format!("{}: {e}", what(f))),
        }
    }
    let Some((_, scene, _)) = shown.first() else { return Ok(()) };
    let extinction = visible_extinction(scene.extinction, shown.iter().map(|(.., picture)| picture));
    for (f, scene, of_source) in shown {
        cancel.check()?;
        let scene = Scene { extinction, ..scene };
        let of_source = of_source.at(&scene);
        let field = packed_field(pack, [g, f])?;
        let (of_pack, varies) = match trace_noting_gpu_spread::<f32>(&field, &scene) {
            Ok(traced) => traced,
            Err(e) => {
                report.not_compared.push(format!("{}: {e}", what(f)));
                continue;
            }
        };
        if is_blank(&of_source) && is_blank(&of_pack) {
            report.not_compared.push(format!("{}: the source's picture is blank", what(f)));
            continue;
        }
        let tracers = if renderer.is_gpu() {
            let of_gpu = renderer.render(g, f, &scene).map_err(|e| Error::Other(e.to_string()))?;
            let found = tracer_difference(&of_gpu, &of_pack, &varies, &field, &scene);
            Some(found.map_err(|e| Error::Other(e.to_string()))?)
        } else {
            None
        };
        let drawn = of_pack.pixels.iter().filter(|pixel| pixel[..3] != [0.0; 3]).count();
        if tracers.is_some_and(|t| t.undecided as f64 > DECIDED_PART * drawn as f64) {
            report.not_compared.push(format!(
                "{}: {} and the CPU tracer: rounding decides most pixels",
                what(f),
                renderer.device_name()
            ));
        }
        let (a, b) = (of_source.to_rgb8(&scene), of_pack.to_rgb8(&scene));
        if let Some(folder) = &settings.images {
            let name = file_name(&grid.name, grid.frames[f].record.number);
            write_side_by_side(&folder.join(name), &a, &b)?;
        }
        let picture = PictureReport {
            grid: grid.name.clone(),
            frame: grid.frames[f].record.number,
            extinction,
            tracers,
            source: difference([SIDE; 2], &a, &b),
        };
        judge(&what(f), &picture, renderer.device_name(), report);
        report.pictures.push(picture);
    }
    Ok(())
}

/// Adds what is wrong with a picture to the report, or likely to be noticed.
fn judge(what: &str, picture: &PictureReport, device: &str, report: &mut PicturesReport) {
    if let Some(t) = picture.tracers.filter(|t| t.pixels > t.allowed) {
        report.failures.push(format!(
            "{what}: {} pixels differ between {device} and the CPU tracer, by up to {:.2e}",
            t.pixels, t.largest
        ));
    }
    let flip = picture.source.flip;
    match report.max_flip {
        Some(limit) if flip > limit => report.failures.push(format!(
            "{what}: visual difference (FLIP) {flip:.4}, limit {limit:.4} (max_flip): choose a finer quality or format"
        )),
        None if flip > NOTICEABLE_FLIP => report.warnings.push(format!(
            "{what}: visual difference (FLIP) {flip:.4}: compare the pictures (--images DIR), or choose a finer quality \
             or format"
        )),
        _ => {}
    }
}

/// How the ring looks at a frame.
fn scene(grid: &Grid, frame: usize) -> Scene {
    Scene::new(grid, frame, &View::default(), Mode::of_grid(grid), [SIDE; 2])
}

fn source_picture(field: &DecodedFrame, scene: &Scene) -> Result<SourcePicture, TraceError> {
    Ok(match scene.mode {
        Mode::Density => SourcePicture::Fog(optical_depths::<f32>(field, scene)?),
        _ => SourcePicture::Lit(trace::<f32>(field, scene)?),
    })
}

impl SourcePicture {
    fn at(self, scene: &Scene) -> Image {
        match self {
            Self::Lit(image) => image,
            Self::Fog(depths) => Image::of_optical_depths(scene.size, &depths, scene.extinction),
        }
    }
}

/// An extinction at which the source's pictures show something: a grid whose greatest density is an outlier is hardly seen
/// at the one that suits that.
fn visible_extinction<'a>(extinction: f64, pictures: impl Iterator<Item = &'a SourcePicture>) -> f64 {
    let depths = pictures.flat_map(|picture| match picture {
        SourcePicture::Fog(depths) => &depths[..],
        SourcePicture::Lit(_) => &[],
    });
    let mut covered: Vec<f32> = depths.copied().filter(|depth| *depth > 0.0 && depth.is_finite()).collect();
    let seen = (covered.len() as f64 * SEEN_PART).ceil() as usize;
    if seen == 0 {
        return extinction;
    }
    let (_, depth, _) = covered.select_nth_unstable_by(seen - 1, |a, b| b.total_cmp(a));
    extinction.max(1.0 / f64::from(*depth))
}

fn is_blank(image: &Image) -> bool {
    image.pixels.iter().all(|pixel| pixel[..3].iter().all(|v| v.abs() < BLANK))
}

fn packed_field(pack: &Pack, [g, f]: [usize; 2]) -> Result<DecodedFrame> {
    let field = pack.frame(g, f).and_then(|reader| DecodedFrame::from_pack(&reader));
    field.map_err(|e| {
        let grid = &pack.grids()[g];
        Error::Verify(format!("grid {:?} frame {}: {e}", grid.name, grid.frames[f].record.number))
    })
}

fn source_field(pack: &Pack, sources: &Sources, [g, f]: [usize; 2]) -> Result<DecodedFrame> {
    let grid = &pack.grids()[g];
    let path = sources.path(grid.frames[f].record.source);
    let file = VdbFile::open(path).map_err(Error::vdb(path))?;
    let settings = &sources.provenance.settings;
    let (info, component) = find_packed(&file.grids, &grid.name, settings.integers)
        .ok_or_else(|| missing_grid(path, &grid.name))?;
    let reading = Reading { component, nonfinite: settings.nonfinite };
    with_scalar_type!(&info.value_type,
        T => {
            let tree = file.read_tree::<T>(info).map_err(Error::vdb(path))?;
            Ok(DecodedFrame::from_tree(&tree, |value: T| reading.value(value)))
        },
        other => Err(not_packable(path, &grid.name, other))
    )
}

/// The error for a source without the grid that was packed from it.
pub(super) fn missing_grid(path: &Path, grid: &str) -> Error {
    Error::Verify(format!("{}: grid {grid:?} is in the pack, but not in the file", path.display()))
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

/// Traces a frame of a grid on the CPU with the picture ring's camera, and the extinction that the ring found to show
/// something; `None` for one that cannot be traced.
///
/// # Errors
/// When the source or a chunk of the pack cannot be read.
pub fn look(
    pack: &Pack,
    sources: Option<&Sources>,
    [g, f]: [usize; 2],
    extinction: Option<f64>,
) -> Result<Option<Seen>> {
    let scene = scene(&pack.grids()[g], f);
    let scene = Scene { extinction: extinction.unwrap_or(scene.extinction), ..scene };
    let draw = |field: &DecodedFrame| trace::<f32>(field, &scene).map(|image| image.to_rgb8(&scene));
    let Ok(of_pack) = draw(&packed_field(pack, [g, f])?) else { return Ok(None) };
    let source = sources.map(|sources| source_field(pack, sources, [g, f])).transpose()?;
    let source = source.and_then(|field| draw(&field).ok());
    Ok(Some(Seen { side: SIDE, pack: of_pack, source }))
}

fn tracer_difference(
    of_gpu: &Image,
    of_cpu: &Image,
    varies: &[bool],
    field: &DecodedFrame,
    scene: &Scene,
) -> Result<TracerDifference, TraceError> {
    let apart = |pixel: usize| apart(&of_gpu.pixels[pixel][..3], &of_cpu.pixels[pixel][..3]);
    let tolerance = |pixel: usize| if varies[pixel] { VARYING_TOLERANCE } else { TRACER_TOLERANCE };
    let pixels = of_cpu.pixels.len();
    let (far, close): (Vec<usize>, Vec<usize>) =
        (0..pixels).partition(|&pixel| apart(pixel) > tolerance(pixel));
    let spread = spread(field, scene, &far)?;
    let unexplained = far
        .iter()
        .zip(spread)
        .filter(|&(&pixel, spread)| apart(pixel) > tolerance(pixel) + SPREAD_TOLERANCE * spread);
    let differing: Vec<usize> = unexplained.map(|(&pixel, _)| pixel).collect();
    Ok(TracerDifference {
        pixels: differing.len() as u64,
        undecided: (far.len() - differing.len()) as u64,
        allowed: (TIE_PIXELS * pixels as f64) as u64,
        largest: differing.iter().chain(&close).map(|&pixel| apart(pixel)).fold(0.0, f32::max),
    })
}

/// The name of a picture: its grid's, without what file systems do not take, and its frame's number.
fn file_name(grid: &str, frame: i32) -> String {
    let grid: String =
        grid.chars().map(|c| if c.is_alphanumeric() || "._-".contains(c) { c } else { '_' }).collect();
    let name = format!("{grid}-{frame:04}.png");
    // A grid `nul.x`, which nobody can rename who has only its file.
    if check_name(&name).is_ok() { name } else { format!("_{name}") }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_have_names_that_every_system_takes() {
        assert_eq!(file_name("density", 7), "density-0007.png");
        assert_eq!(file_name("a/b:c", -1), "a_b_c--001.png");
        assert_eq!(file_name("nul", 7), "nul-0007.png");
        assert_eq!(file_name("nul.x", 7), "_nul.x-0007.png");
    }
}
