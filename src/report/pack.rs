//! A pack in figures.

use std::collections::{BTreeMap, BTreeSet};

use schemars::JsonSchema;
use serde::Serialize;

use crate::codec::Codec;
use crate::pack::tree::{MASK_WORDS, RECORD_WORDS, header};
use crate::pack::{Atlas, Pack};

/// A pack's sizes and counts.
#[derive(Clone, Debug, Serialize, JsonSchema)]
pub struct PackSummary {
    /// The grids' names.
    pub grids: Vec<String>,
    /// Distinct frame numbers.
    pub frames: u64,
    /// 8³ regions over all frames, shared ones counted each time.
    pub bricks: u64,
    /// Distinct 8³ regions.
    pub unique_bricks: u64,
    /// Distinct 8³ regions and their texels by codec.
    pub codecs: BTreeMap<&'static str, CodecSummary>,
    /// Bytes of the tree without masks.
    pub tree_bytes: u64,
    /// Bytes of masks.
    pub mask_bytes: u64,
    /// Bytes of texture pages.
    pub texel_bytes: u64,
    /// What a GPU has to hold: tree, masks and texels.
    pub gpu_bytes: u64,
    /// Bytes of the file.
    pub file_bytes: u64,
    /// GPU bits for each voxel of the source's leaves, before any sharing.
    pub bits_per_voxel: f64,
    /// Distinct L2 nodes.
    pub l2_nodes: u64,
    /// Leaves of the source over all frames.
    pub source_leaves: u64,
}

/// The bricks of one codec.
#[derive(Clone, Copy, Debug, Default, Serialize, JsonSchema)]
pub struct CodecSummary {
    /// How many there are.
    pub bricks: u64,
    /// Bytes of their texture pages.
    pub bytes: u64,
    /// Those as a part of all texture pages.
    pub share_of_bytes: f64,
    /// The squared error of their voxels as a part of the pack's, each grid against its own range of values.
    pub share_of_error: f64,
}

impl PackSummary {
    /// Counts what is in a pack.
    pub fn new(pack: &Pack) -> Self {
        let words = pack.tree();
        let record_at = words[header::RECORD_AT] as usize;
        let record = |i: &u32| &words[record_at + *i as usize * RECORD_WORDS..][..RECORD_WORDS];
        let mut unique: Vec<u32> = (0..words[header::RECORDS]).collect();
        unique.sort_unstable_by_key(|i| record(i));
        unique.dedup_by_key(|i| record(i));
        let mut codecs: BTreeMap<&'static str, CodecSummary> = BTreeMap::new();
        for i in &unique {
            let codec = Codec::from_tag(record(i)[0] & 7).expect("the pack was checked");
            codecs.entry(codec.name()).or_default().bricks += 1;
        }
        for atlas in pack.atlases() {
            codecs.entry(atlas.codec.name()).or_default().bytes = atlas.bytes();
        }

        let squares = squares_by_codec(pack);
        let error: f64 = squares.iter().sum();
        let texel_bytes: u64 = pack.atlases().iter().map(Atlas::bytes).sum();
        let part = |part: f64, whole: f64| if whole > 0.0 { part / whole } else { 0.0 };
        for (tag, squares) in squares.into_iter().enumerate() {
            let codec = Codec::from_tag(tag as u32).expect("one for each codec");
            if squares > 0.0 || codecs.contains_key(codec.name()) {
                let entry = codecs.entry(codec.name()).or_default();
                entry.share_of_bytes = part(entry.bytes as f64, texel_bytes as f64);
                entry.share_of_error = part(squares, error);
            }
        }

        let frames: BTreeSet<i32> =
            pack.grids().iter().flat_map(|g| g.frames.iter().map(|f| f.record.number)).collect();
        // Nothing in a pack bounds what it says of its source.
        let leaves = pack.grids().iter().flat_map(|g| g.frames.iter().map(|f| f.record.leaves));
        let source_leaves = leaves.fold(0, u64::saturating_add);
        let mask_bytes = u64::from(words[header::MASKS]) * MASK_WORDS as u64 * 4;
        let tree_bytes = words.len() as u64 * 4 - mask_bytes;
        let gpu_bytes = pack.gpu_bytes();
        Self {
            grids: pack.grids().iter().map(|g| g.name.clone()).collect(),
            frames: frames.len() as u64,
            bricks: pack.region_count(),
            unique_bricks: unique.len() as u64,
            codecs,
            tree_bytes,
            mask_bytes,
            texel_bytes,
            gpu_bytes,
            file_bytes: pack.file_bytes(),
            bits_per_voxel: if source_leaves == 0 {
                0.0
            } else {
                gpu_bytes as f64 * 8.0 / (512.0 * source_leaves as f64)
            },
            l2_nodes: words[header::NODES].into(),
            source_leaves,
        }
    }
}

/// What each codec cost, by tag, in squared ranges of each grid's active values.
fn squares_by_codec(pack: &Pack) -> [f64; Codec::COUNT] {
    let mut squares = [0.0; Codec::COUNT];
    for grid in pack.grids() {
        let peak = grid.peak();
        for (sum, error_l2) in squares.iter_mut().zip(grid.record.codec_error_l2s) {
            let error_l2 = f64::from(error_l2);
            let relative = error_l2 / peak;
            if relative.is_finite() {
                *sum += relative * relative;
            }
        }
    }
    squares
}
