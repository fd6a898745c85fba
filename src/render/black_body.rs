//! The colour of a black body.

/// Planck's second radiation constant hc/k, in nanometre kelvins (CODATA 2018).
const C2: f64 = 1.438_776_877e7;

/// Radiance at a wavelength in nm of a black body of so many kelvins, up to a factor (Planck).
fn planck(wavelength: f64, kelvin: f64) -> f64 {
    wavelength.powi(-5) / (C2 / (wavelength * kelvin)).exp_m1()
}

/// The CIE 1931 colour matching functions at a wavelength in nm: the fit of Wyman, Sloan and Shirley ("Simple analytic
/// approximations to the CIE XYZ color matching functions", JCGT 2(2), 2013).
fn cie_xyz(wavelength: f64) -> [f64; 3] {
    let lobe = |scale: f64, middle: f64, below: f64, above: f64| {
        let t = (wavelength - middle) * if wavelength < middle { below } else { above };
        scale * (-0.5 * t * t).exp()
    };
    [
        lobe(0.362, 442.0, 0.0624, 0.0374) + lobe(1.056, 599.8, 0.0264, 0.0323)
            - lobe(0.065, 501.1, 0.0490, 0.0382),
        lobe(0.821, 568.8, 0.0213, 0.0247) + lobe(0.286, 530.9, 0.0613, 0.0322),
        lobe(1.217, 437.0, 0.0845, 0.0278) + lobe(0.681, 459.0, 0.0385, 0.0725),
    ]
}

/// The colour of a black body in CIE XYZ, up to a factor.
fn black_body_xyz(kelvin: f64) -> [f64; 3] {
    let mut sum = [0.0; 3];
    for step in 0..=(830 - 360) / 5 {
        let wavelength = 360.0 + 5.0 * f64::from(step);
        let radiance = planck(wavelength, kelvin);
        for (sum, matching) in sum.iter_mut().zip(cie_xyz(wavelength)) {
            *sum += radiance * matching;
        }
    }
    sum
}

/// The colour of a black body in linear sRGB (IEC 61966-2-1), its largest component 1. Below 1,900 K blue
/// is slightly negative, and is set to 0. For temperatures that glow: the fit of the CIE functions is wrong in infrared.
pub fn black_body(kelvin: f64) -> [f64; 3] {
    let [x, y, z] = black_body_xyz(kelvin);
    let rgb = [
        3.2406 * x - 1.5372 * y - 0.4986 * z,
        -0.9689 * x + 1.8758 * y + 0.0415 * z,
        0.0557 * x - 0.2040 * y + 1.0570 * z,
    ];
    let largest = rgb.into_iter().fold(0.0, f64::max);
    rgb.map(|c| if largest > 0.0 { (c / largest).max(0.0) } else { 0.0 })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_black_body_has_its_place_on_the_planckian_locus() {
        // CIE 1931 x and y of Planck's radiators at 1,500 K, 2,856 K (illuminant A) and 6,500 K.
        for (kelvin, x, y) in [(1500.0, 0.5857, 0.3931), (2856.0, 0.4476, 0.4075), (6500.0, 0.3135, 0.3237)] {
            let xyz = black_body_xyz(kelvin);
            let sum: f64 = xyz.iter().sum();
            let (dx, dy) = (xyz[0] / sum - x, xyz[1] / sum - y);
            // The fit is off by 0.0065 in deep red, which is two or three just noticeable differences.
            assert!(dx.hypot(dy) < 0.007, "{kelvin} K: off by {dx:.4}, {dy:.4}");
        }
    }

    #[test]
    fn a_black_body_of_1500_k_is_orange() {
        // From x = 0.5857, y = 0.3931 by sRGB's matrix.
        let [r, g, b] = black_body(1500.0);
        assert!(r == 1.0 && (g - 0.133).abs() < 0.02 && b == 0.0, "{r} {g} {b}");
    }
}
