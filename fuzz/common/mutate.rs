//! Damages files the same way every time: a case is its number and a seed, no more.

use std::ops::Range;

use super::reseal::reseal;
use super::seeds::Seed;

/// Longest block that is duplicated, removed or zeroed.
const MAX_BLOCK: usize = 4096;

/// Lengths, counts and offsets that code gets wrong.
const WORDS: [u64; 18] = [
    0,
    1,
    2,
    0x7f,
    0x80,
    0xff,
    0x7fff,
    0xffff,
    0x1_0000,
    0x7fff_ffff,
    0x8000_0000,
    0xffff_fffe,
    0xffff_ffff,
    0x1_0000_0000,
    0x7fff_ffff_ffff_ffff,
    0x8000_0000_0000_0000,
    0xffff_ffff_ffff_ff00,
    u64::MAX,
];

/// A small generator (xorshift64*), so that a case is the same on every machine and for ever.
pub struct Rng(u64);

impl Rng {
    /// The generator of one case.
    pub fn new(seed: u64, case: u64) -> Self {
        // Neighbouring cases must not resemble each other, and the state must not be zero.
        let mut rng = Self((seed ^ case.wrapping_mul(0x9e37_79b9_7f4a_7c15)) | 1);
        for _ in 0..8 {
            rng.bits();
        }
        rng
    }

    fn bits(&mut self) -> u64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        self.0.wrapping_mul(0x2545_f491_4f6c_dd1d)
    }

    /// A number below `n`, which is not 0.
    pub fn below(&mut self, n: usize) -> usize {
        ((u128::from(self.bits()) * n as u128) >> 64) as usize
    }

    fn pick<'a, T>(&mut self, all: &'a [T]) -> &'a T {
        &all[self.below(all.len())]
    }
}

/// One damaged file.
pub struct Case {
    /// What it was made from, for a message.
    pub name: String,
    /// Its bytes.
    pub bytes: Vec<u8>,
}

/// A damaged OpenVDB file.
pub fn vdb_case(seeds: &[Seed], seed: u64, case: u64) -> Case {
    let mut rng = Rng::new(seed, case);
    let from = rng.pick(seeds);
    Case { name: from.name.clone(), bytes: mutate(&mut rng, from, seeds) }
}

/// A damaged pack. Odd cases have their digests made anew, without which nothing behind the digests
/// would ever see a wrong byte.
pub fn pack_case(seeds: &[Seed], seed: u64, case: u64) -> Case {
    let mut rng = Rng::new(!seed, case);
    let from = rng.pick(seeds);
    let mut bytes = mutate(&mut rng, from, seeds);
    let sealed = case % 2 == 1;
    if sealed {
        reseal(&mut bytes);
    }
    let name = if sealed { format!("{} resealed", from.name) } else { from.name.clone() };
    Case { name, bytes }
}

fn mutate(rng: &mut Rng, from: &Seed, seeds: &[Seed]) -> Vec<u8> {
    let mut bytes = from.bytes.clone();
    // One damage mostly: the first thing that is wrong hides what is behind it.
    let steps = *rng.pick(&[1, 1, 1, 2, 4]);
    for _ in 0..steps {
        let other = &rng.pick(seeds).bytes;
        step(rng, &mut bytes, &from.hot, other);
    }
    bytes
}

fn step(rng: &mut Rng, bytes: &mut Vec<u8>, hot: &[Range<usize>], other: &[u8]) {
    if bytes.is_empty() {
        return;
    }
    let area = area(rng, bytes.len(), hot);
    match rng.below(13) {
        0..=2 => {
            for _ in 0..*rng.pick(&[1, 1, 2, 4, 16]) {
                bytes[at(rng, &area)] ^= 1 << rng.below(8);
            }
        }
        3 => {
            for _ in 0..1 + rng.below(4) {
                bytes[at(rng, &area)] = *rng.pick(&[0, 0xff, 0x7f, 0x80]);
            }
        }
        4..=6 => {
            let at = at(rng, &area);
            word::<4>(rng, bytes, at);
        }
        7 => {
            let at = at(rng, &area);
            word::<8>(rng, bytes, at);
        }
        8 => bytes.truncate(at(rng, &area)),
        9 => {
            let block = block(rng, &area);
            let copy = bytes[block.clone()].to_vec();
            let place = if rng.below(2) == 0 { block.end } else { rng.below(bytes.len() + 1) };
            bytes.splice(place..place, copy);
        }
        10 => {
            let block = block(rng, &area);
            if rng.below(2) == 0 {
                bytes.drain(block);
            } else {
                bytes[block].fill(0);
            }
        }
        11 => {
            let at = at(rng, &area);
            if rng.below(2) == 0 { same_words::<4>(rng, bytes, at) } else { same_words::<8>(rng, bytes, at) }
        }
        // The front of one file and the back of another, or a piece of it in the middle.
        _ => {
            let place = at(rng, &area);
            if rng.below(2) == 0 {
                bytes.truncate(place);
                bytes.extend(other.get(place..).unwrap_or_default());
            } else if !other.is_empty() {
                let piece = block(rng, &(0..other.len()));
                let piece = &other[piece];
                let len = piece.len().min(bytes.len() - place);
                bytes[place..place + len].copy_from_slice(&piece[..len]);
            }
        }
    }
}

/// Where to do damage: half of the time where the file is dense with lengths and counts.
fn area(rng: &mut Rng, len: usize, hot: &[Range<usize>]) -> Range<usize> {
    let hot = if hot.is_empty() || rng.below(2) == 0 { 0..len } else { rng.pick(hot).clone() };
    // An earlier step may have cut the file short.
    if hot.start < len.min(hot.end) { hot.start..hot.end.min(len) } else { 0..len }
}

/// A place in an area, four times in five one where a 32-bit word can begin.
fn at(rng: &mut Rng, area: &Range<usize>) -> usize {
    let at = area.start + rng.below(area.len());
    if rng.below(5) > 0 { (at & !3).max(area.start) } else { at }
}

fn block(rng: &mut Rng, area: &Range<usize>) -> Range<usize> {
    let start = at(rng, area);
    let longest = (area.end - start).min(*rng.pick(&[4, 16, 256, MAX_BLOCK]));
    start..start + 1 + rng.below(longest)
}

/// Overwrites a little-endian word with a boundary value, a neighbour of what it was, or anything.
fn word<const BYTES: usize>(rng: &mut Rng, bytes: &mut [u8], at: usize) {
    let len = BYTES.min(bytes.len() - at);
    let mut old = [0; 8];
    old[..len].copy_from_slice(&bytes[at..at + len]);
    let old = u64::from_le_bytes(old);
    let new = match rng.below(8) {
        0..=3 => *rng.pick(&WORDS),
        4 => old.wrapping_add(1),
        5 => old.wrapping_sub(1),
        6 => old.wrapping_mul(*rng.pick(&[2, 3, 256, u64::MAX])),
        _ => rng.bits(),
    };
    bytes[at..at + len].copy_from_slice(&new.to_le_bytes()[..len]);
}

/// Overwrites every copy of a word, so that an offset or a count that is written down twice still agrees
/// with itself.
fn same_words<const BYTES: usize>(rng: &mut Rng, bytes: &mut [u8], at: usize) {
    let at = at & !3;
    let Some(old) = bytes.get(at..at + BYTES).map(<[u8]>::to_vec) else { return };
    word::<BYTES>(rng, bytes, at);
    let new = bytes[at..at + BYTES].to_vec();
    if old.iter().any(|&byte| byte != 0) {
        for place in (0..=bytes.len() - BYTES).step_by(4) {
            if bytes[place..place + BYTES] == old {
                bytes[place..place + BYTES].copy_from_slice(&new);
            }
        }
    }
}
