//! Stages 3 and 4 over a sequence: what is known of a frame is taken from the cache, the rest is read.

use std::sync::Arc;

use rayon::prelude::*;

use super::cached_bricks::GridCache;
use super::{Job, Plan, Progress, memory};
use crate::cache::{Cache, Key, Namespace};
use crate::codec::TexelCodec;
use crate::error::{Error, Result};
use crate::profile;
use crate::settings::{Format, Masks, Settings};
use crate::stages::dedup::{DedupError, Fetch, FrameIndex, MaskPolicy, SequenceTree};
use crate::stages::flatten::{Flattened, flatten};
use crate::stages::metadata::{FrameSource, SequenceInfo};
use crate::stages::select::{SelectedGrid, Selection};
use crate::vdb::{GridClass, VdbFile, find_grid};
use crate::volume::{Brick, ChunkedVec, FlatFrame};

/// What frames pass through before anything is made of them.
pub type Alter<'a> = &'a (dyn Fn(&mut FlatFrame) + Sync);

const OUTLINE: Namespace = Namespace { name: "outline", version: 4, travels: false };

/// One grid of one frame, with its voxels unless they were not needed so far.
type Frame = (FrameIndex, Option<ChunkedVec<Brick>>);

/// Reads frames and adds them in order: while some are added the next are read, as many as memory
/// has room for.
pub(super) fn read(
    job: &Job,
    plan: &Plan,
    cache: Option<&Arc<Cache>>,
    alter: Option<Alter>,
    progress: &mut dyn Progress,
) -> Result<Vec<SequenceTree>> {
    let (Plan { sequence, selection, .. }, settings) = (plan, &job.settings);
    let at_once = memory::frames_at_once(plan, &job.resources)?;
    let window_frames = (at_once / 2).max(1);
    let cancel = progress.cancel_token();
    let tree = |grid: &SelectedGrid| {
        let fetch = cache.is_some().then(|| fetch(sequence, grid, settings, window_frames));
        SequenceTree::new(job.resources.scratch.clone(), fetch)
    };
    let mut trees: Vec<SequenceTree> = selection.grids.iter().map(tree).collect();
    let mut add = |sources: &[FrameSource], frames| add(&mut trees, selection, sources, frames);
    let read = |window: &[FrameSource]| -> Vec<Result<Vec<Option<Frame>>>> {
        let read = |frame: &FrameSource| read_frame(frame, selection, settings, cache.map(|c| &**c), alter);
        window.par_iter().map(read).collect()
    };
    let mut windows = sequence.frames.chunks(window_frames);
    let mut window = windows.next().unwrap_or_default();
    let mut frames = read(window);
    while !window.is_empty() {
        cancel.check()?;
        let next = windows.next().unwrap_or_default();
        // The next frames are read while these are added: on this thread, so that what stays does not lie between what
        // comes and goes with a frame, which would keep the allocator from using it anew.
        let mut later = Vec::new();
        if at_once > 1 {
            rayon::in_place_scope(|scope| {
                scope.spawn(|_| later = read(next));
                add(window, frames)
            })?;
        } else {
            add(window, frames)?;
            later = read(next);
        }
        progress.advance(window.len() as u64);
        (window, frames) = (next, later);
    }
    trees.iter_mut().try_for_each(SequenceTree::seal)?;
    Ok(trees)
}

/// Adds frames to their grids, in order.
fn add(
    trees: &mut [SequenceTree],
    selection: &Selection,
    sources: &[FrameSource],
    frames: Vec<Result<Vec<Option<Frame>>>>,
) -> Result<()> {
    let _span = profile::span("dedup");
    for (source, frame) in sources.iter().zip(frames) {
        for ((tree, grid), frame) in trees.iter_mut().zip(&selection.grids).zip(frame?) {
            let Some((frame_index, voxels)) = frame else { continue };
            tree.add(frame_index, voxels).map_err(|e| match e {
                DedupError::Scratch(e) => e.into(),
                DedupError::Background { .. } => Error::Input(format!(
                    "{}: grid {:?}: {e}: export the whole sequence with one background",
                    source.path.display(),
                    grid.name
                )),
            })?;
        }
    }
    Ok(())
}

/// The selected grids of one file; `None` for those that it does not have.
fn read_frame(
    frame: &FrameSource,
    selection: &Selection,
    settings: &Settings,
    cache: Option<&Cache>,
    alter: Option<Alter>,
) -> Result<Vec<Option<Frame>>> {
    let mut file = None;
    let mut read = Vec::new();
    let one = |grid: &SelectedGrid| -> Result<Option<Frame>> {
        let Some(key) = key(frame, grid, settings) else { return Ok(None) };
        let known = cache.and_then(|cache| cache.get::<FrameIndex>(&key)).filter(FrameIndex::is_sound);
        if let Some(frame_index) = known {
            return Ok(Some((frame_index, None)));
        }
        let file = match &file {
            Some(file) => file,
            None => file.insert(VdbFile::open(&frame.path).map_err(Error::vdb(&frame.path))?),
        };
        let span = profile::span("flatten");
        let mut flat = flatten_grid(file, frame, grid, settings)?;
        if let Some(alter) = alter {
            alter(&mut flat.frame);
        }
        let (frame_index, voxels) = FrameIndex::split(flat, mask_policy(settings, grid.class));
        drop(span);
        read.push(key);
        Ok(Some((frame_index, Some(voxels))))
    };
    let frames = selection.grids.iter().map(one).collect::<Result<Vec<_>>>()?;
    if let Some(cache) = cache.filter(|_| !read.is_empty()) {
        frame.check_unchanged()?;
        let frame_indices = frames.iter().flatten().filter(|(_, voxels)| voxels.is_some());
        read.iter().zip(frame_indices).for_each(|(key, (frame_index, _))| cache.put(key, frame_index));
    }
    Ok(frames)
}

fn flatten_grid(
    file: &VdbFile,
    frame: &FrameSource,
    grid: &SelectedGrid,
    settings: &Settings,
) -> Result<Flattened> {
    // What the file says now may not be what it said when the grid was selected.
    let info = find_grid(&file.grids, &grid.source);
    let info = info.filter(|info| info.value_type.is_scalar()).ok_or_else(|| {
        Error::Input(format!("{}: grid {:?} is gone: the file changed", frame.path.display(), grid.source))
    })?;
    flatten(file, &frame.path, info, grid.component, settings.nonfinite)
}

/// Reads the voxels of a grid's frames once more, for those whose frame index alone is known.
fn fetch(sequence: &SequenceInfo, grid: &SelectedGrid, settings: &Settings, at_once: usize) -> Fetch {
    let frames: Vec<FrameSource> = grid.frames.iter().map(|&i| sequence.frames[i].clone()).collect();
    let (grid, settings) = (grid.clone(), settings.clone());
    let read = move |place: usize| {
        let frame: &FrameSource = &frames[place];
        let file = VdbFile::open(&frame.path).map_err(Error::vdb(&frame.path))?;
        let flat = flatten_grid(&file, frame, &grid, &settings)?;
        frame.check_unchanged()?;
        Ok(flat.frame.bricks)
    };
    Fetch { read: Box::new(read), at_once }
}

/// What the frame index of one grid of one frame depends on; `None` if the frame lacks the grid.
fn key(frame: &FrameSource, grid: &SelectedGrid, settings: &Settings) -> Option<Key> {
    let info = find_grid(&frame.grids, &grid.source)?;
    let policy = mask_policy(settings, grid.class);
    let of_grid = (frame.digest.as_bytes(), &info.name, grid.component);
    Some(Key::new(&OUTLINE, &(of_grid, settings.nonfinite, policy)))
}

/// For each grid, where what is made of its frames is kept.
pub(super) fn caches(
    sequence: &SequenceInfo,
    selection: &Selection,
    settings: &Settings,
    cache: Option<&Arc<Cache>>,
) -> Vec<Option<GridCache>> {
    let of_grid = |grid: &SelectedGrid| {
        let keys = grid.frames.iter().filter_map(|&i| key(&sequence.frames[i], grid, settings));
        cache.map(|cache| GridCache { cache: Arc::clone(cache), frames: keys.collect() })
    };
    selection.grids.iter().map(of_grid).collect()
}

/// The names of files of which something is selected that the cache does not have.
pub(super) fn unknown(
    sequence: &SequenceInfo,
    selection: &Selection,
    settings: &Settings,
    cache: Option<&Cache>,
) -> Vec<String> {
    let is_known = |frame: &FrameSource, grid: &SelectedGrid| {
        key(frame, grid, settings).is_none_or(|key| cache.is_some_and(|cache| cache.has(&key)))
    };
    let unknown = |frame: &&FrameSource| !selection.grids.iter().all(|grid| is_known(frame, grid));
    sequence.frames.iter().filter(unknown).map(FrameSource::file_name).collect()
}

fn mask_policy(settings: &Settings, class: GridClass) -> MaskPolicy {
    match (settings.masks, settings.format(), class) {
        (Masks::Keep, ..)
        | (Masks::Auto, Format::Uniform(TexelCodec::EXACT), _)
        | (Masks::Auto, _, GridClass::LevelSet) => MaskPolicy::Keep,
        (Masks::Auto, ..) => MaskPolicy::DropFog,
        (Masks::Drop, ..) => MaskPolicy::DropWhereBackground,
    }
}
