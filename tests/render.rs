//! The tracers against each other: the shader, its twin in `f32`, and the reference in `f64`.

mod common;
#[path = "../fuzz/common/reseal.rs"]
mod reseal;

use std::io::BufReader;
use std::path::Path;

use common::{animation, build_verified, fixture, gpu};
use volpack::pack::Pack;
use volpack::pack::layout::{Section, kind};
use volpack::pipeline::build_altered;
use volpack::render::{
    Camera, DecodedFrame, Device, Image, Interpolation, Mode, Renderer, Scene, Step, Traversal, Up, View,
    WorldBox, apart, difference, trace, trace_noting_gpu_spread, write_png,
};
use volpack::settings::{Format, Settings};
use volpack::volume::{Cell, CellContent, Child, Constant, Coord, CoordBox, FlatFrame, ValueRange};

const SIZE: [u32; 2] = [72, 56];

fn scene(
    pack: &Pack,
    field: &DecodedFrame,
    mode: Mode,
    traversal: Traversal,
    interpolation: Interpolation,
) -> Scene {
    let record = &pack.grids()[0].frames[0].record;
    let camera = View::default().camera(&WorldBox::around([(field.bounds, &record.transform)]), Up::Y, SIZE);
    Scene {
        traversal,
        camera,
        interpolation,
        extinction: 0.5,
        ..Scene::new(&pack.grids()[0], 0, &View::default(), mode, SIZE)
    }
}

/// Every mode, with both interpolations where that makes a difference.
fn modes(pack: &Pack) -> impl Iterator<Item = (Mode, Interpolation)> {
    let level_set = pack.grids()[0].is_level_set();
    let trilinear = Mode::ALL.into_iter().map(|mode| (mode, Interpolation::Trilinear));
    let nearest = Mode::ALL.into_iter().map(|mode| (mode, Interpolation::Nearest));
    trilinear.chain(nearest.filter(move |(mode, _)| level_set || *mode == Mode::Density))
}

/// Pixels that differ by more than `tolerance` of the larger, and the largest such difference.
fn differing(a: &Image, b: &Image, channels: std::ops::Range<usize>, tolerance: f32) -> (usize, f32) {
    differing_by(a, b, channels, |_| tolerance)
}

/// The same with a tolerance for each pixel.
fn differing_by(
    a: &Image,
    b: &Image,
    channels: std::ops::Range<usize>,
    tolerance: impl Fn(usize) -> f32,
) -> (usize, f32) {
    let apart =
        a.pixels.iter().zip(&b.pixels).map(|(a, b)| apart(&a[channels.clone()], &b[channels.clone()]));
    let far = apart.enumerate().filter(|(i, d)| *d > tolerance(*i));
    far.fold((0, 0.0), |(n, most), (_, d)| (n + 1, most.max(d)))
}

/// Boxes of thousands of voxels an axis, with several L1 nodes and tiles of 4096³.
const VAST: [&str; 2] = ["negative", "tiles"];

fn cases() -> Vec<(&'static str, Vec<std::path::PathBuf>, &'static str)> {
    vec![
        ("fog", vec![fixture("fog_half_blosc.vdb")], "density"),
        ("animation", animation(), "density"),
        ("ball", vec![fixture("levelset_half.vdb")], "surface"),
        ("types", vec![fixture("types.vdb")], "density"),
        ("tiles", vec![fixture("tiles.vdb")], "density"),
        ("negative", vec![fixture("negative.vdb")], "density"),
    ]
}

#[test]
fn hdda_and_dda_see_the_same() {
    let folder = tempfile::tempdir().unwrap();
    for (name, frames, grid) in cases() {
        let settings =
            Settings { grids: vec![grid.to_owned()], encoding: Format::F32.into(), ..Settings::default() };
        let (pack, _) = build_verified(&frames, settings, folder.path());
        let field = DecodedFrame::from_pack(&pack.frame(0, 0).unwrap()).unwrap();
        // A box of thousands of voxels takes a DDA too long.
        if VAST.contains(&name) {
            continue;
        }
        for (mode, interpolation) in modes(&pack) {
            let scene = |traversal| scene(&pack, &field, mode, traversal, interpolation);
            let reference = trace::<f64>(&field, &scene(Traversal::Dda)).unwrap();
            let hdda = trace::<f64>(&field, &scene(Traversal::Hdda)).unwrap();
            assert!(hdda.mean_steps() <= reference.mean_steps());
            if mode != Mode::Steps {
                let apart = differing(&reference, &hdda, 0..3, 1e-6);
                assert_eq!(apart, (0, 0.0), "{name} {mode:?} {interpolation:?}");
            }
            // Rounding may move a ray to the other side of an edge in single pixels.
            let twin = trace::<f32>(&field, &scene(Traversal::Dda)).unwrap();
            let (n, most) = differing(&reference, &twin, 0..3, 1e-4);
            assert!(n <= 4, "{name} {mode:?} {interpolation:?}: {n} pixels, {most}");
        }
    }
}

#[test]
fn the_shader_sees_what_the_cpu_sees() {
    let Some(gpu) = gpu() else { return };
    let folder = tempfile::tempdir().unwrap();
    for (name, frames, grid) in cases() {
        for format in Format::ALL {
            let settings =
                Settings { grids: vec![grid.to_owned()], encoding: format.into(), ..Settings::default() };
            let output = folder.path().join("test.volpack");
            let job = volpack::pipeline::Job::new(
                frames.clone(),
                output,
                settings,
                volpack::pipeline::VerifyLevel::None,
            );
            volpack::pipeline::build(&job, &mut volpack::pipeline::Silent).unwrap();
            let pack = Pack::open(&job.output).unwrap();
            let uploaded = gpu.upload(&pack).unwrap();
            let frame = pack.grids()[0].frames.len() - 1;
            let reader = pack.frame(0, frame).unwrap();
            let field = DecodedFrame::from_pack(&reader).unwrap();
            assert_eq!(reader.bounds(), field.bounds);
            for (mode, interpolation) in modes(&pack) {
                for traversal in [Traversal::Dda, Traversal::Hdda] {
                    if traversal == Traversal::Dda && (VAST.contains(&name) || mode != Mode::Density) {
                        continue;
                    }
                    let mut scene = scene(&pack, &field, mode, traversal, interpolation);
                    let is_marched = interpolation == Interpolation::Trilinear
                        && !scene.level_set
                        && matches!(mode, Mode::Density | Mode::Lit);
                    // tests/fog.rs marches through the others.
                    if is_marched && format != Format::Adaptive {
                        continue;
                    }
                    if VAST.contains(&name) {
                        scene.march.step = Step::Voxels(16.0);
                    }
                    let ours = gpu.trace(&uploaded, [0, frame as u32], field.bounds, &scene).unwrap();
                    let (twin, varies) = trace_noting_gpu_spread::<f32>(&field, &scene).unwrap();
                    // A sample on the face of a region may be taken in either, or left out with the one that is empty.
                    let channels = if is_marched { 0..3 } else { 0..4 };
                    // Thousands of voxels away, the last bit of a place is a thousandth of a voxel.
                    let rounding = if is_marched && VAST.contains(&name) { 1e-3 } else { 1e-5 };
                    // The interpolation of BC4 is each GPU's own: 0.03 of a block's range.
                    let tolerance = |pixel: usize| if varies[pixel] { 0.03 } else { rounding };
                    let (n, most) = differing_by(&twin, &ours, channels, tolerance);
                    // In a category a ray that meets an edge may go to either side: 0.1 % of pixels. Thousands of voxels
                    // away, the last bit of an f32 direction is a thousandth of a voxel: there rays tie in measures too.
                    let pixels = varies.len();
                    let ties = if mode.is_categorical() || VAST.contains(&name) { pixels / 1000 } else { 0 };
                    // BC4 moves edges, and with them hits; of the nearest voxels one of another sign is several pixels.
                    let of_bc4 = varies.iter().filter(|bc4| **bc4).count();
                    let part = if interpolation == Interpolation::Nearest { 100 } else { 200 };
                    let allowed = ties + (pixels / part).min(of_bc4);
                    assert!(
                        n <= allowed,
                        "{name} {format:?} {mode:?} {interpolation:?} {traversal:?}: {n} pixels, at most {most}"
                    );
                }
            }
        }
    }
}

/// The pictures of fixtures, kept: a change that is meant is blessed with `VOLPACK_BLESS=1`.
#[test]
fn pictures_look_as_they_did() {
    let folder = tempfile::tempdir().unwrap();
    // The voxels of "negative" are too far apart to be seen in one picture.
    for (name, frames, grid) in cases().into_iter().filter(|(name, ..)| *name != "negative") {
        let settings =
            Settings { grids: vec![grid.to_owned()], encoding: Format::F16.into(), ..Settings::default() };
        let (pack, _) = build_verified(&frames, settings, folder.path());
        let frame = pack.grids()[0].frames.len() - 1;
        let renderer = Renderer::new(&pack, Device::Auto).unwrap();
        let mode = if name == "ball" { Mode::Lit } else { Mode::Density };
        let size = [96, 96];
        let scene = Scene::new(&pack.grids()[0], frame, &View::default(), mode, size);
        let picture = renderer.render(0, frame, &scene).unwrap().to_rgb8(&scene);

        let golden = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("tests/golden/{name}.png"));
        if std::env::var_os("VOLPACK_BLESS").is_some() {
            write_png(std::fs::File::create(&golden).unwrap(), size, &picture).unwrap();
        }
        let decoder = png::Decoder::new(BufReader::new(std::fs::File::open(&golden).unwrap()));
        let mut reader = decoder.read_info().unwrap();
        let mut kept = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut kept).unwrap();
        let apart = difference(size, &kept, &picture);
        assert!(apart.flip < 0.005, "{name}: FLIP {}", apart.flip);
    }
}

/// Blocks of every mode, which an encoder that is asked for speed never makes: the texture unit must
/// decode them as bcdec_rs does.
#[test]
fn the_gpu_decodes_any_bc7_block_as_the_cpu_does() {
    let Some(gpu) = gpu() else { return };
    let folder = tempfile::tempdir().unwrap();
    let settings = Settings { encoding: Format::BC7.into(), zstd: 0, ..Settings::default() };
    build_verified(&[fixture("fog_half_zip.vdb")], settings, folder.path());
    let mut bytes = std::fs::read(folder.path().join("test.volpack")).unwrap();
    let sections = bytes[64..].chunks_exact(80).map(bytemuck::pod_read_unaligned::<Section>);
    let texels = sections.take(8).find(|s| s.kind == kind::TEXELS).unwrap();
    let mut state = 0x9e37_79b9_7f4a_7c15u64;
    for (i, block) in
        bytes[texels.offset as usize..][..texels.raw_bytes as usize].chunks_exact_mut(16).enumerate()
    {
        for byte in block.iter_mut() {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            *byte = (state >> 56) as u8;
        }
        // The lowest bit that is on is the block's mode, 0 to 7.
        let mode = i % 8;
        block[0] = (block[0] >> mode | 1) << mode;
    }
    reseal::reseal(&mut bytes);
    let pack = Pack::from_bytes(bytes).unwrap();
    let uploaded = gpu.upload(&pack).unwrap();
    let field = DecodedFrame::from_pack(&pack.frame(0, 0).unwrap()).unwrap();
    for mode in [Mode::Density, Mode::First] {
        for view in ["orbit:40,20,0.8", "orbit:200,-35,0.8"] {
            let scene = Scene::new(&pack.grids()[0], 0, &view.parse().unwrap(), mode, [160, 160]);
            let ours = gpu.trace(&uploaded, [0, 0], field.bounds, &scene).unwrap();
            let twin = trace::<f32>(&field, &scene).unwrap();
            let (n, most) = differing(&twin, &ours, 0..4, 1e-5);
            // Sums of noise are a few roundings apart in single pixels; a value that is a 255th off is so in all
            // that see its block, by far more.
            assert!(n <= 25 && most < 1e-4, "{mode:?} {view}: {n} pixels, {most}");
        }
    }
}

#[test]
fn a_large_node_s_neighbours_are_seen_brick_by_brick() {
    let Some(gpu) = gpu() else { return };
    let folder = tempfile::tempdir().unwrap();
    let job = volpack::pipeline::Job::new(
        vec![fixture("levelset_half.vdb")],
        folder.path().join("test.volpack"),
        Settings { grids: vec!["surface".to_owned()], encoding: Format::F32.into(), ..Settings::default() },
        volpack::pipeline::VerifyLevel::None,
    );
    // Positive up to x = 127; behind it regions of 8³ whose signs are those of a chessboard.
    let chessboard = |frame: &mut FlatFrame| {
        let sign = |place: u16| if (place / 16 + place % 16).is_multiple_of(2) { 1.0 } else { -1.0 };
        let constant = |value| Constant { value, active: true };
        let node = (0..256).map(|place| (place, Child::Constant(constant(sign(place))))).collect();
        let cell = |x, content| Cell { origin: Coord::new(x, 0, 0), content };
        frame.roots.clear();
        frame.bricks = Vec::new().into();
        frame.cells = vec![cell(0, CellContent::Constant(constant(1.0))), cell(128, CellContent::Node(node))];
        frame.stats.bbox = CoordBox { min: Coord::new(0, 0, 0), max: Coord::new(135, 127, 127) };
        frame.stats.active_range = Some(ValueRange { min: -1.0, max: 1.0 });
    };
    build_altered(&job, &chessboard, &mut volpack::pipeline::Silent).unwrap();
    let pack = Pack::open(&job.output).unwrap();
    let reader = pack.frame(0, 0).unwrap();
    let field = DecodedFrame::from_pack(&reader).unwrap();
    let mut scene = scene(&pack, &field, Mode::Depth, Traversal::Hdda, Interpolation::Trilinear);
    // Along the last layer of the positive node, where every cell reaches into the chessboard.
    let world = |[x, y, z]: [f64; 3]| {
        let m = &scene.matrix;
        std::array::from_fn(|a| x * m[a] + y * m[4 + a] + z * m[8 + a] + m[12 + a])
    };
    // Far off and narrow, so that most rays stay in it for long, and beside a positive region first.
    scene.camera =
        Camera { eye: world([126.6, -100.0, 52.0]), target: world([127.6, 64.0, 52.0]), fov: 1.5, up: Up::Y };
    let ours = gpu.trace(&gpu.upload(&pack).unwrap(), [0, 0], field.bounds, &scene).unwrap();
    let twin = trace::<f32>(&field, &scene).unwrap();
    let hits = twin.pixels.iter().filter(|pixel| pixel[0] >= 0.0).count();
    assert!(hits > ours.pixels.len() / 4, "the view shows what it is about: {hits}");
    let (n, most) = differing(&twin, &ours, 0..3, 1e-3);
    assert!(n <= 4, "{n} of {hits} pixels, at most {most}");
}
