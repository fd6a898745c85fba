//! One chart of quality against a cost.

use std::collections::BTreeMap;

use plotters::prelude::*;
use plotters::style::text_anchor::HPos;

use super::axis::{Axis, ends, number};
use super::labels::{LABEL, Taken};
use super::paint::*;
use super::{ChartError, Point, pareto};

/// Methods with a dial: their settings are joined into a line. The first also has its values written out.
pub(super) const JOINED: [&str; 2] = ["adaptive", "NanoVDB fpN"];

/// What is built when nothing is asked: a mark on one of the lines.
const DEFAULT: &str = "default";
pub(super) const FRONT: RGBColor = RGBColor(0xFB, 0xE4, 0x94);
/// A clock in a build tool means little below this; zero seconds would have no place on a log axis.
const SHORTEST: f64 = 1e-3;
/// Names of one method that still leave room for others.
const MANY: usize = 4;

pub(super) struct Spec {
    heading: &'static str,
    x_title: &'static str,
    cost: fn(&Point) -> Option<f64>,
    scale: Scale,
    /// Said in place of the chart when no point has this cost.
    absent: &'static str,
    missing: &'static str,
}

enum Scale {
    /// Powers of two, with MiB above.
    Bits,
    Log,
    /// From zero, where lengths compare honestly; logarithmic past a factor of ten, where the small values
    /// would be one heap.
    Auto,
}

pub(super) const SIZE: Spec = Spec {
    heading: "Quality against size",
    x_title: "← smaller\u{2003}size on the GPU, bits per voxel (log scale)",
    cost: |p| Some(if p.bits_per_voxel > 1e-12 { p.bits_per_voxel } else { f64::NAN }),
    scale: Scale::Bits,
    absent: "no settings to draw",
    missing: "not sized",
};
pub(super) const BUILD: Spec = Spec {
    heading: "Quality against build time",
    x_title: "← faster\u{2003}build time, seconds",
    cost: |p| Some(if p.build_seconds >= 0.0 { p.build_seconds.max(SHORTEST) } else { f64::NAN }),
    scale: Scale::Log,
    absent: "no settings to draw",
    missing: "not timed",
};
pub(super) const TRACE: Spec = Spec {
    heading: "Quality against trace time",
    x_title: "← faster\u{2003}GPU trace time, milliseconds",
    cost: |p| p.trace_ms,
    scale: Scale::Auto,
    absent: "no GPU here: not traced",
    missing: "not traced",
};

pub(super) struct Zone {
    pub(super) x: i32,
    pub(super) y: i32,
    pub(super) w: i32,
    pub(super) h: i32,
}

/// A point that can be drawn; infinite quality stands for exact.
pub(super) struct Dot<'a> {
    pub(super) point: &'a Point,
    pub(super) cost: f64,
    pub(super) quality: f64,
}

/// f64 itself spans 6200 dB, so a larger PSNR is a mistake; so are costs past these powers of ten.
pub(super) fn dot(point: &Point, cost: f64) -> Option<Dot<'_>> {
    let quality = point.psnr.unwrap_or(f64::INFINITY);
    let fine = (0.0..1e12).contains(&cost) && point.psnr.is_none_or(|q| q.abs() < 6200.0);
    fine.then_some(Dot { point, cost, quality })
}

pub(super) fn name(p: &Point) -> String {
    if p.setting.is_empty() { p.method.clone() } else { format!("{}, {}", p.method, p.setting) }
}

/// The dots no other beats, cheapest first; failed ones do not compete.
pub(super) fn front<'a, 'b>(dots: &'b [Dot<'a>]) -> Vec<&'b Dot<'a>> {
    let fine: Vec<&Dot> = dots.iter().filter(|d| d.point.failures.is_empty()).collect();
    let on = pareto(&fine.iter().map(|d| (d.cost, d.quality)).collect::<Vec<_>>());
    let mut front: Vec<&Dot> = fine.into_iter().zip(on).filter(|f| f.1).map(|f| f.0).collect();
    front.sort_by(|a, b| a.cost.total_cmp(&b.cost));
    front
}

/// PSNR, and where exact points sit above it. All three charts share it, so they can be read across.
pub(super) struct Quality {
    axis: Axis,
    /// (bottom, middle) of the band of exact points.
    exact: Option<(f64, f64)>,
}

impl Quality {
    pub(super) fn of(points: &[&Point]) -> Quality {
        let dots: Vec<Dot> = points.iter().filter_map(|p| dot(p, 1.0)).collect();
        let finite: Vec<f64> = dots.iter().map(|d| d.quality).filter(|q| q.is_finite()).collect();
        // With nothing but exact points any range will do; 30 to 60 dB is where lossy methods live.
        let values = if finite.is_empty() { vec![30.0, 60.0] } else { finite };
        let mut axis = Axis::linear(values.into_iter(), false, 8);
        let exact = dots.iter().any(|d| d.quality.is_infinite()).then(|| {
            let (bottom, band) = (axis.hi, (axis.hi - axis.lo) * 0.12);
            axis.hi += band;
            axis.ticks.push(bottom + band / 2.0);
            (bottom, bottom + band / 2.0)
        });
        Quality { axis, exact }
    }

    fn at(&self, quality: f64) -> f64 {
        self.exact.filter(|_| quality.is_infinite()).map_or(quality, |(_, middle)| middle)
    }

    fn label(&self, position: f64) -> String {
        match self.exact {
            Some((bottom, _)) if position > bottom => "exact".into(),
            _ => self.axis.label(position),
        }
    }
}

/// MiB for one bit per voxel, if the points agree on it to 2 %: they do when all count the same voxels.
fn mib_per_bit(dots: &[Dot]) -> Option<f64> {
    let ratios = dots.iter().map(|d| d.point.gpu_bytes as f64 / (1u64 << 20) as f64 / d.cost);
    let (lo, hi) = ends(ratios)?;
    (lo > 0.0 && hi <= lo * 1.02).then_some((lo * hi).sqrt())
}

/// What the three charts of a page share.
pub(super) struct Plot<'a> {
    pub(super) points: &'a [&'a Point],
    pub(super) looks: &'a [(&'a str, Look)],
    pub(super) quality: &'a Quality,
}

impl Plot<'_> {
    pub(super) fn draw(&self, root: &Root, zone: &Zone, spec: &Spec) -> Result<(), ChartError> {
        let costs: Vec<(&Point, f64)> =
            self.points.iter().filter_map(|p| Some((*p, (spec.cost)(p)?))).collect();
        let dots: Vec<Dot> = costs.iter().filter_map(|&(p, c)| dot(p, c)).collect();
        let (left, right) = (zone.x + 78, zone.x + zone.w - 10);
        write(root, spec.heading, (left, zone.y + 14), Type::new(22.0, INK).bold())?;
        let mut notes = Vec::new();
        if !dots.is_empty() && costs.len() < self.points.len() {
            let missing = self.points.len() - costs.len();
            notes.push(format!("{missing} of {} settings {}", self.points.len(), spec.missing));
        }
        if dots.len() < costs.len() {
            notes.push(format!("{} left out: not a finite number", costs.len() - dots.len()));
        }
        let short = dots.iter().filter(|d| d.point.build_seconds < SHORTEST).count();
        if short > 0 && matches!(spec.scale, Scale::Log) {
            notes.push(format!("{short} under 1 ms, drawn at 1 ms"));
        }
        write(root, &notes.join("; "), (left, zone.y + zone.h + 18), Type::new(16.0, GREY))?;
        if dots.is_empty() {
            let (top, bottom) = (zone.y + 34, zone.y + zone.h - 66);
            root.draw(&Rectangle::new([(left, top), (right, bottom)], BAND.filled()))?;
            let absent = if self.points.is_empty() { SIZE.absent } else { spec.absent };
            let middle = ((left + right) / 2, (top + bottom) / 2);
            return write(root, absent, middle, Type::new(22.0, GREY).h(HPos::Center));
        }

        let values = || dots.iter().map(|d| d.cost);
        let max_ticks = (zone.w / 75) as usize;
        let (least, most) = ends(values()).unwrap_or((1.0, 1.0));
        let axis = match spec.scale {
            Scale::Bits => Axis::log(values(), 2.0, max_ticks),
            Scale::Auto if least < 1e-12 || most <= 10.0 * least => Axis::linear(values(), true, max_ticks),
            Scale::Log | Scale::Auto => Axis::log(values(), 10.0, max_ticks),
        };
        let mib = if matches!(spec.scale, Scale::Bits) { mib_per_bit(&dots) } else { None };
        let above = Axis::log_shifted(&axis, mib.unwrap_or(1.0).ln());
        let canvas = root.clone().shrink((zone.x, zone.y + 30), (zone.w as u32, zone.h as u32 - 30));
        let top_height = if mib.is_some() { 58 } else { 6 };
        let mut chart = ChartBuilder::on(&canvas)
            .margin_right(10)
            .set_label_area_size(LabelAreaPosition::Left, 78)
            .set_label_area_size(LabelAreaPosition::Bottom, 62)
            .set_label_area_size(LabelAreaPosition::Top, top_height)
            .build_cartesian_2d(axis.clone(), self.quality.axis.clone())?
            .set_secondary_coord(above.clone(), self.quality.axis.clone());
        if let Some((bottom, _)) = self.quality.exact {
            let band = [(axis.lo, bottom), (axis.hi, self.quality.axis.hi)];
            chart.draw_series([Rectangle::new(band, BAND.filled())])?;
        }
        let log_note = if axis.log && !spec.x_title.contains("log") { " (log scale)" } else { "" };
        chart
            .configure_mesh()
            .light_line_style(TRANSPARENT)
            .bold_line_style(GRID)
            .axis_style(GREY)
            .label_style(Type::new(19.0, INK).style())
            .axis_desc_style(Type::new(19.0, INK).style())
            .x_label_formatter(&|x| axis.label(*x))
            .y_label_formatter(&|y| self.quality.label(*y))
            .x_desc(format!("{}{log_note}", spec.x_title))
            .y_desc("quality: PSNR, dB\u{2003}better →")
            .draw()?;
        if mib.is_some() {
            chart
                .configure_secondary_axes()
                .axis_style(GREY)
                .label_style(Type::new(17.0, GREY).style())
                .x_label_formatter(&|x| above.label(*x))
                .x_desc("the same in MiB")
                .draw()?;
        }
        let spots: Vec<Spot> = dots
            .iter()
            .map(|d| chart.backend_coord(&(axis.at(d.cost), self.quality.at(d.quality))))
            .collect();
        let (x, y) = chart.plotting_area().get_pixel_range();
        self.draw_dots(root, &dots, &spots, Taken::new((x.start, y.start), (x.end, y.end)))
    }

    /// Front, lines, marks and labels, in this order from back to front.
    fn draw_dots(
        &self,
        root: &Root,
        dots: &[Dot],
        spots: &[Spot],
        mut taken: Taken,
    ) -> Result<(), ChartError> {
        let spot = |d: &Dot| dots.iter().position(|o| std::ptr::eq(o, d)).map_or((0, 0), |i| spots[i]);
        let mut step: Vec<Spot> = Vec::new();
        for d in front(dots) {
            let (x, y) = spot(d);
            step.push((x, step.last().map_or(taken.right_bottom.1, |s| s.1)));
            step.push((x, y));
        }
        step.extend(step.last().map(|s| (taken.right_bottom.0, s.1)));
        step.windows(2).for_each(|w| taken.front(w[0], w[1]));
        root.draw(&PathElement::new(step, FRONT.stroke_width(12)))?;

        // Names of lines first, as the longest; then the values along them; then the rest.
        let (mut names, mut values) = (Vec::new(), Vec::new());
        for (method, line) in lines(dots) {
            let path: Vec<Spot> = line.iter().map(|d| spot(d)).collect();
            let look = look_of(self.looks, method);
            path.windows(2).for_each(|w| taken.line(w[0], w[1]));
            root.draw(&PathElement::new(path, look.colour().stroke_width(2)))?;
            let Some((last, others)) = line.split_last() else { continue };
            let ends = [(last, name(last.point)), (last, method.to_string()), (&line[0], method.to_string())];
            names.push((look, ends.map(|(d, text)| (spot(d), text)).to_vec()));
            if method == JOINED[0] {
                let value = |d: &&Dot| Some((spot(d), number(first_number(&d.point.setting).1?)));
                values.extend(others.iter().filter_map(|d| Some((look, vec![value(d)?]))));
            }
        }
        names.append(&mut values);
        for d in dots.iter().filter(|d| !JOINED.contains(&d.point.method.as_str())) {
            let mates = || dots.iter().filter(|o| o.point.method == d.point.method);
            // A method with many settings would fill the chart with its name: only its best gets it.
            if mates().count() > MANY && mates().any(|o| o.quality > d.quality) {
                continue;
            }
            let mut texts = vec![(spot(d), d.point.method.clone())];
            if mates().count() > 1 {
                texts.insert(0, (spot(d), name(d.point)));
            }
            let place = if d.point.method == DEFAULT { 0 } else { names.len() };
            names.insert(place, (look_of(self.looks, &d.point.method), texts));
        }
        spots.iter().for_each(|s| taken.mark(*s));
        // Our lines above the rest, the default on its line, and failed marks on top: they are what a reader must not miss.
        let mut order: Vec<&Dot> = dots.iter().collect();
        order.sort_by_key(|d| {
            let method = d.point.method.as_str();
            (!d.point.failures.is_empty(), method == DEFAULT, JOINED.contains(&method))
        });
        for d in order {
            mark(root, spot(d), look_of(self.looks, &d.point.method), !d.point.failures.is_empty())?;
        }
        for (look, texts) in names {
            if let Some((text, at, h)) = texts.iter().find_map(|(at, text)| taken.place(*at, text)) {
                write(root, text, at, Type::new(LABEL, look.ink()).h(h))?;
            }
        }
        Ok(())
    }
}

/// Splits a setting at its first number: "psnr = 45, dither" is ("psnr = …, dither", 45).
fn first_number(setting: &str) -> (String, Option<f64>) {
    let Some(start) = setting.find(|c: char| c.is_ascii_digit()) else { return (setting.into(), None) };
    let rest = &setting[start..];
    let end = rest.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(rest.len());
    (format!("{}…{}", &setting[..start], &rest[end..]), rest[..end].trim_end_matches('.').parse().ok())
}

/// The dots to join: a method's settings that differ in their first number only, in its order.
fn lines<'a, 'b>(dots: &'b [Dot<'a>]) -> Vec<(&'a str, Vec<&'b Dot<'a>>)> {
    let mut groups: BTreeMap<(usize, String), Vec<(f64, &Dot)>> = BTreeMap::new();
    for d in dots {
        let Some(method) = JOINED.iter().position(|j| *j == d.point.method) else { continue };
        let (family, value) = first_number(&d.point.setting);
        groups.entry((method, family)).or_default().push((value.unwrap_or(0.0), d));
    }
    let sorted = |mut g: Vec<(f64, &'b Dot<'a>)>| {
        // A tolerance gets better as it falls; ending on the largest keeps the name at the good end.
        g.sort_by(|a, b| {
            a.0.total_cmp(&b.0).then(a.1.point.bits_per_voxel.total_cmp(&b.1.point.bits_per_voxel))
        });
        if g.first().zip(g.last()).is_some_and(|(f, l)| f.1.quality > l.1.quality) {
            g.reverse();
        }
        g.into_iter().map(|(_, d)| d).collect::<Vec<_>>()
    };
    groups.into_values().map(sorted).map(|g| (g[0].point.method.as_str(), g)).collect()
}
