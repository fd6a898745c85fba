//! Cuts a frame into bricks that share their outer voxels with their neighbours, and encodes them.

use std::collections::{BTreeSet, HashMap};
use std::error::Error;

use rayon::prelude::*;
use volpack::codec::{BrickRange, Codec, Half, SequenceRange, TexelCodec};
use volpack::pack::{Pack, Region};
use volpack::settings::{RangeMode, Settings};
use volpack::volume::{BRICK_DIM, Coord};

use super::blocks;
use super::voxels::{Voxels, interpolate};

/// How bricks are cut: brick b is sampled from b · pitch to (b + 1) · pitch.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shape {
    /// Texels along an axis.
    pub texels: i32,
    /// Voxels from a brick to the next.
    pub pitch: i32,
    /// Texels before the one at b · pitch.
    pub border: i32,
}

/// 8³ texels fit blocks of 4 × 4, and so do 16³; 9³ is the least for regions of 8³, 10³ what `march_limit.cu` measured.
pub const SHAPES: [Shape; 4] = [
    Shape { texels: 8, pitch: 7, border: 0 },
    Shape { texels: 9, pitch: 8, border: 0 },
    Shape { texels: 10, pitch: 8, border: 1 },
    Shape { texels: 16, pitch: 15, border: 0 },
];

impl Shape {
    /// Whether its slices are made of whole blocks.
    pub fn fits_blocks(self) -> bool {
        self.texels % 4 == 0
    }

    /// How a brick lies in a texture. Blocks that a slice fills in part are there in full.
    pub fn layout(self, codec: Codec) -> Layout {
        let texels = self.texels as usize;
        let blocks = texels.div_ceil(4);
        let (dims, rows, row_bytes) = match codec {
            Codec::Bc7 => ([4 * blocks, 4 * blocks, blocks], blocks, blocks * 16),
            Codec::Bc4 => ([4 * blocks, 4 * blocks, texels], blocks, blocks * 8),
            Codec::F16 => ([texels; 3], texels, texels * 2),
            Codec::F32 => ([texels; 3], texels, texels * 4),
            Codec::Unorm8 | Codec::Constant => ([texels; 3], texels, texels),
        };
        Layout { dims, rows, row_bytes }
    }
}

/// One brick in a texture.
#[derive(Clone, Copy)]
pub struct Layout {
    /// Texels along x, y and z.
    pub dims: [usize; 3],
    /// Rows of texels or of blocks in a slice.
    pub rows: usize,
    /// Bytes of a row.
    pub row_bytes: usize,
}

impl Layout {
    /// Bytes of a brick.
    pub fn bytes(self) -> usize {
        self.dims[2] * self.rows * self.row_bytes
    }
}

/// Something of a brick, behind the brick's place: its smallest corner is place · pitch.
pub type Placed<T> = ([i32; 3], T);

/// What a brick holds. A brick that is all background is left out.
pub enum Content {
    /// One value everywhere that it is sampled.
    Constant(f32),
    /// A value for each texel, x fastest, z slowest.
    Texels(Vec<f32>),
}

/// Cuts a frame into the bricks that are not background, in the order of their places.
pub fn cut(voxels: &Voxels, shape: Shape) -> Vec<Placed<Content>> {
    let Shape { texels, pitch, border } = shape;
    let mut places = BTreeSet::new();
    for covered in voxels.boxes() {
        let range = |a: usize| (covered.min.0[a] - 1).div_euclid(pitch)..=covered.max.0[a].div_euclid(pitch);
        places.extend(range(0).flat_map(|x| range(1).flat_map(move |y| range(2).map(move |z| [x, y, z]))));
    }
    let content = |place: [i32; 3]| {
        let origin = Coord(place.map(|b| b * pitch));
        let sampled = voxels.block(origin, [pitch + 1; 3]);
        let first = sampled[0];
        if sampled.iter().all(|v| *v == first) {
            return (first != voxels.background).then_some((place, Content::Constant(first)));
        }
        let values = voxels.block(origin.offset_by([-border; 3]), [texels; 3]);
        Some((place, Content::Texels(values)))
    };
    Vec::from_iter(places).into_par_iter().filter_map(content).collect()
}

/// How a grid's bricks are encoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Coding {
    /// One codec, with a range for each brick where the codec has ranges.
    Uniform(TexelCodec),
    /// unorm8 with one range for the grid.
    GridRange,
    /// The codec that a default adaptive pack chose there.
    Adaptive,
}

impl Coding {
    /// All that bricks are measured with. f32 is the reference and is fetched only.
    pub const ALL: [Self; 6] = [
        Self::GridRange,
        Self::Uniform(TexelCodec::UNORM8),
        Self::Uniform(TexelCodec::F16),
        Self::Uniform(TexelCodec::BC4),
        Self::Uniform(TexelCodec::BC7),
        Self::Adaptive,
    ];

    /// Its name in tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::Uniform(codec) => codec.name(),
            Self::GridRange => "unorm8, one range",
            Self::Adaptive => "adaptive",
        }
    }

    /// How today's packs are built with it.
    pub fn settings(self) -> Settings {
        match self {
            Self::Uniform(codec) => Settings { encoding: codec.into(), ..Settings::default() },
            Self::GridRange => Settings {
                encoding: TexelCodec::UNORM8.into(),
                range: RangeMode::Sequence,
                ..Settings::default()
            },
            Self::Adaptive => Settings::default(),
        }
    }
}

/// What today's adaptive pack chose.
pub struct Choices {
    /// The codec of each region of 8³ that has texels.
    codecs: HashMap<Coord, Codec>,
    /// The largest deviation of the source's values from their mean (its square's mean) in a region that became one value.
    flattest: f64,
}

impl Choices {
    /// Those of a pack's first frame. `exact` are the source's values.
    pub fn of(pack: &Pack, exact: &Voxels) -> Self {
        let mut codecs = HashMap::new();
        pack.frame_tree(0, 0).for_each_region(|origin, _, region| {
            if let Region::Brick(record) = region
                && record.codec != Codec::Constant
            {
                codecs.insert(origin, record.codec);
            }
        });
        let flattened = exact.bricks().filter(|(origin, _)| !codecs.contains_key(origin));
        let flattest = flattened.map(|(_, values)| variance(&values[..])).fold(0.0, f64::max);
        Self { codecs, flattest }
    }

    /// Regions with texels.
    pub fn with_texels(&self) -> usize {
        self.codecs.len()
    }

    /// The codec of the region that holds a brick's centre. If that has no texels, the brick is a constant too, unless its values vary more than
    /// any that today's pack flattened: then the codec is that of another region in which it lies. Bricks that do not fit blocks have
    /// bc4 for bc7.
    fn choose(&self, shape: Shape, place: [i32; 3], values: &[f32]) -> Codec {
        let origin = Coord(place.map(|b| b * shape.pitch));
        let at = |step: [i32; 3]| self.codecs.get(&origin.offset_by(step).align_down(BRICK_DIM)).copied();
        let steps = || (0..=shape.pitch).step_by(shape.pitch.min(BRICK_DIM) as usize).chain([shape.pitch]);
        let around = || {
            let mut others = steps().flat_map(|x| steps().flat_map(move |y| steps().map(move |z| [x, y, z])));
            if variance(values) <= self.flattest { None } else { others.find_map(at) }
        };
        match at([shape.pitch / 2; 3]).or_else(around) {
            Some(Codec::Bc7) if !shape.fits_blocks() => Codec::Bc4,
            chosen => chosen.unwrap_or(Codec::Constant),
        }
    }
}

fn mean(values: &[f32]) -> f64 {
    values.iter().map(|v| f64::from(*v)).sum::<f64>() / values.len() as f64
}

fn variance(values: &[f32]) -> f64 {
    let mean = mean(values);
    values.iter().map(|v| (f64::from(*v) - mean).powi(2)).sum::<f64>() / values.len() as f64
}

/// An encoded brick.
pub struct Encoded {
    /// Its codec; a constant has no texels.
    pub codec: Codec,
    /// The axis that the channels of bc7 run along.
    pub axis: u8,
    /// Its range, or a constant's value: the last word of its record.
    pub range: u32,
    /// Its rows of texels, slice by slice.
    pub bytes: Vec<u8>,
    /// What its texels decode to, x fastest, z slowest; a constant has one.
    pub decoded: Vec<f32>,
}

/// Encodes bricks. `choices` are those of the adaptive pack.
pub fn encode(
    cut: &[Placed<Content>],
    shape: Shape,
    sequence: &SequenceRange,
    coding: Coding,
    choices: &Choices,
) -> Result<Vec<Placed<Encoded>>, Box<dyn Error>> {
    let encoded = cut.par_iter().map(|(place, content)| {
        let values = match content {
            Content::Constant(value) => return Ok((*place, constant(*value))),
            Content::Texels(values) => values,
        };
        let codec = match coding {
            Coding::Uniform(codec) => codec.codec(),
            Coding::GridRange => Codec::Unorm8,
            Coding::Adaptive => choices.choose(shape, *place, values),
        };
        if codec == Codec::Constant {
            return Ok((*place, constant(mean(values) as f32)));
        }
        let (min, max) = values.iter().fold((f32::MAX, f32::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
        let range = if coding == Coding::GridRange { BrickRange::SEQUENCE } else { sequence.fit(min, max) };
        Ok((*place, encode_one(codec, shape, sequence, range, values)?))
    });
    encoded.collect::<Result<_, String>>().map_err(Into::into)
}

fn constant(value: f32) -> Encoded {
    Encoded {
        codec: Codec::Constant,
        axis: 2,
        range: value.to_bits(),
        bytes: Vec::new(),
        decoded: vec![value],
    }
}

fn encode_one(
    codec: Codec,
    shape: Shape,
    sequence: &SequenceRange,
    range: BrickRange,
    values: &[f32],
) -> Result<Encoded, String> {
    let texels = shape.texels as usize;
    let mut axis = 2;
    let (bytes, decoded) = match codec {
        Codec::Constant => unreachable!("it has no texels"),
        Codec::F32 => (bytemuck::cast_slice(values).to_vec(), values.to_vec()),
        Codec::F16 => {
            let halves: Vec<Half> = values.iter().map(|v| Half::from_f32(*v)).collect();
            (bytemuck::cast_slice(&halves).to_vec(), halves.iter().map(|h| h.to_f32()).collect())
        }
        Codec::Unorm8 => {
            let bytes = unorm8(sequence, range, values);
            let value = sequence.decoder(range);
            let decoded = bytes.iter().map(|b| value(f32::from(*b) / 255.0)).collect();
            (bytes, decoded)
        }
        Codec::Bc4 => blocks::bc4(texels, sequence, range, values).map_err(|e| e.to_string())?,
        Codec::Bc7 => {
            let value = sequence.decoder(range);
            let (best, bytes, unorms) = blocks::bc7(texels, &unorm8(sequence, range, values));
            axis = best;
            (bytes, unorms.iter().map(|b| value(f32::from(*b) / 255.0)).collect())
        }
    };
    Ok(Encoded { codec, axis, range: range.to_word(), bytes, decoded })
}

/// The nearest 255ths of a range.
fn unorm8(sequence: &SequenceRange, range: BrickRange, values: &[f32]) -> Vec<u8> {
    let (low, high) = (f64::from(sequence.decode(range, 0.0)), f64::from(sequence.decode(range, 1.0)));
    let scale = if high > low { 255.0 / (high - low) } else { 0.0 };
    values.iter().map(|v| ((f64::from(*v) - low) * scale).round() as u8).collect()
}

/// Encoded bricks as a texture unit filters them.
pub struct Decoded<'a> {
    shape: Shape,
    background: f32,
    bricks: HashMap<[i32; 3], &'a Encoded>,
}

impl<'a> Decoded<'a> {
    /// Those bricks.
    pub fn new(shape: Shape, background: f32, bricks: &'a [Placed<Encoded>]) -> Self {
        Self { shape, background, bricks: bricks.iter().map(|(place, brick)| (*place, brick)).collect() }
    }

    /// The bricks that have texels, and their places.
    pub fn with_texels(&self) -> impl Iterator<Item = (&[i32; 3], &'a Encoded)> {
        self.bricks.iter().map(|(place, brick)| (place, *brick)).filter(|(_, b)| b.codec != Codec::Constant)
    }

    /// The brick at a place, if it has texels.
    pub fn texels_at(&self, place: [i32; 3]) -> Option<&'a Encoded> {
        self.bricks.get(&place).copied().filter(|brick| brick.codec != Codec::Constant)
    }

    /// The field between voxels.
    pub fn at(&self, p: [f64; 3]) -> f64 {
        let pitch = f64::from(self.shape.pitch);
        let place = p.map(|c| (c / pitch).floor() as i32);
        match self.bricks.get(&place) {
            None => f64::from(self.background),
            Some(brick) => self.in_brick(brick, std::array::from_fn(|a| p[a] - f64::from(place[a]) * pitch)),
        }
    }

    /// The field in a brick, 0 to its pitch along each axis.
    pub fn in_brick(&self, brick: &Encoded, p: [f64; 3]) -> f64 {
        let Shape { texels, pitch, border } = self.shape;
        if brick.codec == Codec::Constant {
            return f64::from(brick.decoded[0]);
        }
        let low = p.map(|c| (c.floor() as i32).clamp(0, pitch - 1));
        let corner = |i: usize| {
            let [x, y, z] = std::array::from_fn(|a| low[a] + border + (i >> a & 1) as i32);
            f64::from(brick.decoded[((z * texels + y) * texels + x) as usize])
        };
        interpolate(std::array::from_fn(corner), std::array::from_fn(|a| p[a] - f64::from(low[a])))
    }
}
