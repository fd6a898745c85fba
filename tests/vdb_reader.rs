//! The OpenVDB reader against what OpenVDB itself says of every fixture.

mod common;

use common::{facts, fixtures, probes};
use serde_json::{Value as Json, json};
use volpack::vdb::{Accessor, Scalar, Tree, Value, VdbFile, with_scalar_type, with_value_type};
use volpack::volume::Coord;

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
                    check("min", json!(stats.min.map(Value::to_json)));
                    check("max", json!(stats.max.map(Value::to_json)));
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
    for (at, expected, expected_active) in probes(facts) {
        let (value, active) = accessor.get(Coord(at));
        // A NaN's payload is not OpenVDB's to keep.
        let same =
            value.to_f64().to_bits() == expected.to_bits() || value.to_f64().is_nan() && expected.is_nan();
        assert!(same, "{what} at {at:?}: {}, OpenVDB says {expected}", value.to_f64());
        assert_eq!(active, expected_active, "{what} at {at:?}");
    }
}
