//! The grid of steps of λ that searches go along.

use std::sync::LazyLock;

use crate::error::Result;

/// A step is 1.1 % of λ, under 0.05 dB of PSNR.
pub(super) const STEPS_PER_OCTAVE: u32 = 64;

/// λ near step 0, in squared peaks a bit: 2^24 times 1,024 bits outweigh the greatest error of a fog's brick (512 squared
/// peaks) in every frame of the longest sequence. Step 0 itself is the coarsest choice whatever its error.
const FIRST_OCTAVE: f64 = 24.0;

/// From this step on λ is 0. The one before has 2^-76: a bit is worth less there than an error past 200 dB.
pub(super) const LAST_STEP: u32 = 100 * STEPS_PER_OCTAVE;

/// λ at a step: 0 at the last.
pub(super) fn lambda(step: u32) -> f64 {
    static STEPS: LazyLock<Vec<f64>> = LazyLock::new(|| {
        let octave = |step| FIRST_OCTAVE - f64::from(step) / f64::from(STEPS_PER_OCTAVE);
        (0..LAST_STEP).map(|step| octave(step).exp2()).collect()
    });
    STEPS.get(step as usize).copied().unwrap_or(0.0)
}

/// The first step, of 0 to [`LAST_STEP`], that meets what every finer one meets too; the last if none does. Near a step
/// that is known to be close by it is found in fewer looks.
pub(super) fn first_step(near: Option<u32>, mut meets: impl FnMut(u32) -> Result<bool>) -> Result<u32> {
    let (mut low, mut high) = (0, LAST_STEP);
    if let Some(near) = near {
        let (mut at, mut stride) = (near, 1);
        let is_down = meets(near)?;
        if is_down {
            high = near
        } else {
            low = near + 1
        }
        while low < high {
            at = if is_down { at.saturating_sub(stride).max(low) } else { (at + stride).min(high - 1) };
            stride *= 2;
            let met = meets(at)?;
            if met {
                high = at
            } else {
                low = at + 1
            }
            if met != is_down {
                break;
            }
        }
    }
    while low < high {
        let middle = (low + high) / 2;
        if meets(middle)? {
            high = middle;
        } else {
            low = middle + 1;
        }
    }
    Ok(low)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_step_is_found_from_anywhere() {
        let ends = [0, 1, 2, 700, 3_199, 3_200, LAST_STEP - 1, LAST_STEP];
        for (first, near) in ends.into_iter().flat_map(|first| ends.map(|near| (first, near))) {
            for near in [None, Some(near)] {
                let mut looks = 0;
                let found = first_step(near, |step| {
                    looks += 1;
                    Ok(step >= first)
                });
                assert_eq!(found.unwrap(), first, "{near:?}");
                // Twice a bisection's at most, and next to none where it is close by.
                assert!(looks <= if near.is_some_and(|near| near.abs_diff(first) <= 1) { 4 } else { 26 });
            }
        }
    }
}
