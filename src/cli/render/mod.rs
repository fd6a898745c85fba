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
use crate::pack::{Frame, Grid, Pack};
use crate::progress::Progress;
use crate::render::gpu::GpuError;
use crate::render::{
    Device, Emission, Interpolation, Light, March, Mode, Renderer, SOOTY_ALBEDO, Scene, Step, Traversal, Up,
    View, WorldBox, write_apng, write_png,
};

#[derive(Args)]
pub struct RenderArgs {
    /// Pack to render
    pack: PathBuf,
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
    /// Camera: orbit:AZIMUTH,ELEVATION[,DISTANCE] in degrees and box diagonals, or "X,Y,Z;X,Y,Z;FOV" (eye; target; degrees)
    #[arg(long, value_name = "VIEW", default_value = "orbit:40,20")]
    camera: View,
    /// Axis that points up [default: guessed from the shape]
    #[arg(long, value_name = "AXIS")]
    up: Option<Up>,
    /// Device that renders
    #[arg(long, default_value = "auto")]
    device: Device,
    /// How rays step through the tree
    #[arg(long, default_value = "hdda")]
    traversal: Traversal,
    /// Interpolation between voxels
    #[arg(long, default_value = "trilinear")]
    interpolation: Interpolation,
    #[command(flatten)]
    fog: FogArgs,
}

/// How fog is sampled and lit.
#[derive(Args)]
#[command(next_help_heading = "Fog")]
struct FogArgs {
    /// Step of the ray march: 0.5 is in voxels, 0.02world in world units
    #[arg(long, value_name = "STEP", default_value = "0.5", value_parser = step)]
    step: Step,
    /// Offset each pixel's samples by a hash, which turns banding into noise
    #[arg(long)]
    jitter: bool,
    /// Extinction: optical depth per world unit at density 1 [default: with --mode lit, half of the covered pixels have an optical depth above 3; otherwise, the highest density has 24 across the box]
    #[arg(long, value_name = "X", value_parser = super::above_zero)]
    extinction: Option<f64>,
    /// Direction of the sun in degrees [default: 110,40]
    #[arg(long, value_name = "AZIMUTH,ELEVATION", allow_hyphen_values = true, value_parser = sun)]
    sun: Option<[f64; 2]>,
    /// Scattering albedo, 0 to 1 [default: 0.95; 0.6 with an emissive grid]
    #[arg(long, value_name = "PART", value_parser = part)]
    albedo: Option<f64>,
    /// Anisotropy of scattering (g of Henyey and Greenstein): -0.99 backward, 0 isotropic, 0.99 forward
    #[arg(long, value_name = "G", default_value_t = Light::default().anisotropy, allow_negative_numbers = true, value_parser = anisotropy)]
    anisotropy: f64,
    /// Ambient light from the sky, as a factor
    #[arg(long, value_name = "X", default_value_t = Light::default().ambient, value_parser = not_below_zero)]
    ambient: f64,
    /// Emissive grid, or none [default: flame or temperature, if the pack has it]
    #[arg(long, value_name = "GRID")]
    emission: Option<String>,
    /// Brightness of the emission, as a factor
    #[arg(long, value_name = "X", default_value_t = 1.0, value_parser = not_below_zero)]
    emission_strength: f64,
    /// Temperature at value 1 of the emissive grid, in kelvin [default: 1 if the grid has values above 100; otherwise, its highest value is 1900 K]
    #[arg(long, value_name = "K", value_parser = super::above_zero)]
    kelvin: Option<f64>,
}

fn number(text: &str, is_allowed: impl Fn(f64) -> bool, what: &str) -> std::result::Result<f64, String> {
    text.trim().parse().ok().filter(|v: &f64| v.is_finite() && is_allowed(*v)).ok_or_else(|| what.to_owned())
}

fn part(text: &str) -> std::result::Result<f64, String> {
    number(text, |v| (0.0..=1.0).contains(&v), "a number from 0 to 1")
}

fn not_below_zero(text: &str) -> std::result::Result<f64, String> {
    number(text, |v| v >= 0.0, "a number of 0 or more")
}

fn anisotropy(text: &str) -> std::result::Result<f64, String> {
    number(text, |v| v.abs() <= 0.99, "a number from -0.99 to 0.99")
}

fn step(text: &str) -> std::result::Result<Step, String> {
    let what = "a number above 0, such as 0.5 (voxels) or 0.02world (world units)";
    let (text, step): (_, fn(f64) -> Step) = match text.strip_suffix("world") {
        Some(text) => (text, Step::World),
        None => (text, Step::Voxels),
    };
    number(text, |v| v > 0.0, what).map(step)
}

fn sun(text: &str) -> std::result::Result<[f64; 2], String> {
    let what = "an azimuth and an elevation in degrees, such as 75,45";
    let (azimuth, elevation) = text.split_once(',').ok_or(what)?;
    Ok([number(azimuth, |_| true, what)?, number(elevation, |v| v.abs() <= 90.0, what)?])
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

pub fn run(args: &RenderArgs, common: Common) -> Result<()> {
    let file_type = FileType::of(&args.output)?;
    let pack = Pack::open(&args.pack).map_err(Error::pack(&args.pack))?;
    if args.output.canonicalize().is_ok_and(|o| args.pack.canonicalize().is_ok_and(|p| o == p)) {
        return Err(Error::Usage(format!("{} is the pack and the picture too", args.output.display())));
    }
    let wrong = |what: String| Error::Usage(format!("{}: {what}", args.pack.display()));
    let grid = args.grid.as_deref().map_or(Ok(0), |name| named(pack.grids(), name)).map_err(wrong)?;
    let frames = frames(args, &pack.grids()[grid].frames).map_err(wrong)?;
    let emissive = emissive(args, pack.grids(), grid).map_err(wrong)?;
    let renderer = Renderer::fastest(&pack, args.device).map_err(|e| gpu_error(e, &args.pack))?;
    if !common.quiet {
        let why = renderer.fallback.as_ref().map(|why| format!(" ({why})")).unwrap_or_default();
        anstream::eprintln!("tracing with {}{why}", renderer.device_name());
    }

    let extinction = match args.fog.extinction {
        None if args.mode == Mode::Lit && !pack.grids()[grid].is_level_set() => {
            renderer.body_extinction(grid, &args.camera).map_err(|e| gpu_error(e, &args.pack))?
        }
        asked => asked,
    };
    let reporter = Mutex::new(Reporter::new(&args.output.to_string_lossy(), common.quiet));
    let say = |say: &dyn Fn(&mut Reporter)| say(&mut reporter.lock().unwrap_or_else(|e| e.into_inner()));
    if frames.len() > 1 {
        say(&|reporter| reporter.stage("rendering", frames.len() as u64, "frames"));
    }
    let draw = |&frame: &usize| -> Result<(Picture, f64)> {
        let scene = scene(args, pack.grids(), [grid, frame], emissive);
        let scene = Scene { extinction: extinction.unwrap_or(scene.extinction), ..scene };
        let image = renderer.render(grid, frame, &scene).map_err(|e| gpu_error(e, &args.pack))?;
        say(&|reporter| reporter.advance(1));
        let number = pack.grids()[grid].frames[frame].record.number;
        Ok((Picture { number, rgb: image.to_rgb8(&scene) }, image.mean_steps()))
    };
    let drawn = frames.par_iter().map(draw).collect::<Result<Vec<_>>>();
    say(&|reporter| reporter.finish());
    let (pictures, steps): (Vec<_>, Vec<_>) = drawn?.into_iter().unzip();
    write(args, file_type, &pictures, pack.grids()[grid].record.fps)?;
    if !common.quiet {
        let what = if frames.len() == 1 { "1 frame".to_owned() } else { format!("{} frames", frames.len()) };
        let steps = steps.iter().sum::<f64>() / frames.len() as f64;
        // What --extinction can be set from.
        let shown = extinction.map(|extinction| format!(", extinction {extinction:.3}")).unwrap_or_default();
        let title = style::TITLE;
        outln!("{title}{}{title:#}: {what}, {steps:.1} steps a ray{shown}", args.output.display());
    }
    Ok(())
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
        (None, None) if all.is_empty() => Err("it has no frames".to_owned()),
        (None, None) => Ok(vec![0]),
    }
}

/// Names of emissive grids in Blender, Houdini and EmberGen. Flames come first, because cool smoke has a temperature too.
const EMISSIVE: [&str; 7] = ["flame", "flames", "fire", "burn", "temperature", "temp", "heat"];

/// The emissive grid of lit fog.
fn emissive(args: &RenderArgs, grids: &[Grid], shown: usize) -> std::result::Result<Option<usize>, String> {
    if args.mode != Mode::Lit || grids[shown].is_level_set() {
        return Ok(None);
    }
    match args.fog.emission.as_deref() {
        Some("none") => Ok(None),
        Some(name) => named(grids, name).map(Some),
        None => Ok(EMISSIVE
            .iter()
            .find_map(|name| {
                grids
                    .iter()
                    .position(|grid| grid.name.to_lowercase() == *name && grid.record.active_max > 0.0)
            })
            .filter(|grid| *grid != shown)),
    }
}

fn scene(args: &RenderArgs, grids: &[Grid], [grid, frame]: [usize; 2], emissive: Option<usize>) -> Scene {
    let usual = Scene::new(&grids[grid], frame, &args.camera, args.mode, args.size);
    let fog = &args.fog;
    let number = grids[grid].frames[frame].record.number;
    let emission = emissive.and_then(|other| {
        let frame = grids[other].frames.iter().position(|frame| frame.record.number == number)?;
        Some(Emission::new(grids, other, frame, fog.kelvin, fog.emission_strength))
    });
    let usual_albedo = if emission.is_some() { SOOTY_ALBEDO } else { Light::default().albedo };
    Scene {
        camera: match args.up {
            Some(up) => args.camera.camera(&WorldBox::of_grid(&grids[grid]), up, args.size),
            None => usual.camera,
        },
        traversal: args.traversal,
        interpolation: args.interpolation,
        march: March { step: fog.step, jitter: fog.jitter },
        light: Light {
            sun: fog.sun.unwrap_or(Light::default().sun),
            albedo: fog.albedo.unwrap_or(usual_albedo),
            anisotropy: fog.anisotropy,
            ambient: fog.ambient,
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
