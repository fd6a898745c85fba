//! Writes small OpenVDB files, so that a test can make exactly the input that it is about.
//!
//! The layout is that of OpenVDB's `io/Archive.cc` and the tree nodes' `writeTopology` / `writeBuffers`, file version
//! 224 unless asked for another: inner nodes with mask compression and nothing but background in their tiles, leaves with all 512 values.

#![allow(dead_code)] // Each test file uses a part of it.

use std::collections::BTreeMap;
use std::path::Path;

use bytemuck::Pod;
use volpack::volume::{BRICK_VOXELS, Coord, Mask512};

/// `io::COMPRESS_ACTIVE_MASK`.
const ACTIVE_MASK: u32 = 2;
/// `io::COMPRESS_BLOSC`.
pub const BLOSC: u32 = 4;
/// A node's value modes: inactive values are the background; every value is stored.
const BACKGROUND: u8 = 0;
const ALL_VALUES: u8 = 6;

/// One grid with values of type `V`, which must be the type that `tree_type` names.
pub struct GridFile<V> {
    /// The grid's name.
    pub name: String,
    /// The grid type as the file has it, for instance `Tree_float_5_4_3`.
    pub tree_type: String,
    /// Text metadata, for instance `class`.
    pub metadata: Vec<(String, String)>,
    /// Boolean metadata, for instance `is_saved_as_half_float`.
    pub flags: Vec<(String, bool)>,
    /// The value outside everything.
    pub background: V,
    /// The voxels' edge in world units.
    pub voxel_size: f64,
    /// Where voxel 0 is in world space.
    pub translation: [f64; 3],
    /// Leaves by their smallest corner, a multiple of 8: values x slowest, and which of them are active.
    pub leaves: BTreeMap<Coord, ([V; BRICK_VOXELS], Mask512)>,
    /// `io::COMPRESS_*` flags beside that of active masks.
    pub compression: u32,
    /// A leaf's values as the file has them.
    pub stored: fn(&[V]) -> Vec<u8>,
    /// What lies between the last leaf's values and the grid's end.
    pub left_over: Vec<u8>,
}

/// A grid's name, its type, and its bytes behind the descriptor.
pub type Part = (String, String, Vec<u8>);

impl<V: Pod> GridFile<V> {
    /// A grid without leaves.
    pub fn new(name: &str, tree_type: &str, background: V) -> Self {
        Self {
            name: name.to_owned(),
            tree_type: tree_type.to_owned(),
            metadata: Vec::new(),
            flags: Vec::new(),
            background,
            voxel_size: 0.1,
            translation: [0.0; 3],
            leaves: BTreeMap::new(),
            compression: 0,
            stored: |values| bytemuck::cast_slice(values).to_vec(),
            left_over: Vec::new(),
        }
    }

    /// The same of a class: `level set` or `fog volume`.
    pub fn of_class(mut self, class: &str) -> Self {
        self.metadata.push(("class".to_owned(), class.to_owned()));
        self
    }

    /// Fills a box of `leaves` leaves an axis from voxel 0 on: `value` gives a voxel's value and whether it is active.
    pub fn fill(mut self, leaves: [i32; 3], value: impl Fn([i32; 3]) -> (V, bool)) -> Self {
        for x in 0..leaves[0] {
            for y in 0..leaves[1] {
                for z in 0..leaves[2] {
                    let origin = Coord::new(8 * x, 8 * y, 8 * z);
                    let mut active = Mask512::NONE;
                    let values = std::array::from_fn(|i| {
                        let at = origin.offset_by(Coord::child_offset(i, 3, 1)).0;
                        let (value, is_active) = value(at);
                        if is_active {
                            active.set(i);
                        }
                        value
                    });
                    self.leaves.insert(origin, (values, active));
                }
            }
        }
        self
    }

    /// The grid as a part of a file.
    pub fn part(&self) -> Part {
        (self.name.clone(), self.tree_type.clone(), self.body())
    }

    /// The grid behind its descriptor.
    fn body(&self) -> Vec<u8> {
        let mut out = Vec::new();
        out.extend((self.compression | ACTIVE_MASK).to_le_bytes());
        out.extend(((self.metadata.len() + self.flags.len()) as u32).to_le_bytes());
        for (key, value) in &self.metadata {
            for part in [key, "string", value] {
                string(&mut out, part);
            }
        }
        for (key, value) in &self.flags {
            string(&mut out, key);
            string(&mut out, "bool");
            out.extend([1, 0, 0, 0, u8::from(*value)]);
        }
        string(&mut out, "UniformScaleTranslateMap");
        self.translation.iter().for_each(|value| out.extend(value.to_le_bytes()));
        // Scale, voxel size, and three inverses derived from the scale.
        let (s, inverse) = (self.voxel_size, 1.0 / self.voxel_size);
        for value in [s, s, inverse, inverse * inverse, inverse / 2.0] {
            (0..3).for_each(|_| out.extend(value.to_le_bytes()));
        }
        self.tree(&mut out);
        out.extend(&self.left_over);
        out
    }

    fn tree(&self, out: &mut Vec<u8>) {
        let mut roots: BTreeMap<Coord, BTreeMap<Coord, Vec<Coord>>> = BTreeMap::new();
        for &origin in self.leaves.keys() {
            let cells = roots.entry(origin.align_down(4096)).or_default();
            cells.entry(origin.align_down(128)).or_default().push(origin);
        }
        out.extend(1u32.to_le_bytes());
        out.extend(bytemuck::bytes_of(&self.background));
        out.extend(0u32.to_le_bytes());
        out.extend((roots.len() as u32).to_le_bytes());
        // A file has children in the order of their bits: x slowest, as coordinates compare.
        let mut order = Vec::new();
        for (root, cells) in &roots {
            root.0.iter().for_each(|v| out.extend(v.to_le_bytes()));
            self.inner_node(out, cells.keys().map(|cell| cell.child_index(5, 128)), 1 << 15);
            for leaves in cells.values() {
                self.inner_node(out, leaves.iter().map(|leaf| leaf.child_index(4, 8)), 1 << 12);
                for leaf in leaves {
                    out.extend(self.leaves[leaf].1.to_words().iter().flat_map(|word| word.to_le_bytes()));
                    order.push(*leaf);
                }
            }
        }
        for leaf in order {
            let (values, active) = &self.leaves[&leaf];
            out.extend(active.to_words().iter().flat_map(|word| word.to_le_bytes()));
            out.push(ALL_VALUES);
            out.extend((self.stored)(values));
        }
    }

    /// An inner node of so many places with children at some of them, and tiles of inactive background at the others.
    fn inner_node(&self, out: &mut Vec<u8>, children: impl Iterator<Item = usize>, places: usize) {
        let mut mask = vec![0u8; places / 8];
        children.for_each(|place| mask[place / 8] |= 1 << (place % 8));
        out.extend(&mask);
        out.extend(vec![0u8; places / 8]);
        out.push(BACKGROUND);
        if self.compression != 0 {
            // No value is stored, which takes no bytes.
            out.extend(0i64.to_le_bytes());
        }
    }
}

fn string(out: &mut Vec<u8>, text: &str) {
    out.extend((text.len() as u32).to_le_bytes());
    out.extend(text.as_bytes());
}

/// The bytes of a file of some grids.
pub fn file(version: u32, has_offsets: bool, grids: &[Part]) -> Vec<u8> {
    let mut out = Vec::new();
    out.extend(0x5644_4220u64.to_le_bytes());
    for word in [version, 10, 0] {
        out.extend(word.to_le_bytes());
    }
    out.push(u8::from(has_offsets));
    out.extend(b"00000000-0000-0000-0000-000000000000");
    out.extend(0u32.to_le_bytes());
    out.extend((grids.len() as i32).to_le_bytes());
    for (name, tree_type, body) in grids {
        for part in [&**name, tree_type, ""] {
            string(&mut out, part);
        }
        let start = out.len() as u64 + 24;
        // Where its blocks begin is not used by any reader.
        for offset in [start, start, start + body.len() as u64] {
            out.extend(if has_offsets { offset } else { 0 }.to_le_bytes());
        }
        out.extend(body);
    }
    out
}

/// The bytes of a file of one grid.
pub fn one_grid<V: Pod>(grid: &GridFile<V>) -> Vec<u8> {
    file(224, true, &[grid.part()])
}

/// Writes a file of one grid.
pub fn write_grid<V: Pod>(path: &Path, grid: &GridFile<V>) {
    std::fs::write(path, one_grid(grid)).unwrap();
}
