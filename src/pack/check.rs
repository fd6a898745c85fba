//! Structural checks: every offset, index, count and rank of the tree and the tables.

use std::collections::HashSet;
use std::ops::Range;

use super::error::corrupt;
use super::layout::GridRecord;
use super::tree::{
    self, GRID_WORDS, HEADER_WORDS, L3Record, Link, MASK_WORDS, NODE_WORDS, RECORD_WORDS, grid, header,
    l1_words,
};
use super::{Grid, Pack, PackError};
use crate::codec::{Codec, SequenceRange};
use crate::volume::{CELL_DIM, Coord, InactiveRule};

/// The words of the tree that a header entry names.
fn area(words: &[u32], at: usize, count: usize, size: usize, what: &str) -> Result<Range<usize>, PackError> {
    let start = words[at] as usize;
    let len = count.checked_mul(size);
    match len.and_then(|len| start.checked_add(len)) {
        Some(end) if start >= HEADER_WORDS && end <= words.len() => Ok(start..end),
        _ => corrupt(format!("the tree's {what} lie outside it")),
    }
}

/// Checks the tree's header, L2 nodes, L3 records and, for each grid, L1 nodes.
pub(super) fn tree(pack: &Pack) -> Result<(), PackError> {
    let words = &pack.tree;
    if words.len() < HEADER_WORDS || words[header::WORDS] as usize != words.len() {
        return corrupt("the tree is not as long as it says");
    }
    let count = |at: usize| words[at] as usize;
    let grids = area(words, header::GRID_AT, count(header::GRIDS), GRID_WORDS, "grids")?;
    let nodes = area(words, header::NODE_AT, count(header::NODES), NODE_WORDS, "L2 nodes")?;
    let records = area(words, header::RECORD_AT, count(header::RECORDS), RECORD_WORDS, "L3 records")?;
    area(words, header::MASK_AT, count(header::MASKS), MASK_WORDS, "masks")?;
    area(words, header::CONSTANT_AT, count(header::CONSTANTS), 1, "constants")?;
    if grids.is_empty() {
        return corrupt("there is no grid");
    }
    for codec in Codec::WITH_TEXELS {
        let atlas = pack.atlas(codec).map_or([0; 3], |a| [a.columns, a.rows, a.page_slabs]);
        if words[header::atlas(codec)..][..3] != atlas {
            return corrupt(format!("the tree and the atlas table disagree about {}", codec.name()));
        }
    }
    for (i, record) in words[records.clone()].chunks_exact(RECORD_WORDS).enumerate() {
        check_record(pack, record, count(header::MASKS))
            .map_err(|what| PackError::Corrupt(format!("L3 record {i}: {what}")))?;
    }
    for (i, node) in words[nodes].chunks_exact(NODE_WORDS).enumerate() {
        let (mask, ranks, first) = (&node[..128], &node[128..192], node[192] as usize);
        let children: usize = mask.iter().map(|w| w.count_ones() as usize).sum();
        if tree::ranks(mask) != ranks {
            return corrupt(format!("L2 node {i} has wrong ranks"));
        }
        if first + children > count(header::RECORDS) {
            return corrupt(format!("L2 node {i} has children outside the L3 records"));
        }
    }
    Ok(())
}

fn check_record(pack: &Pack, words: &[u32], masks: usize) -> Result<(), String> {
    let record = L3Record::from_words([words[0], words[1], words[2]]).ok_or("unknown codec")?;
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
    let atlas = pack.atlas(record.codec).ok_or("its codec has no atlas")?;
    if record.slot >= atlas.bricks {
        return Err(format!("brick {} of {}", record.slot, atlas.bricks));
    }
    if record.axis > 2 || record.codec != Codec::Bc7 && record.axis != 2 {
        return Err(format!("packing axis {}", record.axis));
    }
    let range = crate::codec::BrickRange::from_word(record.word2);
    if !(range.extent.is_finite() && range.extent.to_f32() >= 0.0) {
        return Err(format!("extent {}", range.extent));
    }
    Ok(())
}

/// Reads and checks the tree's header of one grid.
pub(super) fn grid_header(
    words: &[u32],
    index: usize,
    record: GridRecord,
    name: &str,
) -> Result<Grid, PackError> {
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
    let one_root = grid.roots == [1; 3];
    let cells_fit = grid.cells.iter().all(|c| (1..=32).contains(c)) && (one_root || grid.cells == [32; 3]);
    let extent = |a: usize| i64::from(grid.cells[a]) * i64::from(grid.roots[a]) * i64::from(CELL_DIM);
    // Wrong cells could make the extent wrap.
    let box_fits = cells_fit
        && (0..3).all(|a| {
            grid.roots[a] >= 1 && i64::from(grid.origin.0[a]) + extent(a) <= i64::from(i32::MAX) + 1
        });
    let roots = grid.roots.iter().try_fold(u64::from(h[grid::FRAMES]), |n, r| n.checked_mul((*r).into()));
    // A grid without frames has no roots, but they too begin inside.
    let room = words.len().checked_sub(grid.root_at);
    let roots_fit = roots.zip(room).is_some_and(|(roots, room)| roots <= room as u64);
    if !box_fits || !roots_fit || !grid.origin.is_aligned(CELL_DIM) || h[grid::FRAMES] != record.frames {
        return corrupt(format!("grid {name:?} has an impossible header"));
    }
    if !(grid.sequence.lo.is_finite() && grid.sequence.span.is_finite() && grid.sequence.span > 0.0) {
        return corrupt(format!("grid {name:?} has an impossible range"));
    }
    Ok(grid)
}

/// Checks each grid's roots and L1 nodes, and that its frames' chunk lists name texel chunks.
pub(super) fn grids(pack: &Pack) -> Result<(), PackError> {
    let words = &pack.tree;
    let constants = words[header::CONSTANTS];
    let nodes = words[header::NODES];
    // No root serves twice, or a small file could take any time to check.
    let all_roots = pack.grids.iter().map(|g| g.root_count() * g.frames.len()).sum::<usize>();
    if all_roots > words.len() {
        return corrupt("the grids' roots overlap");
    }
    for grid in &pack.grids {
        let cells = grid.cell_count();
        let roots = grid.root_count() * grid.frames.len();
        let mut seen = HashSet::new();
        for &word in &words[grid.root_at..grid.root_at + roots] {
            match Link::from_word(word) {
                Link::Node(0) => {}
                Link::Constant { index, .. } if index < constants => {}
                Link::Node(at) => {
                    if seen.insert(at) {
                        check_l1(words, at as usize, cells, nodes, constants).map_err(|what| {
                            PackError::Corrupt(format!("grid {:?}, L1 node at word {at}: {what}", grid.name))
                        })?;
                    }
                }
                Link::Constant { index, .. } => {
                    return corrupt(format!("root constant {index} of {constants}"));
                }
            }
        }
        for frame in &grid.frames {
            if frame.chunks.iter().any(|&c| c as usize >= pack.chunk_count()) || !frame.chunks.is_sorted() {
                return corrupt(format!(
                    "grid {:?} frame {} lists chunks that are not there",
                    grid.name, frame.record.number
                ));
            }
            if frame.record.transform.iter().any(|v| !v.is_finite()) {
                return corrupt(format!(
                    "grid {:?} frame {} has no valid transform",
                    grid.name, frame.record.number
                ));
            }
        }
    }
    Ok(())
}

fn check_l1(words: &[u32], at: usize, cells: usize, nodes: u32, constants: u32) -> Result<(), String> {
    let (mask_words, rank_words) = l1_words(cells);
    let Some(head) = words.get(at..at + mask_words + rank_words).filter(|_| at >= HEADER_WORDS) else {
        return Err("it lies outside the tree".to_owned());
    };
    let (mask, ranks) = head.split_at(mask_words);
    if tree::ranks(mask) != ranks {
        return Err("wrong ranks".to_owned());
    }
    if !cells.is_multiple_of(32) && mask[mask_words - 1] >> (cells % 32) != 0 {
        return Err("children outside its cells".to_owned());
    }
    let children: usize = mask.iter().map(|w| w.count_ones() as usize).sum();
    let first = at + mask_words + rank_words;
    let Some(links) = words.get(first..first + children) else {
        return Err("its children lie outside the tree".to_owned());
    };
    for &word in links {
        match Link::from_word(word) {
            Link::Node(node) if node < nodes => {}
            Link::Constant { index, .. } if index < constants => {}
            link => return Err(format!("a child is {link:?}")),
        }
    }
    Ok(())
}
