//! The tracers against each other: the shader, its twin in `f32`, and the reference in `f64`.

mod common;

use common::{animation, build_verified, fixture};
use volpack::pack::Pack;
use volpack::render::gpu::Gpu;
use volpack::render::{Field, Image, Mode, Scene, Traversal, View, trace};
use volpack::settings::{Format, Settings};

const SIZE: [u32; 2] = [72, 56];

fn scene(pack: &Pack, field: &Field, mode: Mode, traversal: Traversal) -> Scene {
    let record = &pack.grids[0].frames[0].record;
    let camera = View::default().camera(field.bounds, &record.transform);
    Scene {
        mode,
        traversal,
        camera,
        size: SIZE,
        matrix: record.transform,
        level_set: pack.grids[0].record.class == 1,
        extinction: 0.5,
        threshold: 0.05 * pack.grids[0].record.active_max,
    }
}

/// Pixels that differ by more than `tolerance` of the larger, and the largest such difference.
fn differing(a: &Image, b: &Image, channels: std::ops::Range<usize>, tolerance: f32) -> (usize, f32) {
    let apart = a.pixels.iter().zip(&b.pixels).map(|(a, b)| {
        channels
            .clone()
            .map(|c| (a[c] - b[c]).abs() / a[c].abs().max(b[c].abs()).max(1.0))
            .fold(0.0, f32::max)
    });
    apart.filter(|d| *d > tolerance).fold((0, 0.0), |(n, most), d| (n + 1, most.max(d)))
}

fn cases() -> Vec<(&'static str, Vec<std::path::PathBuf>, &'static str)> {
    vec![
        ("fog", vec![fixture("fog_half_blosc.vdb")], "density"),
        ("animation", animation(), "density"),
        ("ball", vec![fixture("levelset_half.vdb")], "surface"),
        ("tiles", vec![fixture("types.vdb")], "density"),
        ("negative", vec![fixture("negative.vdb")], "density"),
    ]
}

#[test]
fn hdda_and_dda_see_the_same() {
    let folder = tempfile::tempdir().unwrap();
    for (name, frames, grid) in cases() {
        let settings = Settings { grids: vec![grid.to_owned()], format: Format::F32, ..Settings::default() };
        let (pack, _) = build_verified(&frames, settings, folder.path());
        let field = Field::from_pack(&pack.frame(0, 0).unwrap()).unwrap();
        // A box of thousands of voxels takes a DDA too long.
        if name == "negative" {
            continue;
        }
        for mode in Mode::ALL {
            let reference = trace::<f64>(&field, &scene(&pack, &field, mode, Traversal::Dda)).unwrap();
            let hdda = trace::<f64>(&field, &scene(&pack, &field, mode, Traversal::Hdda)).unwrap();
            assert!(hdda.mean_steps() <= reference.mean_steps());
            if mode != Mode::Steps {
                assert_eq!(differing(&reference, &hdda, 0..3, 1e-6), (0, 0.0), "{name} {mode:?}");
            }
            // Rounding may move a ray to the other side of an edge in single pixels.
            let twin = trace::<f32>(&field, &scene(&pack, &field, mode, Traversal::Dda)).unwrap();
            let (n, most) = differing(&reference, &twin, 0..3, 1e-4);
            assert!(n <= 4, "{name} {mode:?}: {n} pixels, {most}");
        }
    }
}

#[test]
fn the_shader_sees_what_the_cpu_sees() {
    let gpu = match Gpu::shared() {
        Ok(gpu) => gpu,
        Err(e) => {
            assert!(std::env::var_os("VOLPACK_REQUIRE_GPU").is_none(), "{e}");
            eprintln!("skipped: {e}");
            return;
        }
    };
    let folder = tempfile::tempdir().unwrap();
    for (name, frames, grid) in cases() {
        for format in Format::ALL {
            let settings = Settings { grids: vec![grid.to_owned()], format, ..Settings::default() };
            let output = folder.path().join("test.volpack");
            let job = volpack::pipeline::Job {
                frames: frames.clone(),
                output,
                settings,
                strict: false,
                verify: volpack::pipeline::VerifyLevel::None,
                pictures: Default::default(),
            };
            volpack::pipeline::build(&job, &mut volpack::pipeline::Silent).unwrap();
            let pack = Pack::open(&job.output).unwrap();
            let uploaded = gpu.upload(&pack).unwrap();
            let frame = pack.grids[0].frames.len() - 1;
            let reader = pack.frame(0, frame).unwrap();
            let field = Field::from_pack(&reader).unwrap();
            assert_eq!(reader.bounds(), field.bounds);
            for mode in Mode::ALL {
                for traversal in [Traversal::Dda, Traversal::Hdda] {
                    if traversal == Traversal::Dda && (name == "negative" || mode != Mode::Density) {
                        continue;
                    }
                    let scene = scene(&pack, &field, mode, traversal);
                    let ours = gpu.trace(&uploaded, [0, frame as u32], field.bounds, &scene).unwrap();
                    let twin = trace::<f32>(&field, &scene).unwrap();
                    let tolerance = match format {
                        // The interpolation of BC4 is each GPU's own: 0.03 of a block's range.
                        Format::Bc4 => 0.03,
                        _ => 1e-5,
                    };
                    let (n, most) = differing(&twin, &ours, 0..4, tolerance);
                    // In a category a ray that meets an edge may go to either side: 0.1 % of pixels. BC4 moves
                    // edges, and with them hits.
                    let pixels = (SIZE[0] * SIZE[1]) as usize;
                    let allowed = match format {
                        Format::Bc4 => pixels / 200,
                        _ if mode.is_categorical() => pixels / 1000,
                        _ => 0,
                    };
                    assert!(
                        n <= allowed,
                        "{name} {format:?} {mode:?} {traversal:?}: {n} pixels, at most {most}"
                    );
                }
            }
        }
    }
}
