//! One page for one volume: quality against size, build time and trace time.

use plotters::prelude::*;

use super::axis::number;
use super::paint::*;
use super::plot::{BUILD, Dot, FRONT, JOINED, Plot, Quality, SIZE, TRACE, Zone, dot, front, name};
use super::{ChartError, Point};

const ROW: i32 = 29;
/// More would push the page past one screen; the count of the rest is still given.
const LISTED: usize = 8;

/// Words a reader new to all this needs, below the key.
const WORDS: [&str; 4] = [
    "PSNR: how close values are to the source's, in decibels; 6 dB more is half the error.",
    "exact: no error at all.",
    "bits per voxel: plain floats take 32.",
    "Pareto front: no other setting is as cheap and better.",
];
const NANOVDB: &str = "NanoVDB: another format, to compare with.";

/// One page for one volume: three charts, the Pareto front marked in each. Points of other volumes are left
/// out; so are, with a count on the chart, those whose numbers are not finite. Failed points are drawn hollow
/// with a cross, are listed below the charts and are never on the front.
pub fn sweep_svg(volume: &str, subtitle: &str, points: &[Point]) -> Result<String, ChartError> {
    let points: Vec<&Point> = points.iter().filter(|p| p.volume == volume).collect();
    let looks = looks(points.iter().map(|p| p.method.as_str()));
    let failed: Vec<&&Point> = points.iter().filter(|p| !p.failures.is_empty()).collect();
    let quality = Quality::of(&points);

    let notes: Vec<Vec<String>> = failed
        .iter()
        .take(LISTED)
        .map(|p| wrap(&format!("{}: {}", name(p), p.failures.join("; ")), 18.0, f64::from(WIDTH) - 80.0, 2))
        .collect();
    let more = failed.len().saturating_sub(LISTED);
    let key_height = ROW * (looks.len() as i32 + 3) + 360;
    let top = Zone { x: 10, y: 140, w: 890, h: key_height.max(620) };
    let lower = top.y + top.h + 46;
    let below = lower + 540;
    let note_lines = notes.iter().map(Vec::len).sum::<usize>() + usize::from(more > 0);
    let height = below + if notes.is_empty() { 10 } else { 50 + 26 * note_lines as i32 };

    let plural = if points.len() == 1 { "" } else { "s" };
    let title = format!("{volume}: quality against cost, {} setting{plural}", points.len());
    page([WIDTH, height as u32], &title, &describe(&points), |root| {
        let how = "Each mark is one setting of one method. Higher is closer to the original, further left is cheaper.";
        heading(root, &title, subtitle, how)?;
        let plot = Plot { points: &points, looks: &looks, quality: &quality };
        plot.draw(root, &top, &SIZE)?;
        plot.draw(root, &Zone { x: 10, y: lower, w: 585, h: 490 }, &BUILD)?;
        plot.draw(root, &Zone { x: 605, y: lower, w: 585, h: 490 }, &TRACE)?;
        if !points.is_empty() {
            key(root, (915, top.y + 44), &looks, !failed.is_empty())?;
        }
        if !notes.is_empty() {
            write(root, "Failed settings", (20, below + 8), Type::new(20.0, FAIL).bold())?;
        }
        let mut y = below + 40;
        for (p, lines) in failed.iter().zip(&notes) {
            mark(root, (34, y), look_of(&looks, &p.method), true)?;
            for line in lines {
                write(root, line, (56, y), Type::new(18.0, INK))?;
                y += 26;
            }
        }
        if more > 0 {
            write(root, &format!("and {more} more"), (56, y), Type::new(18.0, INK))?;
        }
        Ok(())
    })
}

/// The page in words: the front of quality against size, and what failed.
fn describe(points: &[&Point]) -> String {
    let dots: Vec<Dot> = points.iter().filter_map(|p| dot(p, p.bits_per_voxel)).collect();
    let best = front(&dots).into_iter().map(|d| {
        let quality = d.point.psnr.map_or("exact".into(), |q| format!("{} dB", number(q)));
        format!("{} at {} bits per voxel, {quality}", name(d.point), number(d.cost))
    });
    let failed = points.iter().filter(|p| !p.failures.is_empty()).map(|p| name(p));
    let list = |items: Vec<String>| if items.is_empty() { "none".into() } else { items.join("; ") };
    format!(
        "Three charts of {} settings: PSNR against size, build seconds and trace milliseconds. Best for their \
         size: {}. Failed: {}.",
        points.len(),
        list(best.collect()),
        list(failed.collect())
    )
}

fn key(root: &Root, (x, y): Spot, looks: &[(&str, Look)], failed: bool) -> Result<(), ChartError> {
    let mut at = y;
    let mut line = |text: &str| -> Result<i32, ChartError> {
        let fitted = wrap(text, 18.0, 230.0, 1);
        write(root, fitted.first().map_or("", |t| t), (x + 46, at), Type::new(18.0, INK))?;
        at += ROW;
        Ok(at - ROW)
    };
    for (method, look) in looks {
        let y = line(method)?;
        if JOINED.contains(method) {
            root.draw(&PathElement::new(vec![(x, y), (x + 36, y)], look.colour().stroke_width(2)))?;
        }
        mark(root, (x + 18, y), *look, false)?;
    }
    if failed {
        let y = line("failed: see below")?;
        mark(root, (x + 18, y), Look { colour: 6, shape: 0 }, true)?;
    }
    let y = line("best for its cost")?;
    root.draw(&PathElement::new(vec![(x, y), (x + 36, y)], FRONT.stroke_width(12)))?;
    let mut y = line("(Pareto front)")? + ROW + 12;
    let compared = looks.iter().any(|l| l.0.starts_with("NanoVDB"));
    for paragraph in WORDS.into_iter().chain(compared.then_some(NANOVDB)) {
        for text in wrap(paragraph, 17.0, 270.0, 5) {
            write(root, &text, (x, y), Type::new(17.0, GREY))?;
            y += 22;
        }
        y += 8;
    }
    Ok(())
}
