//! What an adaptive pack is asked for, as manifests and the command line write it.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::vdb::GridClass;

/// The PSNR of fog for which nothing is asked: smoke shows no blocks in its haze there, as it does at 45 dB
/// (docs/benchmarks/sweep.md).
const DEFAULT_PSNR: f64 = 55.0;
/// The largest error of a level set for which nothing is asked: its surface shows no dents there.
const DEFAULT_ERROR: ErrorBound = ErrorBound { value: 0.05, unit: ErrorUnit::Voxel };

/// How far a frame's PSNR may lie below the whole sequence's: one bright frame must not erase late, thin
/// smoke.
pub const FRAME_MARGIN_DB: f64 = 6.0;

/// What an adaptive pack meets at the smallest cost.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Quality {
    /// What suits a grid by its class: the default, in full, since packs are verified by what they were asked for.
    ByClass {
        /// As [`Quality::Psnr`], for all but level sets.
        psnr: f64,
        /// As [`Quality::MaxError`], for level sets.
        level_set_error: ErrorBound,
    },
    /// Each grid's PSNR over active leaf voxels is at least this, in dB.
    Psnr(f64),
    /// No voxel is further from its source, on any GPU.
    MaxError(ErrorBound),
    /// The GPU bits for each of the 512 voxels of each leaf of the source are at most this.
    BitsPerVoxel(f64),
    /// Tree, masks and texels are at most this many bytes.
    Size(u64),
}

impl Default for Quality {
    fn default() -> Self {
        Self::ByClass { psnr: DEFAULT_PSNR, level_set_error: DEFAULT_ERROR }
    }
}

impl Quality {
    /// What is asked of a grid of a class whose errors are measured against `peak` and whose voxels are `voxel_size` wide,
    /// both in the grid's units: never [`Quality::ByClass`].
    pub fn of_grid(self, class: GridClass, peak: f64, voxel_size: f64) -> Self {
        match self {
            // A level set whose values span less than a voxel is none whose distances are in world units.
            Self::ByClass { level_set_error, .. } if class == GridClass::LevelSet && peak > voxel_size => {
                Self::MaxError(level_set_error)
            }
            Self::ByClass { psnr, .. } => Self::Psnr(psnr),
            asked => asked,
        }
    }

    /// Whether it is bytes that are asked for, one way or another.
    pub fn is_size(self) -> bool {
        matches!(self, Self::BitsPerVoxel(_) | Self::Size(_))
    }
}

impl fmt::Display for Quality {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::ByClass { psnr, level_set_error } => {
                write!(f, "psnr {psnr} (level sets: max-error {level_set_error})")
            }
            Self::Psnr(db) => write!(f, "psnr {db}"),
            Self::MaxError(bound) => write!(f, "max-error {bound}"),
            Self::BitsPerVoxel(bits) => write!(f, "bits-per-voxel {bits}"),
            Self::Size(bytes) => write!(f, "size {bytes}"),
        }
    }
}

/// A largest error, and what it is measured in.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ErrorBound {
    value: f64,
    unit: ErrorUnit,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum ErrorUnit {
    /// The sequence's active values' maximum less their minimum.
    Range,
    /// What the grid's values are in.
    Grid,
    /// A voxel's smallest side, for level sets.
    Voxel,
}

impl ErrorBound {
    /// A fraction of the range of the sequence's active values.
    pub fn of_range(value: f64) -> Self {
        Self { value, unit: ErrorUnit::Range }
    }

    /// In the grid's units, for a grid whose active values span `peak` and whose voxels are `voxel_size` wide.
    pub fn absolute(self, peak: f64, voxel_size: f64) -> f64 {
        match self.unit {
            ErrorUnit::Range => self.value * peak,
            ErrorUnit::Grid => self.value,
            ErrorUnit::Voxel => self.value * voxel_size,
        }
    }

    /// So many times as large a bound.
    pub fn times(self, factor: f64) -> Self {
        Self { value: self.value * factor, ..self }
    }

    /// The fraction of the range, where that is what it is given in.
    pub fn fraction(self) -> Option<f64> {
        (self.unit == ErrorUnit::Range).then_some(self.value)
    }
}

impl fmt::Display for ErrorBound {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let unit = match self.unit {
            ErrorUnit::Range => "",
            ErrorUnit::Grid => " units",
            ErrorUnit::Voxel => " voxels",
        };
        write!(f, "{}{unit}", self.value)
    }
}

impl FromStr for ErrorBound {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let text = text.trim();
        let split = text.find(['%', ' ', 'u', 'v']).unwrap_or(text.len());
        let (number, unit) = text.split_at(split);
        let (unit, scale) = match unit.trim() {
            "" => (ErrorUnit::Range, 1.0),
            "%" => (ErrorUnit::Range, 0.01),
            "units" | "unit" | "u" => (ErrorUnit::Grid, 1.0),
            "voxels" | "voxel" | "v" => (ErrorUnit::Voxel, 1.0),
            _ => return Err(ERROR_SYNTAX.to_owned()),
        };
        match number.parse::<f64>() {
            Ok(value) if value.is_finite() && value >= 0.0 => Ok(Self { value: value * scale, unit }),
            _ => Err(ERROR_SYNTAX.to_owned()),
        }
    }
}

const ERROR_SYNTAX: &str = "an error is a number, not below 0: a fraction of the range of values (0.01 or 1%), \
    or with a unit (\"0.2 units\" of the grid, \"0.1 voxels\")";

/// A number of bytes, as `40MB`, `512KiB` or a plain number.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ByteSize(pub u64);

impl FromStr for ByteSize {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let syntax = || "a size is a number of bytes: 2500000, 40MB or 512KiB".to_owned();
        let text = text.trim();
        let split = text.find(|c: char| c.is_ascii_alphabetic() || c == ' ').unwrap_or(text.len());
        let (number, unit) = text.split_at(split);
        let scale = match unit.trim().to_ascii_lowercase().as_str() {
            "" | "b" => 1.0,
            "k" | "kb" => 1e3,
            "m" | "mb" => 1e6,
            "g" | "gb" => 1e9,
            "kib" => 1024.0,
            "mib" => 1024.0 * 1024.0,
            "gib" => 1024.0 * 1024.0 * 1024.0,
            _ => return Err(syntax()),
        };
        match number.parse::<f64>() {
            Ok(n) if n.is_finite() && n > 0.0 => Ok(Self((n * scale) as u64)),
            _ => Err(syntax()),
        }
    }
}

/// PSNR past this is below the rounding of an f32.
const MAX_DB: f64 = 200.0;

pub(super) fn decibels(text: &str) -> Result<f64, String> {
    check_decibels(text.parse().unwrap_or(f64::NAN))
}

pub(super) fn check_decibels(db: f64) -> Result<f64, String> {
    if (0.0..=MAX_DB).contains(&db) { Ok(db) } else { Err(format!("a number of dB from 0 to {MAX_DB}")) }
}

/// A number above 0, as the command line has it.
///
/// # Errors
/// When it is something else.
pub fn above_zero(text: &str) -> Result<f64, String> {
    check_above_zero(text.parse().unwrap_or(f64::NAN))
}

pub(crate) fn check_above_zero(v: f64) -> Result<f64, String> {
    if v > 0.0 && v.is_finite() { Ok(v) } else { Err("a number above 0".to_owned()) }
}

/// Why an error bound that is the whole range of values or more is refused, for a grid whose values span `peak` and whose
/// voxels are `voxel_size` wide.
pub fn whole_range(bound: ErrorBound, peak: f64, voxel_size: f64) -> String {
    let meant = match bound.fraction() {
        Some(fraction) if fraction < 100.0 => format!(": for {fraction} % of it write \"{fraction}%\""),
        Some(_) => String::new(),
        None => format!(": it is {} of {peak} units", bound.absolute(peak, voxel_size)),
    };
    format!("max_error {bound} is the whole range of values or more, and would keep nothing of them{meant}")
}

/// Reads what `FromStr` reads, and plain numbers too.
pub(super) fn from_text_or_number<'de, D: Deserializer<'de>, T: FromStr<Err = String>>(
    d: D,
) -> Result<T, D::Error> {
    #[derive(Deserialize)]
    #[serde(untagged, expecting = "a number, or a text with a unit")]
    enum Raw {
        Number(f64),
        Text(String),
    }
    let text = match Raw::deserialize(d)? {
        Raw::Number(n) => n.to_string(),
        Raw::Text(text) => text,
    };
    text.parse().map_err(serde::de::Error::custom)
}

impl<'de> Deserialize<'de> for ErrorBound {
    fn deserialize<D: Deserializer<'de>>(d: D) -> Result<Self, D::Error> {
        from_text_or_number(d)
    }
}

impl Serialize for ErrorBound {
    fn serialize<S: Serializer>(&self, s: S) -> Result<S::Ok, S::Error> {
        s.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for ByteSize {
    fn deserialize<D: Deserializer<'de>>(d: D) -> Result<Self, D::Error> {
        from_text_or_number(d)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_and_sizes_are_read_with_their_units() {
        for (text, absolute) in
            [("0.01", 0.05), ("1%", 0.05), ("0.2 units", 0.2), ("0.2u", 0.2), ("0.1 voxels", 0.2), ("0", 0.0)]
        {
            let bound: ErrorBound = text.parse().unwrap();
            assert!((bound.absolute(5.0, 2.0) - absolute).abs() < 1e-12, "{text}");
            assert_eq!(bound.to_string().parse(), Ok(bound), "{text}");
        }
        for bad in ["", "-1", "nan", "0.1 metres", "%"] {
            assert!(bad.parse::<ErrorBound>().is_err(), "{bad}");
        }
        for (text, bytes) in [("1000", 1000), ("1.5 kB", 1500), ("2MiB", 2 << 20), ("1GB", 1_000_000_000)] {
            assert_eq!(text.parse(), Ok(ByteSize(bytes)), "{text}");
        }
        for bad in ["", "MB", "-1", "3 parsecs"] {
            assert!(bad.parse::<ByteSize>().is_err(), "{bad}");
        }
    }
}
