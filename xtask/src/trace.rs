//! Milliseconds a frame on a GPU, for every format, cell by cell and node by node.

use std::error::Error;
use std::path::PathBuf;

use serde_json::json;
use volpack::pack::Pack;
use volpack::pipeline::{Job, Silent, VerifyLevel, build};
use volpack::render::gpu::Gpu;
use volpack::render::{Mode, Scene, Traversal, View};
use volpack::settings::{Format, Settings};

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
    /// Write the raw figures here too
    #[arg(long)]
    json: Option<PathBuf>,
}

/// Along (-0.6, -0.35, -0.72) from one diagonal away: the camera of the NanoVDB peer.
const VIEW: View = View::Orbit([39.8056, 20.4927, 1.0]);

pub fn bench(args: &Args) -> Result<(), Box<dyn Error>> {
    let gpu = Gpu::shared()?;
    let folder = tempfile::tempdir()?;
    let mut rows = Vec::new();
    println!("{} at {} × {}, median of {} frames\n", gpu.name, args.size[0], args.size[1], args.repeats);
    println!("| volume | shows | format | HDDA ms | DDA ms | DDA / HDDA | HDDA steps | DDA steps |");
    println!("|---|---|---|---|---|---|---|---|");
    for path in &args.files {
        let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
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
            let mut row = Vec::new();
            for traversal in [Traversal::Hdda, Traversal::Dda] {
                let size = [args.size[0], args.size[1]];
                // Level sets: depth; fog: accumulated density.
                let mode = if grid.record.class == 1 { Mode::Depth } else { Mode::Density };
                let scene =
                    Scene { traversal, ..Scene::new(grid, &grid.frames[0], bounds, &VIEW, mode, size) };
                let (image, mut ms) = gpu.trace_timed(&uploaded, [0, 0], bounds, &scene, args.repeats)?;
                ms.sort_by(f64::total_cmp);
                row.push((ms.get(ms.len() / 2).copied().unwrap_or(f64::NAN), image.mean_steps()));
                rows.push(json!({ "volume": name, "format": format, "traversal": format!("{traversal:?}"),
                    "milliseconds": ms, "mean_steps": image.mean_steps() }));
            }
            let [(hdda, hdda_steps), (dda, dda_steps)] = row[..] else { return Err("two traversals".into()) };
            let shows = if grid.record.class == 1 { "depth" } else { "density" };
            println!(
                "| {name} | {shows} | {} | {hdda:.3} | {dda:.3} | {:.2} | {hdda_steps:.1} | {dda_steps:.1} |",
                format.name(),
                dda / hdda
            );
        }
    }
    if let Some(path) = &args.json {
        std::fs::write(path, serde_json::to_string(&json!({ "device": gpu.name, "rows": rows }))?)?;
    }
    Ok(())
}
