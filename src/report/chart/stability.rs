//! How far each method's results spread over repetitions.

use plotters::prelude::*;
use plotters::style::text_anchor::HPos;

use super::axis::{Axis, ends, number};
use super::paint::*;
use super::{ChartError, Spread};

const NAMES: i32 = 300;
const COLUMN: i32 = (WIDTH as i32 - NAMES) / 4;
const TOP: i32 = 192;
const VALUE: f64 = 16.0;
/// Smaller than on the other page, so that narrow ranges show on both sides.
const MARK: f64 = 6.0;

/// Below the table, for a reader new to all this.
const WORDS: [&str; 3] = [
    "PSNR: how close values are to the source's, in decibels; 6 dB more is half the error.",
    "Largest error: of any voxel, as a share of the source's range of values.",
    "Blockiness: jumps across brick faces against jumps inside bricks, compared with the source's.",
];

struct Column {
    heading: &'static str,
    unit: &'static str,
    range: fn(&Spread) -> (f64, f64),
    scale: Scale,
    /// What an infinite (PSNR) or zero (error) range is called, and the side it is on.
    perfect: Option<(f64, &'static str, HPos)>,
    /// A value to compare with, marked by a line.
    reference: Option<f64>,
}

enum Scale {
    Linear,
    Log,
    /// Logarithmic where linear would heap up the small values.
    Size,
}

const COLUMNS: [Column; 4] = [
    Column {
        heading: "Quality",
        unit: "PSNR, dB →",
        range: |s| s.psnr,
        scale: Scale::Linear,
        perfect: Some((f64::INFINITY, "exact", HPos::Right)),
        reference: None,
    },
    Column {
        heading: "Size",
        unit: "← bits per voxel",
        range: |s| s.bits_per_voxel,
        scale: Scale::Size,
        perfect: None,
        reference: None,
    },
    Column {
        heading: "Largest error",
        unit: "← share of range",
        range: |s| s.max_error,
        scale: Scale::Log,
        perfect: Some((0.0, "none", HPos::Left)),
        reference: None,
    },
    Column {
        heading: "Blockiness",
        unit: "← 1 = as the source",
        range: |s| s.blockiness,
        scale: Scale::Linear,
        perfect: None,
        reference: Some(1.0),
    },
];

/// What a cell shows.
enum Cell {
    Range(f64, f64),
    Word(&'static str, HPos),
}

impl Column {
    fn cell(&self, spread: &Spread) -> Cell {
        let (a, b) = (self.range)(spread);
        let (lo, hi) = (a.min(b), a.max(b));
        let drawable =
            |v: f64| v.abs() < 1e12 && (v > 1e-12 || !matches!(self.scale, Scale::Log | Scale::Size));
        match self.perfect {
            Some((best, word, side)) if a == best && b == best => Cell::Word(word, side),
            _ if !a.is_nan() && drawable(lo) && drawable(hi) => Cell::Range(lo, hi),
            _ => Cell::Word("no value", HPos::Center),
        }
    }

    /// The axis, and where a strip for words begins on it.
    fn axis(&self, spreads: &[&Spread]) -> (Axis, Option<f64>) {
        let mut values: Vec<f64> = self.reference.into_iter().collect();
        for s in spreads {
            if let Cell::Range(lo, hi) = self.cell(s) {
                values.extend([lo, hi]);
            }
        }
        let wide = ends(values.iter().copied()).is_some_and(|(lo, hi)| hi > 8.0 * lo);
        let mut axis = match self.scale {
            Scale::Log => Axis::log(values.into_iter(), 10.0, 4),
            Scale::Size if wide => Axis::log(values.into_iter(), 2.0, 4),
            _ => Axis::linear(values.into_iter(), false, 4),
        };
        let words =
            spreads.iter().filter(|s| matches!(self.cell(s), Cell::Word(_, HPos::Left | HPos::Right)));
        // Words get a strip of their own: inside the scale they would read as values.
        let strip = if words.count() > 0 { (axis.hi - axis.lo) * 0.3 } else { 0.0 };
        let mut edge = None;
        match self.perfect {
            Some((_, _, HPos::Right)) if strip > 0.0 => {
                edge = Some(axis.hi);
                axis.hi += strip;
            }
            Some((_, _, HPos::Left)) if strip > 0.0 => {
                edge = Some(axis.lo);
                axis.lo -= strip;
            }
            _ => {}
        }
        (axis, edge)
    }
}

/// A dot-and-range chart: a row a method, columns PSNR, bits per voxel, largest error and blockiness, each
/// from the smallest to the largest value over the repetitions. Rows that fail are hollow and say why.
/// Spreads of other volumes are left out.
pub fn stability_svg(volume: &str, subtitle: &str, spreads: &[Spread]) -> Result<String, ChartError> {
    let spreads: Vec<&Spread> = spreads.iter().filter(|s| s.volume == volume).collect();
    let looks = looks(spreads.iter().map(|s| s.method.as_str()));
    let mut rows: Vec<(i32, i32, Vec<String>)> = Vec::new();
    let mut y = TOP;
    for s in &spreads {
        let text = s.failures.join("; ");
        let why = if text.is_empty() { vec![] } else { wrap(&format!("fails: {text}"), 17.0, 1130.0, 2) };
        let height = 60 + 24 * why.len() as i32;
        rows.push((y, height, why));
        y += height;
    }
    let (bottom, failing) = (y, spreads.iter().filter(|s| !s.failures.is_empty()).count());
    let title = format!("{volume}: how far results spread, {} settings", spreads.len());
    let description = format!(
        "A row for each of {} settings, with the smallest and largest PSNR, bits per voxel, largest error and \
         blockiness over repeated runs. Failing: {failing}.",
        spreads.len()
    );
    page([WIDTH, (bottom + 60 + 26 * WORDS.len() as i32) as u32], &title, &description, |root| {
        let how = "Each bar runs from the smallest to the largest value seen over repeated runs. Arrows point to better.";
        heading(root, &title, subtitle, how)?;
        if spreads.is_empty() {
            return write(root, "no repetitions to draw", (20, bottom), Type::new(21.0, GREY));
        }
        for (i, (y, height, why)) in rows.iter().enumerate() {
            let ground = match (why.is_empty(), i % 2) {
                (false, _) => RGBColor(0xFD, 0xEC, 0xE8),
                (_, 0) => RGBColor(0xF5, 0xF5, 0xF5),
                _ => PAPER,
            };
            root.draw(&Rectangle::new([(10, *y), (WIDTH as i32 - 10, y + height)], ground.filled()))?;
        }
        for (i, column) in COLUMNS.iter().enumerate() {
            draw_column(root, NAMES + i as i32 * COLUMN, bottom, column, &spreads, &rows, &looks)?;
        }
        for (i, text) in WORDS.iter().enumerate() {
            write(root, text, (20, bottom + 66 + 26 * i as i32), Type::new(17.0, GREY))?;
        }
        for (s, (y, _, why)) in spreads.iter().zip(&rows) {
            let runs = if s.runs == 1 { "1 run".into() } else { format!("{} runs", s.runs) };
            let first = |text: &str, width: f64| wrap(text, 17.0, width, 1).pop().unwrap_or_default();
            write(root, &first(&s.method, 190.0), (20, y + 19), Type::new(18.0, INK).bold())?;
            write(root, &runs, (NAMES - 4, y + 19), Type::new(16.0, GREY).h(HPos::Right))?;
            write(root, &first(&s.setting, 275.0), (20, y + 43), Type::new(16.0, GREY))?;
            for (i, line) in why.iter().enumerate() {
                write(root, line, (20, y + 68 + 24 * i as i32), Type::new(17.0, FAIL))?;
            }
        }
        Ok(())
    })
}

fn draw_column(
    root: &Root,
    x: i32,
    bottom: i32,
    column: &Column,
    spreads: &[&Spread],
    rows: &[(i32, i32, Vec<String>)],
    looks: &[(&str, Look)],
) -> Result<(), ChartError> {
    let (axis, edge) = column.axis(spreads);
    let unit = format!("{}{}", column.unit, if axis.log { " (log)" } else { "" });
    write(root, column.heading, (x + COLUMN / 2, TOP - 42), Type::new(19.0, INK).bold().h(HPos::Center))?;
    write(root, &unit, (x + COLUMN / 2, TOP - 17), Type::new(16.0, GREY).h(HPos::Center))?;
    let canvas = root.clone().shrink((x, TOP), (COLUMN as u32, (bottom - TOP + 40) as u32));
    let mut chart = ChartBuilder::on(&canvas)
        .margin_left(10)
        .margin_right(10)
        .set_label_area_size(LabelAreaPosition::Bottom, 40)
        // Rows are placed by hand, so y is in pixels.
        .build_cartesian_2d(axis.clone(), f64::from(bottom)..f64::from(TOP))?;
    chart
        .configure_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(GRID)
        .axis_style(GREY)
        .disable_y_mesh()
        .label_style(Type::new(17.0, INK).style())
        .x_label_formatter(&|v| axis.label(*v))
        .draw()?;
    if let Some(value) = column.reference {
        let line = [value, value].into_iter().zip([f64::from(TOP), f64::from(bottom)]);
        chart.draw_series(DashedLineSeries::new(line, 6, 5, GREY.stroke_width(2)))?;
    }
    if let Some(edge) = edge {
        chart.draw_series([PathElement::new(
            vec![(edge, f64::from(TOP)), (edge, f64::from(bottom))],
            GREY.mix(0.5).stroke_width(1),
        )])?;
    }
    let (left, right) = (x + 10, x + COLUMN - 10);
    for (s, (y, _, _)) in spreads.iter().zip(rows) {
        let look = look_of(looks, &s.method);
        let px = |v: f64| chart.backend_coord(&(axis.at(v), 0.0)).0;
        match column.cell(s) {
            Cell::Range(lo, hi) => {
                let (a, b) = (px(lo), px(hi));
                let (from, to) = (number(lo), number(hi));
                if from != to {
                    root.draw(&Rectangle::new([(a, y + 18), (b, y + 24)], look.colour().filled()))?;
                    for end in [a, b] {
                        let cap = vec![(end, y + 14), (end, y + 28)];
                        root.draw(&PathElement::new(cap, look.colour().stroke_width(2)))?;
                    }
                }
                bare_mark(root, ((a + b) / 2, y + 21), look, !s.failures.is_empty(), MARK)?;
                let text = if from == to { from } else { format!("{from} – {to}") };
                let half = (text_width(&text, VALUE) / 2.0) as i32;
                let at = ((a + b) / 2).clamp(left + half, (right - half).max(left + half));
                write(root, &text, (at, y + 46), Type::new(VALUE, look.ink()).h(HPos::Center))?;
            }
            Cell::Word(word, side) => {
                let at = match side {
                    HPos::Left => left + 24,
                    HPos::Right => right - 24,
                    HPos::Center => (left + right) / 2,
                };
                if matches!(side, HPos::Center) {
                    write(root, word, (at, y + 30), Type::new(VALUE, GREY).h(side))?;
                } else {
                    bare_mark(root, (at, y + 21), look, !s.failures.is_empty(), MARK)?;
                    write(root, word, (at, y + 46), Type::new(VALUE, look.ink()).h(HPos::Center))?;
                }
            }
        }
    }
    Ok(())
}
