//! How pictures of an asset look: camera, march and light, as the command line and manifests write them.

use std::str::FromStr;

use clap::{Args, ValueEnum};
use serde::{Deserialize, Deserializer};

/// How pictures of an asset look. The names of fields are the keys of `[asset.NAME.look]`.
#[derive(Args, Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Look {
    /// Camera: orbit:AZIMUTH,ELEVATION or orbit:AZIMUTH,ELEVATION,DISTANCE in degrees and box diagonals, or "X,Y,Z;X,Y,Z;FOV" (eye; target; degrees) [default: orbit:40,20]
    #[arg(long, value_name = "VIEW")]
    pub camera: Option<View>,
    /// Axis that points up [default: guessed from the shape]
    #[arg(long, value_name = "AXIS")]
    pub up: Option<Up>,
    /// Step of the ray march: 0.5 is in voxels, 0.02world in world units [default: 0.5]
    #[arg(long, value_name = "STEP", help_heading = "Fog")]
    pub step: Option<Step>,
    /// Offset each pixel's samples by a hash, which turns banding into noise
    #[arg(long, help_heading = "Fog")]
    pub jitter: bool,
    /// Extinction: optical depth per world unit at density 1 [default: with --mode lit, half of the covered pixels have an optical depth above 3; otherwise, the highest density has 24 across the box]
    #[arg(long, value_name = "X", allow_negative_numbers = true, help_heading = "Fog")]
    pub extinction: Option<f64>,
    /// Direction of the sun in degrees [default: 110,40]
    #[arg(long, value_name = "AZIMUTH,ELEVATION", allow_hyphen_values = true, help_heading = "Fog")]
    pub sun: Option<Sun>,
    /// Scattering albedo, 0 to 1 [default: 0.95; 0.6 with an emissive grid]
    #[arg(long, value_name = "PART", allow_negative_numbers = true, help_heading = "Fog")]
    pub albedo: Option<f64>,
    /// Anisotropy of scattering (g of Henyey and Greenstein): -0.99 backward, 0 isotropic, 0.99 forward [default: 0]
    #[arg(long, value_name = "G", allow_negative_numbers = true, help_heading = "Fog")]
    pub anisotropy: Option<f64>,
    /// Ambient light from the sky, as a factor [default: 1]
    #[arg(long, value_name = "X", allow_negative_numbers = true, help_heading = "Fog")]
    pub ambient: Option<f64>,
    /// Emissive grid, or none [default: flame or temperature, if the pack has it]
    #[arg(long, value_name = "GRID", help_heading = "Fog")]
    pub emission: Option<String>,
    /// Brightness of the emission, as a factor [default: 1]
    #[arg(long, value_name = "X", help_heading = "Fog")]
    pub emission_strength: Option<f64>,
    /// Temperature at value 1 of the emissive grid, in kelvin [default: 1 if the grid has values above 100; otherwise, its highest value is 1900 K]
    #[arg(long, value_name = "K", help_heading = "Fog")]
    pub kelvin: Option<f64>,
}

/// Largest number of a look: products of two are still numbers in the GPU's 32 bits.
const LARGEST: f64 = 1e15;

impl Look {
    /// Fills options that are not set from `other`.
    pub fn or(self, other: &Self) -> Self {
        Self {
            camera: self.camera.or(other.camera),
            up: self.up.or(other.up),
            step: self.step.or(other.step),
            jitter: self.jitter || other.jitter,
            extinction: self.extinction.or(other.extinction),
            sun: self.sun.or(other.sun),
            albedo: self.albedo.or(other.albedo),
            anisotropy: self.anisotropy.or(other.anisotropy),
            ambient: self.ambient.or(other.ambient),
            emission: self.emission.or_else(|| other.emission.clone()),
            emission_strength: self.emission_strength.or(other.emission_strength),
            kelvin: self.kelvin.or(other.kelvin),
        }
    }

    /// Checks that numbers are in range.
    ///
    /// # Errors
    /// The first that is not, and its range.
    pub fn check(&self) -> Result<(), String> {
        type IsAllowed = fn(f64) -> bool;
        let numbers: [(&str, Option<f64>, IsAllowed, &str); 6] = [
            ("extinction", self.extinction, |v| v > 0.0, "above 0"),
            ("albedo", self.albedo, |v| (0.0..=1.0).contains(&v), "from 0 to 1"),
            ("anisotropy", self.anisotropy, |v| v.abs() <= 0.99, "from -0.99 to 0.99"),
            ("ambient", self.ambient, |v| v >= 0.0, "of 0 or more"),
            ("emission_strength", self.emission_strength, |v| v >= 0.0, "of 0 or more"),
            ("kelvin", self.kelvin, |v| v > 0.0, "above 0"),
        ];
        for (name, value, is_allowed, what) in numbers {
            if value.is_some_and(|v| !is_allowed(v)) {
                return Err(format!("{name} is a number {what}"));
            }
            if value.is_some_and(|v| v > LARGEST) {
                return Err(format!("{name} is at most {LARGEST:e}"));
            }
        }
        Ok(())
    }
}

/// The axis of world space that points up.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Up {
    /// x
    X,
    /// y, as in Houdini
    Y,
    /// z, as in Blender
    Z,
}

/// Where a picture is taken from.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(try_from = "String")]
pub enum View {
    /// Around the middle of the volume's box.
    Orbit {
        /// In degrees: 0 is in front, 90 to the right.
        azimuth: f64,
        /// In degrees: 90 is above.
        elevation: f64,
        /// In diagonals of the box; without one as near as shows all of the box.
        distance: Option<f64>,
    },
    /// A camera in world space.
    Fixed {
        /// Where it is.
        eye: [f64; 3],
        /// What is in the middle of the picture.
        target: [f64; 3],
        /// The vertical angle of view in degrees.
        fov: f64,
    },
}

/// A view that cannot be parsed.
#[derive(Debug, thiserror::Error)]
#[error(
    "{0:?} is not a camera: orbit:AZIMUTH,ELEVATION[,DISTANCE] or X,Y,Z;X,Y,Z;FOV (eye; target; degrees)"
)]
pub struct ViewError(String);

fn numbers(text: &str) -> Option<Vec<f64>> {
    let numbers: Vec<f64> = text.split(',').map(|v| v.trim().parse().ok()).collect::<Option<_>>()?;
    numbers.iter().all(|v| v.is_finite()).then_some(numbers)
}

impl FromStr for View {
    type Err = ViewError;

    fn from_str(text: &str) -> Result<Self, ViewError> {
        let error = || ViewError(text.to_owned());
        if let Some(orbit) = text.strip_prefix("orbit:") {
            return match numbers(orbit).as_deref() {
                Some(&[azimuth, elevation]) => Ok(Self::Orbit { azimuth, elevation, distance: None }),
                Some(&[azimuth, elevation, distance]) if distance > 0.0 => {
                    Ok(Self::Orbit { azimuth, elevation, distance: Some(distance) })
                }
                _ => Err(error()),
            };
        }
        let place = |text: &str| -> Option<[f64; 3]> { numbers(text)?.try_into().ok() };
        let parts: Vec<&str> = text.split(';').collect();
        let [eye, target, fov] = parts[..] else { return Err(error()) };
        let fov = fov.trim().parse().ok().filter(|f| (1.0..170.0).contains(f)).ok_or_else(error)?;
        let (eye, target) = place(eye).zip(place(target)).filter(|(e, t)| e != t).ok_or_else(error)?;
        Ok(Self::Fixed { eye, target, fov })
    }
}

impl TryFrom<String> for View {
    type Error = ViewError;

    fn try_from(text: String) -> Result<Self, ViewError> {
        text.parse()
    }
}

/// The step of a ray march.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Step {
    /// In voxels.
    Voxels(f64),
    /// In world units.
    World(f64),
}

impl FromStr for Step {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (number, step): (_, fn(f64) -> Self) = match text.strip_suffix("world") {
            Some(number) => (number, Self::World),
            None => (text, Self::Voxels),
        };
        let number = number.trim().parse().ok().filter(|v: &f64| v.is_finite() && *v > 0.0);
        number.map(step).ok_or_else(|| {
            format!(
                "{text:?} is not a step: a number above 0, such as 0.5 (voxels) or 0.02world (world units)"
            )
        })
    }
}

impl<'de> Deserialize<'de> for Step {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        #[serde(untagged, expecting = "a number of voxels, or a text such as \"0.02world\"")]
        enum Written {
            Number(f64),
            Text(String),
        }
        let text = match Written::deserialize(deserializer)? {
            Written::Number(number) => number.to_string(),
            Written::Text(text) => text,
        };
        text.parse().map_err(serde::de::Error::custom)
    }
}

/// The direction of the sun: azimuth and elevation in degrees, counted like a camera's.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(try_from = "[f64; 2]")]
pub struct Sun(pub [f64; 2]);

impl TryFrom<[f64; 2]> for Sun {
    type Error = String;

    fn try_from(sun: [f64; 2]) -> Result<Self, String> {
        let is_direction = sun[0].is_finite() && sun[1].abs() <= 90.0;
        is_direction.then_some(Self(sun)).ok_or_else(|| {
            "the sun has an azimuth and an elevation of -90 to 90, in degrees, such as 110,40".to_owned()
        })
    }
}

impl FromStr for Sun {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let sun = numbers(text).and_then(|numbers| numbers.try_into().ok());
        // What is no direction either.
        Self::try_from(sun.unwrap_or([f64::NAN; 2]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn views_are_parsed() {
        let orbit = |distance| View::Orbit { azimuth: 10.0, elevation: 20.0, distance };
        assert_eq!("orbit:10,20,1.5".parse::<View>().unwrap(), orbit(Some(1.5)));
        assert_eq!("orbit:10,20".parse::<View>().unwrap(), orbit(None));
        let fixed = View::Fixed { eye: [1.0, 2.0, 3.0], target: [0.0; 3], fov: 45.0 };
        assert_eq!("1,2,3;0,0,0;45".parse::<View>().unwrap(), fixed);
        for bad in [
            "",
            "orbit:1",
            "orbit:1,2,0",
            "orbit:1,2,3,4",
            "1,2,3;1,2,3;45",
            "1,2,3;0,0,0;0",
            "1,2,x;0,0,0;45",
        ] {
            assert!(bad.parse::<View>().is_err(), "{bad}");
        }
    }

    #[test]
    fn a_manifest_and_the_command_line_write_the_same() {
        let text = "camera = 'orbit:10,20'\nup = 'z'\nstep = '0.02world'\nsun = [110, -5.5]\nalbedo = 0.5\n";
        let look: Look = toml::from_str(text).unwrap();
        assert_eq!(look.step, Some("0.02world".parse().unwrap()));
        assert_eq!(look.sun, Some("110,-5.5".parse().unwrap()));
        assert_eq!(look.camera, Some("orbit:10,20".parse().unwrap()));
        assert_eq!(toml::from_str::<Look>("step = 2").unwrap().step, Some(Step::Voxels(2.0)));
        for wrong in ["step = 0", "sun = [0, 91]", "camera = 'x'", "up = 'w'", "shine = 1"] {
            assert!(toml::from_str::<Look>(wrong).is_err(), "{wrong}");
        }
        let overridden = Look { albedo: Some(0.9), ..Look::default() }.or(&look);
        assert_eq!((overridden.albedo, overridden.up), (Some(0.9), Some(Up::Z)));
        let wrong = Look { albedo: Some(1.5), ..Look::default() };
        assert_eq!(wrong.check().unwrap_err(), "albedo is a number from 0 to 1");
    }
}
