//! K-means of voxel bricks under the mean absolute difference: Lloyd's iterations with exact pruning.
//!
//! Every pruned candidate is provably no nearer than the best one, so assignments, tie-breaks and
//! centroids are those of a brute-force search over [`distance`], bit for bit.

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

#[cfg(test)]
mod tests {
    use super::*;
    use linfa::{DatasetBase, traits::Fit};
    use linfa_clustering::{KMeans, KMeansInit};
    use linfa_nn::distance::{Distance, L1Dist};
    use ndarray::{Axis, array, s};
    use proptest::prelude::*;
    use rand::Rng;

    fn fit(points: &Array2<f32>, clusters: usize, iterations: usize) -> Clusters {
        kmeans(points.view(), &KMeansSettings { clusters, iterations, seed: 3 })
    }

    /// Rows as brick = level + slope along the index + noise; `step` > 0 rounds levels, which makes repeats and
    /// ties.
    fn bricks(rows: usize, dims: usize, step: f32, noise: f32, seed: u64) -> Array2<f32> {
        let mut rng = Xoshiro256Plus::seed_from_u64(seed);
        let mut data = Array2::zeros((rows, dims));
        for mut row in data.rows_mut() {
            let mut level: f32 = rng.r#gen();
            let slope = if step > 0.0 { 0.0 } else { rng.gen_range(-0.3..0.3) };
            if step > 0.0 {
                level = (level / step).floor() * step;
            }
            for (i, v) in row.iter_mut().enumerate() {
                *v = level + slope * i as f32 / dims as f32 + noise * rng.r#gen::<f32>();
            }
        }
        data
    }

    /// Lloyd's iterations with every distance computed.
    fn brute(points: &Array2<f32>, clusters: usize, iterations: usize) -> Clusters {
        let (rows, dims) = points.dim();
        let mut centroids = points.select(Axis(0), &initial_rows(points.view(), clusters, 3));
        let flat = |a: &Array2<f32>, i: usize| a.row(i).to_vec();
        let assign = |centroids: &Array2<f32>| -> Vec<(f32, u32)> {
            let near = |i| {
                let to = |c| (distance(&flat(points, i), &flat(centroids, c)), c as u32);
                (0..centroids.nrows()).map(to).reduce(|a, b| if b.0 < a.0 { b } else { a }).unwrap()
            };
            (0..rows).map(near).collect()
        };
        for _ in 0..iterations {
            let near = assign(&centroids);
            for (c, mut centroid) in centroids.rows_mut().into_iter().enumerate() {
                let members: Vec<usize> = (0..rows).filter(|&i| near[i].1 == c as u32).collect();
                if !members.is_empty() {
                    let mean = points.select(Axis(0), &members).mapv(f64::from).mean_axis(Axis(0)).unwrap();
                    centroid.assign(&mean.mapv(|v| v as f32));
                }
            }
        }
        let near = assign(&centroids);
        let inertia = near.iter().map(|n| f64::from(n.0)).sum::<f64>() / (rows * dims) as f64;
        Clusters { centroids, members: near.iter().map(|n| n.1).collect(), inertia }
    }

    proptest! {
        // Levels in steps of 0.1 put constant bricks at exact and nearly exact ties whose bounds equal their
        // distances; the offset makes the rounding of sums large beside the distances.
        #![proptest_config(ProptestConfig::with_cases(200))]
        #[test]
        fn equals_brute_force(
            rows in 1usize..80, clusters in 0usize..20, iterations in 0usize..4, seed: u64,
            dims in prop::sample::select(vec![512usize, 512, 512, 1, 70, 600]),
            step in prop::sample::select(vec![0f32, 0.1]),
            noise in prop::sample::select(vec![0f32, 1e-6, 0.05, 1.0]),
            offset in prop::sample::select(vec![0f32, -0.5, 1000.0]),
        ) {
            let points = bricks(rows, dims, step, noise, seed) + offset;
            prop_assert_eq!(fit(&points, clusters, iterations), brute(&points, clusters, iterations));
        }
    }

    #[test]
    fn each_iteration_agrees_with_linfa() {
        let (rows, k) = (400, 30);
        let points = bricks(rows, 512, 0.0, 0.1, 5);
        let linfa = |init: KMeansInit<f32>| {
            let rng = Xoshiro256Plus::seed_from_u64(3);
            let params = KMeans::params_with(k, rng, L1Dist).init_method(init).n_runs(1).max_n_iterations(1);
            params.tolerance(1e-12).fit(&DatasetBase::from(points.view())).unwrap()
        };
        let mut old = fit(&points, k, 0);
        let drawn = linfa(KMeansInit::Random);
        for iterations in 1..=4 {
            let theirs = linfa(KMeansInit::Precomputed(old.centroids.clone()));
            if iterations == 1 {
                assert_eq!(drawn.centroids(), theirs.centroids(), "the same rows are drawn first");
            }
            assert!((f64::from(theirs.inertia()) / 512.0 - old.inertia).abs() < 1e-6);
            let new = fit(&points, k, iterations);
            for c in 0..k {
                let count = old.members.iter().filter(|&&m| m == c as u32).count() as f32;
                assert_eq!(theirs.cluster_count()[c], count);
                // linfa counts the old centroid as one more member.
                let mean = (&new.centroids.row(c) * count + old.centroids.row(c)) / (count + 1.0);
                let off = L1Dist.distance(mean.view(), theirs.centroids().row(c)) / 512.0;
                assert!(count == 0.0 && new.centroids.row(c) == old.centroids.row(c) || off < 1e-6);
            }
            assert!(new.inertia < old.inertia);
            old = new;
        }
    }

    #[test]
    fn distance_is_linfas() {
        for dims in [1, 17, 512, 1000] {
            let points = bricks(2, dims, 0.0, 1.0, 1);
            let (a, b) = (points.row(0), points.row(1));
            let (ours, theirs) = (distance(&a.to_vec(), &b.to_vec()), L1Dist.distance(a, b));
            assert!((ours - theirs).abs() <= 1e-5 * theirs, "{dims}: {ours} {theirs}");
        }
    }

    #[test]
    fn threads_do_not_change_the_result() {
        let points = bricks(500, 512, 0.0, 0.2, 9);
        let run = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| fit(&points, 40, 5))
        };
        assert_eq!(run(1), run(2));
    }

    #[test]
    fn layout_does_not_change_the_result() {
        let points = bricks(60, 512, 0.0, 0.2, 9);
        let columns = points.t().as_standard_layout().into_owned();
        let transposed = kmeans(columns.t(), &KMeansSettings { clusters: 5, iterations: 3, seed: 3 });
        assert_eq!(transposed, fit(&points, 5, 3));
    }

    #[test]
    fn degenerate_inputs() {
        let none = fit(&Array2::zeros((0, 512)), 5, 3);
        assert_eq!((none.centroids.dim(), none.members.len(), none.inertia), ((0, 512), 0, 0.0));
        let flat = fit(&Array2::zeros((4, 0)), 5, 3);
        assert_eq!((flat.centroids.dim(), flat.members, flat.inertia), ((1, 0), vec![0; 4], 0.0));
        let equal = fit(&Array2::from_elem((7, 512), 0.3), 3, 5);
        assert_eq!((equal.centroids.dim(), equal.members, equal.inertia), ((1, 512), vec![0; 7], 0.0));
        assert_eq!(fit(&array![[0f32], [1.0]], 0, 1).centroids, array![[0.5f32]]);

        // More clusters than distinct rows: each row finds itself, bit for bit.
        let mut points = bricks(20, 512, 0.0, 0.1, 2);
        points.slice_mut(s![10.., ..]).fill(-0.0);
        points.row_mut(19).fill(0.0);
        for clusters in [11, 12, 20, 1000] {
            let own = fit(&points, clusters, 3);
            assert_eq!((own.centroids.nrows(), own.inertia), (11, 0.0));
            assert_eq!(
                own.centroids.select(Axis(0), &own.members.iter().map(|&m| m as usize).collect::<Vec<_>>()),
                points
            );
        }
        // Ten distinct rows among twenty, ten asked for: repeats are not drawn twice.
        assert_eq!(fit(&points, 10, 0).centroids.nrows(), 10);
    }

    /// A point midway between two centroids, with one sign of difference to each, so that bounds equal distances
    /// but for rounding: near 1000 that of block sums, with many dims that of running sums, which come out low.
    #[test]
    fn rounding_does_not_break_ties() {
        let random = |dims, base, unit, most, seed| {
            let mut rng = Xoshiro256Plus::seed_from_u64(seed);
            Array2::from_shape_simple_fn((1, dims), || base + unit * rng.gen_range(1..=most) as f32)
        };
        let tiny = 0.5f32.powi(13);
        let near_1000 = |seed| (random(512, 1000.0, tiny, 3, seed), random(512, 0.0, tiny, 3, seed + 20));
        let long = (Array2::zeros((1, 1 << 14)), Array2::from_elem((1, 1 << 14), 0.7));
        for (point, step) in (0..20).map(near_1000).chain([long]) {
            for side in [-1.0, 1.0] {
                let centroids = ndarray::concatenate![Axis(0), &point + &step * side, &point - &step * side];
                assert_eq!(lloyd(point.view(), centroids, 0).members, [0]);
            }
        }
    }

    #[test]
    fn an_empty_cluster_keeps_its_centroid() {
        let far = lloyd(array![[0f32], [0.2]].view(), array![[0.1f32], [9.0]], 3);
        assert_eq!((far.centroids, far.members), (array![[0.1f32], [9.0]], vec![0, 0]));
    }

    #[test]
    fn non_finite_points_do_not_panic() {
        for bad in [f32::NAN, f32::INFINITY, f32::MAX, f32::MIN] {
            let mut points = bricks(30, 512, 0.0, 0.1, 4);
            points.slice_mut(s![..;3, ..;5]).fill(bad);
            let rows = initial_rows(points.view(), 8, 1);
            let members = lloyd(points.view(), points.select(Axis(0), &rows), 3).members;
            assert!(members.iter().all(|&m| m < 8));
        }
    }
}
