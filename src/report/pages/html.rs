//! A report as one page that needs nothing beside it.

use askama::Template;
use base64::Engine;
use base64::prelude::BASE64_STANDARD;

use super::markdown::arrow;
use crate::codec::TexelCodec;
use crate::report::chart::{ChartError, Line, frames_svg, histogram_svg};
use crate::report::model::{AssetReport, Breach, Figures, FrameCost, PackReport, Report, StageSeconds};
use crate::report::{CodecSummary, Gallery, KeyFrame, Png, Strip};
use crate::units::{bytes, count, of_limit, percent, seconds};

/// Why a page could not be made.
#[derive(Debug, thiserror::Error)]
pub enum PageError {
    /// A chart.
    #[error(transparent)]
    Chart(#[from] ChartError),
    /// The template.
    #[error("cannot write the page: {0}")]
    Template(#[from] askama::Error),
}

#[derive(Template)]
#[template(path = "report.html", config = "src/report/templates/askama.toml")]
struct Page<'a> {
    report: &'a Report,
    verdict: String,
    css: String,
    js: &'static str,
    total: Vec<Fact>,
    assets: Vec<Asset<'a>>,
    /// Places of the assets that a cheaper setting is known for, what it saves most first.
    offers: Vec<Offer<'a>>,
}

/// A figure: where it stands in the JSON, as it stands there, and for people.
struct Fact {
    label: &'static str,
    path: String,
    value: String,
    text: String,
    /// What tables are sorted by; none goes last.
    sort: Option<f64>,
    /// Against the baseline, and whether that is for the better.
    change: Option<(String, bool)>,
}

struct Asset<'a> {
    id: String,
    report: &'a AssetReport,
    breaches: Vec<&'a Breach>,
    thumbnail: Option<String>,
    pack: Option<Details<'a>>,
}

struct Details<'a> {
    report: &'a PackReport,
    facts: Vec<Fact>,
    parts: Vec<Part>,
    codecs: Vec<[Fact; 4]>,
    charts: Vec<String>,
    shots: Vec<Shot>,
    strips: Vec<Player>,
    stages: Vec<(Fact, f64)>,
    frames: Vec<[Fact; 4]>,
    settings: String,
}

/// A part of the bytes on a GPU.
struct Part {
    name: &'static str,
    fact: Fact,
    percent: f64,
}

struct Shot {
    title: String,
    side: u32,
    pack: String,
    /// Source and difference.
    source: Option<[String; 2]>,
}

struct Player {
    grid: String,
    first: i32,
    last: i32,
    count: usize,
    png: String,
}

struct Offer<'a> {
    name: &'a str,
    id: String,
    setting: &'a str,
    saved: u64,
    facts: [Fact; 4],
}

/// The report as HTML, with the gallery of each asset that has one, in the same order.
///
/// # Errors
/// When a chart or the template fails.
pub fn html(report: &Report, galleries: &[Option<Gallery>]) -> Result<String, PageError> {
    let assets = report.assets.iter().enumerate();
    let assets: Vec<Asset> = assets
        .map(|(i, asset)| view(report, i, asset, galleries.get(i).and_then(Option::as_ref)))
        .collect::<Result<_, _>>()?;
    let total = |label, key: &str, value: u64, budget: Option<u64>| {
        fact(label, format!("/total/{key}"), value, of_limit(value, budget, bytes))
    };
    let sums = &report.total;
    let took = of_limit(sums.build_seconds, sums.seconds_budget, seconds);
    let mut offers: Vec<Offer> = report.assets.iter().enumerate().filter_map(offer).collect();
    offers.sort_by_key(|offer| std::cmp::Reverse(offer.saved));
    let page = Page {
        report,
        verdict: verdict(report),
        css: css(),
        js: include_str!("../templates/report.js"),
        total: vec![
            total("On the GPU", "gpu_bytes", sums.gpu_bytes, sums.gpu_budget),
            total("Files", "file_bytes", sums.file_bytes, sums.file_budget),
            total("Sources", "source_bytes", sums.source_bytes, None),
            fact("This run", "/total/build_seconds".to_owned(), sums.build_seconds, took),
        ],
        assets,
        offers,
    };
    Ok(page.render()?)
}

/// The style sheet, with a colour for each codec.
fn css() -> String {
    let mut css = include_str!("../templates/report.css").to_owned();
    for codec in TexelCodec::ALL {
        css += &format!(".part.{} {{ background: {}; }}\n", codec.name(), codec.color());
    }
    css
}

/// The page in a sentence.
fn verdict(report: &Report) -> String {
    if !report.ok {
        let errors = report.assets.iter().filter(|asset| asset.error.is_some()).count();
        let over = report.breaches.len();
        let failed = (errors > 0).then(|| format!("{errors} of {} assets failed", report.assets.len()));
        let past =
            (over > 0).then(|| format!("{over} limit{} past", if over == 1 { " is" } else { "s are" }));
        return format!("✗ {}", [failed, past].into_iter().flatten().collect::<Vec<_>>().join(", "));
    }
    let packs = report.assets.iter().filter_map(|asset| asset.pack.as_ref());
    match packs.filter(|pack| !pack.figures.compared).count() {
        0 => "✓ Every pack was compared with its source and is within budget".to_owned(),
        1 => "✓ Every pack is whole; 1 was not compared with its source".to_owned(),
        unknown => format!("✓ Every pack is whole; {unknown} were not compared with their sources"),
    }
}

fn fact(label: &'static str, path: String, value: impl ToString, text: String) -> Fact {
    let value = value.to_string();
    // What is exact is better than any number.
    let sort = value.parse().ok().or((text == "exact").then_some(f64::INFINITY));
    Fact { label, path, value, text, sort, change: None }
}

fn optional(value: Option<f64>) -> String {
    value.map_or_else(|| "null".to_owned(), |value| value.to_string())
}

fn view<'a>(
    report: &'a Report,
    i: usize,
    asset: &'a AssetReport,
    gallery: Option<&Gallery>,
) -> Result<Asset<'a>, PageError> {
    let shot = gallery.and_then(|gallery| gallery.key_frames.get(gallery.key_frames.len() / 2));
    let path = format!("/assets/{i}/pack");
    Ok(Asset {
        id: id(i),
        report: asset,
        breaches: report.breaches_of(Some(&asset.name)).collect(),
        thumbnail: shot.map(|shot| data_url(&shot.pack)),
        pack: asset.pack.as_ref().map(|pack| details(&path, pack, gallery)).transpose()?,
    })
}

fn details<'a>(
    path: &str,
    pack: &'a PackReport,
    gallery: Option<&Gallery>,
) -> Result<Details<'a>, PageError> {
    let codec = |(name, codec): (&&'static str, &CodecSummary)| {
        let path = |key: &str| format!("{path}/summary/codecs/{name}/{key}");
        // The error of what has no record.
        let label = if codec.bricks == 0 { "empty" } else { *name };
        [
            fact(label, path("bricks"), codec.bricks, count(codec.bricks)),
            fact(name, path("bytes"), codec.bytes, bytes(codec.bytes)),
            fact(name, path("share_of_bytes"), codec.share_of_bytes, percent(codec.share_of_bytes)),
            fact(name, path("share_of_error"), codec.share_of_error, percent(codec.share_of_error)),
        ]
    };
    let frame = |(i, frame): (usize, &FrameCost)| {
        let path = |key: &str| format!("{path}/frames/{i}/{key}");
        [
            fact("frame", path("frame"), frame.frame, frame.frame.to_string()),
            fact("texels", path("texel_bytes"), frame.texel_bytes, bytes(frame.texel_bytes)),
            fact("new", path("new_texel_bytes"), frame.new_texel_bytes, bytes(frame.new_texel_bytes)),
            fact(
                "PSNR",
                path("psnr"),
                optional(frame.psnr),
                if frame.exact { "exact".to_owned() } else { pack.figures.decibels(frame.psnr) },
            ),
        ]
    };
    let stages = pack.build.iter().flat_map(|build| build.stages.iter().enumerate());
    let longest = stages.clone().map(|(_, stage)| stage.seconds).fold(1e-9, f64::max);
    let stage = |(i, stage): (usize, &StageSeconds)| {
        let path = format!("{path}/build/stages/{i}/seconds");
        (fact(stage.stage, path, stage.seconds, seconds(stage.seconds)), stage.seconds / longest * 100.0)
    };
    Ok(Details {
        report: pack,
        facts: facts(path, pack),
        parts: parts(path, pack),
        codecs: pack.summary.codecs.iter().map(codec).collect(),
        charts: charts(pack)?,
        shots: gallery.iter().flat_map(|gallery| &gallery.key_frames).map(shot).collect(),
        strips: gallery.iter().flat_map(|gallery| &gallery.strips).map(player).collect(),
        stages: stages.map(stage).collect(),
        frames: pack.frames.iter().enumerate().map(frame).collect(),
        settings: serde_json::to_string_pretty(&pack.reproduce.settings).unwrap_or_default(),
    })
}

fn facts(path: &str, pack: &PackReport) -> Vec<Fact> {
    let figures = &pack.figures;
    let path = |key: &str| format!("{path}/figures/{key}");
    let or_none = |value: Option<String>| value.unwrap_or_else(|| "not compared".to_owned());
    let mut facts = vec![
        fact("On the GPU", path("gpu_bytes"), figures.gpu_bytes, bytes(figures.gpu_bytes)),
        fact("File", path("file_bytes"), figures.file_bytes, bytes(figures.file_bytes)),
        fact("PSNR", path("psnr"), optional(figures.psnr), figures.decibels(figures.psnr)),
        fact(
            "Worst frame",
            path("worst_frame_psnr"),
            optional(figures.worst_frame_psnr),
            figures.decibels(figures.worst_frame_psnr),
        ),
        fact(
            "Largest error, of the range",
            path("max_error"),
            optional(figures.max_error),
            or_none(figures.max_error.map(percent)),
        ),
        fact(
            "FLIP, 0 to 1",
            path("flip"),
            optional(figures.flip),
            or_none(figures.flip.map(|flip| format!("{flip:.4}"))),
        ),
        fact(
            "Bits a voxel",
            path("bits_per_voxel"),
            figures.bits_per_voxel,
            format!("{:.2} bits", figures.bits_per_voxel),
        ),
        fact("Tree and masks", path("tree_share"), figures.tree_share, percent(figures.tree_share)),
        fact("Source files", path("source_bytes"), figures.source_bytes, bytes(figures.source_bytes)),
    ];
    if let Some(change) = &pack.change {
        let growth = |part: f64| Some((arrow(part * 100.0, "%", 1), part <= 0.0));
        let gain = |db: Option<f64>| db.map(|db| (arrow(db, "dB", 2), db >= 0.0));
        facts[0].change = growth(change.gpu_bytes);
        facts[1].change = growth(change.file_bytes);
        let lost = change.lost_exactness.then(|| ("no longer exact".to_owned(), false));
        facts[2].change = gain(change.psnr).or(lost);
        facts[3].change = gain(change.worst_frame_psnr);
    }
    facts
}

/// Tree, masks, and texels by codec.
fn parts(path: &str, pack: &PackReport) -> Vec<Part> {
    let summary = &pack.summary;
    let part = |name: &'static str, key: String, size: u64| Part {
        name,
        fact: fact(name, format!("{path}/summary/{key}"), size, bytes(size)),
        percent: size as f64 / summary.gpu_bytes.max(1) as f64 * 100.0,
    };
    let fixed = [
        part("tree", "tree_bytes".to_owned(), summary.tree_bytes),
        part("masks", "mask_bytes".to_owned(), summary.mask_bytes),
    ];
    let codecs =
        summary.codecs.iter().map(|(name, codec)| part(name, format!("codecs/{name}/bytes"), codec.bytes));
    fixed.into_iter().chain(codecs).filter(|part| part.percent > 0.0).collect()
}

fn charts(pack: &PackReport) -> Result<Vec<String>, ChartError> {
    let mut charts = Vec::new();
    let grids = &pack.summary.grids;
    let of = |grid: &String, value: &dyn Fn(&FrameCost) -> Option<f64>| {
        let frames = pack.frames.iter().filter(|frame| frame.grid == *grid);
        frames.filter_map(|frame| Some((frame.frame, value(frame)?))).collect::<Vec<_>>()
    };
    let kib = |bytes: u64| Some(bytes as f64 / 1024.0);
    for grid in grids {
        let shown = of(grid, &|frame| kib(frame.texel_bytes));
        if shown.len() > 1 {
            let new = of(grid, &|frame| kib(frame.new_texel_bytes));
            let lines = [Line { name: "shown", points: shown }, Line { name: "new in it", points: new }];
            charts.push(frames_svg(&format!("{grid}: texels of each frame"), "KiB", &lines, true)?);
        }
        let quality = of(grid, &|frame| frame.psnr);
        if quality.len() > 1 {
            let lines = [Line { name: "PSNR", points: quality }];
            charts.push(frames_svg(&format!("{grid}: PSNR of each frame"), "dB", &lines, false)?);
        }
    }
    for grid in pack.verification.iter().flat_map(|found| &found.grids).filter(|grid| grid.active.voxels > 0)
    {
        charts.push(histogram_svg(&format!("{}: errors", grid.grid), &grid.histogram)?);
    }
    Ok(charts)
}

fn shot(key: &KeyFrame) -> Shot {
    let worst = if key.is_worst { ", the worst" } else { "" };
    Shot {
        title: format!("{}, frame {}{worst}", key.grid, key.frame),
        side: key.side,
        pack: data_url(&key.pack),
        source: key.source.as_ref().map(|pair| [data_url(&pair[0]), data_url(&pair[1])]),
    }
}

fn player(strip: &Strip) -> Player {
    Player {
        grid: strip.grid.clone(),
        first: strip.frames.first().copied().unwrap_or_default(),
        last: strip.frames.last().copied().unwrap_or_default(),
        count: strip.frames.len(),
        png: data_url(&strip.png),
    }
}

fn offer((i, asset): (usize, &AssetReport)) -> Option<Offer<'_>> {
    let pack = asset.pack.as_ref()?;
    let (cheaper, figures): (_, &Figures) = (pack.cheaper.as_ref()?, &pack.figures);
    let path = |key: &str| format!("/assets/{i}/pack/cheaper/figures/{key}");
    let offered = &cheaper.figures;
    let saved = figures.gpu_bytes.saturating_sub(offered.gpu_bytes);
    Some(Offer {
        name: &asset.name,
        id: id(i),
        setting: &cheaper.setting,
        saved,
        facts: [
            fact("GPU", path("gpu_bytes"), offered.gpu_bytes, bytes(offered.gpu_bytes)),
            fact("saves", String::new(), saved, bytes(saved)),
            fact("PSNR", path("psnr"), optional(offered.psnr), offered.decibels(offered.psnr)),
            fact(
                "largest error",
                path("max_error"),
                optional(offered.max_error),
                offered.max_error.map_or_else(String::new, percent),
            ),
        ],
    })
}

/// Where an asset stands in the page.
fn id(i: usize) -> String {
    format!("asset-{i}")
}

fn data_url(png: &Png) -> String {
    format!("data:image/png;base64,{}", BASE64_STANDARD.encode(&png.0))
}
