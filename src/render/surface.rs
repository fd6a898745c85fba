//! Where a ray first meets the zero of a trilinearly interpolated cell.

use super::traverse::Real;

/// The interpolant of a cell along a ray from `from` to `from + along` (both in the cell's own unit
/// coordinates) as a cubic in 0 to 1, lowest power first. `corners` are ordered by x + 2y + 4z.
pub fn cubic<F: Real>(corners: [F; 8], from: [F; 3], along: [F; 3]) -> [F; 4] {
    let [v000, v100, v010, v110, v001, v101, v011, v111] = corners;
    let (kx, ky, kz) = (v100 - v000, v010 - v000, v001 - v000);
    let kxy = v110 - v100 - v010 + v000;
    let kyz = v011 - v010 - v001 + v000;
    let kxz = v101 - v100 - v001 + v000;
    let kxyz = v111 - v110 - v101 - v011 + v100 + v010 + v001 - v000;
    let [a, b, c] = from;
    let [p, q, r] = along;
    [
        v000 + kx * a + ky * b + kz * c + kxy * a * b + kyz * b * c + kxz * a * c + kxyz * a * b * c,
        kx * p
            + ky * q
            + kz * r
            + kxy * (a * q + p * b)
            + kyz * (b * r + q * c)
            + kxz * (a * r + p * c)
            + kxyz * (a * b * r + a * q * c + p * b * c),
        kxy * p * q + kyz * q * r + kxz * p * r + kxyz * (a * q * r + p * b * r + p * q * c),
        kxyz * p * q * r,
    ]
}

/// A cubic's value.
pub fn evaluate<F: Real>(c: [F; 4], u: F) -> F {
    ((c[3] * u + c[2]) * u + c[1]) * u + c[0]
}

/// Halvings of an interval that has a root: past the precision of an `f32`.
const HALVINGS: u32 = 24;

/// The first place in 0 to 1 where the sign is not `negative` any more. The cubic is cut where it
/// turns, so that each piece has at most one root.
pub fn first_change<F: Real>(c: [F; 4], negative: bool) -> Option<F> {
    let zero = F::from_i32(0);
    let one = F::from_i32(1);
    let changed = |u: F| (evaluate(c, u) < zero) != negative;
    if changed(zero) {
        return Some(zero);
    }
    let [first, second] = turns(c);
    let mut low = zero;
    for high in [first, second, one] {
        if high > low && high <= one {
            if changed(high) {
                return Some(halve(low, high, changed));
            }
            low = high;
        }
    }
    None
}

fn halve<F: Real>(mut low: F, mut high: F, changed: impl Fn(F) -> bool) -> F {
    let half = F::from_f64(0.5);
    for _ in 0..HALVINGS {
        let middle = (low + high) * half;
        if changed(middle) {
            high = middle;
        } else {
            low = middle;
        }
    }
    high
}

/// Where a cubic turns, ascending; 0 for what does not exist.
fn turns<F: Real>(c: [F; 4]) -> [F; 2] {
    let zero = F::from_i32(0);
    let (a, b, c) = (F::from_i32(3) * c[3], c[2], c[1]);
    let discriminant = b * b - a * c;
    if discriminant < zero {
        return [zero; 2];
    }
    // Both roots of a·u² + 2b·u + c without cancellation.
    let root = discriminant.sqrt();
    let q = if b < zero { root - b } else { -(root + b) };
    let first = if a == zero { zero } else { q / a };
    let second = if q == zero { zero } else { c / q };
    if first < second { [first, second] } else { [second, first] }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn trilinear(v: [f64; 8], [x, y, z]: [f64; 3]) -> f64 {
        (0..8)
            .map(|i| {
                let side = |bit: usize, u: f64| if i >> bit & 1 == 1 { u } else { 1.0 - u };
                v[i] * side(0, x) * side(1, y) * side(2, z)
            })
            .sum()
    }

    proptest! {
        #[test]
        fn the_first_root_is_found(
            corners in proptest::array::uniform8(-1f64..1.0),
            from in proptest::array::uniform3(0f64..1.0),
            to in proptest::array::uniform3(0f64..1.0),
        ) {
            let along = std::array::from_fn(|a| to[a] - from[a]);
            let c = cubic(corners, from, along);
            let at = |u: f64| trilinear(corners, std::array::from_fn(|a| from[a] + along[a] * u));
            for u in [0.0, 0.3, 1.0] {
                prop_assert!((evaluate(c, u) - at(u)).abs() < 1e-9);
            }
            let negative = at(0.0) < 0.0;
            // A root that only touches zero may go either way; steps this fine see all others.
            let seen = (0..=1000).map(|i| f64::from(i) / 1000.0).find(|&u| (at(u) < 0.0) != negative);
            match (first_change(c, negative), seen) {
                (Some(u), Some(seen)) => prop_assert!(u <= seen + 1e-6 && at(u).abs() < 1e-5),
                (Some(u), None) => prop_assert!(at(u).abs() < 1e-5),
                (None, seen) => prop_assert!(seen.is_none()),
            }
        }
    }
}
