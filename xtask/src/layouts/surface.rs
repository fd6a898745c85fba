//! The rows of a level set: depth and normal of the trilinear zero, by today's tracer and by filtered bricks.

use std::error::Error;
use std::fmt::Write;

use serde::{Deserialize, Serialize};
use volpack::codec::{Codec, TexelCodec};
use volpack::pack::Pack;
use volpack::render::gpu::{CUBIC_WGSL, Gpu as Tracer, Uploaded};
use volpack::render::{Mode, Scene};
use volpack::volume::CoordBox;

use super::atlas::{self, Texture};
use super::bricks::{self, Choices, Coding, Decoded, SHAPES};
use super::fog::codec_bits;
use super::gpu::{Gpu, Program};
use super::params::Params;
use super::report::{Bytes, Times, cells_of};
use super::source::Source;
use super::voxels::Voxels;
use super::{Maker, STEP};
use crate::trace;

static SURFACE: [&str; 3] = [CUBIC_WGSL, include_str!("filtered.wgsl"), include_str!("surface.wgsl")];

/// The method that fetches no corners.
const FILTERED: &str = "filtered only";

/// f32 is the reference, f16 shows what a method does without errors of texels.
const CODINGS: [Coding; 4] = [
    Coding::Uniform(TexelCodec::F16),
    Coding::Uniform(TexelCodec::UNORM8),
    Coding::Uniform(TexelCodec::BC4),
    Coding::Adaptive,
];

/// A pixel's depth in voxels, −1 without a hit, and its normal.
type Pixel = [f32; 4];

/// A mean, the value that 99 of 100 are below, and the largest.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct Spread {
    pub mean: f64,
    pub p99: f64,
    pub max: f64,
}

/// How far a picture is from the reference, over pixels that hit in both.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct Errors {
    /// In voxels.
    pub depth: Spread,
    /// Of the normal, in degrees.
    pub angle: Spread,
    /// Pixels that hit in both.
    pub hits: usize,
    /// Pixels that hit in one of the two only.
    pub apart: usize,
}

/// One method with one coding of one level set.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct SurfaceRow {
    pub volume: String,
    pub method: String,
    pub lookup: String,
    pub coding: String,
    pub bricks: usize,
    pub bytes: Bytes,
    pub errors: Errors,
    pub times: Option<Times>,
}

/// A picture by today's tracer.
pub struct Traced {
    tracer: &'static Tracer,
    uploaded: Uploaded,
    bounds: CoordBox,
    scene: Scene,
}

impl Traced {
    fn new(pack: &Pack, size: [u32; 2]) -> Result<Self, Box<dyn Error>> {
        let tracer = Tracer::shared()?;
        let scene = trace::scene(&pack.grids()[0], Mode::Normals, size);
        Ok(Self { tracer, uploaded: tracer.upload(pack)?, bounds: pack.frame_tree(0, 0).bounds(), scene })
    }

    /// Milliseconds of frames that find depth and normal.
    pub fn time(&self, frames: u32) -> Result<Vec<f64>, Box<dyn Error>> {
        let Self { tracer, uploaded, bounds, scene } = self;
        Ok(tracer.trace_timed(uploaded, [0, 0], *bounds, scene, frames)?.1)
    }

    /// `voxel` is a voxel's side in world units.
    fn picture(&self, voxel: f64) -> Result<Vec<Pixel>, Box<dyn Error>> {
        let picture = |mode| {
            let scene = Scene { mode, ..self.scene };
            self.tracer.trace(&self.uploaded, [0, 0], self.bounds, &scene)
        };
        let (depths, normals) = (picture(Mode::Depth)?.pixels, picture(Mode::Normals)?.pixels);
        let pixel = |(depth, normal): (&[f32; 4], &[f32; 4])| {
            let [x, y, z, _] = normal.map(|c| 2.0 * c - 1.0);
            if depth[0] < 0.0 {
                [-1.0, 0.0, 0.0, 0.0]
            } else {
                [(f64::from(depth[0]) / voxel) as f32, x, y, z]
            }
        };
        Ok(depths.iter().zip(&normals).map(pixel).collect())
    }
}

/// All rows of a level set, and what makes their pictures. The first is the reference.
pub fn rows(
    gpu: &mut Gpu,
    source: &Source,
    size: [u32; 2],
) -> Result<(Vec<SurfaceRow>, Vec<Maker>), Box<dyn Error>> {
    let voxel = 1.0 / source.view.forward.iter().map(|c| c * c).sum::<f64>().sqrt();
    let (mut rows, mut makers, mut reference) = (Vec::new(), Vec::new(), Vec::new());
    let row = |method: &str, lookup: &str, coding: Coding, bricks, bytes, errors| SurfaceRow {
        volume: source.name.clone(),
        method: method.to_owned(),
        lookup: lookup.to_owned(),
        coding: coding.name().to_owned(),
        bricks,
        bytes,
        errors,
        times: None,
    };
    for coding in [Coding::Uniform(TexelCodec::F32)].into_iter().chain(CODINGS) {
        let pack = source.pack(coding)?;
        let traced = Traced::new(&pack, size)?;
        let picture = traced.picture(voxel)?;
        if reference.is_empty() {
            reference = picture.clone();
        }
        let bricks = Choices::of(&pack, &Voxels::of(&pack)?).with_texels();
        let errors = errors(&picture, &reference);
        rows.push(row("fetched corners, as today", "tree", coding, bricks, Bytes::of(&pack), errors));
        makers.push(Maker::Tracer(Box::new(traced)));
    }
    let shape = SHAPES[0];
    let cut = bricks::cut(&source.voxels, shape);
    let output = gpu.output(size, 4);
    for coding in CODINGS {
        let encoded = bricks::encode(&cut, shape, &source.sequence, coding, &source.choices)?;
        let textures: Vec<Texture> =
            Codec::WITH_TEXELS.iter().filter_map(|codec| atlas::texture(shape, *codec, &encoded)).collect();
        let codecs = codec_bits(textures.iter().map(|texture| texture.codec));
        let textures = gpu.upload(&textures)?;
        let bricks = Decoded::new(shape, source.voxels.background, &encoded).with_texels().count();
        let texels = encoded.iter().map(|(_, brick)| brick.bytes.len() as u64).sum();
        let ends = source.view.ends(shape.pitch);
        for (name, lookup) in
            [("indirection", atlas::indirection(&encoded, ends)), ("tree", atlas::tree(&encoded, ends))]
        {
            let bytes = Bytes { texels, records: lookup.record_bytes, tree: lookup.tree_bytes(), masks: 0 };
            let params = Params::with_lookup(source, size, shape.pitch, &lookup, &textures);
            for (exact, method) in [(true, "filtered steps, fetched corners"), (false, FILTERED)] {
                let constants = vec![
                    ("VP_CODECS", codecs),
                    ("TREE", f64::from(u8::from(name == "tree"))),
                    ("RECORDS", f64::from(u8::from(lookup.has_records))),
                    ("PITCH", f64::from(shape.pitch)),
                    ("EXACT", f64::from(u8::from(exact))),
                ];
                let program = Program { files: &SURFACE, constants };
                let kernel = gpu.kernel(&program, &lookup.words, &textures, params, &output);
                let picture = gpu.picture(&kernel)?;
                let errors = errors(picture.as_chunks().0, &reference);
                rows.push(row(method, name, coding, bricks, bytes, errors));
                makers.push(Maker::Shader(kernel));
            }
        }
    }
    Ok((rows, makers))
}

fn errors(ours: &[Pixel], reference: &[Pixel]) -> Errors {
    let pairs = || ours.iter().zip(reference);
    let hits: Vec<_> = pairs().filter(|(a, b)| a[0] >= 0.0 && b[0] >= 0.0).collect();
    let apart = pairs().filter(|(a, b)| (a[0] >= 0.0) != (b[0] >= 0.0)).count();
    let angle = |a: &Pixel, b: &Pixel| {
        let [a, b] = [a, b].map(|p| [p[1], p[2], p[3]].map(f64::from));
        let dot: f64 = (0..3).map(|i| a[i] * b[i]).sum();
        let cross: f64 =
            (0..3).map(|i| (a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3]).powi(2)).sum();
        // More exact than an arc cosine near 0.
        cross.sqrt().atan2(dot).to_degrees()
    };
    Errors {
        depth: Spread::of(hits.iter().map(|(a, b)| f64::from((a[0] - b[0]).abs())).collect()),
        angle: Spread::of(hits.iter().map(|(a, b)| angle(a, b)).collect()),
        hits: hits.len(),
        apart,
    }
}

impl Spread {
    fn of(mut values: Vec<f64>) -> Self {
        values.sort_by(f64::total_cmp);
        let Some(&max) = values.last() else { return Self::default() };
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        Self { mean, p99: values[(values.len() - 1) * 99 / 100], max }
    }
}

/// How many rows without errors of texels are farther from the reference than filter weights of 8 bits explain: by depth in 99 of 100
/// pixels, by the mean angle (differences of filtered samples round off the edges of a surface), or by pixels that hit in one picture only.
pub fn check(rows: &[SurfaceRow]) -> usize {
    let is_wrong = |row: &&SurfaceRow| {
        let Errors { depth, angle, hits, apart } = row.errors;
        let [voxels, degrees] = if row.method == FILTERED { [0.02, 1.0] } else { [1e-3, 0.01] };
        depth.p99 > voxels || angle.mean > degrees || apart * 100 > hits
    };
    let wrong = rows.iter().filter(|row| row.coding == TexelCodec::F16.name()).filter(is_wrong);
    wrong.inspect(|row| println!("WRONG: {} {} {}", row.method, row.lookup, row.coding)).count()
}

/// The table of level set rows, as Markdown.
pub fn table(rows: &[SurfaceRow]) -> String {
    let mut table = format!(
        "| volume | method | lookup | codec | {} depth mean | 99 % | max voxels | normal mean | 99 % | max ° | pixels | in one only |\n{}|\n",
        "ms | spread | MB | texels | records | tree | bricks |",
        "|---".repeat(19)
    );
    for row in rows {
        let Errors { depth, angle, hits, apart } = row.errors;
        // Writing to a string does not fail.
        let _ = writeln!(
            table,
            "| {} | {} | {} | {} | {} | {:.5} | {:.5} | {:.4} | {:.3} | {:.3} | {:.2} | {hits} | {apart} |",
            row.volume,
            row.method,
            row.lookup,
            row.coding,
            cells_of(row.times.as_ref(), &row.bytes, row.bricks),
            depth.mean,
            depth.p99,
            depth.max,
            angle.mean,
            angle.p99,
            angle.max,
        );
    }
    table
}

/// What the table's columns are.
pub fn notes() -> String {
    format!(
        "Depth and normal of the first zero of the trilinear field, against today's tracer on the f32 pack. Filtered bricks are 8³ at pitch 7. \
         Filtered steps are {STEP} voxels."
    )
}
