//! Measures milliseconds per frame on a GPU: every format, with DDA and HDDA, compared with NanoVDB's HDDA on the same
//! rays.

use std::error::Error;
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Stdio};

use serde_json::{Value as Json, json};
use volpack::pack::{Grid, Pack};
use volpack::pipeline::{Job, Silent, VerifyLevel, build};
use volpack::render::gpu::Gpu;
use volpack::render::{Image, Interpolation, Lens, Mode, Scene, Traversal, Up, View, WorldBox};
use volpack::settings::{Format, Settings};
use volpack::sweep::nanovdb::{self, Quantise};
use volpack::sweep::{Steady, steady};

use crate::peer_programs;
use crate::peers::TOLERANCE;
use crate::process_stats::median;

#[derive(clap::Args)]
pub struct Args {
    /// OpenVDB files
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// Minimum number of frames per picture; tracing continues until three medians in a row agree
    #[arg(long, default_value_t = 100)]
    repeats: u32,
    /// Size of the pictures in pixels, as WIDTH HEIGHT
    #[arg(long, num_args = 2, default_values_t = [1920, 1080])]
    size: Vec<u32>,
    /// Folder that contains nanovdb/, to compare with that version; repeat it for another [default: the compiler's path]
    #[arg(long, value_name = "DIR")]
    nanovdb: Vec<PathBuf>,
    /// Also write the raw figures to this JSON file
    #[arg(long)]
    json: Option<PathBuf>,
}

/// Along (-0.6, -0.35, -0.72) from one diagonal away.
const VIEW: View = View::Orbit { azimuth: 39.8056, elevation: 20.4927, distance: Some(1.0) };

/// The benchmarks' picture of a grid's first frame. The camera is the same for all volumes, whatever is up in them.
pub fn scene(grid: &Grid, mode: Mode, size: [u32; 2]) -> Scene {
    let camera = VIEW.camera(&WorldBox::of_grid(grid), Up::Y, size);
    Scene { camera, ..Scene::new(grid, 0, &VIEW, mode, size) }
}

/// What is shown of a level set or of fog: its name, which is the peer's word too, and how.
type Shown = (&'static str, Mode, Interpolation);
const FOG: &[Shown] = &[("fog", Mode::Density, Interpolation::Nearest)];
const LEVEL_SET: &[Shown] =
    &[("trilinear", Mode::Depth, Interpolation::Trilinear), ("nearest", Mode::Depth, Interpolation::Nearest)];

pub fn bench(args: &Args) -> Result<(), Box<dyn Error>> {
    let gpu = Gpu::shared()?;
    if gpu.is_software {
        return Err(format!(
            "{} is not a GPU, so its times are meaningless here: run this on a machine with a GPU",
            gpu.name
        )
        .into());
    }
    let folder = tempfile::tempdir()?;
    let [width, height] = args.size[..] else { return Err("a size is WIDTH HEIGHT".into()) };
    let peers = peers(args);
    if let Err(reason) = &peers {
        println!("NanoVDB is not measured: {reason}\n");
    }
    let peers = peers.unwrap_or_default();
    println!("{} at {width} × {height}, medians of {} frames or more\n", gpu.name, args.repeats);
    print_head(&peers);
    let mut bench =
        Bench { args, gpu, size: [width, height], peers, folder: folder.path(), rows: Vec::new() };
    for path in &args.files {
        bench.volume(path)?;
    }
    peer_programs::write(args.json.as_deref(), &json!({ "device": gpu.name, "rows": bench.rows }))
}

/// A compiled tracer of NanoVDB's.
struct Peer {
    program: PathBuf,
    version: String,
}

fn peers(args: &Args) -> Result<Vec<Peer>, Box<dyn Error>> {
    let compile =
        |headers| peer_programs::compile_nanovdb(headers).map(|(program, version)| Peer { program, version });
    if args.nanovdb.is_empty() {
        return Ok(vec![compile(None)?]);
    }
    args.nanovdb.iter().map(|headers| compile(Some(headers))).collect()
}

fn print_head(peers: &[Peer]) {
    let mut head = "| volume | shows | format | HDDA ms |".to_owned();
    for Peer { version, .. } in peers {
        head += &format!(" NanoVDB {version}, float, ms | HDDA / it | its FpN ms | HDDA / it |");
    }
    head += if peers.is_empty() { "" } else { " apart |" };
    head += " DDA ms | DDA / HDDA | HDDA steps | DDA steps |";
    println!("{head}\n{}|", "|---".repeat(head.matches('|').count() - 1));
}

struct Bench<'a> {
    args: &'a Args,
    gpu: &'static Gpu,
    size: [u32; 2],
    peers: Vec<Peer>,
    folder: &'a Path,
    rows: Vec<Json>,
}

impl Bench<'_> {
    fn volume(&mut self, path: &Path) -> Result<(), Box<dyn Error>> {
        let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let mut packs = Vec::new();
        for format in Format::ALL {
            let output = self.folder.join(format!("{}.volpack", format.name()));
            let settings = Settings { encoding: format.into(), ..Settings::default() };
            build(
                &Job::new(vec![path.to_owned()], output.clone(), settings, VerifyLevel::None),
                &mut Silent,
            )?;
            packs.push((format, Pack::open(&output)?));
        }
        let grid = &packs[0].1.grids()[0];
        for &(shows, mode, interpolation) in if grid.is_level_set() { LEVEL_SET } else { FOG } {
            let scene = Scene { interpolation, ..scene(grid, mode, self.size) };
            let theirs = self.theirs(path, &grid.name, shows, &scene)?;
            for (format, pack) in &packs {
                self.row((&name, shows, *format), pack, &scene, &theirs)?;
            }
            for (version, kind, traced) in theirs.iter().flat_map(Theirs::kinds) {
                self.rows.push(json!({ "volume": name, "shows": shows, "format": kind, "nanovdb": version,
                    "milliseconds": traced.timed.milliseconds, "is_steady": traced.timed.is_steady }));
            }
        }
        Ok(())
    }

    /// What each peer makes of a scene.
    fn theirs(
        &self,
        vdb: &Path,
        grid: &str,
        shows: &str,
        scene: &Scene,
    ) -> Result<Vec<Theirs>, Box<dyn Error>> {
        // What the converter itself allows: a tenth of a voxel where there is a level set.
        let absolute =
            if scene.level_set { 0.1 * volpack::vdb::voxel_size(&scene.matrix) } else { TOLERANCE };
        let mut all = Vec::new();
        for Peer { program, version } in &self.peers {
            let trace = |quantise| {
                let nvdb = self.folder.join("peer.nvdb");
                nanovdb::convert(vdb, grid, &quantise, &nvdb)?;
                nanovdb_trace(program, &nvdb, shows, scene, self.args.repeats)
            };
            let (float, fpn) = (trace(Quantise::Float)?, trace(Quantise::FpN { absolute })?);
            all.push(Theirs { version: version.clone(), float, fpn });
        }
        Ok(all)
    }

    /// Traces a pack both ways and prints its row.
    fn row(
        &mut self,
        (name, shows, format): (&str, &str, Format),
        pack: &Pack,
        scene: &Scene,
        theirs: &[Theirs],
    ) -> Result<(), Box<dyn Error>> {
        let uploaded = self.gpu.upload(pack)?;
        let bounds = pack.frame_tree(0, 0).bounds();
        let mut trace = |traversal| -> Result<(Steady, Image), Box<dyn Error>> {
            let scene = Scene { traversal, ..*scene };
            let mut image = None;
            let timed = steady(self.args.repeats, |frames| -> Result<_, Box<dyn Error>> {
                let (last, ms) = self.gpu.trace_timed(&uploaded, [0, 0], bounds, &scene, frames)?;
                image = Some(last);
                Ok(ms)
            })?;
            let image = image.ok_or("no picture")?;
            self.rows.push(json!({ "volume": name, "shows": shows, "format": format,
                "traversal": format!("{traversal:?}"), "milliseconds": timed.milliseconds, "is_steady": timed.is_steady,
                "mean_steps": image.mean_steps() }));
            Ok((timed, image))
        };
        let (hdda, picture) = trace(Traversal::Hdda)?;
        let (dda, dda_picture) = trace(Traversal::Dda)?;
        let mut line = format!("| {name} | {shows} | {} | {} |", format.name(), ms(&hdda));
        for (_, _, traced) in theirs.iter().flat_map(Theirs::kinds) {
            line += &format!(" {} | {:.2} |", ms(&traced.timed), hdda.median() / traced.timed.median());
        }
        if let Some(theirs) = theirs.first() {
            line += &format!(" {:.1e} |", theirs.float.apart(&picture, scene));
        }
        println!(
            "{line} {} | {:.2} | {:.1} | {:.1} |",
            ms(&dda),
            dda.median() / hdda.median(),
            picture.mean_steps(),
            dda_picture.mean_steps()
        );
        Ok(())
    }
}

/// The median, marked if the batches never agreed.
fn ms(timed: &Steady) -> String {
    format!("{:.3}{}", timed.median(), if timed.is_steady { "" } else { " (unsteady)" })
}

/// What one of NanoVDB's versions makes of a scene.
struct Theirs {
    version: String,
    float: Traced,
    fpn: Traced,
}

impl Theirs {
    /// Its version, and its grids by name.
    fn kinds(&self) -> [(&str, &'static str, &Traced); 2] {
        [(&self.version, "NanoVDB float", &self.float), (&self.version, "NanoVDB FpN", &self.fpn)]
    }
}

struct Traced {
    timed: Steady,
    /// World units of a voxel.
    voxel: f64,
    /// In voxels: the integral of density, or depth.
    picture: Vec<f32>,
}

/// Traces a grid with the peer's program.
fn nanovdb_trace(
    program: &Path,
    nvdb: &Path,
    shows: &str,
    scene: &Scene,
    repeats: u32,
) -> Result<Traced, Box<dyn Error>> {
    let picture = nvdb.with_extension("f32");
    // To NanoVDB's steps a voxel is the cube from its coordinate on, half a voxel off from index space; between
    // voxels a cell is.
    let shift = if shows == "trilinear" { 0.0 } else { 0.5 };
    let lens =
        Lens::new(&scene.camera, &scene.matrix, scene.size, [shift; 3]).ok_or("no inverse transform")?;
    let rays = [lens.origin, lens.forward, lens.right, lens.up].concat();
    let rays: Vec<String> = rays.iter().map(ToString::to_string).collect();
    let mut child = Command::new(program)
        .arg(nvdb)
        .arg(shows)
        .args(scene.size.map(|s| s.to_string()))
        .arg(&picture)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()?;
    let mut input = child.stdin.take().ok_or("a pipe")?;
    let mut output = BufReader::new(child.stdout.take().ok_or("a pipe")?);
    writeln!(input, "{}", rays.join(" "))?;
    let timed = steady(repeats, |frames| -> Result<_, Box<dyn Error>> {
        writeln!(input, "{frames}")?;
        input.flush()?;
        (0..frames).map(|_| line(&mut output)).collect()
    });
    drop(input);
    wait(child, program, nvdb)?;
    let [x, y, z] = lens.forward;
    let picture = std::fs::read(&picture)?;
    let picture = picture.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
    Ok(Traced { timed: timed?, voxel: 1.0 / (x * x + y * y + z * z).sqrt(), picture })
}

fn line(output: &mut BufReader<ChildStdout>) -> Result<f64, Box<dyn Error>> {
    let mut line = String::new();
    output.read_line(&mut line)?;
    Ok(line.trim().parse()?)
}

fn wait(mut child: Child, program: &Path, nvdb: &Path) -> Result<(), Box<dyn Error>> {
    if child.wait()?.success() {
        return Ok(());
    }
    Err(format!("{} failed on {}", program.display(), nvdb.display()).into())
}

impl Traced {
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
