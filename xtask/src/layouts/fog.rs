//! The rows of a fog volume: every layout with every codec.

use std::error::Error;

use volpack::codec::{Codec, TexelCodec};
use volpack::pack::Pack;

use super::atlas::{self, Texture};
use super::bricks::{self, Choices, Coding, Decoded, Encoded, Placed, SHAPES, Shape};
use super::gpu::{Gpu, Program, Textures};
use super::params::Params;
use super::quality::{self, Field};
use super::report::{Bytes, Row};
use super::source::Source;
use super::voxels::{Voxels, interpolate};
use super::{Entry, Maker, STEP};

static FETCH: [&str; 2] = [include_str!("density.wgsl"), include_str!("fetch.wgsl")];
static FILTERED: [&str; 3] =
    [include_str!("density.wgsl"), include_str!("filtered.wgsl"), include_str!("fog.wgsl")];
static DENSE: [&str; 2] = [include_str!("density.wgsl"), include_str!("dense.wgsl")];

/// Regions of the dense texture's indirection, as packs have them.
const DENSE_SHAPE: Shape = Shape { texels: 9, pitch: 8, border: 0 };

/// Builds the rows of one volume.
pub struct Fog<'a> {
    gpu: &'a mut Gpu,
    source: &'a Source,
    output: wgpu::Buffer,
    size: [u32; 2],
    /// Whether pictures of decoded texels are computed on the CPU too.
    check: bool,
    entries: Vec<Entry>,
}

impl<'a> Fog<'a> {
    /// All rows; the first is the reference.
    pub fn rows(
        gpu: &'a mut Gpu,
        source: &'a Source,
        size: [u32; 2],
        check: bool,
    ) -> Result<Vec<Entry>, Box<dyn Error>> {
        let output = gpu.output(size, 1);
        let mut fog = Self { gpu, source, output, size, check, entries: Vec::new() };
        fog.add_all()?;
        Ok(fog.entries)
    }

    fn add_all(&mut self) -> Result<(), Box<dyn Error>> {
        for coding in [Coding::Uniform(TexelCodec::F32)].into_iter().chain(Coding::ALL) {
            self.fetched(coding)?;
        }
        for shape in SHAPES {
            let cut = bricks::cut(&self.source.voxels, shape);
            for coding in Coding::ALL {
                if coding == Coding::Uniform(TexelCodec::BC7) && !shape.fits_blocks() {
                    continue;
                }
                let Source { sequence, choices, .. } = self.source;
                let encoded = bricks::encode(&cut, shape, sequence, coding, choices)?;
                self.filtered(shape, coding, &encoded)?;
            }
        }
        self.dense()
    }

    /// Adds a row. `field` is what its texels decode to.
    fn add(
        &mut self,
        program: Program,
        words: &[u32],
        textures: &Textures,
        params: Params,
        mut row: Row,
        field: Field,
    ) -> Result<(), Box<dyn Error>> {
        let kernel = self.gpu.kernel(&program, words, textures, params, &self.output);
        let picture = self.gpu.picture(&kernel)?;
        let reference = self.entries.first().map_or(&picture, |first| &first.picture);
        row.picture = quality::apart(&picture, reference);
        row.mean = quality::mean(&picture);
        if self.check {
            let model = quality::march(field, &self.source.view, self.size, STEP);
            row.model = Some(quality::apart(&picture, &model));
        }
        self.entries.push(Entry { row, maker: Maker::Shader(kernel), picture });
        Ok(())
    }

    /// Today's pack, with eight fetches a sample.
    fn fetched(&mut self, coding: Coding) -> Result<(), Box<dyn Error>> {
        let source = self.source;
        let pack = source.pack(coding)?;
        let voxels = Voxels::of(&pack)?;
        let field = |p| voxels.at(p);
        let psnr = source.psnr(&field);
        let textures = Codec::WITH_TEXELS.iter().filter_map(|codec| pack_texture(&pack, *codec));
        let textures = textures.collect::<Result<Vec<_>, _>>()?;
        let codecs = textures.iter().map(|texture| texture.codec);
        let tree = pack.tree();
        let bricks = Choices::of(&pack, &voxels).with_texels();
        let bytes = Bytes::of(&pack);
        let constants =
            [("VP_CODECS", codec_bits(codecs)), ("VP_MASKS", f64::from(u8::from(bytes.masks > 0)))];
        let textures = self.gpu.upload(&textures)?;
        let params = Params::new(source, self.size, source.voxels.bounds.min.0, &textures);
        for (keep, layout) in [(false, "fetch, as today"), (true, "fetch, brick kept")] {
            let constants = [&constants[..], &[("KEEP", f64::from(u8::from(keep)))]].concat();
            let row = Row::new(&source.name, layout, "tree", coding.name(), bricks, bytes, psnr);
            self.add(Program { files: &FETCH, constants }, tree, &textures, params, row, &field)?;
        }
        Ok(())
    }

    /// Filtered bricks, behind an indirection and behind a tree.
    fn filtered(
        &mut self,
        shape: Shape,
        coding: Coding,
        encoded: &[Placed<Encoded>],
    ) -> Result<(), Box<dyn Error>> {
        let source = self.source;
        let decoded = Decoded::new(shape, source.voxels.background, encoded);
        let field = |p| decoded.at(p);
        let psnr = source.psnr(&field);
        let seams = quality::seams(&decoded, shape.pitch, source.peak);
        let textures: Vec<Texture> =
            Codec::WITH_TEXELS.iter().filter_map(|codec| atlas::texture(shape, *codec, encoded)).collect();
        let codecs = codec_bits(textures.iter().map(|texture| texture.codec));
        let textures = self.gpu.upload(&textures)?;
        let bricks = decoded.with_texels().count();
        let texels = encoded.iter().map(|(_, brick)| brick.bytes.len() as u64).sum();
        let ends = source.view.ends(shape.pitch);
        for (name, lookup) in
            [("indirection", atlas::indirection(encoded, ends)), ("tree", atlas::tree(encoded, ends))]
        {
            let bytes = Bytes { texels, records: lookup.record_bytes, tree: lookup.tree_bytes(), masks: 0 };
            let layout = format!("{}³ at pitch {}", shape.texels, shape.pitch);
            let mut row = Row::new(&source.name, &layout, name, coding.name(), bricks, bytes, psnr);
            row.seams = seams;
            let constants = vec![
                ("VP_CODECS", codecs),
                ("TREE", f64::from(u8::from(name == "tree"))),
                ("RECORDS", f64::from(u8::from(lookup.has_records))),
                ("PITCH", f64::from(shape.pitch)),
                ("BORDER", f64::from(shape.border)),
            ];
            let params = Params::with_lookup(source, self.size, shape.pitch, &lookup, &textures);
            let program = Program { files: &FILTERED, constants };
            self.add(program, &lookup.words, &textures, params, row, &field)?;
        }
        Ok(())
    }

    /// One texture of the whole box.
    fn dense(&mut self) -> Result<(), Box<dyn Error>> {
        let source = self.source;
        let pitch = DENSE_SHAPE.pitch;
        let cut = bricks::cut(&source.voxels, DENSE_SHAPE);
        let regions: Vec<_> =
            bricks::encode(&cut, DENSE_SHAPE, &source.sequence, Coding::GridRange, &source.choices)?;
        let mut lookup = atlas::indirection(&regions, source.view.ends(pitch));
        // Nothing but whether a region is empty is asked for.
        lookup.words.truncate(lookup.records_at as usize);
        lookup.record_bytes = 0;
        let size = lookup.cells.map(|n| n as i32 * pitch + 2);
        let first: [i32; 3] = lookup.origin.map(|place| place * pitch - 1);
        let values = source.voxels.block(volpack::volume::Coord(first), size);
        let (lo, span) = (source.sequence.lo, source.sequence.span);
        let bytes: Vec<u8> = values.iter().map(|v| ((v - lo) / span * 255.0).round() as u8).collect();
        let [width, height, _] = size.map(|n| n as usize);
        let field = |p: [f64; 3]| {
            let low = p.map(f64::floor);
            let corner = |i: usize| {
                let [x, y, z] = std::array::from_fn(|a| {
                    (low[a] as i32 - first[a] + (i >> a & 1) as i32).clamp(0, size[a] - 1) as usize
                });
                f64::from(lo) + f64::from(span) * f64::from(bytes[(z * height + y) * width + x]) / 255.0
            };
            interpolate(std::array::from_fn(corner), std::array::from_fn(|a| p[a] - low[a]))
        };
        let psnr = source.psnr(&field);
        let texture = Texture {
            codec: Codec::Unorm8,
            size: size.map(|n| n as u32),
            bytes: bytes.clone(),
            columns: 1,
            brick: size.map(|n| n as u32),
        };
        let textures = self.gpu.upload(&[texture])?;
        let params = Params::with_lookup(source, self.size, pitch, &lookup, &textures);
        for (skip, name) in [(false, "none"), (true, "indirection")] {
            let tree = if skip { lookup.tree_bytes() } else { 0 };
            let bytes = Bytes { texels: bytes.len() as u64, records: 0, tree, masks: 0 };
            let row = Row::new(&source.name, "dense", name, Coding::GridRange.name(), 0, bytes, psnr);
            let constants = vec![("SKIP", f64::from(u8::from(skip)))];
            let program = Program { files: &DENSE, constants };
            self.add(program, &lookup.words, &textures, params, row, &field)?;
        }
        Ok(())
    }
}

/// Bit `tag` for each codec, and bit 0 for constants: `VP_CODECS` of volpack.wgsl.
pub fn codec_bits(codecs: impl Iterator<Item = Codec>) -> f64 {
    f64::from(codecs.fold(1u32, |bits, codec| bits | 1 << codec as u32))
}

/// A pack's texture of a codec: its slabs follow each other as slices do.
fn pack_texture(pack: &Pack, codec: Codec) -> Option<Result<Texture, Box<dyn Error>>> {
    let atlas = *pack.atlas(codec)?;
    Some((|| {
        if atlas.slabs > atlas.page_slabs {
            return Err(format!("{} has more than one texture page", codec.name()).into());
        }
        let mut bytes = Vec::new();
        for slab in 0..atlas.slabs {
            bytes.extend_from_slice(&pack.slab(codec, slab)?);
        }
        let brick = [8, 8, codec.layout().slices as u32];
        let size = [atlas.columns * 8, atlas.rows * 8, atlas.slabs * brick[2]];
        Ok(Texture { codec, size, bytes, columns: atlas.columns, brick })
    })())
}
