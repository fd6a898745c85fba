//! Pictures of a pack, as PNG. Traced on the CPU, so that they are the same everywhere.

use std::path::PathBuf;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::cache::{Cache, Key, Stage};
use crate::error::{Error, Result};
use crate::pack::Pack;
use crate::render::{Field, Mode, Scene, View, trace, write_png};
use crate::verify::{Sources, VerifyReport, difference_map, look, shown_frames};
use crate::volume::CoordBox;

/// Frames of a strip, at most: what still shows how a sequence moves, in 400 KB.
const STRIP_FRAMES: usize = 24;
/// Pixels of the side of one of them.
const STRIP_SIDE: u32 = 96;

/// Pictures are drawn once for a pack.
const STAGE: Stage = Stage { name: "gallery", version: 1, travels: true };

/// A pack's pictures.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Gallery {
    /// The first, a middle, the last and the worst frame of each grid.
    pub key_frames: Vec<KeyFrame>,
    /// Each grid's frames side by side.
    pub strips: Vec<Strip>,
}

/// One frame of one grid.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct KeyFrame {
    /// The grid.
    pub grid: String,
    /// The frame's number.
    pub frame: i32,
    /// Whether no frame of the pack has a lower PSNR.
    pub is_worst: bool,
    /// Pixels of a side.
    pub side: u32,
    /// The pack.
    pub pack: Png,
    /// Source and difference; absent where there is no source.
    pub source: Option<[Png; 2]>,
}

/// Frames side by side, for pages to play.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Strip {
    /// The grid.
    pub grid: String,
    /// Their numbers.
    pub frames: Vec<i32>,
    /// Pixels of a frame's side.
    pub side: u32,
    /// All of them.
    pub png: Png,
}

/// A PNG file's bytes.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Png(#[serde(with = "serde_bytes")] pub Vec<u8>);

impl Png {
    fn new(size: [u32; 2], rgb: &[u8]) -> Self {
        let mut bytes = Vec::new();
        write_png(&mut bytes, size, rgb).expect("memory takes any picture");
        Self(bytes)
    }
}

/// Draws a pack, or takes its pictures from the cache. `digest` is BLAKE3 of its file. Among `files` are its sources, if
/// there are any: they are looked for where there is something to draw.
///
/// # Errors
/// When a source or a chunk of the pack cannot be read.
pub fn gallery(
    pack: &Pack,
    digest: &[u8; 32],
    files: Option<&[PathBuf]>,
    found: Option<&VerifyReport>,
    cache: Option<&Cache>,
) -> Result<Gallery> {
    let worst = found.and_then(|found| found.worst_frame.as_ref());
    let worst = worst.map(|worst| (worst.grid.as_str(), worst.frame));
    let key = Key::new(&STAGE, &(digest, files.is_some(), worst));
    if let Some(known) = cache.and_then(|cache| cache.get(&key)) {
        return Ok(known);
    }
    let sources = files.map(|files| Sources::find(pack, files)).transpose()?;
    let sources = sources.as_ref();
    let mut places = Vec::new();
    for (g, grid) in pack.grids.iter().enumerate() {
        let is_worst = |f: usize| worst == Some((grid.name.as_str(), grid.frames[f].record.number));
        let mut shown = shown_frames(grid.frames.len());
        shown.extend((0..grid.frames.len()).find(|&f| is_worst(f)));
        shown.sort_unstable();
        shown.dedup();
        places.extend(shown.into_iter().map(|f| ([g, f], is_worst(f))));
    }
    let key_frames =
        places.into_par_iter().map(|(place, is_worst)| key_frame(pack, sources, place, is_worst));
    let strips = (0..pack.grids.len()).map(|g| strip(pack, g));
    let gallery = Gallery {
        key_frames: key_frames.collect::<Result<Vec<_>>>()?.into_iter().flatten().collect(),
        strips: strips.collect::<Result<Vec<_>>>()?.into_iter().flatten().collect(),
    };
    if let Some(cache) = cache {
        cache.put(&key, &gallery);
    }
    Ok(gallery)
}

fn key_frame(
    pack: &Pack,
    sources: Option<&Sources>,
    [g, f]: [usize; 2],
    is_worst: bool,
) -> Result<Option<KeyFrame>> {
    let grid = &pack.grids[g];
    let Some(seen) = look(pack, sources, [g, f])? else { return Ok(None) };
    let png = |rgb: &[u8]| Png::new([seen.side; 2], rgb);
    Ok(Some(KeyFrame {
        grid: grid.name.clone(),
        frame: grid.frames[f].record.number,
        is_worst,
        side: seen.side,
        pack: png(&seen.pack),
        source: seen.source.as_ref().map(|source| [png(source), png(&difference_map(source, &seen.pack))]),
    }))
}

/// `None` for a grid of less than two frames, where there is nothing to play.
fn strip(pack: &Pack, g: usize) -> Result<Option<Strip>> {
    let grid = &pack.grids[g];
    let all = grid.frames.len();
    if all < 2 {
        return Ok(None);
    }
    let count = all.min(STRIP_FRAMES);
    let frames: Vec<usize> = (0..count).map(|i| i * (all - 1) / (count - 1)).collect();
    // One camera for all: around everything that any of them has.
    let mut bounds = CoordBox::EMPTY;
    frames.iter().for_each(|&f| bounds.union(pack.frame_tree(g, f).bounds()));
    if bounds.is_empty() {
        return Ok(None);
    }
    let mode = Mode::of_grid(grid);
    let draw = |&f: &usize| -> Result<Vec<u8>> {
        crate::interrupt::check()?;
        let frame = &grid.frames[f];
        let broken = |e: &dyn std::fmt::Display| {
            Error::Verify(format!("grid {:?} frame {}: {e}", grid.name, frame.record.number))
        };
        let field = Field::from_pack(&pack.frame(g, f).map_err(|e| broken(&e))?).map_err(|e| broken(&e))?;
        let scene = Scene::new(grid, frame, bounds, &View::default(), mode, [STRIP_SIDE; 2]);
        let image =
            trace::<f32>(&field, &scene).ok_or_else(|| broken(&"its transform cannot be inverted"))?;
        Ok(image.to_rgb8(mode))
    };
    let pictures = frames.par_iter().map(draw).collect::<Result<Vec<_>>>()?;
    let row = STRIP_SIDE as usize * 3;
    let mut rgb = Vec::with_capacity(pictures.len() * row * STRIP_SIDE as usize);
    for y in 0..STRIP_SIDE as usize {
        pictures.iter().for_each(|picture| rgb.extend_from_slice(&picture[y * row..(y + 1) * row]));
    }
    Ok(Some(Strip {
        grid: grid.name.clone(),
        frames: frames.iter().map(|&f| grid.frames[f].record.number).collect(),
        side: STRIP_SIDE,
        png: Png::new([STRIP_SIDE * pictures.len() as u32, STRIP_SIDE], &rgb),
    }))
}
