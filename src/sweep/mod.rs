//! Measures many settings of one volume side by side, and how steady each is.

mod cheaper;
mod field;
pub mod nanovdb;
mod noise;
mod points;
mod stability;
mod steady;

use std::path::PathBuf;

use serde::Serialize;

use crate::error::{Error, Result};
use crate::pipeline::{Job, Progress, VerifyLevel};
use crate::report::chart::{self, Point, Spread};
use crate::settings::{
    Clustering, Encoding, ErrorBound, Format, Integers, NonFinite, Quality, RangeMode, Settings, TexelCodec,
};

pub use cheaper::cheaper;
pub use field::{Difference, Jumps};
pub use points::{difference, measure};
pub use stability::stability;
pub use steady::{Steady, steady};

/// What is measured, and how.
#[derive(Clone, Debug)]
pub struct Options {
    /// The files of one sequence.
    pub frames: Vec<PathBuf>,
    /// What charts and tables call it.
    pub name: String,
    /// The grid; the default one where none is given.
    pub grid: Option<String>,
    /// What to do with infinities and NaNs.
    pub nonfinite: NonFinite,
    /// How often each build and each picture is timed; the fastest build and the median picture count.
    pub repeats: u32,
    /// Pixels of a traced picture; `None` to trace none.
    pub trace: Option<[u32; 2]>,
}

/// One way to make a pack.
#[derive(Clone, Debug)]
pub struct Method {
    /// Its name in charts.
    pub method: &'static str,
    /// What sets it apart from others of that name.
    pub setting: String,
    /// How it is asked for.
    pub settings: Settings,
}

/// A setting that gave no pack, and why.
#[derive(Clone, Debug, Serialize)]
pub struct Skipped {
    /// Its method.
    pub method: String,
    /// Its setting.
    pub setting: String,
    /// Why.
    pub why: String,
}

/// What a sweep found.
#[derive(Debug, Serialize)]
pub struct Sweep {
    /// What traced pictures; null where nothing did.
    pub device: Option<String>,
    /// What was measured.
    pub points: Vec<Point>,
    /// What gave no pack.
    pub skipped: Vec<Skipped>,
}

/// What a sweep of stability found.
#[derive(Debug, Serialize)]
pub struct Stability {
    /// One row a method.
    pub spreads: Vec<Spread>,
    /// What gave no pack.
    pub skipped: Vec<Skipped>,
}

/// k, iterations and variance threshold as the thesis's figure 19 varies them.
const CLUSTERINGS: [(u32, u32, f64); 7] = [
    (1000, 5, 0.01),
    (100, 5, 0.01),
    (100, 10, 0.01),
    (1000, 5, 0.1),
    (100, 5, 0.1),
    (100, 10, 0.1),
    (100, 5, 0.99),
];

impl Options {
    fn settings(&self, encoding: impl Into<Encoding>) -> Settings {
        Settings {
            grids: self.grid.iter().cloned().collect(),
            encoding: encoding.into(),
            nonfinite: self.nonfinite,
            // Codecs are compared, those too that do not keep integers.
            integers: Integers::Nearest,
            // What is compared is what a GPU holds; the file's own compression would blur the times.
            zstd: 0,
            ..Settings::default()
        }
    }

    fn uniform(&self, format: Format) -> Method {
        let settings = self.settings(format);
        Method { method: format.name(), setting: "brick range".to_owned(), settings }
    }

    fn sequence_range(&self, format: Format) -> Method {
        let settings = Settings { range: RangeMode::Sequence, ..self.settings(format) };
        Method { method: format.name(), setting: "sequence range".to_owned(), settings }
    }

    /// Adaptive packs of a quality.
    pub fn adaptive(&self, quality: Quality) -> Method {
        let settings = self.settings(quality);
        let (method, setting) = match quality {
            Quality::Psnr(db) => ("adaptive", format!("psnr = {db}")),
            Quality::ByClass { .. } => ("default", "adaptive".to_owned()),
            other => ("adaptive max-error", other.to_string().replacen("max-error ", "max error = ", 1)),
        };
        Method { method, setting, settings }
    }

    fn clustered(&self, (clusters, iterations, variance): (u32, u32, f64), seed: u64) -> Method {
        let clustering = Some(Clustering { clusters, iterations, variance, seed });
        let settings = self.settings(Encoding::Uniform { codec: TexelCodec::BC7, clustering });
        Method {
            method: "kmeans",
            // The thesis's three columns.
            setting: format!("k={clusters}, {iterations} times, {variance}"),
            settings,
        }
    }

    /// The settings that a sweep compares.
    pub fn methods(&self) -> Vec<Method> {
        let mut methods: Vec<Method> =
            (30..=70).step_by(5).map(|db| self.adaptive(Quality::Psnr(db.into()))).collect();
        methods.push(self.adaptive(Quality::default()));
        methods.extend(
            [0.02, 0.01, 0.005, 0.001].map(|e| self.adaptive(Quality::MaxError(ErrorBound::of_range(e)))),
        );
        let uniform = || Format::ALL.into_iter().filter(|format| format.codec().is_some());
        let is_normalised = |format: &Format| format.codec().is_some_and(|c| c.codec().is_normalised());
        methods.extend(uniform().map(|format| self.uniform(format)));
        methods.extend(uniform().filter(is_normalised).map(|format| self.sequence_range(format)));
        methods.extend(CLUSTERINGS.map(|c| self.clustered(c, 0)));
        methods
    }

    /// The settings that a sweep of stability repeats.
    pub fn repeated_methods(&self) -> Vec<Method> {
        vec![
            self.adaptive(Quality::Psnr(35.0)),
            self.adaptive(Quality::Psnr(45.0)),
            self.adaptive(Quality::default()),
            self.adaptive(Quality::MaxError(ErrorBound::of_range(0.01))),
            self.uniform(Format::UNORM8),
            self.sequence_range(Format::UNORM8),
            self.uniform(Format::BC4),
            self.uniform(Format::BC7),
            self.clustered((100, 5, 0.01), 0),
            self.clustered((1000, 5, 0.1), 0),
            self.clustered((100, 5, 0.1), 0),
            self.clustered((100, 5, 0.99), 0),
        ]
    }

    fn job(&self, method: &Method, frames: &[PathBuf], output: PathBuf) -> Job {
        Job::new(frames.to_vec(), output, method.settings.clone(), VerifyLevel::None)
    }
}

/// Runs every method's measurement, and keeps what fails apart from what a whole sweep cannot do without.
fn each<T>(
    methods: &[Method],
    progress: &mut dyn Progress,
    mut measure: impl FnMut(&Method) -> Result<T>,
) -> Result<(Vec<T>, Vec<Skipped>)> {
    progress.stage("sweep", methods.len() as u64, "settings");
    let (mut found, mut skipped) = (Vec::new(), Vec::new());
    for method in methods {
        match measure(method) {
            Ok(one) => found.push(one),
            Err(error @ (Error::OutOfRange { .. } | Error::Usage(_))) => skipped.push(Skipped {
                method: method.method.to_owned(),
                setting: method.setting.clone(),
                why: error.to_string(),
            }),
            Err(error) => return Err(error),
        }
        progress.advance(1);
    }
    Ok((found, skipped))
}

/// Which points no other one beats: in size, in build seconds and in trace milliseconds.
pub fn fronts(points: &[Point]) -> [Vec<bool>; 3] {
    let front = |cost: fn(&Point) -> f64| {
        let at = |p: &Point| {
            let cost = if p.failures.is_empty() { cost(p) } else { f64::NAN };
            (cost, p.psnr.unwrap_or(f64::INFINITY))
        };
        chart::pareto(&points.iter().map(at).collect::<Vec<_>>())
    };
    [front(|p| p.bits_per_voxel), front(|p| p.build_seconds), front(|p| p.trace_ms.unwrap_or(f64::NAN))]
}

/// A pack whose jumps across brick faces are this much larger than its source's shows its bricks. The cloud that the
/// thesis accepts (figure 19 d, variance 0.01) is at 1.16, and the one that it calls blocky (c, 0.1) at 1.8.
const BLOCKY: f64 = 1.5;

/// A word on a pack whose bricks can be seen.
fn blocky(pack: &field::Jumps, source: &field::Jumps) -> Option<String> {
    let blockiness = pack.blockiness(source);
    (blockiness > BLOCKY)
        .then(|| format!("its bricks show: jumps across their faces are {blockiness:.2} times the source's"))
}
