//! Times of a GPU that was idle: its clocks rise for a while, and what was timed meanwhile means nothing.

/// Medians in a row that have to agree.
const IN_A_ROW: usize = 3;
/// How far apart they may be, of the least of them: what medians of a GPU that is warm differ by.
const APART: f64 = 0.02;
/// The work that one median is taken of: clocks rise within less than three of them.
const BATCH_MS: f64 = 200.0;
/// Batches after which it is given up: four seconds of work.
const MOST_BATCHES: usize = 20;

/// What repeated work took.
#[derive(Clone, Debug, Default)]
pub struct Steady {
    /// Milliseconds of each time in the last batch.
    pub milliseconds: Vec<f64>,
    /// Whether the last three medians agreed.
    pub is_steady: bool,
}

impl Steady {
    /// The median of the last batch; not a number where nothing was timed.
    pub fn median(&self) -> f64 {
        median(&self.milliseconds)
    }
}

/// Repeats work until the medians of three batches in a row agree within 2 %. `batch` does it as often as it is told,
/// and returns the milliseconds of each time; it is told `repeats`, or more if those take less than 200 ms.
///
/// # Errors
/// Those of `batch`.
pub fn steady<E>(repeats: u32, mut batch: impl FnMut(u32) -> Result<Vec<f64>, E>) -> Result<Steady, E> {
    let first = median(&batch(repeats)?);
    if !first.is_finite() {
        return Ok(Steady::default());
    }
    let repeats = repeats.max((BATCH_MS / first.max(0.01)) as u32);
    let mut medians: Vec<f64> = Vec::new();
    loop {
        let milliseconds = batch(repeats)?;
        medians.push(median(&milliseconds));
        let last = &medians[medians.len().saturating_sub(IN_A_ROW)..];
        let [least, most] =
            [last.iter().copied().fold(f64::INFINITY, f64::min), last.iter().copied().fold(0.0, f64::max)];
        let is_steady = last.len() == IN_A_ROW && most - least <= APART * least;
        if is_steady || medians.len() == MOST_BATCHES {
            return Ok(Steady { milliseconds, is_steady });
        }
    }
}

fn median(figures: &[f64]) -> f64 {
    let mut figures = figures.to_vec();
    figures.sort_by(f64::total_cmp);
    figures.get(figures.len() / 2).copied().unwrap_or(f64::NAN)
}

#[cfg(test)]
mod tests {
    use std::convert::Infallible;

    use super::*;

    /// Times of a GPU whose batches take what is listed, and the last of them from then on.
    fn of_batches(batches: &[f64]) -> (Steady, usize) {
        let mut done = 0;
        let timed = steady(10, |repeats| {
            let ms = batches[done.min(batches.len() - 1)];
            done += 1;
            Ok::<_, Infallible>(vec![ms; repeats as usize])
        });
        let Ok(timed) = timed;
        (timed, done)
    }

    #[test]
    fn times_count_once_clocks_have_risen() {
        let (timed, batches) = of_batches(&[2.0, 1.6, 1.2, 1.0, 0.8, 0.8, 0.8, 5.0]);
        assert_eq!((timed.median(), timed.is_steady, batches), (0.8, true, 7));
        assert_eq!(timed.milliseconds.len(), 100, "a batch is 200 ms of the first one's pictures");
    }

    #[test]
    fn what_never_settles_is_said() {
        let restless: Vec<f64> = (0..100).map(|i| if i % 2 == 0 { 1.0 } else { 1.1 }).collect();
        assert!(!of_batches(&restless).0.is_steady);
        assert!(of_batches(&[f64::NAN]).0.median().is_nan(), "a device that times nothing");
    }
}
