//! The tree: one buffer of 32-bit words that a shader binds as it lies.
//!
//! This file has the words' places and meaning; `docs/format.md`, "The tree", is the specification.

use crate::codec::Codec;
use crate::{Constant, InactiveRule, NODE_CHILDREN};

/// Words of the tree's header.
pub const HEADER_WORDS: usize = 32;
/// Words of a grid's header.
pub const GRID_WORDS: usize = 16;
/// Words of an L2 node's mask, a bit a child.
pub const NODE_MASK_WORDS: usize = NODE_CHILDREN / 32;
/// The place of the first record's number in an L2 node, after the mask and its 16-bit ranks, one a word of the mask.
pub const NODE_FIRST_RECORD: usize = NODE_MASK_WORDS + NODE_MASK_WORDS / 2;
/// Words of an L2 node.
pub const NODE_WORDS: usize = NODE_FIRST_RECORD + 1;
/// Words of an L3 record.
pub const RECORD_WORDS: usize = 3;
/// Words of a mask.
pub const MASK_WORDS: usize = 16;

/// Places of words in the header.
#[allow(missing_docs)] // docs/format.md names each.
pub mod header {
    pub const WORDS: usize = 0;
    pub const GRIDS: usize = 1;
    pub const GRID_AT: usize = 2;
    pub const NODE_AT: usize = 3;
    pub const NODES: usize = 4;
    pub const RECORD_AT: usize = 5;
    pub const RECORDS: usize = 6;
    pub const MASK_AT: usize = 7;
    pub const MASKS: usize = 8;
    pub const CONSTANT_AT: usize = 9;
    pub const CONSTANTS: usize = 10;

    /// The place of a codec's atlas geometry: columns, rows, slabs a page.
    pub const fn atlas(codec: crate::codec::Codec) -> usize {
        12 + 4 * (codec as usize - 1)
    }
}

// The header has room for every codec, and a record's three bits for its tag.
const _: () = {
    assert!(Codec::COUNT <= 8);
    assert!(header::atlas(Codec::WITH_TEXELS[Codec::WITH_TEXELS.len() - 1]) + 4 <= HEADER_WORDS);
};

/// Places of words in a grid's header.
#[allow(missing_docs)] // docs/format.md names each.
pub mod grid {
    pub const ORIGIN: usize = 0;
    pub const CELLS: usize = 3;
    pub const ROOTS: usize = 6;
    pub const LO: usize = 9;
    pub const SPAN: usize = 10;
    pub const BACKGROUND: usize = 11;
    pub const ROOT_AT: usize = 12;
    pub const FRAMES: usize = 13;
}

const CONSTANT: u32 = 1 << 31;
const ACTIVE: u32 = 1 << 30;

/// A root's or an L1 node's child.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Link {
    /// The place of a value in the table of constants, and whether it is active.
    Constant {
        /// The place.
        index: u32,
        /// Whether its voxels are active.
        active: bool,
    },
    /// For a root, the word at which its L1 node begins; for an L1 node, the number of an L2 node.
    Node(u32),
}

impl Link {
    /// As one word.
    pub fn to_word(self) -> u32 {
        match self {
            Self::Constant { index, active } => CONSTANT | if active { ACTIVE } else { 0 } | index,
            Self::Node(node) => node,
        }
    }

    /// The inverse of [`Link::to_word`].
    pub fn from_word(word: u32) -> Self {
        if word & CONSTANT != 0 {
            Self::Constant { index: word & !(CONSTANT | ACTIVE), active: word & ACTIVE != 0 }
        } else {
            Self::Node(word)
        }
    }

    /// Places that a link to a constant can name.
    pub const MAX_CONSTANTS: u32 = ACTIVE;
}

/// An L3 record: one 8³ region.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct L3Record {
    /// The codec of its texels.
    pub codec: Codec,
    /// The axis that its channels run along, for bc7.
    pub axis: u8,
    /// Its place in the codec's atlas.
    pub slot: u32,
    /// Its active mask.
    pub mask: Option<u32>,
    /// What its inactive voxels are.
    pub rule: InactiveRule,
    /// For a constant its value's bits, else its [`crate::codec::BrickRange`].
    pub word2: u32,
}

impl L3Record {
    /// Slots that fit a record.
    pub const MAX_SLOTS: u32 = 1 << 27;
    /// Masks that fit a record; the number itself says that there is no mask.
    pub const NO_MASK: u32 = (1 << 30) - 1;

    /// As three words.
    pub fn to_words(self) -> [u32; 3] {
        let word0 = self.codec as u32 | u32::from(self.axis) << 3 | self.slot << 5;
        let word1 = self.mask.unwrap_or(Self::NO_MASK) | (self.rule as u32) << 30;
        [word0, word1, self.word2]
    }

    /// The inverse of [`L3Record::to_words`]; `None` for an unknown codec.
    pub fn from_words([word0, word1, word2]: [u32; 3]) -> Option<Self> {
        let mask = word1 & Self::NO_MASK;
        Some(Self {
            codec: Codec::from_tag(word0 & 7)?,
            axis: (word0 >> 3 & 3) as u8,
            slot: word0 >> 5,
            mask: (mask != Self::NO_MASK).then_some(mask),
            rule: InactiveRule::from_bits(word1 >> 30),
            word2,
        })
    }
}

/// Words of the mask of an L1 node of that many cells, and words of its ranks.
pub fn l1_words(cells: usize) -> (usize, usize) {
    let mask = cells.div_ceil(32);
    (mask, mask.div_ceil(2))
}

/// The running counts of `mask`'s bits before each of its words, two to a word, low half first.
pub fn ranks(mask: &[u32]) -> Vec<u32> {
    let mut ranks = vec![0u32; mask.len().div_ceil(2)];
    let mut before = 0;
    for (i, word) in mask.iter().enumerate() {
        ranks[i / 2] |= before << (16 * (i & 1));
        before += word.count_ones();
    }
    ranks
}

/// How many bits of `mask` are on before bit `index`, by way of the ranks; `None` if it is off.
///
/// # Panics
/// When the mask has no such bit, or not as many ranks as [`ranks`] gives.
pub fn rank(mask: &[u32], ranks: &[u32], index: usize) -> Option<u32> {
    let (word, bit) = (index / 32, index % 32);
    let bits = mask[word];
    let before = ranks[word / 2] >> (16 * (word & 1)) & 0xffff;
    (bits >> bit & 1 != 0).then(|| before + (bits & ((1 << bit) - 1)).count_ones())
}

/// A constant from the table and its link's state.
pub fn constant(bits: u32, active: bool) -> Constant {
    Constant { value: f32::from_bits(bits), active }
}
