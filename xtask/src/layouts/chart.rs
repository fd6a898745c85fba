//! One chart a volume: milliseconds against bytes, with seams as the size of a point.

use std::error::Error;
use std::path::Path;

use plotters::prelude::*;
use volpack::codec::TexelCodec;

use super::bricks::Coding;
use super::report::Row;

const PANEL: [u32; 2] = [900, 640];
const LEGEND: u32 = 70;
const TEXT: (&str, i32) = ("sans-serif", 16);

/// Draws the rows that were timed. Volumes lie below each other.
pub fn draw(path: &Path, rows: &[Row]) -> Result<(), Box<dyn Error>> {
    // An indirection is where its tree is, a little lower, and would hide it.
    let is_drawn = |row: &&Row| row.coding != "f32" && (row.lookup == "tree" || row.layout == "dense");
    let timed: Vec<&Row> = rows.iter().filter(|row| row.times.is_some()).filter(is_drawn).collect();
    let mut volumes: Vec<&str> = timed.iter().map(|row| row.volume.as_str()).collect();
    volumes.dedup();
    let height = LEGEND + PANEL[1] * volumes.len() as u32;
    let area = SVGBackend::new(path, (PANEL[0], height)).into_drawing_area();
    area.fill(&WHITE)?;
    let (legend, panels) = area.split_vertically(LEGEND);
    draw_legend(&legend)?;
    for (panel, volume) in panels.split_evenly((volumes.len(), 1)).iter().zip(volumes) {
        let rows: Vec<&Row> = timed.iter().copied().filter(|row| row.volume == volume).collect();
        draw_volume(panel, volume, &rows)?;
    }
    area.present()?;
    Ok(())
}

type Area<'a> = DrawingArea<SVGBackend<'a>, plotters::coord::Shift>;

fn draw_legend(area: &Area) -> Result<(), Box<dyn Error>> {
    for (x, coding) in [20, 190, 290, 380, 470, 560].into_iter().zip(Coding::ALL) {
        area.draw(&Circle::new((x, 18), 6, color(coding.name()).filled()))?;
        area.draw(&Text::new(coding.name(), (x + 12, 11), TEXT))?;
    }
    let key = "Labels: texels along a filtered brick (8, 9, 10, 16); F: fetch, K: fetch, brick kept; D: dense texture, S: the same, empty regions skipped";
    area.draw(&Text::new(key, (14, 34), TEXT))?;
    let size =
        "A point grows with its mean jump between bricks: 4 px are none, 12 px are 0.2 % of the grid's range";
    area.draw(&Text::new(size, (14, 52), TEXT))?;
    Ok(())
}

fn draw_volume(area: &Area, volume: &str, rows: &[&Row]) -> Result<(), Box<dyn Error>> {
    let place = |row: &Row| (row.bytes.total() as f64 / 1e6, row.times.as_ref().map_or(0.0, |t| t.median));
    let ends = |values: &mut dyn Iterator<Item = f64>| {
        let (least, most) = values.fold((f64::INFINITY, 0.0f64), |(l, m), v| (l.min(v), m.max(v)));
        least * 0.8..most * 1.25
    };
    let x = ends(&mut rows.iter().map(|row| place(row).0));
    let y = ends(&mut rows.iter().map(|row| place(row).1));
    let mut chart = ChartBuilder::on(area)
        .caption(volume, ("sans-serif", 20))
        .margin(12)
        .x_label_area_size(45)
        .y_label_area_size(65)
        .build_cartesian_2d(x.log_scale(), y.log_scale())?;
    chart
        .configure_mesh()
        .x_desc("MB on the GPU: texels, records, tree or indirection")
        .y_desc("milliseconds a frame")
        .x_labels(6)
        .label_style(TEXT)
        .light_line_style(WHITE)
        .draw()?;
    chart.draw_series(rows.iter().map(|row| {
        let radius = (4.0 + 8.0 * (row.seams.mean / 0.002).min(2.0)).round() as i32;
        EmptyElement::at(place(row))
            + Circle::new((0, 0), radius, color(&row.coding).mix(0.75).filled())
            + Text::new(label(row), (radius + 2, -6), ("sans-serif", 13))
    }))?;
    Ok(())
}

fn label(row: &Row) -> String {
    match row.layout.split_once('³') {
        Some((texels, _)) => texels.to_owned(),
        None if row.layout.ends_with("kept") => "K".to_owned(),
        None if row.layout.starts_with("fetch") => "F".to_owned(),
        None if row.layout == "dense" && row.lookup == "indirection" => "S".to_owned(),
        None if row.layout == "dense" => "D".to_owned(),
        None => row.layout.clone(),
    }
}

fn color(coding: &str) -> RGBColor {
    let uniform = TexelCodec::ALL.into_iter().find(|codec| codec.name() == coding);
    match uniform.and_then(|codec| u32::from_str_radix(&codec.color()[1..], 16).ok()) {
        Some(hex) => RGBColor((hex >> 16) as u8, (hex >> 8) as u8, hex as u8),
        None if coding == Coding::Adaptive.name() => BLACK,
        None => RGBColor(0xe6, 0x9f, 0x00),
    }
}
