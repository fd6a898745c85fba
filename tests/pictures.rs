//! The picture ring: pictures prove something of every frame, and frames of one sequence are seen alike.

mod common;
#[path = "common/vdb_writer.rs"]
mod vdb_writer;

use std::path::{Path, PathBuf};

use common::{build_verified, gpu};
use vdb_writer::{GridFile, write_grid};
use volpack::cancel::CancelToken;
use volpack::pack::Pack;
use volpack::pipeline::{Job, Silent, VerifyLevel, build};
use volpack::render::{
    DecodedFrame, Device, Image, Interpolation, Mode, Scene, Up, View, apart, spread, trace,
    trace_noting_gpu_spread,
};
use volpack::settings::{Format, Quality, Settings};
use volpack::verify::{PictureSettings, PicturesReport, Sources, pictures, shown_frames};

const SIZE: [u32; 2] = [96, 96];

/// A ball of fog in world space, denser towards its middle, in a box of so many leaves whose voxel 0 is at `corner`.
fn ball(voxel_size: f64, corner: [f64; 3], leaves: i32, middle: [f64; 3], radius: f64) -> GridFile<f32> {
    let density = move |voxel: [i32; 3]| {
        let world = |a: usize| corner[a] + voxel_size * f64::from(voxel[a]);
        let distance = (0..3).map(|a| (world(a) - middle[a]).powi(2)).sum::<f64>().sqrt();
        (1.0 - distance / radius).max(0.0) as f32
    };
    let grid = GridFile::new("density", "Tree_float_5_4_3", 0.0).of_class("fog volume");
    let grid = GridFile { voxel_size, translation: corner, ..grid };
    grid.fill([leaves; 3], move |voxel| (density(voxel), density(voxel) > 0.0))
}

fn level_set(value: impl Fn([i32; 3]) -> f32) -> GridFile<f32> {
    let grid = GridFile::new("density", "Tree_float_5_4_3", 0.0).of_class("level set");
    grid.fill([3; 3], move |voxel| (value(voxel), true))
}

fn write(folder: &Path, frames: &[GridFile<f32>]) -> Vec<PathBuf> {
    let path = |i: usize| folder.join(format!("frame_{i:04}.vdb"));
    frames.iter().enumerate().for_each(|(i, frame)| write_grid(&path(i), frame));
    (0..frames.len()).map(path).collect()
}

fn settings(format: Format) -> Settings {
    Settings { encoding: format.into(), ..Settings::default() }
}

fn built(frames: &[PathBuf], settings: Settings, folder: &Path) -> Pack {
    let job = Job::new(frames.to_vec(), folder.join("test.volpack"), settings, VerifyLevel::None);
    build(&job, &mut Silent).unwrap();
    Pack::open(&job.output).unwrap()
}

fn ring(pack: &Pack, frames: &[PathBuf]) -> PicturesReport {
    let settings = PictureSettings { device: Device::Cpu, ..PictureSettings::default() };
    pictures(pack, &Sources::find(pack, frames).unwrap(), &settings, &CancelToken::default()).unwrap()
}

fn field(pack: &Pack, frame: usize) -> DecodedFrame {
    DecodedFrame::from_pack(&pack.frame(0, frame).unwrap()).unwrap()
}

/// Middle and size of what a picture shows, in pixels, and the sum of its opacity.
fn seen(image: &Image) -> [f64; 4] {
    let width = image.size[0] as usize;
    let place = |i: usize| ((i % width) as f64, (i / width) as f64);
    let mean = |of: &dyn Fn(f64, f64) -> f64| -> f64 {
        let pixels = image.pixels.iter().enumerate();
        pixels.map(|(i, pixel)| f64::from(pixel[0]) * of(place(i).0, place(i).1)).sum()
    };
    let sum = mean(&|_, _| 1.0);
    assert!(sum > 100.0, "the ball is seen");
    let (x, y) = (mean(&|x, _| x) / sum, mean(&|_, y| y) / sum);
    let size = (mean(&|px, py| (px - x).powi(2) + (py - y).powi(2)) / sum).sqrt();
    [x, y, size, sum]
}

#[test]
fn the_first_a_middle_and_the_last_frame_are_shown() {
    let all = [(0, vec![]), (1, vec![0]), (2, vec![0, 1]), (3, vec![0, 1, 2]), (24, vec![0, 11, 23])];
    for (count, shown) in all {
        assert_eq!(shown_frames(count), shown);
    }
}

/// Blender's adaptive domains and FLIP Fluids move the box and change the voxel size from frame to frame.
#[test]
fn a_still_ball_stands_still_whatever_its_box_does() {
    let folder = tempfile::tempdir().unwrap();
    let (middle, radius) = ([1.0, 0.8, 0.9], 0.6);
    let frames = [
        ball(0.1, [0.0; 3], 3, middle, radius),
        ball(0.1, [-1.6, 0.0, 0.0], 5, middle, radius),
        ball(0.05, [0.0; 3], 5, middle, radius),
        ball(0.0625, [0.1, 0.0, -0.5], 5, middle, radius),
    ];
    let frames = write(folder.path(), &frames);
    // What a lossy pack drops must not move the camera either.
    for settings in
        [settings(Format::F32), Settings { encoding: Quality::Psnr(30.0).into(), ..Settings::default() }]
    {
        let pack = built(&frames, settings, folder.path());
        let shot = |f: usize| {
            let scene = Scene::new(&pack.grids()[0], f, &View::default(), Mode::Density, SIZE);
            seen(&trace::<f32>(&field(&pack, f), &scene).unwrap())
        };
        let first = shot(0);
        for f in 1..frames.len() {
            let now = shot(f);
            let moved = f64::hypot(now[0] - first[0], now[1] - first[1]) / f64::from(SIZE[0]);
            assert!(moved < 0.01, "frame {f} moves by {:.1} % of the width", 100.0 * moved);
            for (what, a, b) in [("size", first[2], now[2]), ("opacity", first[3], now[3])] {
                assert!((b / a - 1.0).abs() < 0.05, "frame {f}: {what} goes from {a} to {b}");
            }
        }
    }
}

#[test]
fn what_is_below_zero_absorbs_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let ball = ball(0.1, [0.0; 3], 3, [1.2; 3], 0.9);
    let value = |voxel: [i32; 3]| {
        let leaf = &ball.leaves[&volpack::volume::Coord(voxel).align_down(8)];
        leaf.0[volpack::volume::Coord(voxel).child_index(3, 1)]
    };
    // The same ball in fog of -0.3, and on a background that stands for no data.
    let fog = |background| GridFile::new("density", "Tree_float_5_4_3", background).of_class("fog volume");
    let negative = fog(0.0).fill([3; 3], |v| (if value(v) > 0.0 { value(v) } else { -0.3 }, true));
    let no_data =
        fog(-9999.0).fill([3; 3], |v| (if value(v) > 0.0 { value(v) } else { -9999.0 }, value(v) > 0.0));
    for other in [negative, no_data] {
        let [expected, found] = [&ball, &other].map(|grid| {
            let frames = write(folder.path(), std::slice::from_ref(grid));
            let pack = built(&frames, settings(Format::F32), folder.path());
            let scene =
                Scene::new(&pack.grids()[0], 0, &"orbit:30,20,1".parse().unwrap(), Mode::Density, SIZE);
            // Their boxes differ, and with them what a camera around them would see.
            let camera =
                volpack::render::Camera { eye: [5.0, 3.0, 4.0], target: [1.2; 3], fov: 30.0, up: Up::Y };
            let scene = Scene { camera, extinction: 5.0, ..scene };
            if let Some(gpu) = gpu() {
                let traced =
                    gpu.trace(&gpu.upload(&pack).unwrap(), [0, 0], field(&pack, 0).bounds, &scene).unwrap();
                let twin = trace::<f32>(&field(&pack, 0), &scene).unwrap();
                assert!(traced.pixels.iter().zip(&twin.pixels).all(|(a, b)| apart(a, b) < 1e-5));
            }
            trace::<f32>(&field(&pack, 0), &scene).unwrap()
        });
        seen(&expected);
        let most = expected.pixels.iter().zip(&found.pixels).map(|(a, b)| apart(&a[..3], &b[..3]));
        assert!(most.fold(0.0, f32::max) < 1e-5);
    }
}

#[test]
fn there_is_no_surface_where_nothing_is_negative() {
    let folder = tempfile::tempdir().unwrap();
    let small = |v: [i32; 3]| ((v[0] * 7 + v[1] * 5 + v[2] * 3) % 11) as f32;
    let plateaus = |v: [i32; 3]| (small(v) - 6.0).max(0.0) * 0.037;
    let ball =
        |v: [i32; 3]| (v.iter().map(|x| (f64::from(*x) - 11.0).powi(2)).sum::<f64>().sqrt() - 6.3) as f32;
    // Plateaus of 0 between positive values, values next to 0, and a ball that touches nothing.
    let cases =
        [(level_set(plateaus), false), (level_set(|v| small(v) * 1e-7), false), (level_set(ball), true)];
    for (grid, has_surface) in cases {
        let frames = write(folder.path(), &[grid]);
        let pack = built(&frames, settings(Format::F32), folder.path());
        let field = field(&pack, 0);
        for interpolation in [Interpolation::Trilinear, Interpolation::Nearest] {
            for view in ["orbit:40,20,1.25", "orbit:0,0,2", "orbit:45,90,1.25"] {
                let scene = Scene::new(&pack.grids()[0], 0, &view.parse().unwrap(), Mode::Lit, SIZE);
                let scene = Scene { interpolation, ..scene };
                let image = trace::<f32>(&field, &scene).unwrap();
                assert!(image.pixels.iter().all(|p| p.iter().all(|v| v.is_finite())), "{view}");
                let hit = image.pixels.iter().filter(|p| p[0] > 0.0).count();
                assert_eq!(hit > 0, has_surface, "{view} {interpolation:?}: {hit} pixels");
                let Some(gpu) = gpu() else { continue };
                let traced = gpu.trace(&gpu.upload(&pack).unwrap(), [0, 0], field.bounds, &scene).unwrap();
                let differ =
                    traced.pixels.iter().zip(&image.pixels).filter(|(a, b)| apart(&a[..3], &b[..3]) > 1e-4);
                assert!(differ.count() <= 4, "{view} {interpolation:?}");
            }
        }
    }
}

#[test]
fn a_number_that_is_none_is_far_from_any() {
    let close = apart(&[0.5, 1.0, -1.0], &[0.5, 1.0, -1.0]);
    assert_eq!(close, 0.0);
    for odd in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        assert!(apart(&[0.5, odd, 0.0], &[0.5, 0.0, 0.0]) > 1e9, "{odd}");
        assert!(apart(&[0.5, 0.0, 0.0], &[0.5, odd, 0.0]) > 1e9, "{odd}");
    }
    assert!(apart(&[f32::NAN], &[f32::NAN]) > 1e9);
}

#[test]
fn only_rays_that_read_bc4_are_said_to() {
    let folder = tempfile::tempdir().unwrap();
    // Two balls far from each other, each of which fills the pictures' middle from one side.
    let frames = write(folder.path(), &[ball(0.1, [0.0; 3], 3, [1.2; 3], 0.9)]);
    for (format, expected) in [(Format::BC4, true), (Format::BC7, false), (Format::F32, false)] {
        let pack = built(&frames, settings(format), folder.path());
        let scene = Scene::new(&pack.grids()[0], 0, &View::default(), Mode::Density, SIZE);
        let (image, varies) = trace_noting_gpu_spread::<f32>(&field(&pack, 0), &scene).unwrap();
        for (pixel, varies) in image.pixels.iter().zip(&varies) {
            assert!(!varies || expected, "{format:?}");
            assert!(pixel[0] == 0.0 || *varies == expected, "{format:?}");
        }
        assert_eq!(varies.contains(&true), expected, "{format:?}");
        assert!(varies.contains(&false), "{format:?}: rays beside the ball read nothing");
    }
}

/// Blender's obstacles: 10,000 beside a surface, which leaves an f32 three digits for where that is. No two GPUs agree on
/// such pixels, nor do an f32 and an f64; all others must.
#[test]
fn what_rounding_decides_is_told_from_what_is_wrong() {
    let folder = tempfile::tempdir().unwrap();
    let obstacle = |[x, y, z]: [i32; 3]| {
        let slab = (z as f32 - 9.6).abs() - 3.2;
        if x == 0 || y == 0 { 10_000.0 } else { slab.min(5.0) }
    };
    let ball =
        |[x, y, z]: [i32; 3]| [x, y, z].iter().map(|v| (*v as f32 - 11.3).powi(2)).sum::<f32>().sqrt() - 8.0;
    let frames = write(folder.path(), &[level_set(obstacle), level_set(ball)]);
    let pack = built(&frames, settings(Format::F32), folder.path());
    let unexplained = |f: usize, other: &dyn Fn(&DecodedFrame, &Scene) -> Image| {
        let field = field(&pack, f);
        let scene = Scene::new(&pack.grids()[0], f, &View::default(), Mode::Lit, [256; 2]);
        let (ours, other) = (trace::<f32>(&field, &scene).unwrap(), other(&field, &scene));
        let apart = |pixel: usize| apart(&ours.pixels[pixel][..3], &other.pixels[pixel][..3]);
        let far: Vec<usize> = (0..ours.pixels.len()).filter(|&pixel| apart(pixel) > 1e-5).collect();
        let spread = spread(&field, &scene, &far).unwrap();
        let unexplained =
            far.iter().zip(spread).filter(|&(&pixel, spread)| apart(pixel) > 1e-5 + 2.0 * spread).count();
        [far.len(), unexplained]
    };
    let exact = |field: &DecodedFrame, scene: &Scene| trace::<f64>(field, scene).unwrap();
    let [far, wrong] = unexplained(0, &exact);
    assert!(far > 65 && wrong <= 6, "{far} pixels differ, {wrong} without a reason");
    let elsewhere = |field: &DecodedFrame, scene: &Scene| {
        let moved = scene.matrix.iter().enumerate().map(|(i, v)| if i == 12 { v + 0.02 } else { *v });
        let matrix: Vec<f64> = moved.collect();
        trace::<f32>(field, &Scene { matrix: matrix.try_into().unwrap(), ..*scene }).unwrap()
    };
    for f in 0..2 {
        let [far, wrong] = unexplained(f, &elsewhere);
        // Of 65,536, of which the picture ring lets 65 pass.
        assert!(wrong > 300 && 2 * wrong > far, "{far} pixels differ, {wrong} without a reason");
    }
}

#[test]
fn faint_fog_is_seen_and_what_is_blank_is_said() {
    let folder = tempfile::tempdir().unwrap();
    let with = |scale: f32, spike: f32| {
        let mut grid = ball(0.1, [0.0; 3], 3, [1.2; 3], 0.9);
        grid.leaves.values_mut().for_each(|(values, _)| values.iter_mut().for_each(|v| *v *= scale));
        let corner = grid.leaves.values_mut().next().unwrap();
        corner.0[0] = spike;
        corner.1.set(0);
        write(folder.path(), &[grid])
    };
    // One voxel is a million times as dense as the rest.
    let frames = with(1e-6, 1.0);
    let (pack, _) = build_verified(&frames, settings(Format::F32), folder.path());
    let found = ring(&pack, &frames);
    assert_eq!((found.pictures.len(), found.not_compared.len()), (1, 0), "{found:?}");
    // Windows does not replace a pack that is mapped.
    drop(pack);
    // Without the haze the picture is another.
    let lossy =
        Settings { encoding: Quality::MaxError("0.01".parse().unwrap()).into(), ..Settings::default() };
    let found = ring(&built(&frames, lossy, folder.path()), &frames);
    assert!(found.pictures[0].source.flip > 0.02 && !found.warnings.is_empty(), "{found:?}");
    assert!(found.failures.is_empty(), "no limit was asked");

    let frames = with(-1.0, -2.0);
    let found = ring(&built(&frames, settings(Format::F32), folder.path()), &frames);
    assert!(found.pictures.is_empty() && found.not_compared[0].contains("blank"), "{found:?}");
}

#[test]
fn a_frame_whose_pack_is_empty_is_compared() {
    let folder = tempfile::tempdir().unwrap();
    let faint = {
        let mut grid = ball(0.1, [0.0; 3], 3, [1.2; 3], 0.9);
        grid.leaves.values_mut().for_each(|(values, _)| values.iter_mut().for_each(|v| *v *= 0.02));
        grid
    };
    let frames = write(folder.path(), &[ball(0.1, [0.0; 3], 3, [1.2; 3], 0.9), faint]);
    let coarse = Settings { encoding: Quality::Psnr(30.0).into(), ..Settings::default() };
    let pack = built(&frames, coarse, folder.path());
    assert!(pack.frame_tree(0, 1).bounds().is_empty(), "its haze was dropped");
    let found = ring(&pack, &frames);
    let last = found.pictures.iter().find(|picture| picture.frame == 1).expect("the frame is compared");
    assert!(last.source.flip > 0.0, "{last:?}");
}
