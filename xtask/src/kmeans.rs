//! Compares our k-means with linfa's: the same bricks, k, iterations, distance and seed.

use std::error::Error;
use std::path::PathBuf;
use std::time::Instant;

use linfa::DatasetBase;
use linfa::traits::{Fit, Predict};
use linfa_clustering::{KMeans, KMeansInit};
use linfa_nn::distance::L1Dist;
use ndarray::Array2;
use rand::SeedableRng;
use rand_xoshiro::Xoshiro256Plus;
use serde_json::json;
use volpack::component::Component;
use volpack::settings::NonFinite;
use volpack::stages::allocate::kmeans::{KMeansSettings, kmeans};
use volpack::stages::flatten::flatten;
use volpack::vdb::{VdbFile, find_grid};

#[derive(clap::Args)]
pub struct Args {
    /// OpenVDB files; all their bricks are clustered together
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// Name of the grid to use
    #[arg(long, default_value = "density")]
    grid: String,
    /// Number of clusters
    #[arg(short, long, default_value_t = 1000)]
    k: usize,
    /// Number of iterations
    #[arg(short, long, default_value_t = 5)]
    iterations: usize,
    /// Number of runs of each; the fastest is printed
    #[arg(long, default_value_t = 3)]
    repeats: u32,
    /// Also write the raw figures to this JSON file
    #[arg(long)]
    json: Option<PathBuf>,
}

const SEED: u64 = 0;

pub fn bench(args: &Args) -> Result<(), Box<dyn Error>> {
    let points = bricks(args)?;
    let mut times = [f64::INFINITY; 2];
    let mut rmses = [0.0; 2];
    for _ in 0..args.repeats {
        let settings = KMeansSettings { clusters: args.k, iterations: args.iterations, seed: SEED };
        let start = Instant::now();
        let ours = kmeans(points.view(), &settings);
        times[0] = times[0].min(start.elapsed().as_secs_f64());
        rmses[0] = rmse(&points, &ours.centroids, |row| ours.members[row] as usize);

        let data = DatasetBase::from(points.clone());
        let params = KMeans::params_with(args.k, Xoshiro256Plus::seed_from_u64(SEED), L1Dist)
            .init_method(KMeansInit::Random)
            .n_runs(1)
            .max_n_iterations(args.iterations as u64)
            // Never reached, so both make every iteration.
            .tolerance(1e-12);
        let start = Instant::now();
        let theirs = params.fit(&data)?;
        times[1] = times[1].min(start.elapsed().as_secs_f64());
        let members = theirs.predict(&points);
        rmses[1] = rmse(&points, theirs.centroids(), |row| members[row]);
    }
    println!("{} bricks, k = {}, {} iterations\n", points.nrows(), args.k, args.iterations);
    println!("| | seconds | RMSE of the range |\n|---|---|---|");
    for (name, i) in [("volpack", 0), ("linfa", 1)] {
        println!("| {name} | {:.3} | {:.5} |", times[i], rmses[i]);
    }
    println!("| linfa / volpack | {:.1} | {:.4} |", times[1] / times[0], rmses[1] / rmses[0]);
    if let Some(path) = &args.json {
        let figures = json!({ "bricks": points.nrows(), "k": args.k, "iterations": args.iterations,
            "seconds": { "volpack": times[0], "linfa": times[1] }, "rmse": { "volpack": rmses[0], "linfa": rmses[1] } });
        std::fs::write(path, serde_json::to_string(&figures)?)?;
    }
    Ok(())
}

/// The values of every brick, as fractions of the largest.
fn bricks(args: &Args) -> Result<Array2<f32>, Box<dyn Error>> {
    let (mut values, mut peak) = (Vec::new(), 0.0f32);
    for path in volpack::manifest::expand(&args.files)? {
        let file = VdbFile::open(&path)?;
        let info = find_grid(&file.grids, &args.grid).ok_or("no such grid")?;
        let frame = flatten(&file, &path, info, Component::Whole, NonFinite::Refuse)?.frame;
        peak = peak.max(frame.stats.active_range.map_or(0.0, |r| r.max));
        values.extend(frame.bricks.iter().flat_map(|b| b.values));
    }
    values.iter_mut().for_each(|v| *v /= peak);
    Ok(Array2::from_shape_vec((values.len() / 512, 512), values)?)
}

fn rmse(points: &Array2<f32>, centroids: &Array2<f32>, member: impl Fn(usize) -> usize) -> f64 {
    let squares = points.rows().into_iter().enumerate().map(|(row, point)| {
        let pairs = point.into_iter().zip(centroids.row(member(row)));
        pairs.map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum::<f64>()
    });
    (squares.sum::<f64>() / points.len() as f64).sqrt()
}
