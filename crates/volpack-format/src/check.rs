//! Structural checks: every offset, index, count and rank of the tree and the tables.
//!
//! Numbers of rules are those of `docs/format.md`, "What a reader checks".

use std::ops::Range;

use crate::codec::{BrickRange, Codec, SequenceRange};
use crate::error::{corrupt, ensure};
use crate::layout::{FrameRecord, GridRecord};
use crate::tree::{
    self, GRID_WORDS, HEADER_WORDS, L3Record, Link, MASK_WORDS, NODE_FIRST_RECORD, NODE_MASK_WORDS,
    NODE_WORDS, RECORD_WORDS, grid, header, l1_words,
};
use crate::{Atlas, Coord, Grid, InactiveRule, L2_DIM, PackError};

/// So many entries of a table from the first on.
pub(crate) fn range(first: u32, count: u32) -> Range<usize> {
    first as usize..first as usize + count as usize
}

/// Rules 32, 33 and 40: parts of a table lie inside it, and none serves twice. Were the same entries to serve many, a
/// small file could take all memory or any time.
pub(crate) fn parts(
    parts: impl Iterator<Item = Range<usize>>,
    len: usize,
    what: &str,
) -> Result<(), PackError> {
    let mut parts: Vec<_> = parts.collect();
    ensure(parts.iter().all(|part| part.end <= len), || format!("{what} lie outside their table"))?;
    parts.retain(|part| !part.is_empty());
    parts.sort_unstable_by_key(|part| part.start);
    ensure(parts.windows(2).all(|pair| pair[0].end <= pair[1].start), || format!("{what} overlap"))
}

/// Rules 34 and 35, once frames are known to lie inside their table.
pub(crate) fn frame_order(grids: &[GridRecord], frames: &[FrameRecord]) -> Result<(), PackError> {
    let place = |frame: &FrameRecord| (frame.grid, frame.number);
    ensure(frames.is_sorted_by(|a, b| place(a) < place(b)), || {
        "the frame table is not ordered by grid and number".to_owned()
    })?;
    let in_grids: u64 = grids.iter().map(|grid| u64::from(grid.frames)).sum();
    let mut own = grids.iter().map(|grid| &frames[range(grid.first_frame, grid.frames)]).enumerate();
    let are_own = own.all(|(g, frames)| frames.iter().all(|frame| frame.grid as usize == g));
    ensure(are_own && in_grids == frames.len() as u64, || {
        "the frame table and the grid table disagree about whose a frame is".to_owned()
    })
}

/// The words of the tree that a header entry names.
fn area(words: &[u32], at: usize, count: usize, size: usize, what: &str) -> Result<Range<usize>, PackError> {
    let start = words[at] as usize;
    let len = count.checked_mul(size);
    match len.and_then(|len| start.checked_add(len)) {
        Some(end) if start >= HEADER_WORDS && end <= words.len() => Ok(start..end),
        _ => corrupt(format!("the tree's {what} lie outside it")),
    }
}

/// Checks the tree's header, L3 records and L2 nodes: rules 22, 23 and 25 to 31.
pub(crate) fn tree(words: &[u32], atlases: &[Atlas]) -> Result<(), PackError> {
    if words.len() < HEADER_WORDS || words[header::WORDS] as usize != words.len() {
        return corrupt("the tree is not as long as it says");
    }
    let count = |at: usize| words[at] as usize;
    area(words, header::GRID_AT, count(header::GRIDS), GRID_WORDS, "grids")?;
    let nodes = area(words, header::NODE_AT, count(header::NODES), NODE_WORDS, "L2 nodes")?;
    let records = area(words, header::RECORD_AT, count(header::RECORDS), RECORD_WORDS, "L3 records")?;
    area(words, header::MASK_AT, count(header::MASKS), MASK_WORDS, "masks")?;
    area(words, header::CONSTANT_AT, count(header::CONSTANTS), 1, "constants")?;
    for codec in Codec::WITH_TEXELS {
        let atlas = Atlas::of(atlases, codec).map_or([0; 3], |a| [a.columns, a.rows, a.page_slabs]);
        ensure(words[header::atlas(codec)..][..3] == atlas, || {
            format!("the tree and the atlas table disagree about {}", codec.name())
        })?;
    }
    for (i, record) in words[records.clone()].chunks_exact(RECORD_WORDS).enumerate() {
        let record = L3Record::from_words([record[0], record[1], record[2]]);
        record
            .ok_or("unknown codec".to_owned())
            .and_then(|record| l3_record(words, atlases, &record))
            .map_err(|what| PackError::Corrupt(format!("L3 record {i}: {what}")))?;
    }
    for (i, node) in words[nodes].chunks_exact(NODE_WORDS).enumerate() {
        let (mask, ranks) = node[..NODE_FIRST_RECORD].split_at(NODE_MASK_WORDS);
        let first = node[NODE_FIRST_RECORD] as usize;
        ensure(tree::ranks(mask) == ranks, || format!("L2 node {i} has wrong ranks"))?;
        ensure(first + ones(mask) <= count(header::RECORDS), || {
            format!("L2 node {i} has children outside the L3 records")
        })?;
    }
    Ok(())
}

/// How many bits are on.
fn ones(mask: &[u32]) -> usize {
    mask.iter().map(|word| word.count_ones() as usize).sum()
}

/// Rules 26 to 29, for a tree whose header was checked.
pub(crate) fn l3_record(words: &[u32], atlases: &[Atlas], record: &L3Record) -> Result<(), String> {
    let masks = words[header::MASKS] as usize;
    if let Some(mask) = record.mask {
        let used = if record.rule == InactiveRule::Sign { 2 } else { 1 };
        if mask as usize + used > masks {
            return Err(format!("mask {mask} of {masks}"));
        }
    } else if record.rule != InactiveRule::Texel {
        return Err("an inactive rule without a mask".to_owned());
    }
    if record.codec == Codec::Constant {
        return Ok(());
    }
    let atlas = Atlas::of(atlases, record.codec).ok_or("its codec has no atlas")?;
    if record.slot >= atlas.bricks {
        return Err(format!("brick {} of {}", record.slot, atlas.bricks));
    }
    if !record.codec.axes().contains(&record.axis) {
        return Err(format!("packing axis {}", record.axis));
    }
    let extent = BrickRange::from_word(record.word2).extent;
    if !(extent.is_finite() && extent.to_f32() >= 0.0) {
        return Err(format!("extent {extent}"));
    }
    Ok(())
}

/// Reads and checks what the tables and the tree's header say of one grid: rules 36 to 39.
pub(crate) fn grid(words: &[u32], index: usize, record: GridRecord, name: &str) -> Result<Grid, PackError> {
    let at = words[header::GRID_AT] as usize + index * GRID_WORDS;
    let h = &words[at..at + GRID_WORDS];
    let three = |at: usize| [h[at], h[at + 1], h[at + 2]];
    let float = |at: usize| f32::from_bits(h[at]);
    let grid = Grid {
        name: name.to_owned(),
        record,
        frames: Vec::new(),
        background: float(grid::BACKGROUND),
        sequence: SequenceRange { lo: float(grid::LO), span: float(grid::SPAN) },
        origin: Coord(three(grid::ORIGIN).map(|v| v as i32)),
        cells: three(grid::CELLS),
        roots: three(grid::ROOTS),
        root_at: h[grid::ROOT_AT] as usize,
    };
    let GridRecord { active_min, active_max, .. } = record;
    ensure(active_min.is_finite() && active_max.is_finite() && active_min <= active_max, || {
        format!("grid {name:?} has an impossible range of active values")
    })?;
    let is_sound = grid.origin.is_aligned(L2_DIM)
        && grid.cells.iter().all(|c| (1..=32).contains(c))
        && grid.roots.iter().all(|r| *r >= 1)
        && (grid.roots == [1; 3] || grid.has_whole_roots());
    let end = |a: usize| {
        i64::from(grid.origin.0[a]) + i64::from(grid.cells[a]) * i64::from(grid.roots[a]) * i64::from(L2_DIM)
    };
    // Unsound cells could make the product wrap.
    ensure(is_sound && (0..3).all(|a| end(a) <= i64::from(i32::MAX) + 1), || {
        format!("grid {name:?} has an impossible box")
    })?;
    let SequenceRange { lo, span } = grid.sequence;
    ensure(lo.is_finite() && span.is_finite() && span > 0.0, || {
        format!("grid {name:?} has an impossible lo or span")
    })?;
    ensure(h[grid::FRAMES] == record.frames, || {
        format!("the tree and the grid table disagree about the frames of grid {name:?}")
    })?;
    // Numbers of roots whose product would wrap do not fit either.
    let frames = u64::from(record.frames);
    let roots = grid.roots.iter().try_fold(frames, |n, r| n.checked_mul((*r).into()));
    let room = words.len().checked_sub(grid.root_at).filter(|_| grid.root_at >= HEADER_WORDS);
    ensure(roots.zip(room).is_some_and(|(roots, room)| roots <= room as u64), || {
        format!("grid {name:?} has roots outside the tree")
    })?;
    Ok(grid)
}

/// Rules 41 and 42. `is_texels` says whether a chunk is one of texels.
pub(crate) fn frames(grids: &[Grid], is_texels: impl Fn(u32) -> bool) -> Result<(), PackError> {
    for (grid, frame) in grids.iter().flat_map(|grid| grid.frames.iter().map(move |frame| (grid, frame))) {
        let what = |what: &str| format!("grid {:?} frame {} {what}", grid.name, frame.record.number);
        let are_texels = frame.chunks.iter().all(|&chunk| is_texels(chunk));
        ensure(are_texels && frame.chunks.is_sorted_by(|a, b| a < b), || {
            what("lists chunks that are not texels, or out of order")
        })?;
        ensure(frame.record.transform.iter().all(|v| v.is_finite()), || what("has no valid transform"))?;
    }
    Ok(())
}

/// Checks each grid's roots and the L1 nodes that they name: rules 43 to 46.
pub(crate) fn l1_nodes(words: &[u32], grids: &[Grid]) -> Result<(), PackError> {
    let mut nodes: Vec<(u32, u32)> = Vec::new();
    for grid in grids {
        for &root in &words[grid.root_words()] {
            match Link::from_word(root) {
                Link::Node(0) => {}
                Link::Node(at) => nodes.push((at, grid.cell_count() as u32)),
                Link::Constant { index, .. } => {
                    ensure(index < words[header::CONSTANTS] && grid.has_whole_roots(), || {
                        format!("grid {:?} has a root that is no constant", grid.name)
                    })?;
                }
            }
        }
    }
    // Each is checked once, however many places, frames and grids share it. None begins inside another, or a small file
    // could have as many large ones as it has words.
    nodes.sort_unstable();
    nodes.dedup();
    let (mut last, mut end) = (0, HEADER_WORDS);
    for (at, cells) in nodes {
        let what = |what: String| PackError::Corrupt(format!("L1 node at word {at}: {what}"));
        if at != last && (at as usize) < end {
            return Err(what("it overlaps what is before it".to_owned()));
        }
        end = end.max(l1_node(words, at as usize, cells as usize).map_err(what)?);
        last = at;
    }
    Ok(())
}

/// Rules 44 to 46 for one L1 node. Returns the word behind it.
fn l1_node(words: &[u32], at: usize, cells: usize) -> Result<usize, String> {
    let (mask_words, rank_words) = l1_words(cells);
    let Some(head) = words.get(at..at + mask_words + rank_words) else {
        return Err("it lies outside the tree".to_owned());
    };
    let (mask, ranks) = head.split_at(mask_words);
    if tree::ranks(mask) != ranks {
        return Err("wrong ranks".to_owned());
    }
    if !cells.is_multiple_of(32) && mask[mask_words - 1] >> (cells % 32) != 0 {
        return Err("children outside its cells".to_owned());
    }
    let first = at + head.len();
    let Some(links) = words.get(first..first + ones(mask)) else {
        return Err("its children lie outside the tree".to_owned());
    };
    for &word in links {
        match Link::from_word(word) {
            Link::Node(node) if node < words[header::NODES] => {}
            Link::Constant { index, .. } if index < words[header::CONSTANTS] => {}
            link => return Err(format!("a child is {link:?}")),
        }
    }
    Ok(first + links.len())
}
