//! Small charts of one asset: what its frames cost, and how large its errors are.

use plotters::prelude::*;
use plotters::style::text_anchor::HPos;

use super::ChartError;
use super::axis::{Axis, number};
use super::paint::*;

/// Half as wide as other pages: a phone shows them 343 px wide, where 16 units are still 11 px.
const SIZE: [u32; 2] = [480, 300];
const TEXT: f64 = 16.0;
/// Colours of the lines, as places in the palette: blue, vermilion, green, orange.
const COLOURS: [usize; 4] = [0, 1, 2, 3];

/// One line: a name, and a value for each frame that has one.
pub struct Line<'a> {
    /// What it shows.
    pub name: &'a str,
    /// Frame numbers and values.
    pub points: Vec<(i32, f64)>,
}

/// Values along a sequence. `unit` says what they are in; `from_zero` is for sizes, whose heights are compared.
///
/// # Errors
/// When the drawing library refuses.
pub fn frames_svg(title: &str, unit: &str, lines: &[Line], from_zero: bool) -> Result<String, ChartError> {
    let all = || lines.iter().flat_map(|line| &line.points);
    let x = Axis::linear(all().map(|(frame, _)| f64::from(*frame)), false, 6);
    let y = Axis::linear(all().map(|(_, value)| *value), from_zero, 5);
    let description = lines.iter().map(|line| {
        let values = || line.points.iter().map(|(_, value)| *value);
        let (least, most) =
            (values().fold(f64::INFINITY, f64::min), values().fold(f64::NEG_INFINITY, f64::max));
        format!(
            "{}: {} to {} {unit} over {} frames.",
            line.name,
            number(least),
            number(most),
            line.points.len()
        )
    });
    page(SIZE, title, &description.collect::<Vec<_>>().join(" "), |root| {
        write(root, &format!("{title}, {unit}"), (12, 18), Type::new(TEXT, INK).bold())?;
        key(root, lines)?;
        let mut chart = chart(root, if lines.len() > 1 { 56 } else { 34 }, &x, &y)?;
        chart
            .configure_mesh()
            .light_line_style(TRANSPARENT)
            .bold_line_style(GRID)
            .axis_style(GREY)
            .label_style(Type::new(TEXT, INK).style())
            .axis_desc_style(Type::new(TEXT, INK).style())
            .x_label_formatter(&|x| if x.fract() == 0.0 { format!("{x:.0}") } else { String::new() })
            .y_label_formatter(&|y| number(*y))
            .x_desc("frame")
            .draw()?;
        for (line, colour) in lines.iter().zip(COLOURS.iter().cycle()) {
            let look = Look { colour: *colour, shape: 0 };
            let points = line.points.iter().map(|(frame, value)| (f64::from(*frame), *value));
            chart.draw_series(LineSeries::new(points.clone(), look.colour().stroke_width(3)))?;
            // A mark a frame, while there is room for them.
            if line.points.len() <= 48 {
                chart.draw_series(points.map(|point| Circle::new(point, 3, look.colour().filled())))?;
            }
        }
        Ok(())
    })
}

/// Voxels by error: bars over octaves of the range, those without an error apart.
///
/// # Errors
/// When the drawing library refuses.
pub fn histogram_svg(title: &str, bins: &[u64]) -> Result<String, ChartError> {
    let total = bins.iter().sum::<u64>().max(1) as f64;
    let shares: Vec<f64> = bins.iter().map(|count| *count as f64 / total * 100.0).collect();
    let count = bins.len();
    let exponent = |bin: usize| bin as i32 - count as i32;
    let exact = shares.first().copied().unwrap_or(0.0);
    let most = (1..count).max_by(|a, b| shares[*a].total_cmp(&shares[*b])).unwrap_or(0);
    let description = format!(
        "{exact:.1} % of the voxels are exact; most others, {:.1} %, are off by about 2 to the power of {} of the range.",
        shares[most],
        exponent(most)
    );
    let mut x = Axis::linear([0.0, count as f64].into_iter(), false, 1);
    (x.lo, x.hi) = (-0.2, count as f64 + 0.2);
    // Under the left edges of the bars that begin at 2⁻¹², 2⁻⁸, 2⁻⁴, and under the exact ones.
    let labelled =
        [(0, "exact"), (count - 12, "1/4096"), (count - 8, "1/256"), (count - 4, "1/16"), (count, "all")];
    x.ticks = labelled.iter().map(|(bin, _)| *bin as f64 + if *bin == 0 { 0.5 } else { 0.0 }).collect();
    let y = Axis::linear(shares.iter().copied(), true, 5);
    page(SIZE, title, &description, |root| {
        write(root, &format!("{title}, % of voxels"), (12, 18), Type::new(TEXT, INK).bold())?;
        let mut chart = chart(root, 34, &x, &y)?;
        chart
            .configure_mesh()
            .light_line_style(TRANSPARENT)
            .bold_line_style(GRID)
            .disable_x_mesh()
            .axis_style(GREY)
            .label_style(Type::new(TEXT, INK).style())
            .axis_desc_style(Type::new(TEXT, INK).style())
            .x_label_formatter(&|x| {
                let at = |bin: usize| bin as f64 + if bin == 0 { 0.5 } else { 0.0 };
                labelled.iter().find(|(bin, _)| at(*bin) == *x).map_or("", |(_, text)| *text).to_owned()
            })
            .y_label_formatter(&|y| number(*y))
            .x_desc("error, part of the range (log scale)")
            .draw()?;
        let bar = |(bin, share): (usize, &f64)| {
            let colour = Look { colour: if bin == 0 { 2 } else { 0 }, shape: 0 }.colour();
            Rectangle::new([(bin as f64 + 0.08, 0.0), (bin as f64 + 0.92, *share)], colour.filled())
        };
        chart.draw_series(shares.iter().enumerate().map(bar))?;
        Ok(())
    })
}

type Chart<'a, 'b> = ChartContext<'a, SVGBackend<'b>, Cartesian2d<Axis, Axis>>;

fn chart<'a, 'b>(root: &'a Root<'b>, top: u32, x: &Axis, y: &Axis) -> Result<Chart<'a, 'b>, ChartError> {
    Ok(ChartBuilder::on(root)
        .margin_top(top)
        .margin_right(26)
        .set_label_area_size(LabelAreaPosition::Left, 62)
        .set_label_area_size(LabelAreaPosition::Bottom, 56)
        .build_cartesian_2d(x.clone(), y.clone())?)
}

/// What the lines are, where there is more than one.
fn key(root: &Root, lines: &[Line]) -> Result<(), ChartError> {
    if lines.len() < 2 {
        return Ok(());
    }
    let mut x = 14;
    for (line, colour) in lines.iter().zip(COLOURS.iter().cycle()) {
        let look = Look { colour: *colour, shape: 0 };
        root.draw(&Rectangle::new([(x, 34), (x + 14, 46)], look.colour().filled()))?;
        write(root, line.name, (x + 20, 40), Type::new(TEXT, INK).h(HPos::Left))?;
        x += 44 + text_width(line.name, TEXT) as i32;
    }
    Ok(())
}
