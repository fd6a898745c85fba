//! `volpack render`.

mod frames;
mod sheet;

use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

use clap::Args;
use rayon::prelude::*;

use self::frames::Frames;
use self::sheet::{Picture, contact_sheet};
use super::progress::Reporter;
use super::{Common, outln, style};
use crate::atomic_file;
use crate::error::{Error, Result};
use crate::manifest::{DEFAULT_NAME, Manifest};
use crate::pack::{Frame, Grid, Pack};
use crate::progress::Progress;
use crate::render::gpu::GpuError;
use crate::render::{
    Device, Emission, Interpolation, Light, March, Mode, Renderer, SOOTY_ALBEDO, Scene, Traversal, View,
    WorldBox, write_apng, write_png,
};
use crate::settings::Look;

#[derive(Args)]
pub struct RenderArgs {
    /// Pack to render
    #[arg(required_unless_present = "asset", conflicts_with_all = ["manifest", "asset"])]
    pack: Option<PathBuf>,
    /// Asset of the manifest to render, with the look that the manifest gives it
    #[arg(long, value_name = "NAME")]
    asset: Option<String>,
    /// Manifest that has the asset
    #[arg(short, long, value_name = "FILE", default_value = DEFAULT_NAME, requires = "asset")]
    manifest: PathBuf,
    /// Picture to write: .png, or .apng for an animation
    #[arg(short, long, value_name = "OUT.png", value_parser = super::output_path())]
    output: PathBuf,
    /// Frame number [default: the first]
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    frame: Option<i32>,
    /// Frames of a contact sheet or an animation: all, or numbers such as 1-24, 1-24:2 or 1,5,9
    #[arg(long, value_name = "WHICH", conflicts_with = "frame", allow_hyphen_values = true)]
    frames: Option<Frames>,
    /// Grid to render [default: the first]
    #[arg(short, long, value_name = "NAME")]
    grid: Option<String>,
    /// What to show
    #[arg(long, default_value = "lit")]
    mode: Mode,
    /// Size of a frame in pixels
    #[arg(long, value_name = "WxH", default_value = "512x512", value_parser = size)]
    size: [u32; 2],
    /// Device that renders; auto takes a GPU if there is one, else the CPU, which is faster than software Vulkan
    #[arg(long, default_value = "auto")]
    device: Device,
    /// How rays step through the tree
    #[arg(long, default_value = "hdda")]
    traversal: Traversal,
    /// Interpolation between voxels
    #[arg(long, default_value = "trilinear")]
    interpolation: Interpolation,
    #[command(flatten)]
    look: Look,
}

/// The largest picture side: a terabyte of pixels is a slip of the finger.
const MAX_SIDE: u32 = 8192;

fn size(text: &str) -> std::result::Result<[u32; 2], String> {
    let parsed = text.split_once('x').and_then(|(w, h)| Some([w.parse().ok()?, h.parse().ok()?]));
    parsed
        .filter(|size: &[u32; 2]| size.iter().all(|s| (1..=MAX_SIDE).contains(s)))
        .ok_or_else(|| format!("a width and a height of 1 to {MAX_SIDE}, such as 1920x1080"))
}

/// What a picture is written as.
#[derive(Clone, Copy, PartialEq)]
enum FileType {
    Png,
    Apng,
}

impl FileType {
    fn of(path: &Path) -> Result<Self> {
        let ending = path.extension().map(|e| e.to_string_lossy().to_lowercase());
        match ending.as_deref() {
            Some("png") => Ok(Self::Png),
            Some("apng") => Ok(Self::Apng),
            _ => Err(Error::Usage(format!(
                "{}: pictures are written as .png (a frame, or a contact sheet) and .apng (an animation)",
                path.display()
            ))),
        }
    }
}

/// The camera where none is asked for: from ahead, above and to the side.
const VIEW: View = View::Orbit { azimuth: 40.0, elevation: 20.0, distance: None };

/// The pack and its look. The command line overrides the manifest.
fn subject(args: &RenderArgs) -> Result<(PathBuf, Look)> {
    let look = args.look.clone();
    match (&args.pack, &args.asset) {
        (Some(pack), _) => Ok((pack.clone(), look)),
        (None, name) => {
            let manifest = Manifest::read(&args.manifest)?;
            let asset = manifest.asset(name.as_deref().unwrap_or_default())?;
            Ok((asset.output.clone(), look.or(&asset.look)))
        }
    }
}

pub fn run(args: &RenderArgs, common: Common) -> Result<()> {
    let file_type = FileType::of(&args.output)?;
    let (path, look) = subject(args)?;
    look.check().map_err(Error::Usage)?;
    let pack = Pack::open(&path).map_err(Error::pack(&path))?;
    if args.output.canonicalize().is_ok_and(|o| path.canonicalize().is_ok_and(|p| o == p)) {
        return Err(Error::Usage(format!("{} is the pack and the picture too", args.output.display())));
    }
    let wrong = |what: String| Error::Usage(format!("{}: {what}", path.display()));
    let grid = args.grid.as_deref().map_or(Ok(0), |name| named(pack.grids(), name)).map_err(wrong)?;
    let frames = frames(args, &pack.grids()[grid].frames).map_err(wrong)?;
    let emissive = emissive(args.mode, &look, pack.grids(), grid).map_err(wrong)?;
    let renderer = Renderer::fastest(&pack, args.device).map_err(|e| gpu_error(e, &path))?;
    if !common.quiet {
        let why = renderer.fallback.as_ref().map(|why| format!(" ({why})")).unwrap_or_default();
        anstream::eprintln!("tracing with {}{why}", renderer.device_name());
    }

    let extinction = match look.extinction {
        None if args.mode == Mode::Lit && !pack.grids()[grid].is_level_set() => {
            renderer.body_extinction(grid).map_err(|e| gpu_error(e, &path))?
        }
        asked => asked,
    };
    let reporter = Mutex::new(Reporter::new(&args.output.to_string_lossy(), common.quiet));
    let say = |say: &dyn Fn(&mut Reporter)| say(&mut reporter.lock().unwrap_or_else(|e| e.into_inner()));
    if frames.len() > 1 {
        say(&|reporter| reporter.stage("rendering", frames.len() as u64, "frames"));
    }
    let draw = |&frame: &usize| -> Result<(Picture, f64)> {
        let scene = scene(args, &look, pack.grids(), [grid, frame], emissive);
        let scene = Scene { extinction: extinction.unwrap_or(scene.extinction), ..scene };
        let image = renderer.render(grid, frame, &scene).map_err(|e| gpu_error(e, &path))?;
        say(&|reporter| reporter.advance(1));
        let number = pack.grids()[grid].frames[frame].record.number;
        Ok((Picture { number, rgb: image.to_rgb8(&scene) }, image.mean_steps()))
    };
    // Two frames at a time hide what is not parallel within one; on a GPU there is nothing to hide.
    let at_once = if renderer.is_gpu() { 1 } else { 2 };
    let drawn = frames.chunks(at_once).map(|some| some.par_iter().map(draw).collect::<Result<Vec<_>>>());
    let drawn = drawn.collect::<Result<Vec<_>>>();
    say(&|reporter| reporter.finish());
    let (pictures, steps): (Vec<_>, Vec<_>) = drawn?.into_iter().flatten().unzip();
    write(args, file_type, &pictures, pack.grids()[grid].record.fps)?;
    if !common.quiet {
        let what = if frames.len() == 1 { "1 frame".to_owned() } else { format!("{} frames", frames.len()) };
        let steps = steps.iter().sum::<f64>() / frames.len() as f64;
        // What --extinction can be set from.
        let shown = extinction
            .map(|extinction| format!(", extinction {}", four_digits(extinction)))
            .unwrap_or_default();
        let title = style::TITLE;
        outln!("{title}{}{title:#}: {what}, {steps:.1} steps a ray{shown}", args.output.display());
    }
    Ok(())
}

/// A number with four digits that say something.
fn four_digits(number: f64) -> String {
    let before_point = number.abs().log10().floor() as i32 + 1;
    format!("{number:.*}", (4 - before_point).clamp(0, 30) as usize)
}

/// The place of a grid.
fn named(grids: &[Grid], name: &str) -> std::result::Result<usize, String> {
    grids.iter().position(|grid| grid.name == name).ok_or_else(|| {
        let names: Vec<&str> = grids.iter().map(|grid| grid.name.as_str()).collect();
        format!("no grid {name:?}; it has {}", names.join(", "))
    })
}

fn frames(args: &RenderArgs, all: &[Frame]) -> std::result::Result<Vec<usize>, String> {
    match (&args.frames, args.frame) {
        (Some(frames), _) => frames.places(all),
        (None, Some(number)) => Frames::one(number).places(all),
        (None, None) => Frames::All.places(all).map(|places| vec![places[0]]),
    }
}

/// Names of emissive grids in Blender, Houdini and EmberGen. Flames come first, because cool smoke has a temperature too.
const EMISSIVE: [&str; 7] = ["flame", "flames", "fire", "burn", "temperature", "temp", "heat"];

/// The emissive grid of lit fog.
fn emissive(
    mode: Mode,
    look: &Look,
    grids: &[Grid],
    shown: usize,
) -> std::result::Result<Option<usize>, String> {
    let is_lit_fog = mode == Mode::Lit && !grids[shown].is_level_set();
    match look.emission.as_deref() {
        Some("none") => Ok(None),
        Some(name) => named(grids, name).map(|grid| Some(grid).filter(|_| is_lit_fog)),
        None if !is_lit_fog => Ok(None),
        None => Ok(EMISSIVE.iter().find_map(|name| {
            let is_it = |grid: &Grid| grid.name.to_lowercase() == *name && grid.record.active_max > 0.0;
            (0..grids.len()).find(|&grid| grid != shown && is_it(&grids[grid]))
        })),
    }
}

fn scene(
    args: &RenderArgs,
    look: &Look,
    grids: &[Grid],
    [grid, frame]: [usize; 2],
    emissive: Option<usize>,
) -> Scene {
    let view = look.camera.unwrap_or(VIEW);
    let usual = Scene::new(&grids[grid], frame, &view, args.mode, args.size);
    let number = grids[grid].frames[frame].record.number;
    let emission = emissive.and_then(|other| {
        let frame = grids[other].frames.iter().position(|frame| frame.record.number == number)?;
        let strength = look.emission_strength.unwrap_or(1.0);
        Emission::new(grids, other, frame, look.kelvin, strength)
    });
    let light = Light::default();
    let usual_albedo = if emission.is_some() { SOOTY_ALBEDO } else { light.albedo };
    Scene {
        camera: match look.up {
            Some(up) => view.camera(&WorldBox::of_grid(&grids[grid]), up, args.size),
            None => usual.camera,
        },
        traversal: args.traversal,
        interpolation: args.interpolation,
        march: March { step: look.step.unwrap_or(usual.march.step), jitter: look.jitter },
        light: Light {
            sun: look.sun.map_or(light.sun, |sun| sun.0),
            albedo: look.albedo.unwrap_or(usual_albedo),
            anisotropy: look.anisotropy.unwrap_or(light.anisotropy),
            ambient: look.ambient.unwrap_or(light.ambient),
        },
        emission,
        ..usual
    }
}

fn write(args: &RenderArgs, file_type: FileType, pictures: &[Picture], fps: f32) -> Result<()> {
    let failed = || Error::io(&args.output);
    let file = atomic_file::beside(&args.output)?;
    let out = BufWriter::new(file.as_file());
    match (file_type, pictures) {
        (FileType::Apng, _) => {
            let fps = if fps > 0.0 { fps.round() as u16 } else { 24 };
            let frames: Vec<_> = pictures.iter().map(|picture| &picture.rgb[..]).collect();
            write_apng(out, args.size, &frames, fps).map_err(failed())?;
        }
        (FileType::Png, [one]) => write_png(out, args.size, &one.rgb).map_err(failed())?,
        (FileType::Png, _) => {
            let (size, sheet) = contact_sheet(args.size, pictures);
            write_png(out, size, &sheet).map_err(failed())?;
        }
    }
    Ok(atomic_file::persist(file, &args.output)?)
}

/// A GPU's failure as an error of the command.
pub fn gpu_error(error: GpuError, pack: &Path) -> Error {
    match error {
        GpuError::Pack(source) => Error::Pack { path: pack.to_owned(), source },
        GpuError::Failed(_) => Error::Other(error.to_string()),
        other => Error::Unsupported(other.to_string()),
    }
}
