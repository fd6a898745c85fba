//! K-means of voxel bricks under the mean absolute difference: Lloyd's iterations with exact pruning.
//!
//! Every pruned candidate is provably no nearer than the best one, so assignments, tie-breaks and
//! centroids are those of a brute-force search over [`distance`], bit for bit.

#[cfg(test)]
mod tests;

use std::{collections::HashSet, ops::Range};

use ndarray::{Array2, ArrayView2};
use rand::{SeedableRng, seq::index::sample};
use rand_xoshiro::Xoshiro256Plus;
use rayon::prelude::*;

/// Sums kept per row: 2³-voxel blocks of an 8³ brick.
const FINE: usize = 64;
/// Sums kept per row one level up: 4³-voxel blocks of an 8³ brick.
const COARSE: usize = 8;
/// A row is walked in four parts, each covered by a contiguous quarter of the fine sums (two x-slices of a
/// brick), so that a part's bound can be swapped for its exact distance.
const PART: usize = FINE / 4;
/// Independent f32 accumulators: four SSE2 registers hide the latency of the additions.
const LANES: usize = 16;

/// How [`kmeans`] runs.
#[derive(Clone, Copy, Debug)]
pub struct KMeansSettings {
    /// Most clusters to return; 0 counts as 1.
    pub clusters: usize,
    /// Most centroid updates; fewer are made once the centroids stand still. 0 returns the initial rows.
    pub iterations: usize,
    /// Seed of the choice of initial rows.
    pub seed: u64,
}

/// What [`kmeans`] found.
#[derive(Clone, Debug, PartialEq)]
pub struct Clusters {
    /// Clusters × dims, in the unit of the points. Fewer clusters than asked for when the points have fewer
    /// distinct rows; none when there are no rows.
    pub centroids: Array2<f32>,
    /// For each row, the index of the nearest of `centroids` (the lowest index of equally near ones).
    pub members: Vec<u32>,
    /// Mean over the rows of the [`distance`] to their centroid divided by dims; 0 without rows or dims.
    pub inertia: f64,
}

/// Clusters `points` (rows × dims, finite) by mean absolute difference; a centroid is its members' mean.
///
/// The initial centroids are random rows, drawn as linfa's `KMeansInit::Random` draws them from the same
/// `Xoshiro256Plus` seed, with repeated rows replaced by others. Any dims will do, but pruning is best with
/// 512, an 8³ brick indexed `x << 6 | y << 3 | z`. A cluster that loses all members keeps its centroid, as in
/// linfa, so that it can win members back and the result stays that of plain Lloyd iterations.
///
/// The result is the same for any number of rayon threads. Beside points that are not in standard layout,
/// which are copied, memory is about 320 bytes a row and 4 copies of the centroids.
///
/// # Errors
/// None, and no input panics in a release build; non-finite points give an unspecified clustering.
pub fn kmeans(points: ArrayView2<f32>, settings: &KMeansSettings) -> Clusters {
    debug_assert!(points.iter().all(|v| v.is_finite()), "points must be finite");
    let points = points.as_standard_layout();
    let initial = initial_rows(points.view(), settings.clusters, settings.seed);
    lloyd(points.view(), points.select(ndarray::Axis(0), &initial), settings.iterations)
}

/// Sum of absolute differences of two rows of equal length, in the order of f32 additions that defines which
/// centroid is nearest.
pub fn distance(a: &[f32], b: &[f32]) -> f32 {
    parts(a.len()).map(|(at, _)| l1::<LANES>(&a[at.clone()], &b[at])).sum()
}

/// Distinct rows, at most `clusters`, in the order drawn.
fn initial_rows(points: ArrayView2<f32>, clusters: usize, seed: u64) -> Vec<usize> {
    let rows = points.nrows();
    let clusters = clusters.clamp(1, u32::MAX as usize).min(rows);
    let mut rng = Xoshiro256Plus::seed_from_u64(seed);
    let mut seen = HashSet::new();
    let mut chosen = Vec::with_capacity(clusters);
    let mut draw = |amount: usize| {
        for row in sample(&mut rng, rows, amount) {
            if chosen.len() == clusters {
                break;
            }
            // Adding 0 merges -0 with 0, which are the same place.
            if seen.insert(points.row(row).iter().map(|v| (v + 0.0).to_bits()).collect::<Vec<_>>()) {
                chosen.push(row);
            }
        }
        chosen.len() == clusters
    };
    if !draw(clusters) && clusters < rows {
        draw(rows);
    }
    chosen
}

/// `iterations` of assignment and update from `centroids`, then the assignment to the final centroids.
fn lloyd(points: ArrayView2<f32>, centroids: Array2<f32>, iterations: usize) -> Clusters {
    let (rows, dims) = points.dim();
    let clusters = centroids.nrows();
    if clusters == 0 {
        return Clusters { centroids, members: Vec::new(), inertia: 0.0 };
    }
    let data = points.to_slice().expect("caller passes standard layout");
    let sums: Vec<Sums> = (0..rows).into_par_iter().map(|i| Sums::new(row(data, dims, i))).collect();
    let mut centroids: Vec<f32> = centroids.iter().copied().collect();
    let mut index = Index::new(&centroids, dims, clusters);
    let mut near: Vec<(u32, f32)> = sums.par_iter().map(|s| (index.guess(s), 0.0)).collect();
    let assign = |near: &mut [(u32, f32)], index: &Index, centroids: &[f32]| {
        near.par_iter_mut().enumerate().with_min_len(16).for_each(|(i, near)| {
            *near = index.nearest(row(data, dims, i), &sums[i], centroids, near.0);
        })
    };
    assign(&mut near, &index, &centroids);
    for _ in 0..iterations {
        let next = means(data, dims, &near, &centroids);
        if next == centroids {
            break;
        }
        index = Index::new(&next, dims, clusters);
        centroids = next;
        assign(&mut near, &index, &centroids);
    }
    let total: f64 = near.iter().map(|n| f64::from(n.1)).sum();
    Clusters {
        centroids: Array2::from_shape_vec((clusters, dims), centroids).expect("clusters x dims values"),
        members: near.into_iter().map(|n| n.0).collect(),
        inertia: total / (rows * dims).max(1) as f64,
    }
}

/// Mean of each cluster's rows, added in row order whatever the threads; the old centroid where there are none.
fn means(data: &[f32], dims: usize, near: &[(u32, f32)], old: &[f32]) -> Vec<f32> {
    let mut grouped: Vec<usize> = (0..near.len()).collect();
    grouped.sort_by_key(|&i| near[i].0); // stable, so in row order within a cluster
    let mut centroids = old.to_vec();
    centroids.par_chunks_mut(dims.max(1)).enumerate().for_each(|(c, centroid)| {
        let upto = |c: usize| grouped.partition_point(|&i| (near[i].0 as usize) < c);
        let members = &grouped[upto(c)..upto(c + 1)];
        if members.is_empty() {
            return;
        }
        let mut sum = vec![0f64; dims];
        for &i in members {
            sum.iter_mut().zip(row(data, dims, i)).for_each(|(s, v)| *s += f64::from(*v));
        }
        centroid.iter_mut().zip(&sum).for_each(|(c, s)| *c = (s / members.len() as f64) as f32);
    });
    centroids
}

/// Block sums of a row, each rounded once from f64.
struct Sums {
    total: f32,
    /// Sum of absolute values, the scale of the rounding of the other sums.
    error_l2: f32,
    coarse: [f32; COARSE],
    fine: [f32; FINE],
}

impl Sums {
    fn new(row: &[f32]) -> Self {
        let (mut error_l2, mut fine, mut coarse) = (0f64, [0f64; FINE], [0f64; COARSE]);
        let width = row.len().div_ceil(FINE).max(1);
        for (i, &v) in row.iter().enumerate() {
            // Of a brick's index, the upper two bits of each of x, y and z.
            let block =
                if row.len() == 512 { i >> 7 << 4 | (i >> 4 & 3) << 2 | i >> 1 & 3 } else { i / width };
            fine[block] += f64::from(v);
            error_l2 += f64::from(v.abs());
        }
        for (i, v) in fine.iter().enumerate() {
            coarse[i >> 5 << 2 | (i >> 3 & 1) << 1 | i >> 1 & 1] += v;
        }
        let total = coarse.iter().sum::<f64>() as f32;
        Sums {
            total,
            error_l2: error_l2 as f32,
            coarse: coarse.map(|v| v as f32),
            fine: fine.map(|v| v as f32),
        }
    }
}

/// The centroids' block sums in ascending order of their totals, so that those whose total alone rules them
/// out are never touched.
struct Index {
    /// Each centroid's number, ascending among equal totals, and its sums.
    entries: Vec<(u32, Sums)>,
    /// Greatest norm of a centroid.
    error_l2: f32,
}

impl Index {
    fn new(centroids: &[f32], dims: usize, clusters: usize) -> Self {
        let mut entries: Vec<(u32, Sums)> =
            (0..clusters).into_par_iter().map(|c| (c as u32, Sums::new(row(centroids, dims, c)))).collect();
        entries.sort_by(|a, b| a.1.total.total_cmp(&b.1.total));
        let error_l2 = entries.iter().map(|e| e.1.error_l2).fold(0.0, f32::max);
        Index { entries, error_l2 }
    }

    /// A centroid likely to be near: the one with the nearest coarse sums.
    fn guess(&self, sums: &Sums) -> u32 {
        let bounds = self.entries.iter().map(|(c, e)| (l1::<COARSE>(&e.coarse, &sums.coarse), *c));
        bounds.reduce(|a, b| if b.0 < a.0 { b } else { a }).map_or(0, |nearest| nearest.1)
    }

    /// The nearest centroid of `row` and its distance, starting from the distance to centroid `hint`.
    fn nearest(&self, row: &[f32], sums: &Sums, centroids: &[f32], hint: u32) -> (u32, f32) {
        let dims = row.len();
        // By rounding, a bound may exceed the computed distance it bounds. With u = EPSILON / 2, every block sum
        // is off by u of itself, so a bound by u × both norms; and with w = dims / 64, a distance takes at most
        // w + 24 roundings and a bound, its parts swapped for exact ones, at most w + 43. Both margins here are
        // these doubled, with 2w + 67 rounded up to 2w + 128.
        let relative = 1.0 + (dims.div_ceil(FINE) + 64) as f32 * f32::EPSILON;
        let absolute = f32::EPSILON * (sums.error_l2 + self.error_l2);
        let mut best = (hint, distance(row, self::row(centroids, dims, hint as usize)));
        let mut limit = best.1 * relative + absolute;
        // False once the totals alone rule out this entry and all beyond it.
        let mut visit = |(id, entry): &(u32, Sums)| {
            if (entry.total - sums.total).abs() > limit {
                return false;
            }
            if *id == hint || l1::<COARSE>(&entry.coarse, &sums.coarse) > limit {
                return true;
            }
            let mut bound = l1::<LANES>(&entry.fine, &sums.fine);
            if bound > limit {
                return true;
            }
            let centroid = self::row(centroids, dims, *id as usize);
            let mut exact = 0.0;
            for (part, blocks) in parts(dims) {
                let d = l1::<LANES>(&row[part.clone()], &centroid[part]);
                exact += d;
                bound += d - l1::<LANES>(&entry.fine[blocks.clone()], &sums.fine[blocks]);
                if bound > limit {
                    return true;
                }
            }
            if (exact, *id) < (best.1, best.0) {
                best = (*id, exact);
                limit = exact * relative + absolute;
            }
            true
        };
        let (below, above) =
            self.entries.split_at(self.entries.partition_point(|(_, e)| e.total < sums.total));
        let _ = above.iter().all(&mut visit);
        let _ = below.iter().rev().all(&mut visit);
        best
    }
}

/// The ranges of a row's values, and of its fine sums, that make up its parts.
fn parts(dims: usize) -> impl Iterator<Item = (Range<usize>, Range<usize>)> {
    let width = dims.div_ceil(FINE) * PART;
    (0..FINE / PART).map(move |p| (dims.min(p * width)..dims.min((p + 1) * width), p * PART..(p + 1) * PART))
}

/// Sum of absolute differences in `LANES` running sums, a power of two, added pairwise; then the odd values.
#[inline(always)]
fn l1<const LANES: usize>(a: &[f32], b: &[f32]) -> f32 {
    let ((a, a_end), (b, b_end)) = (a.as_chunks::<LANES>(), b.as_chunks::<LANES>());
    let mut lanes = [0f32; LANES];
    for (a, b) in a.iter().zip(b) {
        for i in 0..LANES {
            lanes[i] += (a[i] - b[i]).abs();
        }
    }
    let mut half = LANES / 2;
    while half > 0 {
        for i in 0..half {
            lanes[i] += lanes[i + half];
        }
        half /= 2;
    }
    a_end.iter().zip(b_end).fold(lanes[0], |sum, (a, b)| sum + (a - b).abs())
}

fn row(data: &[f32], dims: usize, i: usize) -> &[f32] {
    &data[i * dims..(i + 1) * dims]
}
