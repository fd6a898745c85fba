//! The lights of a fog picture.

use super::camera::direction;
use crate::settings::Up;

/// The lights, and how fog scatters them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Light {
    /// The sun's azimuth and elevation in degrees, counted like a camera's.
    pub sun: [f64; 2],
    /// Scattering albedo: the fraction of light that is scattered and not absorbed.
    pub albedo: f64,
    /// Anisotropy, g of Henyey and Greenstein, between -1 (backward) and 1 (forward); 0 is isotropic.
    pub anisotropy: f64,
    /// Factor of the sky's light.
    pub ambient: f64,
}

impl Default for Light {
    /// White smoke, lit from the right and slightly from behind for the default camera, which shows its shape.
    fn default() -> Self {
        Self { sun: [110.0, 40.0], albedo: 0.95, anisotropy: 0.0, ambient: 1.0 }
    }
}

/// Radiance of the sun, slightly yellow. White fog in full light is nearly white in a picture.
const SUN: [f64; 3] = [1.75, 1.6, 1.4];
/// Radiance of the sky, slightly blue.
const SKY: [f64; 3] = [0.09, 0.125, 0.19];

/// Scattering albedo of a fire's smoke, which contains soot.
pub const SOOTY_ALBEDO: f64 = 0.6;

impl Light {
    /// The direction towards the sun in world space.
    pub fn to_sun(&self, up: Up) -> [f64; 3] {
        let [azimuth, elevation] = self.sun;
        up.to_world(direction(azimuth, elevation))
    }

    /// Unoccluded sunlight times the albedo.
    pub fn sun_light(&self) -> [f64; 3] {
        SUN.map(|c| c * self.albedo)
    }

    /// Sky light times the albedo.
    pub fn sky_light(&self) -> [f64; 3] {
        SKY.map(|c| c * self.albedo * self.ambient)
    }
}
