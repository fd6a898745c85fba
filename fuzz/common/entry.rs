//! The two doors through which bytes from outside come in. Neither may panic, abort, hang, or take much
//! more memory than the bytes themselves, whatever they are.

use std::path::Path;

use volpack::component::Component;
use volpack::error::Error;
use volpack::pack::{FrameReader, Pack, Provenance, Region};
use volpack::report::PackSummary;
use volpack::settings::NonFinite;
use volpack::stages::flatten::flatten;
use volpack::vdb::{Accessor, GridInfo, Value, VdbFile, with_scalar_type, with_value_type};
use volpack::volume::Coord;

/// Places where arithmetic on coordinates would wrap, and some that are just outside a box.
const FAR: [i32; 8] = [0, -1, 7, 4095, -4096, 1 << 20, i32::MIN, i32::MAX];

/// Bricks that are decoded of one pack. Nodes may be shared, so a small file can name any number of
/// them; whoever asks for each of them has asked for the time that it takes.
const MAX_BRICKS: u64 = 1 << 16;

/// Reads everything that an OpenVDB file has. Whether it was all accepted.
pub fn vdb(bytes: Vec<u8>) -> bool {
    match VdbFile::from_bytes(bytes) {
        Ok(file) => file.grids.iter().filter(|grid| !read_grid(&file, grid)).count() == 0,
        Err(error) => refused(&error),
    }
}

fn read_grid(file: &VdbFile, grid: &GridInfo) -> bool {
    let topology = with_value_type!(&grid.value_type,
        T => file.read_topology::<T>(grid).map(|tree| {
            tree.topology_stats();
            tree.background.to_json();
        }),
        _name => return false
    );
    if let Err(error) = topology {
        return refused(&error);
    }
    grid.transform.matrix.as_ref().map(volpack::vdb::voxel_size);
    grid.obstacle();
    if !grid.value_type.is_scalar() {
        return true;
    }
    let values = with_scalar_type!(&grid.value_type,
        T => file.read_tree::<T>(grid).map(|tree| {
            tree.value_stats();
            let accessor = Accessor::new(&tree);
            let corners = tree.leaves.origins.first().into_iter().chain(tree.leaves.origins.last());
            for at in corners.copied().chain(far()) {
                accessor.get(at);
            }
        }),
        _other => return false
    );
    if let Err(error) = values {
        return refused(&error);
    }
    match flatten(file, Path::new("fuzz.vdb"), grid, Component::Whole, NonFinite::Zero) {
        Ok(_) => true,
        Err(error) => refused::<Error>(&error),
    }
}

/// Opens and checks a pack and decodes every brick of it. Whether it was all accepted.
pub fn pack(bytes: Vec<u8>) -> bool {
    let pack = match Pack::from_bytes(bytes) {
        Ok(pack) => pack,
        Err(error) => return refused(&error),
    };
    let mut accepted = match pack.check_chunks() {
        Ok(()) => true,
        Err(error) => refused(&error),
    };
    accepted &= match Provenance::of(&pack) {
        Ok(_) => true,
        Err(error) => refused(&error),
    };
    let summary = PackSummary::new(&pack);
    for (g, grid) in pack.grids().iter().enumerate() {
        for f in 0..grid.frames.len() {
            accepted &= match pack.frame(g, f) {
                Ok(reader) => read_frame(&reader, summary.bricks <= MAX_BRICKS),
                Err(error) => refused(&error),
            };
        }
    }
    accepted
}

fn read_frame(reader: &FrameReader, decode: bool) -> bool {
    let mut accepted = true;
    let mut read = |region| {
        if let Region::Brick(record) = region {
            accepted &= match reader.decode(&record) {
                Ok(_) => true,
                Err(error) => refused(&error),
            };
        }
    };
    let bbox = reader.frame().record.bbox;
    let origin = reader.grid().origin;
    let corners = [origin, Coord::new(bbox[0], bbox[1], bbox[2]), Coord::new(bbox[3], bbox[4], bbox[5])];
    for at in corners.into_iter().chain(far()) {
        read(reader.locate(at).0);
    }
    if decode {
        reader.for_each_region(|at, _, region| {
            reader.locate(at);
            read(region);
        });
    }
    accepted
}

/// Every triple of [`FAR`] places.
fn far() -> impl Iterator<Item = Coord> {
    (0..FAR.len().pow(3)).map(|i| Coord::new(FAR[i / 64], FAR[i / 8 % 8], FAR[i % 8]))
}

/// Says an error as a user would see it, which may not panic either.
fn refused<E: std::error::Error>(error: &E) -> bool {
    let _ = error.to_string();
    false
}
