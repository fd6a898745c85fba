//! Pictures of a pack, as PNG. Traced on the CPU, so that they are the same everywhere.

use std::path::PathBuf;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::cache::{Cache, Key, Namespace};
use crate::cancel::CancelToken;
use crate::error::{Error, Result};
use crate::pack::{Grid, Pack};
use crate::render::{DecodedFrame, Mode, Scene, View, trace, write_png};
use crate::verify::{Seen, Sources, VerifyReport, difference_map, look, shown_frames};

/// Frames of a strip, at most: what still shows how a sequence moves, in 400 KB.
const STRIP_FRAMES: usize = 24;
/// Pixels of the side of one of them.
const STRIP_SIDE: u32 = 96;

/// Pictures are drawn once for a pack.
const STAGE: Namespace = Namespace { name: "gallery", version: 3, travels: true };

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
    cancel: &CancelToken,
) -> Result<Gallery> {
    let worst = found.and_then(|found| found.worst_frame.as_ref());
    let worst = worst.map(|worst| (worst.grid.as_str(), worst.frame));
    // One for all pictures of a grid.
    let pictures = found.and_then(|found| found.pictures.as_ref()).map_or(&[][..], |found| &found.pictures);
    let extinction = |grid: &Grid| {
        pictures.iter().find(|picture| picture.grid == grid.name).map(|picture| picture.extinction)
    };
    let extinctions: Vec<Option<f64>> = pack.grids().iter().map(extinction).collect();
    let key = Key::new(&STAGE, &(digest, files.is_some(), worst, &extinctions));
    if let Some(known) = cache.and_then(|cache| cache.get(&key)) {
        return Ok(known);
    }
    let sources = files.map(|files| Sources::find(pack, files)).transpose()?;
    let sources = sources.as_ref();
    let mut places = Vec::new();
    for (g, grid) in pack.grids().iter().enumerate() {
        let is_worst = |f: usize| worst == Some((grid.name.as_str(), grid.frames[f].record.number));
        let mut shown = shown_frames(grid.frames.len());
        shown.extend((0..grid.frames.len()).find(|&f| is_worst(f)));
        shown.sort_unstable();
        shown.dedup();
        places.extend(shown.into_iter().map(|f| ([g, f], is_worst(f))));
    }
    let key_frame = |(place, is_worst): ([usize; 2], bool)| {
        let Some(seen) = look(pack, sources, place, extinctions[place[0]])? else { return Ok(None) };
        Ok(Some(KeyFrame::new(&pack.grids()[place[0]], place[1], is_worst, &seen)))
    };
    let key_frames = places.into_par_iter().map(key_frame);
    let strips = extinctions.iter().enumerate().map(|(g, extinction)| strip(pack, g, *extinction, cancel));
    let gallery = Gallery {
        key_frames: key_frames.collect::<Result<Vec<_>>>()?.into_iter().flatten().collect(),
        strips: strips.collect::<Result<Vec<_>>>()?.into_iter().flatten().collect(),
    };
    if let Some(cache) = cache {
        cache.put(&key, &gallery);
    }
    Ok(gallery)
}

impl KeyFrame {
    fn new(grid: &Grid, frame: usize, is_worst: bool, seen: &Seen) -> Self {
        let png = |rgb: &[u8]| Png::new([seen.side; 2], rgb);
        let difference = |source: &Vec<u8>| [png(source), png(&difference_map(source, &seen.pack))];
        Self {
            grid: grid.name.clone(),
            frame: grid.frames[frame].record.number,
            is_worst,
            side: seen.side,
            pack: png(&seen.pack),
            source: seen.source.as_ref().map(difference),
        }
    }
}

/// `None` for a grid of less than two frames, where there is nothing to play, and for one that cannot be traced.
fn strip(pack: &Pack, g: usize, extinction: Option<f64>, cancel: &CancelToken) -> Result<Option<Strip>> {
    let grid = &pack.grids()[g];
    let all = grid.frames.len();
    if all < 2 {
        return Ok(None);
    }
    let count = all.min(STRIP_FRAMES);
    let frames: Vec<usize> = (0..count).map(|i| i * (all - 1) / (count - 1)).collect();
    let mode = Mode::of_grid(grid);
    let draw = |&f: &usize| -> Result<Option<Vec<u8>>> {
        cancel.check()?;
        let field = pack.frame(g, f).and_then(|reader| DecodedFrame::from_pack(&reader)).map_err(|e| {
            Error::Verify(format!("grid {:?} frame {}: {e}", grid.name, grid.frames[f].record.number))
        })?;
        let scene = Scene::new(grid, f, &View::default(), mode, [STRIP_SIDE; 2]);
        let scene = Scene { extinction: extinction.unwrap_or(scene.extinction), ..scene };
        Ok(trace::<f32>(&field, &scene).ok().map(|image| image.to_rgb8(&scene)))
    };
    let pictures = frames.par_iter().map(draw).collect::<Result<Option<Vec<_>>>>()?;
    let Some(pictures) = pictures else { return Ok(None) };
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
