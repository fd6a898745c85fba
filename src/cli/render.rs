//! `volpack render`.

use std::io::BufWriter;
use std::path::{Path, PathBuf};

use clap::Args;

use super::{Common, outln, style};
use crate::atomic_file;
use crate::error::{Error, Result};
use crate::pack::Pack;
use crate::render::gpu::GpuError;
use crate::render::{Device, Interpolation, Mode, Renderer, Scene, Traversal, View, write_apng, write_png};

#[derive(Args)]
pub struct RenderArgs {
    /// Pack to render
    pack: PathBuf,
    /// Picture to write: .png, or .apng with --frames all
    #[arg(short, long, value_name = "OUT.png", value_parser = super::output_path())]
    output: PathBuf,
    /// Frame number [default: the first]
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    frame: Option<i32>,
    /// Render every frame: a contact sheet, or an animation if OUT ends in .apng
    #[arg(long, value_name = "WHICH", conflicts_with = "frame")]
    frames: Option<Frames>,
    /// Grid to render [default: the first]
    #[arg(short, long, value_name = "NAME")]
    grid: Option<String>,
    /// What to show [default: density, lit for level sets]
    #[arg(long)]
    mode: Option<Mode>,
    /// Size of a frame in pixels
    #[arg(long, value_name = "WxH", default_value = "512x512", value_parser = size)]
    size: [u32; 2],
    /// Camera: orbit:AZIMUTH,ELEVATION,DISTANCE in degrees and box diagonals, or "X,Y,Z;X,Y,Z;FOV" (eye; target; degrees)
    #[arg(long, value_name = "VIEW", default_value = "orbit:40,20,1.25")]
    camera: View,
    /// Device that renders
    #[arg(long, default_value = "auto")]
    device: Device,
    /// How rays step through the tree
    #[arg(long, default_value = "hdda")]
    traversal: Traversal,
    /// Interpolation of level sets
    #[arg(long, default_value = "trilinear")]
    interpolation: Interpolation,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum Frames {
    All,
}

/// The largest picture side: a terabyte of pixels is a slip of the finger.
const MAX_SIDE: u32 = 8192;

fn size(text: &str) -> std::result::Result<[u32; 2], String> {
    let parsed = text.split_once('x').and_then(|(w, h)| Some([w.parse().ok()?, h.parse().ok()?]));
    parsed
        .filter(|size: &[u32; 2]| size.iter().all(|s| (1..=MAX_SIDE).contains(s)))
        .ok_or_else(|| format!("a width and a height of 1 to {MAX_SIDE}, such as 1920x1080"))
}

pub fn run(args: &RenderArgs, common: Common) -> Result<()> {
    let pack = Pack::open(&args.pack).map_err(Error::pack(&args.pack))?;
    if args.output.canonicalize().is_ok_and(|o| args.pack.canonicalize().is_ok_and(|p| o == p)) {
        return Err(Error::Usage(format!("{} is the pack and the picture too", args.output.display())));
    }
    let names: Vec<&str> = pack.grids().iter().map(|g| g.name.as_str()).collect();
    let grid = args.grid.as_ref().map_or(Some(0), |name| names.iter().position(|n| n == name));
    let grid = grid.ok_or_else(|| {
        Error::Usage(format!("{}: no such grid; it has {}", args.pack.display(), names.join(", ")))
    })?;
    let frames = frames(args, &pack, grid)?;
    let renderer = Renderer::new(&pack, args.device).map_err(|e| gpu_error(e, &args.pack))?;
    if !common.quiet {
        let why = renderer.fallback.as_ref().map(|why| format!(" ({why})")).unwrap_or_default();
        anstream::eprintln!("tracing with {}{why}", renderer.device_name());
    }

    let mode = args.mode.unwrap_or(Mode::of_grid(&pack.grids()[grid]));
    let mut pictures = Vec::new();
    let mut steps = 0.0;
    for &frame in &frames {
        let scene = Scene {
            traversal: args.traversal,
            interpolation: args.interpolation,
            ..Scene::new(&pack.grids()[grid], frame, &args.camera, mode, args.size)
        };
        let image = renderer.render(grid, frame, &scene).map_err(|e| gpu_error(e, &args.pack))?;
        steps += image.mean_steps() / frames.len() as f64;
        pictures.push(image.to_rgb8(mode));
    }
    write(args, &pictures, pack.grids()[grid].record.fps)?;
    if !common.quiet {
        let what = if frames.len() == 1 { "1 frame".to_owned() } else { format!("{} frames", frames.len()) };
        let title = style::TITLE;
        outln!("{title}{}{title:#}: {what}, {steps:.1} steps a ray", args.output.display());
    }
    Ok(())
}

fn frames(args: &RenderArgs, pack: &Pack, grid: usize) -> Result<Vec<usize>> {
    let all = &pack.grids()[grid].frames;
    let none = |what: String| Error::Usage(format!("{}: {what}", args.pack.display()));
    match (args.frames, args.frame) {
        (Some(Frames::All), _) => Ok((0..all.len()).collect()),
        (None, None) if all.is_empty() => Err(none("it has no frames".to_owned())),
        (None, None) => Ok(vec![0]),
        (None, Some(number)) => {
            let found = all.iter().position(|f| f.record.number == number);
            let range = || match (all.first(), all.last()) {
                (Some(a), Some(b)) => {
                    format!("no frame {number}; it has {} to {}", a.record.number, b.record.number)
                }
                _ => "it has no frames".to_owned(),
            };
            Ok(vec![found.ok_or_else(|| none(range()))?])
        }
    }
}

fn write(args: &RenderArgs, pictures: &[Vec<u8>], fps: f32) -> Result<()> {
    let failed = || Error::io(&args.output);
    let file = atomic_file::beside(&args.output)?;
    let out = BufWriter::new(file.as_file());
    match pictures {
        [one] => write_png(out, args.size, one).map_err(failed())?,
        _ if args.output.extension().is_some_and(|e| e == "apng") => {
            let fps = if fps > 0.0 { fps.round() as u16 } else { 24 };
            write_apng(out, args.size, pictures, fps).map_err(failed())?;
        }
        _ => {
            let (size, sheet) = contact_sheet(args.size, pictures);
            write_png(out, size, &sheet).map_err(failed())?;
        }
    }
    Ok(atomic_file::persist(file, &args.output)?)
}

/// Frames left to right and top to bottom, in a sheet about as wide as it is high.
fn contact_sheet([width, height]: [u32; 2], pictures: &[Vec<u8>]) -> ([u32; 2], Vec<u8>) {
    let square = (1..).find(|c| c * c >= pictures.len()).expect("some square is large enough");
    // Up to half again as wide as high, if that leaves fewer places empty.
    let empty = |columns: &usize| pictures.len().next_multiple_of(*columns) - pictures.len();
    let columns = (square..=square * 3 / 2).min_by_key(empty).expect("the range has its first");
    let rows = pictures.len().div_ceil(columns);
    let stride = width as usize * 3;
    let mut sheet = vec![0; stride * columns * height as usize * rows];
    for (i, picture) in pictures.iter().enumerate() {
        for (y, row) in picture.chunks_exact(stride).enumerate() {
            let at = ((i / columns * height as usize + y) * columns + i % columns) * stride;
            sheet[at..at + stride].copy_from_slice(row);
        }
    }
    ([width * columns as u32, height * rows as u32], sheet)
}

/// A GPU's failure as an error of the command.
pub fn gpu_error(error: GpuError, pack: &Path) -> Error {
    match error {
        GpuError::Pack(source) => Error::Pack { path: pack.to_owned(), source },
        GpuError::Failed(_) => Error::Other(error.to_string()),
        other => Error::Unsupported(other.to_string()),
    }
}
