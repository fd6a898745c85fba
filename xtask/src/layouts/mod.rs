//! Measures brick layouts that the next pack format might have: milliseconds of a trilinear half-voxel march on a GPU, bytes, seams
//! and PSNR.

mod atlas;
mod blocks;
mod bricks;
mod chart;
mod fog;
mod gpu;
mod nanovdb;
mod params;
mod quality;
mod report;
mod source;
mod surface;
mod view;
mod voxels;

use std::error::Error;
use std::path::PathBuf;

use volpack::sweep::steady;

use self::fog::Fog;
use self::gpu::{Gpu, Kernel};
use self::nanovdb::{March, Peer};
use self::quality::{apart, mean};
use self::report::{Bytes, Report, Row, Run, Times};
use self::source::Source;
use self::surface::Traced;
use crate::peer_programs;
use crate::process_stats::median;

/// Voxels between samples.
const STEP: f64 = 0.5;

#[derive(clap::Args)]
pub struct Args {
    /// OpenVDB files
    #[arg(required_unless_present = "redraw")]
    files: Vec<PathBuf>,
    /// Only write page and chart again, from the JSON of an earlier run
    #[arg(long, value_name = "JSON", conflicts_with_all = ["files", "json"])]
    redraw: Option<PathBuf>,
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
    /// Folder that contains nanovdb/, to compare with that version; repeat it for another [default: the compiler's path]
    #[arg(long, value_name = "DIR")]
    nanovdb: Vec<PathBuf>,
    /// Also write the raw figures to this JSON file
    #[arg(long)]
    json: Option<PathBuf>,
    /// Also write the tables to this Markdown page
    #[arg(long)]
    page: Option<PathBuf>,
    /// Also draw milliseconds against bytes into this SVG file
    #[arg(long)]
    chart: Option<PathBuf>,
}

/// A row, and what makes its picture.
struct Entry {
    row: Row,
    maker: Maker,
    picture: Vec<f32>,
}

enum Maker {
    Shader(Kernel),
    Tracer(Box<Traced>),
    NanoVdb(March),
}

impl Maker {
    fn time(&mut self, gpu: &Gpu, frames: u32) -> Result<Vec<f64>, Box<dyn Error>> {
        match self {
            Self::Shader(kernel) => gpu.time(kernel, frames),
            Self::Tracer(traced) => traced.time(frames),
            Self::NanoVdb(march) => march.time(frames),
        }
    }
}

pub fn bench(args: &Args) -> Result<(), Box<dyn Error>> {
    if let Some(json) = &args.redraw {
        return write(args, &serde_json::from_slice(&std::fs::read(json)?)?);
    }
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
    let mut report = Report::new(Run::new(&gpu.info, size, args.repeats, args.rounds)?);
    println!("{}\n", report.run.head());
    let peers = peers(args);
    if let Err(reason) = &peers {
        println!("NanoVDB is not measured: {reason}\n");
    }
    let peers = peers.unwrap_or_default();
    let mut wrong = 0;
    for path in &args.files {
        let source = Source::open(path, size)?;
        wrong += if source.level_set {
            level_set(&mut gpu, args, &source, size, &mut report)?
        } else {
            fog(&mut gpu, args, &source, size, &peers, &mut report)?
        };
        // After each volume, so that a failure loses one.
        write(args, &report)?;
    }
    if wrong > 0 {
        return Err(format!("{wrong} pictures differ from what their texels decode to").into());
    }
    Ok(())
}

/// Measures a level set, and returns how many pictures are wrong.
fn level_set(
    gpu: &mut Gpu,
    args: &Args,
    source: &Source,
    size: [u32; 2],
    report: &mut Report,
) -> Result<usize, Box<dyn Error>> {
    let (mut rows, mut makers) = surface::rows(gpu, source, size)?;
    if !args.check {
        let times = time(gpu, args, makers.iter_mut())?;
        rows.iter_mut().zip(times).for_each(|(row, times)| row.times = Some(times));
    }
    println!("{}", surface::table(&rows));
    let wrong = if args.check { surface::check(&rows) } else { 0 };
    report.level_sets.extend(rows);
    Ok(wrong)
}

/// Measures a fog volume, and returns how many pictures are wrong.
fn fog(
    gpu: &mut Gpu,
    args: &Args,
    source: &Source,
    size: [u32; 2],
    peers: &[Peer],
    report: &mut Report,
) -> Result<usize, Box<dyn Error>> {
    let mut entries = Fog::rows(gpu, source, size, args.check)?;
    for peer in peers {
        nanovdb_rows(peer, source, size, &mut entries)?;
    }
    let mut wrong = 0;
    if args.check {
        wrong = check(&entries);
    } else {
        let times = time(gpu, args, entries.iter_mut().map(|entry| &mut entry.maker))?;
        entries.iter_mut().zip(times).for_each(|(entry, times)| entry.row.times = Some(times));
    }
    let rows: Vec<Row> = entries.into_iter().map(|entry| entry.row).collect();
    println!("{}", report::fog_table(&rows));
    report.fog.extend(rows);
    Ok(wrong)
}

fn write(args: &Args, report: &Report) -> Result<(), Box<dyn Error>> {
    peer_programs::write(args.json.as_deref(), &serde_json::to_value(report)?)?;
    if let Some(page) = &args.page {
        std::fs::write(page, report.page())?;
    }
    match &args.chart {
        Some(svg) if report.fog.iter().any(|row| row.times.is_some()) => chart::draw(svg, &report.fog),
        _ => Ok(()),
    }
}

fn peers(args: &Args) -> Result<Vec<Peer>, Box<dyn Error>> {
    if args.nanovdb.is_empty() {
        return Ok(vec![Peer::compile(None)?]);
    }
    args.nanovdb.iter().map(|headers| Peer::compile(Some(headers))).collect()
}

/// Adds NanoVDB's rows; a message says why there are none.
fn nanovdb_rows(
    peer: &Peer,
    source: &Source,
    size: [u32; 2],
    entries: &mut Vec<Entry>,
) -> Result<(), Box<dyn Error>> {
    let nvdb = match peer.nvdb(source) {
        Ok(nvdb) => nvdb,
        Err(reason) => {
            println!("NanoVDB is not measured on {}: {reason}\n", source.name);
            return Ok(());
        }
    };
    let bytes = Bytes { texels: nvdb.metadata()?.len(), records: 0, tree: 0, masks: 0 };
    for (mode, lookup) in [("all", "every sample"), ("skip", "constant nodes left")] {
        let mut once = peer.start(&nvdb, mode, source, size)?;
        once.time(1)?;
        let picture = once.finish()?;
        let layout = format!("NanoVDB {}", peer.version);
        let mut row = Row::new(&source.name, &layout, lookup, "f32", 0, bytes, f64::INFINITY);
        row.picture = apart(&picture, &entries[0].picture);
        row.mean = mean(&picture);
        // The reference is itself compared with the CPU's.
        row.model = Some(row.picture);
        let maker = Maker::NanoVdb(peer.start(&nvdb, mode, source, size)?);
        entries.push(Entry { row, maker, picture });
    }
    Ok(())
}

/// Times all rows of a volume round by round, so that a drift of the clocks hits them alike.
fn time<'a>(
    gpu: &Gpu,
    args: &Args,
    makers: impl Iterator<Item = &'a mut Maker>,
) -> Result<Vec<Times>, Box<dyn Error>> {
    let mut makers: Vec<&mut Maker> = makers.collect();
    if let Some(first) = makers.first_mut() {
        let warm = steady(args.repeats, |frames| first.time(gpu, frames))?;
        if !warm.is_steady {
            println!("The clocks did not settle: the medians of the warm-up never agreed.\n");
        }
    }
    let mut rounds = vec![Vec::new(); makers.len()];
    for _ in 0..args.rounds {
        for (maker, rounds) in makers.iter_mut().zip(&mut rounds) {
            rounds.push(median(maker.time(gpu, args.repeats)?));
        }
    }
    Ok(rounds.into_iter().map(Times::new).collect())
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
