//! What each frame of a pack costs.

use std::collections::HashSet;

use super::model::FrameCost;
use crate::codec::Codec;
use crate::pack::{Pack, Region};
use crate::verify::VerifyReport;

/// The costs of each frame of each grid, in order. A brick that frames share is new in the first of them.
pub(super) fn costs(pack: &Pack, found: Option<&VerifyReport>) -> Vec<FrameCost> {
    let mut seen: HashSet<(Codec, u32)> = HashSet::new();
    let mut out = Vec::new();
    for (g, grid) in pack.grids().iter().enumerate() {
        for (f, frame) in grid.frames.iter().enumerate() {
            let mut shown = HashSet::new();
            pack.frame_tree(g, f).for_each_region(|_, _, region| {
                if let Region::Brick(record) = region
                    && record.codec != Codec::Constant
                {
                    shown.insert((record.codec, record.slot));
                }
            });
            let found = found.and_then(|found| found.frames.get(out.len()));
            let size = |slots: &mut dyn Iterator<Item = &(Codec, u32)>| {
                slots.map(|(codec, _)| codec.layout().brick_bytes() as u64).sum()
            };
            out.push(FrameCost {
                grid: grid.name.clone(),
                frame: frame.record.number,
                texel_bytes: size(&mut shown.iter()),
                new_texel_bytes: size(&mut shown.difference(&seen)),
                psnr: found.and_then(|frame| frame.active.psnr),
                exact: found.is_some_and(|frame| frame.active.max_error == 0.0),
            });
            seen.extend(shown);
        }
    }
    out
}
