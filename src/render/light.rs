//! How fog is lit, and what glows in it.

use super::camera::{Up, direction};

/// How fog is lit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Light {
    /// Where the sun stands: azimuth and elevation in degrees, as a camera's.
    pub sun: [f64; 2],
    /// The part of light that fog scatters; it swallows the rest.
    pub albedo: f64,
    /// Henyey and Greenstein's g, above -1 and below 1: 0 scatters alike everywhere, above 0 mostly onwards.
    pub anisotropy: f64,
    /// How bright the sky is, as a multiple of the usual.
    pub ambient: f64,
}

impl Default for Light {
    /// White smoke, and a sun that stands to the right and a little behind for a default camera: that shows its shape.
    fn default() -> Self {
        Self { sun: [110.0, 40.0], albedo: 0.95, anisotropy: 0.0, ambient: 1.0 }
    }
}

/// The sun's radiance, so that white fog in full light is nearly white in a picture: a little yellow.
const SUN: [f64; 3] = [1.75, 1.6, 1.4];
/// The sky's: a little blue.
const SKY: [f64; 3] = [0.09, 0.125, 0.19];

/// The part of light that the smoke of a fire scatters: there is soot in it.
pub const SOOTY_ALBEDO: f64 = 0.6;

impl Light {
    /// Towards the sun, in world space.
    pub fn to_sun(&self, up: Up) -> [f64; 3] {
        let [azimuth, elevation] = self.sun;
        up.to_world(direction(azimuth, elevation))
    }

    /// What fog scatters of the sun's light where that is not dimmed.
    pub fn sun_light(&self) -> [f64; 3] {
        SUN.map(|c| c * self.albedo)
    }

    /// What fog scatters of the sky's light.
    pub fn sky_light(&self) -> [f64; 3] {
        SKY.map(|c| c * self.albedo * self.ambient)
    }
}
