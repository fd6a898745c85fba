//! Measures brick layouts that the next pack format might have: milliseconds of a trilinear half-voxel march on a GPU, bytes, seams
//! and PSNR.

mod atlas;
mod blocks;
mod bricks;
mod fog;
mod gpu;
mod quality;
mod report;
mod source;
mod view;
mod voxels;

use std::error::Error;
use std::path::PathBuf;

use serde_json::json;
use volpack::sweep::steady;

use self::fog::Fog;
use self::gpu::{Gpu, Kernel};
use self::report::{Row, Times};
use self::source::Source;
use crate::peer_programs;
use crate::process_stats::median;

/// Voxels between samples.
const STEP: f64 = 0.5;

#[derive(clap::Args)]
pub struct Args {
    /// OpenVDB files
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// Frames of each row in a round
    #[arg(long, default_value_t = 50)]
    repeats: u32,
    /// Rounds: each takes every row of a volume once
    #[arg(long, default_value_t = 7)]
    rounds: u32,
    /// Size of the pictures in pixels, as WIDTH HEIGHT [default: 1920 1080; 96 54 with --check]
    #[arg(long, num_args = 2)]
    size: Vec<u32>,
    /// Only compare pictures with those that the CPU makes of the same texels, without timing
    #[arg(long)]
    check: bool,
    /// Report times of a software device, which mean nothing
    #[arg(long)]
    allow_software: bool,
    /// Also write the raw figures to this JSON file
    #[arg(long)]
    json: Option<PathBuf>,
}

/// A row, and what makes its picture.
struct Entry {
    row: Row,
    kernel: Kernel,
    picture: Vec<f32>,
}

pub fn bench(args: &Args) -> Result<(), Box<dyn Error>> {
    let mut gpu = Gpu::open()?;
    if gpu.is_software() && !args.check {
        let name = &gpu.info.name;
        if !args.allow_software {
            return Err(format!(
                "{name} is not a GPU, so its times are meaningless: use --check, or --allow-software"
            )
            .into());
        }
        println!("{name} is not a GPU: the times below are meaningless.\n");
    }
    let size = match args.size[..] {
        [width, height] => [width, height],
        _ if args.check => [96, 54],
        _ => [1920, 1080],
    };
    let output = gpu.output(size, 1);
    let mut rows = Vec::new();
    let mut wrong = 0;
    for path in &args.files {
        let source = Source::open(path, size)?;
        let mut fog = Fog {
            gpu: &mut gpu,
            source: &source,
            output: &output,
            size,
            check: args.check,
            entries: Vec::new(),
        };
        fog.rows()?;
        let mut entries = fog.entries;
        if args.check {
            wrong += check(&entries);
        } else {
            time(&gpu, args, &mut entries)?;
        }
        let volume: Vec<Row> = entries.into_iter().map(|entry| entry.row).collect();
        println!("{}", report::fog_table(&volume));
        rows.extend(volume);
    }
    peer_programs::write(args.json.as_deref(), &json!({ "device": gpu.info.name, "fog": rows }))?;
    if wrong > 0 {
        return Err(format!("{wrong} pictures differ from what their texels decode to").into());
    }
    Ok(())
}

/// Times all rows of a volume round by round, so that a drift of the clocks hits them alike.
fn time(gpu: &Gpu, args: &Args, entries: &mut [Entry]) -> Result<(), Box<dyn Error>> {
    if let Some(first) = entries.first() {
        steady(args.repeats, |frames| gpu.time(&first.kernel, frames))?;
    }
    let mut rounds = vec![Vec::new(); entries.len()];
    for _ in 0..args.rounds {
        for (entry, rounds) in entries.iter().zip(&mut rounds) {
            rounds.push(median(gpu.time(&entry.kernel, args.repeats)?));
        }
    }
    for (entry, rounds) in entries.iter_mut().zip(rounds) {
        entry.row.times = Some(Times::new(rounds));
    }
    Ok(())
}

/// What 8-bit filter weights, and interpolation of BC4 by the device, may change of a picture: as fractions of its largest value.
const MEAN_APART: f64 = 2e-3;
const MAX_APART: f64 = 2e-2;

/// Prints each row's picture against the CPU's, and returns how many are too far apart.
fn check(entries: &[Entry]) -> usize {
    println!("| layout | lookup | codec | against the CPU: mean | max | |\n|---|---|---|---|---|---|");
    let mut wrong = 0;
    for Entry { row, .. } in entries {
        let model = row.model.unwrap_or_default();
        let is_right = model.mean <= MEAN_APART && model.max <= MAX_APART;
        wrong += usize::from(!is_right);
        println!(
            "| {} | {} | {} | {} | {} | {} |",
            row.layout,
            row.lookup,
            row.coding,
            report::percent(model.mean),
            report::percent(model.max),
            if is_right { "ok" } else { "WRONG" }
        );
    }
    println!();
    wrong
}
