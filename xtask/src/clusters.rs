//! Measures k-means clustering: bricks saved, and error. The columns are those of the thesis's figure 19.

use std::error::Error;
use std::path::PathBuf;

use serde_json::json;
use volpack::codec::Codec;
use volpack::pack::Pack;
use volpack::pipeline::{Job, Silent, VerifyLevel, build};
use volpack::settings::{Clustering, Encoding, Settings, TexelCodec};

use crate::{peer_programs, sequence};

#[derive(clap::Args)]
pub struct Args {
    /// Sequences, each a file or a glob
    #[arg(required = true)]
    sequences: Vec<PathBuf>,
    /// Also write the raw figures to this JSON file
    #[arg(long)]
    json: Option<PathBuf>,
}

/// k, iterations and variance threshold: the rows of figure 19, and what lies between them.
const ROWS: [(u32, u32, f64); 9] = [
    (1000, 5, 0.01),
    (100, 10, 0.01),
    (100, 5, 0.01),
    (1000, 5, 0.1),
    (100, 10, 0.1),
    (100, 5, 0.1),
    (1000, 5, 0.99),
    (100, 10, 0.99),
    (100, 5, 0.99),
];

pub fn bench(args: &Args) -> Result<(), Box<dyn Error>> {
    let folder = tempfile::tempdir()?;
    let mut rows = Vec::new();
    println!(
        "| model | k | iterations | variance | before | after | ratio | RMSE | RMSE without | PSNR dB |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|");
    for sequence in &args.sequences {
        let (name, frames) = sequence::named(sequence)?;
        let measure = |clustering| -> Result<(u32, f64, f64), Box<dyn Error>> {
            let job = Job::new(
                frames.clone(),
                folder.path().join("bench.volpack"),
                Settings {
                    encoding: Encoding::Uniform { codec: TexelCodec::BC7, clustering },
                    ..Settings::default()
                },
                VerifyLevel::Voxels,
            );
            let report =
                build(&job, &mut Silent)?.verification.ok_or("the build returned no verification")?;
            let bricks = Pack::open(&job.output)?.atlas(Codec::Bc7).map_or(0, |a| a.bricks);
            let grid = &report.grids[0];
            Ok((bricks, grid.active.rmse / grid.peak, grid.active.psnr.unwrap_or(f64::INFINITY)))
        };
        let (before, alone, _) = measure(None)?;
        for (clusters, iterations, variance) in ROWS {
            let (after, rmse, psnr) =
                measure(Some(Clustering { clusters, iterations, variance, ..Clustering::default() }))?;
            println!(
                "| {name} | {clusters} | {iterations} | {variance} | {before} | {after} | {:.4} | {rmse:.4} | {alone:.4} | {psnr:.2} |",
                f64::from(after) / f64::from(before)
            );
            rows.push(json!({ "volume": name, "k": clusters, "iterations": iterations, "variance": variance,
                "before": before, "after": after, "rmse": rmse, "rmse_without": alone, "psnr": psnr }));
        }
    }
    peer_programs::write(args.json.as_deref(), &json!(rows))
}
