//! Packs that were kept when version 1 of the format froze: every volpack reads them, and finds in them what their
//! sources say. They are never made anew.

mod common;

use std::path::{Path, PathBuf};

use common::fixture;
use volpack::pack::{Pack, PackError};
use volpack::verify::{Sources, voxels};

fn kept(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/v1").join(name)
}

#[test]
fn kept_packs_of_version_1_say_what_their_sources_say() {
    let animation = common::animation();
    let one = |name: &str| vec![fixture(name)];
    for (pack, sources, grids) in [
        // All codecs but the floats, texels that bricks share, no masks, zstd.
        ("adaptive.volpack", animation, 2),
        // Masks, rules for inactive voxels, chunks that are not packed.
        ("levelset.volpack", one("levelset_half.vdb"), 1),
        // Tiles of every level, lossless.
        ("tiles.volpack", one("tiles.vdb"), 1),
        ("half.volpack", one("fog_half_blosc.vdb"), 1),
        ("bc7.volpack", one("negative.vdb"), 1),
    ] {
        let pack = Pack::open(&kept(pack)).unwrap_or_else(|e| panic!("{pack}: {e}"));
        pack.check_chunks().unwrap();
        assert_eq!(pack.grids().len(), grids);
        let report =
            voxels(&pack, &Sources::find(&pack, &sources).unwrap(), 2, &mut volpack::progress::Silent)
                .unwrap();
        assert!(report.ok, "{:?}", report.failures);
    }
}

#[test]
fn other_versions_are_refused_and_say_what_to_do() {
    let bytes = std::fs::read(kept("half.volpack")).unwrap();
    for (version, advice) in [(0u16, "build the pack again"), (2, "use a newer volpack")] {
        let mut other = bytes.clone();
        other[8..10].copy_from_slice(&version.to_le_bytes());
        let error = Pack::from_bytes(other).err().expect("another version is refused");
        assert!(matches!(error, PackError::Version(v) if v == version) && error.is_unsupported());
        assert!(error.to_string().ends_with(advice), "{error}");
    }
}
