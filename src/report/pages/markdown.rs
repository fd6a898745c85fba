//! A report as a table that fits a review comment.

use askama::Template;

use crate::report::model::{PackReport, Report};
use crate::units::{bytes, of_limit, percent};

#[derive(Template)]
#[template(path = "report.md", config = "src/report/templates/askama.toml", escape = "none")]
struct Page<'a> {
    report: &'a Report,
    rows: Vec<Row>,
    breaches: Vec<String>,
    /// Bytes on the GPU and of the files, and what they may be.
    total: [String; 2],
}

struct Row {
    name: String,
    error: Option<String>,
    is_bad: bool,
    cells: Option<[String; 8]>,
}

/// The report as Markdown: a row an asset, then what is wrong.
///
/// # Errors
/// When the template does.
pub fn markdown(report: &Report) -> Result<String, askama::Error> {
    let rows = report.assets.iter().map(|asset| Row {
        name: escape(&asset.name),
        error: asset.error.as_deref().map(escape),
        is_bad: asset.error.is_some() || report.breaches_of(Some(&asset.name)).next().is_some(),
        cells: asset.pack.as_ref().map(cells),
    });
    let sums = &report.total;
    let breaches = report.breaches.iter().map(|breach| escape(&breach.to_string())).collect();
    let total = [
        of_limit(sums.gpu_bytes, sums.gpu_budget, bytes),
        of_limit(sums.file_bytes, sums.file_budget, bytes),
    ];
    Page { report, rows: rows.collect(), breaches, total }.render()
}

fn cells(pack: &PackReport) -> [String; 8] {
    let figures = &pack.figures;
    [
        bytes(figures.gpu_bytes),
        bytes(figures.file_bytes),
        format!("{:.2}", figures.bits_per_voxel),
        figures.decibels(figures.psnr),
        figures.decibels(figures.worst_frame_psnr),
        figures.max_error.map_or_else(|| "-".to_owned(), percent),
        figures.flip.map_or_else(|| "-".to_owned(), |flip| format!("{flip:.4}")),
        pack.change.as_ref().map_or_else(
            || "-".to_owned(),
            |change| {
                let db = change.psnr.map(|db| format!(", {}", arrow(db, "dB", 2)));
                let exact = change.lost_exactness.then(|| ", no longer exact".to_owned());
                let db = db.or(exact).unwrap_or_default();
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

/// Text, so that it cannot break the table, hide what follows or call anyone.
fn escape(text: &str) -> String {
    let mut out = String::new();
    for c in text.chars().map(|c| if c.is_control() { ' ' } else { c }) {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            // A name after a space of no width is nobody's.
            '@' => out.push_str("@\u{200b}"),
            '\\' | '|' | '`' | '*' | '_' | '>' | '[' | ']' | '~' | '#' => out.extend(['\\', c]),
            c => out.push(c),
        }
    }
    out
}
