//! What both pages are drawn with: looks, marks, text and the page itself.

use std::collections::BTreeMap;

use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::ChartError;

pub(super) type Root<'a> = DrawingArea<SVGBackend<'a>, Shift>;
pub(super) type Spot = (i32, i32);

pub(super) const WIDTH: u32 = 1200;
pub(super) const INK: RGBColor = RGBColor(0x22, 0x22, 0x22);
pub(super) const GREY: RGBColor = RGBColor(0x59, 0x59, 0x59);
pub(super) const GRID: RGBColor = RGBColor(0xE4, 0xE4, 0xE4);
/// Behind exact points, and where a chart is missing.
pub(super) const BAND: RGBColor = RGBColor(0xF0, 0xF0, 0xF0);
pub(super) const PAPER: RGBColor = RGBColor(0xFE, 0xFE, 0xFE);
pub(super) const FAIL: RGBColor = RGBColor(0xB0, 0x20, 0x10);

/// Okabe and Ito's colours without yellow, which vanishes on white.
const COLOURS: [RGBColor; 7] = [
    RGBColor(0x00, 0x72, 0xB2),
    RGBColor(0xD5, 0x5E, 0x00),
    RGBColor(0x00, 0x9E, 0x73),
    RGBColor(0xE6, 0x9F, 0x00),
    RGBColor(0x56, 0xB4, 0xE9),
    RGBColor(0xCC, 0x79, 0xA7),
    RGBColor(0x00, 0x00, 0x00),
];

/// Outlines in units of the marker's radius, sized to look equally heavy; the empty one is a circle.
const SHAPES: [&[(f64, f64)]; 9] = [
    &[],
    &[(0.0, -1.2), (1.2, 0.0), (0.0, 1.2), (-1.2, 0.0)],
    &[(0.0, -1.1), (1.1, 0.9), (-1.1, 0.9)],
    &[(-0.9, -0.9), (0.9, -0.9), (0.9, 0.9), (-0.9, 0.9)],
    &[(0.0, 1.1), (1.1, -0.9), (-1.1, -0.9)],
    &[(0.0, -1.1), (1.1, -0.3), (0.7, 1.0), (-0.7, 1.0), (-1.1, -0.3)],
    &[
        (-0.4, -1.2),
        (0.4, -1.2),
        (0.4, -0.4),
        (1.2, -0.4),
        (1.2, 0.4),
        (0.4, 0.4),
        (0.4, 1.2),
        (-0.4, 1.2),
        (-0.4, 0.4),
        (-1.2, 0.4),
        (-1.2, -0.4),
        (-0.4, -0.4),
    ],
    &[(-1.1, 0.0), (0.9, -1.1), (0.9, 1.1)],
    &[(-1.0, -1.0), (1.0, 1.0), (1.0, -1.0), (-1.0, 1.0)],
];

/// (method, colour, shape): fixed, so a method looks the same on every page.
const KNOWN: [(&str, usize, usize); 11] = [
    ("adaptive", 0, 0),
    ("default", 1, 3),
    ("NanoVDB fpN", 1, 1),
    ("bc7", 2, 2),
    ("NanoVDB fp8", 3, 3),
    ("NanoVDB fp4", 3, 7),
    ("bc4", 2, 4),
    ("unorm8", 4, 3),
    ("kmeans", 5, 5),
    ("f16", 6, 6),
    ("f32", 6, 8),
];

#[derive(Clone, Copy, PartialEq)]
pub(super) struct Look {
    pub(super) colour: usize,
    pub(super) shape: usize,
}

impl Look {
    pub(super) fn colour(self) -> RGBColor {
        COLOURS[self.colour]
    }

    /// Sky blue and orange marks are seen well on white, but text in them is not: 0.6 brings all of them to a
    /// contrast of 4.5 or more.
    pub(super) fn ink(self) -> RGBColor {
        let RGBColor(r, g, b) = self.colour();
        let dark = |c: u8| (f64::from(c) * 0.6) as u8;
        RGBColor(dark(r), dark(g), dark(b))
    }
}

/// A look for each method, in the order of first appearance on the key: known ones first, then by name.
pub(super) fn looks<'a>(methods: impl Iterator<Item = &'a str>) -> Vec<(&'a str, Look)> {
    let mut rest: BTreeMap<&str, ()> = methods.map(|m| (m, ())).collect();
    let mut out = Vec::new();
    for (name, colour, shape) in KNOWN {
        if let Some((name, ())) = rest.remove_entry(name) {
            out.push((name, Look { colour, shape }));
        }
    }
    // 7 colours and 9 shapes share no divisor, so counting both up meets every pair once.
    let free = (0..COLOURS.len() * SHAPES.len())
        .map(|i| (COLOURS.len() - 1 - i % COLOURS.len(), SHAPES.len() - 1 - i % SHAPES.len()))
        .filter(|&(c, s)| KNOWN.iter().all(|k| (k.1, k.2) != (c, s)))
        .map(|(colour, shape)| Look { colour, shape });
    out.extend(rest.into_keys().zip(free.collect::<Vec<_>>().into_iter().cycle()));
    out
}

pub(super) fn look_of(looks: &[(&str, Look)], method: &str) -> Look {
    looks.iter().find(|l| l.0 == method).map_or(Look { colour: 6, shape: 0 }, |l| l.1)
}

/// Draws one mark with a white rim, which keeps marks apart where they overlap.
pub(super) fn mark(root: &Root, at: Spot, look: Look, failed: bool) -> Result<(), ChartError> {
    shape(root, at, look, 10.0, PAPER)?;
    bare_mark(root, at, look, failed, 8.0)
}

/// Draws one mark; a failed one is hollow, with a cross.
pub(super) fn bare_mark(root: &Root, at: Spot, look: Look, failed: bool, r: f64) -> Result<(), ChartError> {
    if !failed {
        return shape(root, at, look, r, look.colour());
    }
    shape(root, at, look, r + 1.0, look.colour())?;
    shape(root, at, look, r - 2.0, PAPER)?;
    let ((x, y), arm) = (at, r as i32 + 2);
    for rise in [arm, -arm] {
        root.draw(&PathElement::new(vec![(x - arm, y - rise), (x + arm, y + rise)], FAIL.stroke_width(2)))?;
    }
    Ok(())
}

fn shape(root: &Root, (x, y): Spot, look: Look, r: f64, colour: RGBColor) -> Result<(), ChartError> {
    let corner = |(dx, dy): &(f64, f64)| (x + (dx * r).round() as i32, y + (dy * r).round() as i32);
    match SHAPES[look.shape] {
        [] => root.draw(&Circle::new((x, y), r as u32, colour.filled()))?,
        outline => {
            let corners: Vec<Spot> = outline.iter().map(corner).collect();
            root.draw(&Polygon::new(corners, colour.filled()))?;
        }
    }
    Ok(())
}

/// Width a text may take. SVG names a font it cannot measure; 0.6 em a letter is what wide ones (DejaVu) need.
pub(super) fn text_width(text: &str, size: f64) -> f64 {
    text.chars().count() as f64 * size * 0.6
}

/// Breaks at spaces into at most `lines` lines of `width`; what does not fit ends in "…".
pub(super) fn wrap(text: &str, size: f64, width: f64, lines: usize) -> Vec<String> {
    let room = ((width / (size * 0.6)) as usize).max(4);
    let mut out: Vec<String> = Vec::new();
    for word in text.split_whitespace() {
        match out.last_mut() {
            Some(line) if line.chars().count() + 1 + word.chars().count() <= room => {
                line.push(' ');
                line.push_str(word);
            }
            _ => out.push(word.into()),
        }
    }
    let cut = out.len() > lines;
    out.truncate(lines);
    let last = out.len().saturating_sub(1);
    for (i, line) in out.iter_mut().enumerate() {
        if line.chars().count() > room || (cut && i == last) {
            *line = line.chars().take(room - 1).chain(['…']).collect();
        }
    }
    out
}

pub(super) struct Type {
    size: f64,
    colour: RGBColor,
    bold: bool,
    h: HPos,
}

impl Type {
    pub(super) const fn new(size: f64, colour: RGBColor) -> Type {
        Type { size, colour, bold: false, h: HPos::Left }
    }

    pub(super) const fn bold(self) -> Type {
        Type { bold: true, ..self }
    }

    pub(super) const fn h(self, h: HPos) -> Type {
        Type { h, ..self }
    }

    pub(super) fn style(&self) -> TextStyle<'static> {
        let weight = if self.bold { FontStyle::Bold } else { FontStyle::Normal };
        // Plotters' SVG divides sizes by 1.24; this undoes it.
        let font = FontDesc::new(FontFamily::SansSerif, self.size * 1.24, weight);
        font.color(&self.colour).pos(Pos::new(self.h, VPos::Center))
    }
}

pub(super) fn write(root: &Root, text: &str, at: Spot, style: Type) -> Result<(), ChartError> {
    Ok(root.draw(&Text::new(text.to_string(), at, style.style()))?)
}

/// The title lines every page starts with; charts begin at y = 140.
pub(super) fn heading(root: &Root, title: &str, subtitle: &str, how_to_read: &str) -> Result<(), ChartError> {
    let lines = [
        (title, 34, Type::new(30.0, INK).bold()),
        (subtitle, 72, Type::new(18.0, GREY)),
        (how_to_read, 104, Type::new(18.0, INK)),
    ];
    for (text, y, style) in lines {
        if let Some(line) = wrap(text, style.size, f64::from(WIDTH) - 40.0, 1).first() {
            write(root, line, (20, y), style)?;
        }
    }
    Ok(())
}

/// Runs `draw` on an empty page and makes the result scale and speak to screen readers.
pub(super) fn page(
    [width, height]: [u32; 2],
    title: &str,
    description: &str,
    draw: impl FnOnce(&Root) -> Result<(), ChartError>,
) -> Result<String, ChartError> {
    let mut svg = String::new();
    {
        let root = SVGBackend::with_string(&mut svg, (width, height)).into_drawing_area();
        root.fill(&PAPER)?;
        draw(&root)?;
        root.present()?;
    }
    let body = svg.split_once('\n').map_or("", |(_, body)| body);
    // Text gets a white rim, so that it stays readable where it crosses a line.
    let body = body.replace(
        "<text ",
        r##"<text paint-order="stroke" stroke="#FEFEFE" stroke-width="4" stroke-linejoin="round" "##,
    );
    let escape =
        |s: &str| s.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;");
    let (title, description) = (escape(title), escape(description));
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" width=\"100%\" role=\"img\" \
         aria-label=\"{title}\">\n<title>{title}</title>\n<desc>{description}</desc>\n{body}"
    );
    // XML forbids these even when escaped.
    out.retain(|c| (c >= ' ' || c == '\n') && c != '\u{FFFE}' && c != '\u{FFFF}');
    Ok(out)
}
