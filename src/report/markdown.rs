//! A report as a table that fits a review comment.

use askama::Template;

use super::model::{AssetReport, PackReport, Report};
use crate::units::{bytes, psnr};

#[derive(Template)]
#[template(path = "report.md", config = "src/report/templates/askama.toml", escape = "none")]
struct Page<'a> {
    report: &'a Report,
    rows: Vec<Row<'a>>,
    /// Bytes on the GPU and of the files, and what they may be.
    total: [String; 2],
}

struct Row<'a> {
    name: String,
    asset: &'a AssetReport,
    is_over: bool,
    cells: Option<[String; 8]>,
}

/// The report as Markdown: a row an asset, then what is wrong.
///
/// # Errors
/// When the template does.
pub fn markdown(report: &Report) -> Result<String, askama::Error> {
    let rows = report.assets.iter().map(|asset| Row {
        name: escape(&asset.name),
        asset,
        is_over: report.breaches.iter().any(|breach| breach.asset.as_ref() == Some(&asset.name)),
        cells: asset.pack.as_ref().map(cells),
    });
    let sum = |sum, budget: Option<u64>| match budget {
        Some(budget) => format!("{} of {}", bytes(sum), bytes(budget)),
        None => bytes(sum),
    };
    let sums = &report.total;
    let total = [sum(sums.gpu_bytes, sums.gpu_budget), sum(sums.file_bytes, sums.file_budget)];
    Page { report, rows: rows.collect(), total }.render()
}

fn cells(pack: &PackReport) -> [String; 8] {
    let figures = &pack.figures;
    let decibels = |db: Option<f64>| if figures.compared { psnr(db) } else { "not compared".to_owned() };
    let percent = |part: Option<f64>| part.map_or_else(|| "-".to_owned(), |p| format!("{:.2} %", p * 100.0));
    [
        bytes(figures.gpu_bytes),
        bytes(figures.file_bytes),
        format!("{:.2}", figures.bits_per_voxel),
        decibels(figures.psnr),
        decibels(figures.worst_frame_psnr),
        percent(figures.max_error),
        figures.flip.map_or_else(|| "-".to_owned(), |flip| format!("{flip:.4}")),
        pack.change.as_ref().map_or_else(
            || "-".to_owned(),
            |change| {
                let db = change.psnr.map(|db| format!(", {}", arrow(db, "dB", 2))).unwrap_or_default();
                format!("GPU {}{db}", arrow(change.gpu_bytes * 100.0, "%", 1))
            },
        ),
    ]
}

/// A change with the way that it goes.
pub(super) fn arrow(change: f64, unit: &str, digits: usize) -> String {
    let rounded = format!("{:.digits$}", change.abs());
    if rounded.chars().all(|c| "0.".contains(c)) {
        return "unchanged".to_owned();
    }
    format!("{} {rounded} {unit}", if change > 0.0 { "↑" } else { "↓" })
}

/// A name, so that it cannot break the table.
fn escape(text: &str) -> String {
    let special = |c: char| "\\|`*_<>[]".contains(c);
    let mut out = String::new();
    for c in text.chars().map(|c| if c.is_control() { ' ' } else { c }) {
        if special(c) {
            out.push('\\');
        }
        out.push(c);
    }
    out
}
