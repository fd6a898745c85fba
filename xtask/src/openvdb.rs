//! Compares what volpack reads with what OpenVDB reads.

use std::error::Error;
use std::path::PathBuf;
use std::process::Command;

use serde_json::Value as Json;
use volpack::report::VdbSummary;
use volpack::vdb::{Accessor, Scalar, VdbFile, with_scalar_type};
use volpack::volume::Coord;

use crate::peer_programs;

/// Keys that must be equal, numbers to this relative difference: both sides print 17 digits.
const KEYS: [&str; 15] = [
    "type",
    "half",
    "class",
    "map",
    "matrix",
    "background",
    "leaves",
    "active_voxels",
    "root_tiles",
    "l1_tiles",
    "l2_tiles",
    "bbox",
    "active_leaf_voxels",
    "min",
    "max",
];
const TOLERANCE: f64 = 1e-12;
/// Sums are added in another order.
const SUM_TOLERANCE: f64 = 1e-9;

/// Checks every grid of every file.
pub fn check(files: &[PathBuf]) -> Result<(), Box<dyn Error>> {
    let facts_of = peer_programs::compile_openvdb("fixtures/make_fixtures.cpp")?;
    let mut differences = 0;
    for path in files {
        let output = Command::new(&facts_of).arg("--facts").arg(path).output()?;
        if !output.status.success() {
            return Err(format!("{}: {}", path.display(), String::from_utf8_lossy(&output.stderr)).into());
        }
        let facts: Json = serde_json::from_slice(&output.stdout)?;
        let ours = serde_json::to_value(VdbSummary::read(path, true)?)?;
        let file = VdbFile::open(path)?;
        let grids = facts["grids"].as_array().ok_or("no grids")?;
        let mut probes = 0;
        for theirs in grids {
            let found = ours["grids"].as_array().and_then(|g| g.iter().find(|g| g["name"] == theirs["name"]));
            let Some(ours) = found else {
                println!("{}: no grid {}", path.display(), theirs["name"]);
                differences += 1;
                continue;
            };
            let wrong = KEYS
                .iter()
                .map(|key| (key, TOLERANCE))
                .chain([(&"sum", SUM_TOLERANCE), (&"nonfinite", 0.0)])
                .filter(|(key, tolerance)| {
                    !theirs[**key].is_null() && !same(&ours[**key], &theirs[**key], *tolerance)
                });
            for (key, _) in wrong {
                println!("{} {} {key}: {}, OpenVDB {}", path.display(), ours["name"], ours[key], theirs[key]);
                differences += 1;
            }
            let (checked, wrong) = check_probes(&file, theirs)?;
            probes += checked;
            differences += wrong;
        }
        println!("{}: {} grids, {probes} single voxels compared", path.display(), grids.len());
    }
    if differences > 0 { Err(format!("{differences} differences").into()) } else { Ok(()) }
}

fn same(a: &Json, b: &Json, tolerance: f64) -> bool {
    match (a, b) {
        (Json::Array(a), Json::Array(b)) => {
            a.len() == b.len() && a.iter().zip(b).all(|(a, b)| same(a, b, tolerance))
        }
        (Json::Number(a), Json::Number(b)) => {
            let (a, b) = (a.as_f64().unwrap_or(f64::NAN), b.as_f64().unwrap_or(f64::NAN));
            (a - b).abs() <= tolerance * b.abs()
        }
        _ => a == b,
    }
}

/// How many voxels were compared, and how many differ by a bit.
fn check_probes(file: &VdbFile, facts: &Json) -> Result<(usize, usize), Box<dyn Error>> {
    let Some(probes) = facts["probes"].as_array() else { return Ok((0, 0)) };
    let grid = file.grids.iter().find(|g| facts["name"] == g.name).ok_or("no such grid")?;
    Ok(with_scalar_type!(&grid.value_type,
        T => {
            let tree = file.read_tree::<T>(grid)?;
            let accessor = Accessor::new(&tree);
            let wrong = probes.iter().filter(|probe| {
                let at: [i32; 3] = std::array::from_fn(|a| probe[a].as_i64().unwrap_or(0) as i32);
                let (value, active) = accessor.get(Coord(at));
                let bits = format!("{:016x}", value.to_f64().to_bits());
                let same = probe[3] == bits.as_str() && probe[4] == active;
                if !same {
                    println!("{} {at:?}: {bits} {active}, OpenVDB {} {}", grid.name, probe[3], probe[4]);
                }
                !same
            });
            (probes.len(), wrong.count())
        },
        _other => (0, 0)
    ))
}
