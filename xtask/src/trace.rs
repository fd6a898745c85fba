//! Milliseconds a frame on a GPU: every format, cell by cell and node by node, beside NanoVDB's HDDA on the same
//! rays.

use std::error::Error;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use serde_json::json;
use volpack::pack::Pack;
use volpack::pipeline::{Job, Silent, VerifyLevel, build};
use volpack::render::gpu::Gpu;
use volpack::render::{Image, Interpolation, Lens, Mode, Scene, Traversal, View};
use volpack::settings::{Format, Settings};
use volpack::sweep::nanovdb::{self, Quantise};

use crate::beside::TOLERANCE;
use crate::measured::median;
use crate::peers;

#[derive(clap::Args)]
pub struct Args {
    /// OpenVDB files
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// Times each picture is traced; the median counts
    #[arg(long, default_value_t = 100)]
    repeats: u32,
    /// Pixels, as WIDTH HEIGHT
    #[arg(long, num_args = 2, default_values_t = [1920, 1080])]
    size: Vec<u32>,
    /// benches/peers/nanovdb_trace.cu, compiled; without it nvcc is asked to
    #[arg(long)]
    peer: Option<PathBuf>,
    /// Write the raw figures here too
    #[arg(long)]
    json: Option<PathBuf>,
}

/// Along (-0.6, -0.35, -0.72) from one diagonal away.
const VIEW: View = View::Orbit([39.8056, 20.4927, 1.0]);
/// Pictures before those that count, while clocks rise.
const WARM_UP: u32 = 10;

/// What is shown of a level set or of fog: its name, which is the peer's word too, and how.
type Shown = (&'static str, Mode, Interpolation);
const FOG: &[Shown] = &[("fog", Mode::Density, Interpolation::Trilinear)];
const LEVEL_SET: &[Shown] =
    &[("trilinear", Mode::Depth, Interpolation::Trilinear), ("nearest", Mode::Depth, Interpolation::Nearest)];

pub fn bench(args: &Args) -> Result<(), Box<dyn Error>> {
    let gpu = Gpu::shared()?;
    let folder = tempfile::tempdir()?;
    let [width, height] = args.size[..] else { return Err("a size is WIDTH HEIGHT".into()) };
    let size = [width, height];
    let peer = args.peer.clone().map_or_else(peers::compile_nanovdb, Ok);
    if let Err(reason) = &peer {
        println!("NanoVDB is left out: {reason}\n");
    }
    let mut rows = Vec::new();
    println!("{} at {width} × {height}, median of {} frames\n", gpu.name, args.repeats);
    println!(
        "| volume | shows | format | HDDA ms | NanoVDB float ms | HDDA / float | FpN ms | HDDA / FpN | apart | DDA ms | DDA / HDDA | HDDA steps | DDA steps |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|---|---|---|");
    for path in &args.files {
        let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let mut theirs: Vec<(&str, &str, Theirs)> = Vec::new();
        let mut lines = Vec::new();
        for format in Format::ALL {
            let job = Job::new(
                vec![path.clone()],
                folder.path().join("bench.volpack"),
                Settings { format, ..Settings::default() },
                VerifyLevel::None,
            );
            build(&job, &mut Silent)?;
            let pack = Pack::open(&job.output)?;
            let uploaded = gpu.upload(&pack)?;
            let bounds = pack.frame_tree(0, 0).bounds();
            let grid = &pack.grids[0];
            for &(shows, mode, interpolation) in if grid.is_level_set() { LEVEL_SET } else { FOG } {
                let scene = Scene { interpolation, ..Scene::new(grid, 0, &VIEW, mode, size) };
                if let (Format::F32, Ok(peer)) = (format, &peer) {
                    // What the converter itself allows: a tenth of a voxel where there is a level set.
                    let absolute = if scene.level_set {
                        0.1 * volpack::vdb::voxel_size(&scene.matrix)
                    } else {
                        TOLERANCE
                    };
                    for (kind, quantise) in [(FLOAT, Quantise::Float), (FPN, Quantise::FpN { absolute })] {
                        let source = (path.as_path(), grid.name.as_str(), quantise);
                        let traced = nanovdb_trace(peer, source, shows, &scene, args.repeats, folder.path())?;
                        theirs.push((shows, kind, traced));
                    }
                }
                let theirs = |kind| {
                    theirs.iter().find(|their| (their.0, their.1) == (shows, kind)).map(|their| &their.2)
                };
                let mut row = Vec::new();
                let mut apart = None;
                for traversal in [Traversal::Hdda, Traversal::Dda] {
                    let scene = Scene { traversal, ..scene };
                    let repeats = args.repeats + WARM_UP;
                    let (image, ms) = gpu.trace_timed(&uploaded, [0, 0], bounds, &scene, repeats)?;
                    apart = apart.or_else(|| theirs(FLOAT).map(|t| t.apart(&image, &scene)));
                    let ms = ms.get(WARM_UP as usize..).unwrap_or_default();
                    row.push((median(ms.iter().copied()), image.mean_steps()));
                    rows.push(json!({ "volume": name, "shows": shows, "format": format,
                        "traversal": format!("{traversal:?}"), "milliseconds": ms,
                        "mean_steps": image.mean_steps() }));
                }
                let [(hdda, hdda_steps), (dda, dda_steps)] = row[..] else {
                    return Err("two traversals".into());
                };
                let beside = match (theirs(FLOAT), theirs(FPN), apart) {
                    (Some(float), Some(fpn), Some(apart)) => {
                        let [float, fpn] = [float, fpn].map(|t| median(t.milliseconds.iter().copied()));
                        let [of_float, of_fpn] = [hdda / float, hdda / fpn];
                        format!("{float:.3} | {of_float:.2} | {fpn:.3} | {of_fpn:.2} | {apart:.1e}")
                    }
                    _ => " | | | | ".to_owned(),
                };
                lines.push((shows, format!(
                    "| {name} | {shows} | {} | {hdda:.3} | {beside} | {dda:.3} | {:.2} | {hdda_steps:.1} | {dda_steps:.1} |",
                    format.name(),
                    dda / hdda
                )));
            }
        }
        lines.sort_by_key(|(shows, _)| std::cmp::Reverse(*shows));
        lines.iter().for_each(|(_, line)| println!("{line}"));
        rows.extend(theirs.iter().map(|(shows, kind, theirs)| {
            json!({ "volume": name, "shows": shows, "format": kind, "milliseconds": theirs.milliseconds })
        }));
    }
    if let Some(path) = &args.json {
        std::fs::write(path, serde_json::to_string(&json!({ "device": gpu.name, "rows": rows }))?)?;
    }
    Ok(())
}

/// NanoVDB's grids.
const FLOAT: &str = "NanoVDB float";
const FPN: &str = "NanoVDB FpN";

/// What NanoVDB makes of a scene.
struct Theirs {
    milliseconds: Vec<f64>,
    /// World units of a voxel.
    voxel: f64,
    /// In voxels: the integral of density, or depth.
    picture: Vec<f32>,
}

/// Traces a grid of a file, quantised, with the peer's program.
fn nanovdb_trace(
    peer: &Path,
    (vdb, grid, quantise): (&Path, &str, Quantise),
    shows: &str,
    scene: &Scene,
    repeats: u32,
    folder: &Path,
) -> Result<Theirs, Box<dyn Error>> {
    let (nvdb, out) = (folder.join("peer.nvdb"), folder.join("peer.f32"));
    nanovdb::convert(vdb, grid, &quantise, &nvdb)?;
    // To NanoVDB's steps a voxel is the cube from its coordinate on, half a voxel off from index space; between
    // voxels a cell is.
    let shift = if shows == "trilinear" { 0.0 } else { 0.5 };
    let lens =
        Lens::new(&scene.camera, &scene.matrix, scene.size, [shift; 3]).ok_or("no inverse transform")?;
    let rays = [lens.origin, lens.forward, lens.right, lens.up].concat();
    let rays: Vec<String> = rays.iter().map(ToString::to_string).collect();
    let mut child = Command::new(peer)
        .arg(&nvdb)
        .arg(shows)
        .args(scene.size.map(|s| s.to_string()))
        .arg((repeats + WARM_UP).to_string())
        .arg(&out)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()?;
    child.stdin.take().ok_or("a pipe")?.write_all(rays.join(" ").as_bytes())?;
    let output = child.wait_with_output()?;
    if !output.status.success() {
        return Err(format!("{} failed on {}", peer.display(), vdb.display()).into());
    }
    let milliseconds = String::from_utf8(output.stdout)?
        .lines()
        .skip(WARM_UP as usize)
        .map(str::parse)
        .collect::<Result<_, _>>()?;
    let [x, y, z] = lens.forward;
    let picture = std::fs::read(&out)?;
    let picture = picture.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
    Ok(Theirs { milliseconds, voxel: 1.0 / (x * x + y * y + z * z).sqrt(), picture })
}

impl Theirs {
    /// How far the pictures are apart. Fog: the mean difference of opacity. Level sets: the median difference
    /// in voxels where both hit.
    fn apart(&self, ours: &Image, scene: &Scene) -> f64 {
        let pixels =
            ours.pixels.iter().map(|p| f64::from(p[0])).zip(self.picture.iter().map(|v| f64::from(*v)));
        if scene.level_set {
            let both = pixels.filter(|(ours, theirs)| *ours >= 0.0 && *theirs >= 0.0);
            return median(both.map(|(ours, theirs)| (ours / self.voxel - theirs).abs()));
        }
        let opacity = |depth: f64| 1.0 - (-depth * self.voxel * scene.extinction).exp();
        pixels.map(|(ours, theirs)| (ours - opacity(theirs)).abs()).sum::<f64>() / self.picture.len() as f64
    }
}
