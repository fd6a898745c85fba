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
