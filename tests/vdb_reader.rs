//! The OpenVDB reader against what OpenVDB itself says of every fixture.

use std::path::{Path, PathBuf};

use serde_json::{Value as Json, json};
use volpack::vdb::{Accessor, Scalar, Tree, Value, VdbFile, with_scalar_type, with_value_type};
use volpack::volume::Coord;

fn fixtures() -> Vec<PathBuf> {
    let mut files: Vec<_> = std::fs::read_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/fixtures"))
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|e| e == "vdb"))
        .collect();
    files.sort();
    assert!(files.len() > 30, "the fixtures are missing");
    files
}

fn facts(path: &Path) -> Vec<Json> {
    let text = std::fs::read_to_string(path.with_extension("json")).unwrap();
    serde_json::from_str::<Json>(&text).unwrap()["grids"].as_array().unwrap().clone()
}

/// Equal, numbers to 1e-12 relative: the facts are printed with 17 digits.
fn assert_same(what: &str, ours: &Json, theirs: &Json) {
    let same = match (ours, theirs) {
        (Json::Array(a), Json::Array(b)) => {
            assert_eq!(a.len(), b.len(), "{what}");
            return a.iter().zip(b).for_each(|(a, b)| assert_same(what, a, b));
        }
        (Json::Number(a), Json::Number(b)) => {
            let (a, b) = (a.as_f64().unwrap(), b.as_f64().unwrap());
            (a - b).abs() <= 1e-12 * b.abs()
        }
        _ => ours == theirs,
    };
    assert!(same, "{what}: {ours}, OpenVDB says {theirs}");
}

#[test]
fn every_fixture_reads_as_openvdb_reads_it() {
    for path in fixtures() {
        let file = VdbFile::open(&path).unwrap();
        let facts = facts(&path);
        assert_eq!(file.grids.len(), facts.len(), "{}", path.display());
        for (grid, facts) in file.grids.iter().zip(&facts) {
            let what = format!("{} {}", path.display(), grid.name);
            let check = |key: &str, ours: Json| assert_same(&format!("{what} {key}"), &ours, &facts[key]);
            check("name", json!(grid.name));
            check("type", json!(grid.value_type.name()));
            check("half", json!(grid.half));
            check("class", json!(grid.class.name()));
            check("map", json!(grid.transform.map));
            if let Some(matrix) = grid.transform.matrix {
                check("matrix", json!(matrix));
            }
            with_value_type!(&grid.value_type,
                T => {
                    let tree = file.read_topology::<T>(grid).unwrap();
                    let topology = tree.topology_stats();
                    if !facts["background"].is_null() {
                        check("background", tree.background.to_json());
                    }
                    check("leaves", json!(topology.leaves));
                    check("active_voxels", json!(topology.active_voxels));
                    check("root_tiles", json!(topology.root_tiles));
                    check("l1_tiles", json!(topology.l1_tiles));
                    check("l2_tiles", json!(topology.l2_tiles));
                    check("bbox", json!(topology.bbox.to_array()));
                },
                name => panic!("{what}: type {name}")
            );
            with_scalar_type!(&grid.value_type,
                T => {
                    let tree = file.read_tree::<T>(grid).unwrap();
                    let stats = tree.value_stats();
                    check("active_leaf_voxels", json!(tree.topology_stats().active_leaf_voxels));
                    check("min", json!(stats.min));
                    check("max", json!(stats.max));
                    check("sum", json!(stats.sum));
                    check("nonfinite", json!(stats.nonfinite));
                    check("inactive_leaf_sum", json!(inactive_leaf_sum(&tree)));
                    check_probes(&what, &tree, facts);
                },
                _other => {}
            );
        }
    }
}

fn inactive_leaf_sum<T: Scalar>(tree: &Tree<T>) -> f64 {
    let leaves = &tree.leaves;
    (0..leaves.len())
        .flat_map(|i| {
            (0..512).filter(move |&v| !leaves.masks[i].get(v)).map(move |v| leaves.values(i)[v].to_f64())
        })
        .filter(|v| v.is_finite())
        .sum()
}

fn check_probes<T: Scalar>(what: &str, tree: &Tree<T>, facts: &Json) {
    let accessor = Accessor::new(tree);
    let probes = facts["probes"].as_array().unwrap();
    for probe in probes {
        let at: [i32; 3] = std::array::from_fn(|a| probe[a].as_i64().unwrap() as i32);
        let bits = u64::from_str_radix(probe[3].as_str().unwrap(), 16).unwrap();
        let (value, active) = accessor.get(Coord(at));
        // A NaN's payload is not OpenVDB's to keep.
        let expected = f64::from_bits(bits);
        assert!(
            value.to_f64().to_bits() == bits || value.to_f64().is_nan() && expected.is_nan(),
            "{what} at {at:?}: {}, OpenVDB says {expected}",
            value.to_f64()
        );
        assert_eq!(active, probe[4].as_bool().unwrap(), "{what} at {at:?}");
    }
}
