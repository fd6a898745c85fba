//! Similar bricks made one by k-means, as the Utrecht thesis does it (4.5 and 5.3): of bricks that vary little, all
//! of a cluster take the values of its centroid.

use ndarray::ArrayView2;
use rayon::prelude::*;

use super::kmeans::{KMeansSettings, kmeans};
use super::{Allocation, Coding, Shape, windows};
use crate::codec::{BrickRange, SequenceRange, TexelCodec, Texels, decode, encode};
use crate::error::{Error, Result};
use crate::settings::{Clustering, RangeMode};
use crate::stages::dedup::{SequenceTree, texel_mask};
use crate::stages::encoder_cache::EncoderCache;
use crate::volume::{BRICK_VOXELS, BRICKS_IN_FLIGHT, Brick, Mask512, ValueRange};

/// Gives every brick of the tree of `grid` one codec, and clusters those of little variance. The voxels of those are in memory
/// together: 2 KB a brick.
///
/// # Errors
/// When bricks cannot be read, or a centroid has a value that the codec cannot hold.
pub fn clustered(
    grid: &str,
    tree: &mut SequenceTree,
    encoders: &EncoderCache,
    codec: TexelCodec,
    mode: RangeMode,
    clustering: &Clustering,
) -> Result<Allocation> {
    let mut allocation = Allocation::new(&tree.scratch, encoders);
    let sequence = allocation.sequence;
    let (mut ids, mut points) = (Vec::new(), Vec::new());
    for window in windows(tree.pool.len(), BRICKS_IN_FLIGHT) {
        tree.fetch(&window)?;
        let bricks = tree.pool.read(&window)?;
        for (id, brick) in window.into_iter().zip(&bricks) {
            if variance(brick) <= clustering.variance {
                ids.push(id);
                points.extend(brick.values.iter().map(|v| fraction(&sequence, *v)));
            }
        }
    }
    let points = ArrayView2::from_shape((ids.len(), BRICK_VOXELS), &points).expect("512 values a brick");
    let found = kmeans(
        points,
        &KMeansSettings {
            clusters: clustering.clusters as usize,
            iterations: clustering.iterations as usize,
            seed: clustering.seed,
        },
    );

    let centroids: Vec<Texels> =
        found.centroids.rows().into_iter().map(|row| texels(&sequence, mode, &row.to_vec())).collect();
    let encoded = encode(codec, &sequence, &centroids)
        .map_err(|source| Error::OutOfRange { grid: grid.to_owned(), source })?;
    let size = codec.codec().layout().brick_bytes();
    allocation.shapes = encoded
        .bytes
        .chunks_exact(size)
        .zip(encoded.axes)
        .map(|(bytes, axis)| Shape { codec, bytes: bytes.to_vec(), axis })
        .collect();
    let decoded: Vec<_> = allocation
        .shapes
        .par_iter()
        .zip(&centroids)
        .map(|(shape, texels)| decode(codec.codec(), &shape.bytes, shape.axis, &sequence, texels.range))
        .collect();

    // Texels that are fractions are read by the range that they were made with; what bounds raw ones is what they
    // decode to.
    let ranges: Vec<BrickRange> = decoded
        .iter()
        .zip(&centroids)
        .map(
            |(values, texels)| {
                if codec.codec().is_normalised() { texels.range } else { fit(&sequence, values) }
            },
        )
        .collect();

    let mut members = ids.iter().zip(&found.members).peekable();
    for id in 0..tree.pool.len() {
        match members.next_if(|(member, _)| **member == id) {
            Some((_, &shape)) => allocation.push(Coding::Clustered(shape), Some(ranges[shape as usize])),
            None => allocation.push(Coding::Own(codec), None),
        }
    }
    let rules = tree.brick_rules();
    for (ids, shapes) in
        ids.chunks(BRICKS_IN_FLIGHT as usize).zip(found.members.chunks(BRICKS_IN_FLIGHT as usize))
    {
        let bricks = tree.pool.read(ids)?;
        for ((&id, &shape), brick) in ids.iter().zip(shapes).zip(&bricks) {
            let texel_mask = texel_mask(&brick.active, rules[id as usize]);
            allocation.error_l2s.put(id, &[brick.error_l2(&decoded[shape as usize], &texel_mask)])?;
        }
    }
    allocation.error_l2s.flush()?;
    Ok(allocation)
}

/// The variance of a brick's values once they are stretched to 0..1: so a faint brick counts as a dense one does.
fn variance(brick: &Brick) -> f64 {
    let range = range(&brick.values);
    let extent = if range.width() > 0.0 { range.width() } else { 1.0 };
    let stretched = || brick.values.iter().map(|v| (f64::from(*v) - f64::from(range.min)) / extent);
    let mean = stretched().sum::<f64>() / BRICK_VOXELS as f64;
    stretched().map(|v| (v - mean).powi(2)).sum::<f64>() / BRICK_VOXELS as f64
}

fn fraction(sequence: &SequenceRange, value: f32) -> f32 {
    ((f64::from(value) - f64::from(sequence.lo)) / f64::from(sequence.span)) as f32
}

/// A centroid as a brick of its own.
fn texels(sequence: &SequenceRange, mode: RangeMode, centroid: &[f32]) -> Texels {
    let value =
        |i: usize| (f64::from(sequence.lo) + f64::from(sequence.span) * f64::from(centroid[i])) as f32;
    let values: [f32; BRICK_VOXELS] = std::array::from_fn(value);
    let range = match mode {
        RangeMode::Sequence => BrickRange::SEQUENCE,
        RangeMode::Brick => fit(sequence, &values),
    };
    Texels { values, texel_mask: Mask512::ALL, range }
}

/// The tightest brick range around some values.
fn fit(sequence: &SequenceRange, values: &[f32; BRICK_VOXELS]) -> BrickRange {
    let range = range(values);
    sequence.fit(range.min, range.max)
}

fn range(values: &[f32; BRICK_VOXELS]) -> ValueRange {
    ValueRange::union_all(values.iter().copied().map(ValueRange::of)).expect("a brick has values")
}
