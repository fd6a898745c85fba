//! What was measured, as a table, as JSON and as a page.

use std::error::Error;
use std::fmt::Write;
use std::process::Command;

use serde::{Deserialize, Serialize};
use volpack::pack::Pack;
use volpack::pack::tree::{MASK_WORDS, RECORD_WORDS, header};

use super::STEP;
use super::quality::{Apart, Seams};
use super::surface::{self, SurfaceRow};
use crate::process_stats::median;

/// Bytes of a layout on the GPU. Texels are those of bricks; places of a texture that no brick fills are not counted.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Bytes {
    pub texels: u64,
    pub records: u64,
    /// The tree without records and masks, or the indirection.
    pub tree: u64,
    pub masks: u64,
}

impl Bytes {
    /// Those of a pack.
    pub fn of(pack: &Pack) -> Self {
        let tree = pack.tree();
        let records = tree[header::RECORDS] as usize * RECORD_WORDS;
        let masks = tree[header::MASKS] as usize * MASK_WORDS;
        let texels = pack.atlases().iter().map(|a| a.bricks as usize * a.codec.layout().brick_bytes());
        Self {
            texels: texels.sum::<usize>() as u64,
            records: records as u64 * 4,
            tree: (tree.len() - records - masks) as u64 * 4,
            masks: masks as u64 * 4,
        }
    }

    pub fn total(&self) -> u64 {
        self.texels + self.records + self.tree + self.masks
    }
}

/// Milliseconds of a frame: a median for each round, and what they come to.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Times {
    pub rounds: Vec<f64>,
    pub median: f64,
    /// The largest median of a round less the smallest, as a fraction of the median.
    pub spread: f64,
}

/// One layout with one coding of one volume.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Row {
    pub volume: String,
    pub layout: String,
    pub lookup: String,
    pub coding: String,
    /// Bricks with texels.
    pub bricks: usize,
    pub bytes: Bytes,
    pub seams: Seams,
    /// Of filtered values, in dB; none without a difference.
    pub psnr: Option<f64>,
    /// The mean of the picture: density · voxels.
    pub mean: f64,
    /// How far the picture is from that of the f32 pack, and from one that the CPU makes of the same texels.
    pub picture: Apart,
    pub model: Option<Apart>,
    pub times: Option<Times>,
}

impl Row {
    /// A row without seams, to be drawn and timed.
    pub fn new(
        volume: &str,
        layout: &str,
        lookup: &str,
        coding: &str,
        bricks: usize,
        bytes: Bytes,
        psnr: f64,
    ) -> Self {
        Self {
            volume: volume.to_owned(),
            layout: layout.to_owned(),
            lookup: lookup.to_owned(),
            coding: coding.to_owned(),
            bricks,
            bytes,
            seams: Seams::default(),
            psnr: Some(psnr).filter(|psnr| psnr.is_finite()),
            mean: 0.0,
            picture: Apart::default(),
            model: None,
            times: None,
        }
    }
}

/// The table of fog rows, as Markdown.
pub fn fog_table(rows: &[Row]) -> String {
    let mut table = String::from(
        "| volume | layout | lookup | codec | ms | spread | MB | texels | records | tree | bricks | PSNR dB | seam mean | seam max | picture mean | picture max |\n",
    );
    table += &format!("{}|\n", "|---".repeat(16));
    for row in rows {
        let Row { volume, layout, lookup, coding, .. } = row;
        // Writing to a string does not fail.
        let _ = writeln!(
            table,
            "| {volume} | {layout} | {lookup} | {coding} | {} | {} | {} | {} | {} | {} |",
            cells_of(row.times.as_ref(), &row.bytes, row.bricks),
            row.psnr.map_or("exact".to_owned(), |psnr| format!("{psnr:.2}")),
            percent(row.seams.mean),
            percent(row.seams.max),
            percent(row.picture.mean),
            percent(row.picture.max),
        );
    }
    table
}

/// The cells that all tables have: milliseconds, their spread, megabytes and bricks.
pub fn cells_of(times: Option<&Times>, bytes: &Bytes, bricks: usize) -> String {
    let mb = |bytes: u64| format!("{:.3}", bytes as f64 / 1e6);
    let parts = [bytes.total(), bytes.texels, bytes.records, bytes.tree + bytes.masks].map(mb).join(" | ");
    let timed = times.map_or(" | ".to_owned(), |t| format!("{:.4} | {}", t.median, percent(t.spread)));
    format!("{timed} | {parts} | {bricks}")
}

pub fn percent(fraction: f64) -> String {
    format!("{:.3} %", fraction * 100.0)
}

impl Times {
    /// Of the medians of some rounds.
    pub fn new(rounds: Vec<f64>) -> Self {
        let middle = median(rounds.iter().copied());
        let (least, most) = rounds.iter().fold((f64::INFINITY, 0.0f64), |(l, m), v| (l.min(*v), m.max(*v)));
        Self { median: middle, spread: (most - least) / middle, rounds }
    }
}

/// When, where and how a benchmark ran.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Run {
    date: String,
    device: String,
    driver: String,
    backend: String,
    size: [u32; 2],
    step: f64,
    repeats: u32,
    rounds: u32,
}

impl Run {
    pub fn new(
        info: &wgpu::AdapterInfo,
        size: [u32; 2],
        repeats: u32,
        rounds: u32,
    ) -> Result<Self, Box<dyn Error>> {
        let date = Command::new("date").args(["-u", "+%Y-%m-%d"]).output()?.stdout;
        Ok(Self {
            date: String::from_utf8(date)?.trim().to_owned(),
            device: info.name.clone(),
            driver: format!("{} {}", info.driver, info.driver_info),
            backend: format!("{:?}", info.backend),
            size,
            step: STEP,
            repeats,
            rounds,
        })
    }

    /// One line on all of it.
    pub fn head(&self) -> String {
        let Self { date, device, driver, backend, size: [width, height], step, repeats, rounds } = self;
        format!(
            "{date}, {device} ({backend}, {driver}), {width} × {height}, a sample each {step} voxels, medians of {rounds} rounds of {repeats} frames"
        )
    }
}

/// All that a run measured.
#[derive(Serialize, Deserialize)]
pub struct Report {
    pub run: Run,
    pub fog: Vec<Row>,
    pub level_sets: Vec<SurfaceRow>,
}

impl Report {
    /// One without figures.
    pub fn new(run: Run) -> Self {
        Self { run, fog: Vec::new(), level_sets: Vec::new() }
    }

    /// The Markdown page.
    pub fn page(&self) -> String {
        let mut page = format!("# Brick layouts\n\n{}. Written by `xtask bench layouts`.\n", self.run.head());
        if !self.fog.is_empty() {
            page += &format!("\n## Fog\n\n{FOG_NOTES}\n\n{}", fog_table(&self.fog));
        }
        if !self.level_sets.is_empty() {
            page +=
                &format!("\n## Level sets\n\n{}\n\n{}", surface::notes(), surface::table(&self.level_sets));
        }
        page
    }
}

const FOG_NOTES: &str = "\
All rows sum the same samples of density along the same rays. MB are 10⁶ bytes: texels of bricks (places of a texture that no brick fills are \
not counted), records, and the tree with masks or the indirection. PSNR is that of the filtered value at 200,000 random points of the box of \
active voxels. A seam is the jump of the filtered value across a face between two bricks with texels, as a fraction of the grid's range. \
The picture's difference is from that of the f32 pack, as a fraction of its largest value; the mean is over pixels that show fog. Spread is the range \
of the rounds' medians. Adaptive bricks have the codec that a default adaptive pack chose for the region that holds the brick's centre; \
9³ and 10³ have bc4 where it chose bc7. NanoVDB's row has the size of its file.";
