use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use super::*;

fn paths(names: &[&str]) -> Vec<PathBuf> {
    names.iter().map(|name| PathBuf::from(format!("{name}.vdb"))).collect()
}

/// The numbers of some files, and what is odd about them.
fn numbers(names: &[&str]) -> (Vec<i32>, Vec<String>) {
    let Numbering { numbers, warnings } = number(&paths(names)).unwrap();
    (numbers, warnings)
}

/// The numbers of files that nothing is odd about.
fn plain(names: &[&str]) -> Vec<i32> {
    let (numbers, warnings) = numbers(names);
    assert_eq!(warnings, [""; 0], "{names:?}");
    numbers
}

#[test]
fn the_number_that_varies_is_the_frame() {
    assert_eq!(plain(&["smoke_0001_v2", "smoke_0002_v2", "smoke_0003_v2"]), [1, 2, 3]);
    assert_eq!(plain(&["smoke_8_128x128", "smoke_9_128x128", "smoke_10_128x128"]), [8, 9, 10]);
    assert_eq!(plain(&["fire2_v03.0100", "fire2_v03.0101"]), [100, 101]);
    assert_eq!(plain(&["wedge.3.0001", "wedge.3.0002"]), [1, 2]);
    assert_eq!(plain(&["wedge.3.8", "wedge.3.9", "wedge.3.10"]), [8, 9, 10]);
    assert_eq!(plain(&["take9", "take10"]), [9, 10]);
    assert_eq!(plain(&["0002", "0001"]), [2, 1]);
    // The other number has gaps, or fewer values.
    let other = |names| numbers(names).0;
    assert_eq!(other(&["smoke_0001_812", "smoke_0002_977", "smoke_0003_990"]), [1, 2, 3]);
    assert_eq!(other(&["shot1_0001", "shot1_0002", "shot2_0003"]), [1, 2, 3]);
    assert_eq!(other(&["smoke_0001_v1", "smoke_0002_v2", "smoke_0003_v3"]), [1, 2, 3]);
}

#[test]
fn a_dash_behind_a_separator_is_a_minus_sign() {
    assert_eq!(plain(&["smoke_-0001", "smoke_0000", "smoke_0001"]), [-1, 0, 1]);
    assert_eq!(plain(&["smoke-0003", "smoke-0004"]), [3, 4]);
    assert_eq!(plain(&["smoke--001", "smoke-0000"]), [-1, 0]);
    assert_eq!(plain(&["smoke.-2", "smoke.-1"]), [-2, -1]);
    assert_eq!(plain(&["smoke_-0001.5", "smoke_-0001.0", "smoke_-0000.5"]), [-15, -10, -5]);
    let (_, warnings) = numbers(&["smoke_-0005", "smoke_-0001"]);
    assert_eq!(warnings, ["3 frames are missing from the sequence: -4 to -2"]);
}

#[test]
fn sub_frames_count_in_the_unit_that_they_share() {
    let quarters = ["smoke.0001.25", "smoke.0001.50", "smoke.0001.75", "smoke.0002.00"];
    assert_eq!(plain(&quarters), [125, 150, 175, 200]);
    assert_eq!(plain(&quarters[..3]), [125, 150, 175]);
    assert_eq!(plain(&["a.1.25", "a.1.5", "a.1.75"]), [125, 150, 175]);
    assert_eq!(plain(&["a.0001.0", "a.0001.5", "a.0002.0", "a.0002.5"]), [10, 15, 20, 25]);
    // Houdini's $FF leaves out what is zero.
    assert_eq!(plain(&["a.1", "a.1.5", "a.2", "a.2.5"]), [10, 15, 20, 25]);
    assert_eq!(plain(&["a.9.75_v2", "a.10_v2", "a.10.25_v2"]), [975, 1000, 1025]);
    assert_eq!(plain(&["a_1.33333", "a_1.66667", "a_2", "a_2.33333"]), [133_333, 166_667, 200_000, 233_333]);
    assert_eq!(plain(&["a.1.0417", "a.1.0833", "a.2.0000", "a.2.0417", "a.2.0833"])[2], 20_000);
    assert_eq!(plain(&["a.0001.25"]), [125]);
    // The numbers of parts, as they count up in each frame.
    assert_eq!(plain(&["a.0001.0", "a.0001.1", "a.0001.2", "a.0002.0", "a.0002.1"]), [10, 11, 12, 20, 21]);
    // Numbers behind a point that are no fractions.
    assert_eq!(numbers(&["smoke1.0001", "smoke2.0002"]).0, [1, 2]);
    assert_eq!(plain(&["shot.010.0100", "shot.010.0101"]), [100, 101]);

    let (_, warnings) = numbers(&["a.1", "a.1.5", "a.2.5", "a.3"]);
    assert_eq!(warnings, ["1 frame is missing from the sequence: 2"]);
    assert_eq!(
        plain(&["a_2000.1234567890", "a_2000.6", "a_2001.1"]),
        [2_000_123_457, 2_000_600_000, 2_001_100_000]
    );
    let (fine, warnings) = numbers(&["a_2000000000.3", "a_2000000000.2", "a_2000000001.1"]);
    assert!(fine == [1, 0, 2] && warnings[warnings.len() - 1].contains("too many decimals"), "{warnings:?}");
}

#[test]
fn one_file_has_the_number_that_looks_most_like_a_frame() {
    let one = |name| plain(&[name])[0];
    assert_eq!(one("plume_0012"), 12);
    assert_eq!(one("fire2_v03.0100"), 100);
    assert_eq!(one("take7_smoke"), 7);
    assert_eq!(one("smoke_0001_v2"), 1);
    assert_eq!(one("smoke_0001_128x128"), 1);
    assert_eq!(one("smoke_0007_512"), 7);
    assert_eq!(one("20240105_smoke_0003"), 3);
    for none in ["smoke", "smoke_v2", "smoke_128x128x128", "cloud_lod0", "smoke_2k", "99999999999"] {
        assert_eq!(one(none), 0, "{none}");
    }
    assert_eq!(number(&["smoke.0004".into()]).unwrap().numbers, [4]);
}

#[test]
fn oddities_name_the_files() {
    let odd = |names| numbers(names).1.join("\n");
    let stems = odd(&["a_0001", "b_0002"]);
    assert!(stems.contains("a_0001.vdb and b_0002.vdb differ in more than the frame number"), "{stems}");
    assert!(odd(&["smoke_0001_v1", "smoke_0002_v2"]).contains("smoke_0001_v1.vdb and smoke_0002_v2.vdb"));
    let (versions, warnings) = numbers(&["smoke_v1", "smoke_v2"]);
    assert!(versions == [1, 2] && warnings[0].contains("a version"), "{warnings:?}");
    let (in_order, warnings) = numbers(&["noise", "smoke_0001"]);
    assert!(in_order == [0, 1] && warnings[0].starts_with("noise.vdb has no frame number"), "{warnings:?}");

    let twice = |names: &[&str]| number(&paths(names)).unwrap_err().to_string();
    for names in [["a_1", "a_0001"], ["a_0001_v1", "a_0001_v2"], ["a.1.5", "a.1.50"], ["a_1", "b_1"]] {
        let names = [&names[..], &["a.2"][..usize::from(names[0] == "a.1.5")]].concat();
        let error = twice(&names);
        assert!(names[..2].iter().all(|name| error.contains(&format!("{name}.vdb"))), "{error}");
    }
}

#[test]
fn gaps_are_named() {
    let gaps = |names| numbers(names).1.join("\n");
    assert_eq!(gaps(&["a1", "a3"]), "1 frame is missing from the sequence: 2");
    assert_eq!(gaps(&["a1", "a3", "a7"]), "4 frames are missing from the sequence: 2, 4-6");
    // As fast as it would be without them.
    assert!(gaps(&["a_0.5", "a_1", "a_2000000000.5"]).starts_with("3999999998 frames are missing"));
}

proptest::proptest! {
    #[test]
    fn any_names_are_sorted_and_numbered(
        names in proptest::collection::btree_set("[ab_.xv -]{0,2}[0-9]{0,3}[._-]{0,2}[0-9]{0,9}[._-]{0,2}[0-9]{0,30}v?[0-9]?", 1..9)
    ) {
        let files = paths(&names.iter().map(String::as_str).collect::<Vec<_>>());
        if let Ok(Numbering { numbers, .. }) = number(&files) {
            assert_eq!(numbers.iter().collect::<BTreeSet<_>>().len(), files.len());
        }
        let found = sequences(&files);
        assert_eq!(found.iter().flat_map(|s| &s.files).collect::<BTreeSet<_>>(), files.iter().collect());
        for sequence in found.iter().filter(|s| s.files.len() > 1) {
            // What is one sequence has numbers in its order, unless two files are one frame.
            match number(&sequence.files) {
                Ok(Numbering { numbers, .. }) => assert!(numbers.is_sorted(), "{:?}: {numbers:?}", sequence.files),
                Err(error) => assert!(error.to_string().contains("both frame"), "{error}"),
            }
        }
    }
}

#[test]
fn a_folder_is_sorted_into_sequences() {
    let names = [
        "b/smoke_0001_v1",
        "b/smoke_0002_v1",
        "b/smoke_0001_v2",
        "b/smoke_0002_v2",
        "a/smoke_-1",
        "a/smoke_0",
        "a/smoke_10",
        "a/smoke_low_10",
        "a/cloud_v1",
        "a/cloud_v2",
        "a/sub.0001.50",
        "a/sub.0002.00",
    ];
    let found = sequences(&paths(&names));
    let shown: Vec<_> = found
        .iter()
        .map(|s| (s.before.as_str(), s.after.as_str(), s.files.len(), s.number_globs.join(" ")))
        .collect();
    let digit = "[0-9]";
    let expected = [
        ("cloud_v1", ".vdb", 1, String::new()),
        ("cloud_v2", ".vdb", 1, String::new()),
        ("smoke_", ".vdb", 3, format!("{digit} -{digit} {digit}{digit}")),
        ("smoke_low_", ".vdb", 1, digit.repeat(2)),
        ("sub.", ".vdb", 2, format!("{}.{}", digit.repeat(4), digit.repeat(2))),
        ("smoke_", "_v1.vdb", 2, digit.repeat(4)),
        ("smoke_", "_v2.vdb", 2, digit.repeat(4)),
    ];
    assert_eq!(shown, expected);
    assert_eq!(found[2].files[0], Path::new("a/smoke_-1.vdb"));
}
