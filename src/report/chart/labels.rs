//! Where labels fit next to their marks.

use plotters::style::text_anchor::HPos;

use super::paint::{Spot, text_width};

/// Size of the text next to marks.
pub(super) const LABEL: f64 = 18.0;

/// What labels must not cover (`hard`) and had better not (`soft`, the front).
pub(super) struct Taken {
    hard: Vec<[i32; 4]>,
    soft: Vec<[i32; 4]>,
    left_top: Spot,
    pub(super) right_bottom: Spot,
}

impl Taken {
    pub(super) fn new(left_top: Spot, right_bottom: Spot) -> Taken {
        Taken { hard: Vec::new(), soft: Vec::new(), left_top, right_bottom }
    }

    pub(super) fn mark(&mut self, (x, y): Spot) {
        self.hard.push([x - 10, y - 10, x + 10, y + 10]);
    }

    pub(super) fn line(&mut self, a: Spot, b: Spot) {
        self.hard.extend(beads(a, b, 2));
    }

    pub(super) fn front(&mut self, a: Spot, b: Spot) {
        self.soft.extend(beads(a, b, 6));
    }

    /// A free place next to a mark, and the anchor of the text there. Beside comes first: it reads as one
    /// with its mark. Then the corners a rising line leaves free.
    pub(super) fn place<'t>(&mut self, (x, y): Spot, text: &'t str) -> Option<(&'t str, Spot, HPos)> {
        let (w, h) = (text_width(text, LABEL) as i32, LABEL as i32);
        let sides: [(i32, i32); 8] = [(1, 0), (-1, 0), (-1, -1), (1, 1), (0, -1), (0, 1), (1, -1), (-1, 1)];
        let place = |avoid_soft: bool| {
            sides.into_iter().find_map(|(dx, dy)| {
                let gap = if dy == 0 { 14 } else { 6 };
                let (tx, ty) = (x + dx * gap, y + dy * (h / 2 + if dx == 0 { 12 } else { 6 }));
                let left = [tx - w, tx - w / 2, tx][(dx + 1) as usize];
                let new = [left, ty - h / 2, left + w, ty + h / 2];
                let inside = new[0] >= self.left_top.0
                    && new[2] <= self.right_bottom.0
                    && new[1] >= self.left_top.1
                    && new[3] <= self.right_bottom.1;
                let clear = |b: &[i32; 4]| new[2] < b[0] || b[2] < new[0] || new[3] < b[1] || b[3] < new[1];
                let free =
                    inside && self.hard.iter().all(clear) && (!avoid_soft || self.soft.iter().all(clear));
                free.then_some((new, (tx, ty), [HPos::Right, HPos::Center, HPos::Left][(dx + 1) as usize]))
            })
        };
        let (new, at, h) = place(true).or_else(|| place(false))?;
        self.hard.push(new);
        Some((text, at, h))
    }
}

/// Squares along a segment, close enough that no label slips between them.
fn beads(a: Spot, b: Spot, half: i32) -> impl Iterator<Item = [i32; 4]> {
    let steps = ((b.0 - a.0).abs().max((b.1 - a.1).abs()) / 5).max(1);
    (0..=steps).map(move |i| {
        let (x, y) = (a.0 + (b.0 - a.0) * i / steps, a.1 + (b.1 - a.1) * i / steps);
        [x - half, y - half, x + half, y + half]
    })
}
