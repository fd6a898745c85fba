//! `vdb-rs` as a second opinion, on the fixtures that it reads right: fog in 32-bit floats
//! (`docs/decisions/0001-own-vdb-reader.md` says what it gets wrong).

// vdb-rs does not link with MinGW: see Cargo.toml.
#![cfg(not(all(windows, target_env = "gnu")))]

mod common;

use std::fs::File;
use std::io::BufReader;

use common::fixture;
use vdb_rs::VdbReader;
use volpack::vdb::{Accessor, VdbFile};
use volpack::volume::Coord;

#[test]
fn vdb_rs_sees_the_same_active_voxels() {
    for name in ["fog_float_none", "fog_float_zip", "fog_float_blosc", "fog_float_zip_nomask"] {
        let path = fixture(&format!("{name}.vdb"));
        let mut theirs = VdbReader::new(BufReader::new(File::open(&path).unwrap())).unwrap();
        let theirs = theirs.read_grid::<f32>("density").unwrap();

        let file = VdbFile::open(&path).unwrap();
        let tree = file.read_tree::<f32>(&file.grids[0]).unwrap();
        let ours = Accessor::new(&tree);
        let mut voxels = 0;
        for (at, value, _) in theirs.iter() {
            let at = Coord(at.as_ivec3().to_array());
            assert_eq!(ours.get(at), (value, true), "{name} at {at:?}");
            voxels += 1;
        }
        assert_eq!(voxels, tree.topology_stats().active_voxels, "{name}");
    }
}
