//! Lit fog: its light against closed forms, its glow, and the shader against the CPU.

mod common;
#[path = "common/vdb_writer.rs"]
mod vdb_writer;

use std::path::{Path, PathBuf};

use common::{animation, gpu};
use vdb_writer::{GridFile, write_grid};
use volpack::pack::Pack;
use volpack::pipeline::{Job, Silent, VerifyLevel, build};
use volpack::render::{
    DecodedFrame, Emission, Image, Interpolation, Light, March, Medium, Mode, Scene, Step, View, apart,
    trace, trace_noting_gpu_spread,
};
use volpack::settings::{Format, Settings};

const SIZE: [u32; 2] = [48, 48];
/// Voxels of the box's side.
const SIDE: i32 = 64;
const VOXEL: f64 = 0.1;

fn built(frames: Vec<PathBuf>, grids: &[&str], format: Format, folder: &Path) -> Pack {
    let grids = grids.iter().map(|&grid| grid.to_owned()).collect();
    let settings = Settings { grids, encoding: format.into(), ..Settings::default() };
    let job = Job::new(frames, folder.join("test.volpack"), settings, VerifyLevel::None);
    build(&job, &mut Silent).unwrap();
    Pack::open(&job.output).unwrap()
}

/// A box of one density.
fn homogeneous(folder: &Path) -> Pack {
    let grid = GridFile::new("density", "Tree_float_5_4_3", 0.0).of_class("fog volume");
    let grid = GridFile { voxel_size: VOXEL, ..grid }.fill([SIDE / 8; 3], |_| (0.75f32, true));
    write_grid(&folder.join("box.vdb"), &grid);
    built(vec![folder.join("box.vdb")], &["density"], Format::F32, folder)
}

fn decoded(pack: &Pack, place: [usize; 2]) -> DecodedFrame {
    DecodedFrame::from_pack(&pack.frame(place[0], place[1]).unwrap()).unwrap()
}

/// The pixel in the middle.
fn middle(image: &Image) -> [f64; 3] {
    let [r, g, b, _] = image.pixels[(SIZE[1] / 2 * SIZE[0] + SIZE[0] / 2) as usize];
    [r, g, b].map(f64::from)
}

/// The sun shines on a box from the viewer, and from the side: what comes out has a closed form.
#[test]
fn the_sun_through_a_homogeneous_box_is_what_the_closed_form_says() {
    let folder = tempfile::tempdir().unwrap();
    let pack = homogeneous(folder.path());
    let field = decoded(&pack, [0, 0]);
    let (width, half) = (f64::from(SIDE) * VOXEL, f64::from(SIDE - 1) / 2.0 * VOXEL);
    // From far away and narrow: all rays go straight through.
    let view = View::Fixed { eye: [half, half, 1000.0], target: [half; 3], fov: 0.01 };
    // From the side, light is let in a voxel too deep at the box's faces, because it is measured on every second voxel:
    // 1 % only where fog is thin over a few voxels. From the front it is the faces themselves that are not sharp.
    let front = [([0.0, 0.0], 0.0), ([0.0, 0.0], -0.4)];
    let any = [front[0], front[1], ([90.0, 0.0], 0.0), ([90.0, 0.0], 0.6)];
    for (extinction, steps, suns) in
        [(0.1, 0.5, &any[..]), (0.3, 1.0, &any), (1.0, 0.5, &front), (1.0, 1.0, &front)]
    {
        for &(sun, anisotropy) in suns {
            let light = Light { sun, albedo: 0.8, anisotropy, ambient: 0.0 };
            let scene = Scene {
                light,
                extinction,
                march: March { step: Step::Voxels(steps), jitter: false },
                ..Scene::new(&pack.grids()[0], 0, &view, Mode::Lit, SIZE)
            };
            let depth = 0.75 * extinction * width;
            let behind = (-depth).exp();
            let from_viewer = sun[0] == 0.0;
            // Light that comes in where the eye looks goes the same way twice; from the side it has half a box behind it.
            let scattered = if from_viewer {
                (1.0 - behind * behind) / 2.0
            } else {
                (-depth / 2.0).exp() * (1.0 - behind)
            };
            // Against the ray, or across it.
            let cosine = if from_viewer { -1.0 } else { 0.0 };
            let g: f64 = anisotropy;
            let phase = (1.0 - g * g) / (1.0 + g * g - 2.0 * g * cosine).powf(1.5);
            let backdrop = middle(&trace::<f64>(&field, &Scene { extinction: 0.0, ..scene }).unwrap());
            let found = middle(&trace::<f64>(&field, &scene).unwrap());
            for c in 0..3 {
                let expected = light.sun_light()[c] * phase * scattered;
                let seen = found[c] - behind * backdrop[c];
                assert!(
                    (seen / expected - 1.0).abs() < 0.01,
                    "extinction {extinction}, step {steps}, sun {sun:?}, g {g}: {seen} for {expected}"
                );
            }
        }
    }
}

/// The middle of a box of temperature, in front of nothing: its light is length times what glows.
#[test]
fn what_glows_adds_up_and_is_dimmed() {
    let folder = tempfile::tempdir().unwrap();
    let pack = homogeneous(folder.path());
    let field = decoded(&pack, [0, 0]);
    let half = f64::from(SIDE - 1) / 2.0 * VOXEL;
    let view = View::Fixed { eye: [half, half, 1000.0], target: [half; 3], fov: 0.01 };
    assert!(Emission::new(pack.grids(), 0, 0, Some(300.0 / 0.75), 1.0).is_none(), "air does not glow");
    let emission = Emission::new(pack.grids(), 0, 0, Some(1500.0 / 0.75), 1.0).unwrap();
    let glow = emission.ramp.last().unwrap().map(f64::from);
    assert!(glow[0] > 0.0 && (glow[1] / glow[0] - 0.133).abs() < 0.02 && glow[2] == 0.0, "1,500 K is orange");
    let width = f64::from(SIDE) * VOXEL;
    for extinction in [0.0, 0.1, 0.5] {
        let light = Light { albedo: 0.0, ..Light::default() };
        let scene = Scene {
            extinction,
            light,
            emission: Some(emission),
            ..Scene::new(&pack.grids()[0], 0, &view, Mode::Lit, SIZE)
        };
        let dark = middle(&trace::<f64>(&field, &Scene { emission: None, ..scene }).unwrap());
        let medium = Medium { frame: &field, emission: Some(&field) };
        let found = middle(&trace::<f64>(medium, &scene).unwrap());
        // At the box's faces the temperature falls to 0 within a voxel, and the glow with its fourth power: of that voxel,
        // half of which is inside, a fifth glows.
        let (near, far) = (0.3 * VOXEL, width - 0.3 * VOXEL);
        let rate = 0.75 * extinction;
        let length = match extinction {
            0.0 => far - near,
            _ => ((-rate * near).exp() - (-rate * far).exp()) / rate,
        };
        for c in 0..2 {
            let (seen, expected) = (found[c] - dark[c], glow[c] * length);
            assert!((seen / expected - 1.0).abs() < 0.01, "extinction {extinction}: {seen} for {expected}");
        }
    }
}

/// Where steps begin, and how long they are, is hardly seen.
#[test]
fn steps_change_little() {
    let folder = tempfile::tempdir().unwrap();
    let pack = built(animation(), &["density"], Format::F32, folder.path());
    let field = decoded(&pack, [0, 5]);
    for mode in [Mode::Density, Mode::Lit] {
        let scene = Scene {
            interpolation: Interpolation::Trilinear,
            ..Scene::new(&pack.grids()[0], 5, &View::default(), mode, SIZE)
        };
        let marched = |step, jitter| {
            let image = trace::<f64>(&field, &Scene { march: March { step, jitter }, ..scene }).unwrap();
            image.pixels.into_iter().map(|pixel| f64::from(pixel[0])).collect::<Vec<_>>()
        };
        let fine = marched(Step::Voxels(0.05), false);
        let voxel = pack.grids()[0].frames[5].record.transform[0];
        assert_eq!(marched(Step::Voxels(0.5), false), marched(Step::World(0.5 * voxel), false));
        for (jitter, tolerance) in [(false, 0.002), (true, 0.01)] {
            let coarse = marched(Step::Voxels(0.5), jitter);
            let square = coarse.iter().zip(&fine).map(|(a, b)| (a - b).powi(2)).sum::<f64>();
            let apart = (square / fine.len() as f64).sqrt();
            assert!(apart < tolerance && apart > 0.0, "{mode:?}, jitter {jitter}: {apart}");
        }
    }
}

#[test]
fn the_shader_lights_what_the_cpu_lights() {
    let Some(gpu) = gpu() else { return };
    let folder = tempfile::tempdir().unwrap();
    for format in Format::ALL {
        let pack = built(animation(), &["density", "temperature"], format, folder.path());
        let uploaded = gpu.upload(&pack).unwrap();
        let frame = 6;
        let (field, heat) = (decoded(&pack, [0, frame]), decoded(&pack, [1, frame]));
        let usual = Scene::new(&pack.grids()[0], frame, &View::default(), Mode::Lit, SIZE);
        let emission = Emission::new(pack.grids(), 1, frame, None, 1.0).unwrap();
        for (what, scene) in [
            ("light", usual),
            ("glow", Scene { emission: Some(emission), ..usual }),
            ("jitter", Scene { march: March { step: Step::World(0.3), jitter: true }, ..usual }),
            (
                "phase",
                Scene { light: Light { anisotropy: 0.6, sun: [-120.0, 10.0], ..Light::default() }, ..usual },
            ),
        ] {
            let ours = gpu.trace(&uploaded, [0, frame as u32], field.bounds, &scene).unwrap();
            let medium = Medium { frame: &field, emission: scene.emission.map(|_| &heat) };
            let (twin, varies) = trace_noting_gpu_spread::<f32>(medium, &scene).unwrap();
            let reference = trace::<f64>(medium, &scene).unwrap();
            for (pixel, varies) in varies.into_iter().enumerate() {
                let [gpu, twin, exact] = [&ours, &twin, &reference].map(|image| &image.pixels[pixel][..3]);
                // The interpolation of BC4 is each GPU's own.
                let tolerance = if varies { 0.03 } else { 1e-5 };
                assert!(apart(gpu, twin) < tolerance, "{format:?} {what}: {gpu:?} for {twin:?}");
                assert!(apart(twin, exact) < 1e-4, "{format:?} {what}: {twin:?} for {exact:?}");
            }
        }
    }
}
