//! Random sequences in every format, with a spread of targets: a pack that meets what was asked verifies.
//!
//! `VOLPACK_SEQUENCES=N` builds more of them, `VOLPACK_SEED=N` others; a failure prints the seed of its sequence.

mod common;
#[path = "common/vdb_writer.rs"]
mod vdb_writer;

use std::f64::consts::TAU;
use std::path::{Path, PathBuf};

use rand::{Rng, SeedableRng};
use rand_xoshiro::Xoshiro256PlusPlus;
use vdb_writer::{GridFile, write_grid};
use volpack::error::Error;
use volpack::pipeline::{Job, Silent, VerifyLevel, build};
use volpack::settings::{Format, Masks, Quality, RangeMode, Settings};

/// Sequences that a test run builds: under a minute on two cores.
const SEQUENCES: u64 = 300;

/// What a sequence's values look like.
#[derive(Clone, Copy, Debug)]
enum Field {
    /// Smooth noise that moves.
    Noise,
    /// The same above and below 0.
    Signed,
    /// One brick's shape, scaled, shifted and repeated.
    Bricks,
    /// Few values with sharp edges between them.
    Steps,
    /// Hardly anything, with a bright spot.
    Haze,
    /// A ball's distance field, three voxels to either side of its surface.
    LevelSet,
}

impl Field {
    const ALL: [Self; 6] = [Self::Noise, Self::Signed, Self::Bricks, Self::Steps, Self::Haze, Self::LevelSet];
}

/// A wave through space and time.
struct Wave {
    frequency: [f64; 4],
    phase: f64,
    amplitude: f64,
}

/// One random sequence.
struct Sequence {
    field: Field,
    frames: i32,
    /// Leaves along each axis.
    leaves: [i32; 3],
    background: f32,
    voxel_size: f64,
    scale: f64,
    waves: Vec<Wave>,
    /// Scale and shift of bricks, of which each takes one.
    brick_ranges: Vec<(f64, f64)>,
    /// How far bricks of one shape are from each other.
    jitter: f64,
    /// Which voxels are active: all, those that are not the background, or those of even coordinates too.
    activity: u32,
    /// Where the bright spot or the ball's middle is, and how it moves.
    middle: [f64; 3],
    motion: [f64; 3],
}

impl Sequence {
    fn random(rng: &mut Xoshiro256PlusPlus) -> Self {
        // Bricks twice as often as others: texels that serve several are where most can go wrong.
        let field = Field::ALL.get(rng.gen_range(0..=Field::ALL.len())).copied().unwrap_or(Field::Bricks);
        let leaves = std::array::from_fn(|_| rng.gen_range(1..=4));
        let voxel_size = [0.01, 0.1, 1.0, 12.5][rng.gen_range(0..4)];
        let background = match field {
            Field::LevelSet => (3.0 * voxel_size) as f32,
            _ => [0.0, 0.0, 0.0, -0.5, 1.0][rng.gen_range(0..5)],
        };
        let wave = |rng: &mut Xoshiro256PlusPlus| Wave {
            frequency: std::array::from_fn(|_| rng.gen_range(-0.06..0.06)),
            phase: rng.gen_range(0.0..TAU),
            amplitude: rng.gen_range(0.1..1.0),
        };
        // Powers of two give equal ranges after rounding, which is where borrowed texels look like own ones.
        let range = |rng: &mut Xoshiro256PlusPlus| {
            ([1.0, 1.0, 0.5, 0.25, 0.013][rng.gen_range(0..5)], [0.0, 0.0, 0.125][rng.gen_range(0..3)])
        };
        Self {
            field,
            frames: rng.gen_range(1..=4),
            leaves,
            background,
            voxel_size,
            scale: [1.0, 1.0, 5.7, 1e-3, 2000.0][rng.gen_range(0..5)],
            waves: (0..rng.gen_range(1..=4)).map(|_| wave(rng)).collect(),
            brick_ranges: (0..rng.gen_range(1..=4)).map(|_| range(rng)).collect(),
            jitter: [0.0, 0.003, 0.01, 0.03][rng.gen_range(0..4)],
            activity: rng.gen_range(0..3),
            middle: std::array::from_fn(|a| rng.gen_range(0.0..8.0 * f64::from(leaves[a]))),
            motion: std::array::from_fn(|_| rng.gen_range(-3.0..3.0)),
        }
    }

    fn noise(&self, at: [f64; 3], time: f64) -> f64 {
        let wave = |wave: &Wave| {
            let [x, y, z, t] = wave.frequency;
            let turns = x * at[0] + y * at[1] + z * at[2] + 4.0 * t * time;
            wave.amplitude * (TAU * turns + wave.phase).sin()
        };
        self.waves.iter().map(wave).sum()
    }

    fn distance(&self, at: [f64; 3], time: f64) -> f64 {
        (0..3).map(|a| (at[a] - self.middle[a] - self.motion[a] * time).powi(2)).sum::<f64>().sqrt()
    }

    fn value(&self, voxel: [i32; 3], frame: i32) -> f32 {
        let (at, time) = (voxel.map(f64::from), f64::from(frame));
        let noise = || self.noise(at, time);
        let value = match self.field {
            Field::Noise => noise().max(0.0),
            Field::Signed => noise(),
            Field::Bricks => {
                let inside = voxel.map(|v| f64::from(v & 7));
                let brick = voxel.map(|v| v >> 3);
                let which = (brick[0] * 7 + brick[1] * 3 + brick[2] + frame) as usize;
                let (gain, shift) = self.brick_ranges[which % self.brick_ranges.len()];
                // Corners keep the range of a brick what it is, so that another's texels suit it as they are.
                let shape = match voxel.map(|v| v & 7) {
                    [0, 0, 0] => 0.0,
                    [7, 7, 7] => 1.0,
                    _ => {
                        0.5 + 0.45 * self.noise(inside, 0.0).clamp(-1.0, 1.0)
                            + self.jitter * hash(voxel, frame)
                    }
                };
                gain * shape + shift
            }
            Field::Steps => (3.0 * noise()).floor() / 3.0,
            Field::Haze => 0.01 * noise().max(0.0) + f64::from(self.distance(at, time) < 2.0),
            Field::LevelSet => {
                let distance = (self.distance(at, time) - 6.0) * self.voxel_size;
                return (distance as f32).clamp(-self.background, self.background);
            }
        };
        (value * self.scale) as f32
    }

    fn is_active(&self, voxel: [i32; 3], value: f32) -> bool {
        match (self.field, self.activity) {
            (Field::LevelSet, _) => value.abs() < self.background,
            (_, 0) => true,
            (_, 1) => value != self.background,
            _ => value != self.background && voxel.iter().all(|v| v & 1 == 0),
        }
    }

    /// Writes its frames into a folder.
    fn write(&self, folder: &Path) -> Vec<PathBuf> {
        let class = if matches!(self.field, Field::LevelSet) { "level set" } else { "fog volume" };
        let frame = |frame: i32| {
            let path = folder.join(format!("random_{frame:04}.vdb"));
            let grid = GridFile::new("density", "Tree_float_5_4_3", self.background).of_class(class);
            let grid = GridFile { voxel_size: self.voxel_size, ..grid };
            write_grid(
                &path,
                &grid.fill(self.leaves, |voxel| {
                    let value = self.value(voxel, frame);
                    (value, self.is_active(voxel, value))
                }),
            );
            path
        };
        (0..self.frames).map(frame).collect()
    }
}

/// A number from -0.5 to 0.5 that says nothing.
fn hash(voxel: [i32; 3], frame: i32) -> f64 {
    let mut h = [voxel[0], voxel[1], voxel[2], frame]
        .iter()
        .fold(0x9e37_79b9u32, |h, v| (h ^ *v as u32).wrapping_mul(0x85eb_ca6b).rotate_left(13));
    h = (h ^ h >> 16).wrapping_mul(0xc2b2_ae35);
    f64::from(h ^ h >> 15) / f64::from(u32::MAX) - 0.5
}

/// One of each kind of target for the adaptive format, and one of the uniform formats.
fn settings(rng: &mut Xoshiro256PlusPlus) -> Vec<Settings> {
    let max_error = [0.1, 0.02, 0.01, 0.005, 0.001][rng.gen_range(0..5)];
    let qualities = [
        Quality::Psnr(rng.gen_range(20.0..75.0)),
        Quality::Psnr(rng.gen_range(40.0..65.0)),
        Quality::MaxError(max_error.to_string().parse().unwrap()),
        Quality::BitsPerVoxel(rng.gen_range(0.5..12.0)),
    ];
    let adaptive = qualities.map(|quality| Settings { encoding: quality.into(), ..Settings::default() });
    let uniform = Format::ALL[1 + rng.gen_range(0..5)];
    let mut all = adaptive.to_vec();
    all.push(Settings { encoding: uniform.into(), ..Settings::default() });
    for settings in &mut all {
        settings.range = [RangeMode::Brick, RangeMode::Brick, RangeMode::Sequence][rng.gen_range(0..3)];
        settings.masks = [Masks::Auto, Masks::Auto, Masks::Keep, Masks::Drop][rng.gen_range(0..4)];
        settings.zstd = 0;
    }
    all
}

/// Why a good pack may be refused all the same.
fn may_be_refused(sequence: &Sequence, settings: &Settings, why: &str) -> bool {
    let blocks = matches!(settings.format(), Format::UNORM8 | Format::BC4 | Format::BC7);
    let is_level_set = matches!(sequence.field, Field::LevelSet);
    let is_little = ["cannot be reached, the least is", "the pack has none of its", "is under 20 dB"];
    settings.quality().is_size() && is_little.iter().any(|little| why.contains(little))
        || blocks && is_level_set && why.contains("flipped")
}

#[test]
fn what_meets_its_target_verifies() {
    let number = |name: &str, default| {
        std::env::var(name).map_or(default, |text| text.parse().unwrap_or_else(|e| panic!("{name}: {e}")))
    };
    let (first, count) = (number("VOLPACK_SEED", 0), number("VOLPACK_SEQUENCES", SEQUENCES));
    let mut failed = Vec::new();
    for seed in first..first + count {
        let folder = tempfile::tempdir().unwrap();
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
        let sequence = Sequence::random(&mut rng);
        let frames = sequence.write(folder.path());
        for settings in settings(&mut rng) {
            let job = Job::new(
                frames.clone(),
                folder.path().join("random.volpack"),
                settings.clone(),
                VerifyLevel::Voxels,
            );
            let failures = match build(&job, &mut Silent) {
                Ok(outcome) => outcome.verification.unwrap().failures,
                Err(error @ (Error::Usage(_) | Error::OutOfRange { .. })) => vec![error.to_string()],
                Err(error) => panic!("seed {seed}: {error}"),
            };
            failed.extend(failures.iter().filter(|why| !may_be_refused(&sequence, &settings, why)).map(
                |why| {
                    format!(
                        "seed {seed}: {:?} of {} frames, {} {}, {:?} range, {:?} masks: {why}",
                        sequence.field,
                        sequence.frames,
                        settings.format().name(),
                        settings.quality(),
                        settings.range,
                        settings.masks,
                    )
                },
            ));
        }
    }
    assert!(failed.is_empty(), "{} failures:\n{}", failed.len(), failed.join("\n"));
}
