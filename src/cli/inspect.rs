//! `volpack inspect`.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use clap::Args;

use super::style::{ERROR, TITLE, WARNING};
use super::{outln, print_json};
use crate::error::{Error, Result};
use crate::pack::{Pack, Provenance, layout};
use crate::report::{GridSummary, PackSummary, TopologySummary, VdbSummary};
use crate::units::{bytes, count};
use crate::vdb::ValueType;

#[derive(Args)]
pub struct InspectArgs {
    /// File to inspect, .vdb or .volpack
    file: PathBuf,
    /// Print JSON
    #[arg(long)]
    json: bool,
    /// Read the voxels of a .vdb too, and print their range and sum
    #[arg(long)]
    values: bool,
}

pub fn run(args: &InspectArgs) -> Result<()> {
    if is_pack(&args.file)? {
        let pack = Pack::open(&args.file).map_err(Error::pack(&args.file))?;
        let summary = PackSummary::new(&pack);
        if args.json {
            print_json(&summary);
        } else {
            print_pack(&args.file, &pack, &summary);
        }
    } else {
        let summary = VdbSummary::read(&args.file, args.values)?;
        if args.json {
            print_json(&summary);
        } else {
            print_vdb(&args.file, &summary);
        }
    }
    Ok(())
}

fn is_pack(path: &Path) -> Result<bool> {
    // Which not every system opens: the reader of .vdb files tells what is wrong.
    if path.is_dir() {
        return Ok(false);
    }
    let mut magic = Vec::new();
    let file = File::open(path).map_err(Error::io(path))?;
    file.take(layout::MAGIC.len() as u64).read_to_end(&mut magic).map_err(Error::io(path))?;
    Ok(magic == layout::MAGIC)
}

fn print_vdb(path: &Path, file: &VdbSummary) {
    let by = file.creator.as_ref().map(|c| format!(", by {c}")).unwrap_or_default();
    outln!(
        "{TITLE}{}{TITLE:#}: OpenVDB file version {}, library {}{by}",
        path.display(),
        file.version,
        file.library
    );
    for warning in &file.warnings {
        outln!("  {WARNING}warning{WARNING:#}: {warning}");
    }
    if file.grids.is_empty() {
        outln!("  no grids");
    }
    for grid in &file.grids {
        print_grid(grid);
    }
}

fn print_grid(g: &GridSummary) {
    let half = if g.half && g.value_type != ValueType::Half.name() { " (half)" } else { "" };
    outln!("\n  {TITLE}{}{TITLE:#}: {}{half}, {}", g.name, g.value_type, g.class);
    if let Some(obstacle) = &g.obstacle {
        outln!("    cannot be packed: it {obstacle}");
    }
    outln!("    map           {}", g.map);
    if let Some(topology) = &g.topology {
        print_topology(topology);
    }
    if let Some(v) = &g.values {
        outln!("    values        {} to {}, sum {}", v.min, v.max, v.sum);
        if v.nonfinite != 0 {
            outln!("    not finite    {}", v.nonfinite);
        }
    }
}

fn print_topology(t: &TopologySummary) {
    outln!("    background    {}", t.background);
    let tiles = [("4096³", t.root_tiles), ("128³", t.l1_tiles), ("8³", t.l2_tiles)];
    let tiles: Vec<_> =
        tiles.iter().filter(|(_, n)| *n > 0).map(|(dim, n)| format!("{} of {dim}", count(*n))).collect();
    let tiles = if tiles.is_empty() { "none".to_owned() } else { tiles.join(", ") };
    outln!("    leaves        {}", count(t.leaves));
    outln!("    active tiles  {tiles}");
    outln!("    active voxels {}", count(t.active_voxels));
    if t.active_voxels > 0 {
        let [a, b, c, d, e, f] = t.bbox;
        outln!("    box           [{a}, {b}, {c}] to [{d}, {e}, {f}]");
    }
}

fn print_pack(path: &Path, pack: &Pack, summary: &PackSummary) {
    let (by, unreadable) = match Provenance::of(pack) {
        Ok(provenance) => (format!(", by {} {}", provenance.tool, provenance.version), None),
        Err(error) => (String::new(), Some(error)),
    };
    outln!(
        "{TITLE}{}{TITLE:#}: {}, pack format {}{by}",
        path.display(),
        bytes(summary.file_bytes),
        layout::VERSION
    );
    if let Some(error) = unreadable {
        outln!("  {ERROR}{error}{ERROR:#}");
    }
    for grid in pack.grids() {
        let r = &grid.record;
        let numbers: Vec<i32> = grid.frames.iter().map(|f| f.record.number).collect();
        let frames = match (numbers.first(), numbers.last()) {
            (Some(first), Some(last)) if first != last => format!("frames {first} to {last}"),
            (Some(only), _) => format!("frame {only}"),
            _ => "no frames".to_owned(),
        };
        outln!("  {TITLE}{}{TITLE:#}: {frames}, values {} to {}", grid.name, r.active_min, r.active_max);
    }
    print_sizes(summary, true);
}

/// Prints what a pack holds and its sizes; `with_codecs` adds a line for each codec.
pub fn print_sizes(p: &PackSummary, with_codecs: bool) {
    let frames = if p.frames == 1 { "frame" } else { "frames" };
    outln!("  {} {frames}, {} bricks, {} unique", count(p.frames), count(p.bricks), count(p.unique_bricks));
    for (codec, c) in p.codecs.iter().filter(|_| with_codecs) {
        // What has become background has no brick, but its error counts.
        let codec = if c.bricks == 0 { "empty" } else { codec };
        outln!(
            "    {codec:9} {:>10} bricks  {:>10}  {:5.1} % of texels  {:5.1} % of error",
            count(c.bricks),
            bytes(c.bytes),
            100.0 * c.share_of_bytes,
            100.0 * c.share_of_error
        );
    }
    outln!(
        "  {} on the GPU: tree {}, masks {}, texels {}; {:.3} bits per voxel",
        bytes(p.gpu_bytes),
        bytes(p.tree_bytes),
        bytes(p.mask_bytes),
        bytes(p.texel_bytes),
        p.bits_per_voxel
    );
}
