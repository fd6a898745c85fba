//! A kept pack: the format may not change by accident, and old files stay readable.
//!
//! A change that is meant: `VOLPACK_BLESS=1 cargo test --test format_golden`, and docs/format.md.

mod common;

use std::path::Path;

use common::{build_verified, fixture};
use volpack::pack::Pack;
use volpack::settings::{Format, Settings};

#[test]
fn the_same_frames_give_the_kept_bytes() {
    let golden = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/anim.volpack");
    let folder = tempfile::tempdir().unwrap();
    // No block format and no zstd: their bytes depend on the encoder's instruction set and version.
    let settings = Settings {
        grids: vec!["density".to_owned(), "temperature".to_owned()],
        encoding: Format::UNORM8.into(),
        zstd: 0,
        ..Settings::default()
    };
    let frames = [fixture("anim_0001.vdb"), fixture("anim_0002.vdb")];
    let (_, report) = build_verified(&frames, settings, folder.path());
    assert!(report.ok);
    let built = std::fs::read(folder.path().join("test.volpack")).unwrap();
    if std::env::var_os("VOLPACK_BLESS").is_some() {
        std::fs::create_dir_all(golden.parent().unwrap()).unwrap();
        std::fs::write(&golden, &built).unwrap();
    }
    let kept = std::fs::read(&golden).unwrap();
    assert!(built == kept, "the bytes of a pack have changed: {} then, {} now", kept.len(), built.len());

    let pack = Pack::from_bytes(kept).unwrap();
    pack.check_chunks().unwrap();
    let report = volpack::verify::voxels(
        &pack,
        &volpack::verify::Sources::find(&pack, &frames).unwrap(),
        1,
        &mut volpack::progress::Silent,
    )
    .unwrap();
    assert!(report.ok, "{:?}", report.failures);
}
