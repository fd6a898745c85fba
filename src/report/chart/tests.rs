use super::paint::looks;
use super::*;

fn point(method: &str, setting: &str, bits: f64, psnr: Option<f64>) -> Point {
    Point {
        volume: "v".into(),
        method: method.into(),
        setting: setting.into(),
        gpu_bytes: (bits * 1e6) as u64,
        bits_per_voxel: bits,
        psnr,
        max_error: 0.01,
        build_seconds: 0.0,
        trace_ms: None,
        blockiness: Some(1.0),
        failures: vec![],
    }
}

fn spread(method: &str, psnr: (f64, f64)) -> Spread {
    Spread {
        volume: "v".into(),
        method: method.into(),
        setting: "psnr = 45".into(),
        psnr,
        bits_per_voxel: (1.0, 1.0),
        max_error: (0.0, 0.1),
        blockiness: (1.0, 1.1),
        runs: 3,
        failures: vec![],
    }
}

/// A well-formed page has as many closed as opened texts and no number a viewer would choke on.
fn sound(svg: &str) {
    assert!(svg.starts_with("<svg ") && svg.trim_end().ends_with("</svg>"));
    assert_eq!(svg.matches("<text ").count(), svg.matches("</text>").count());
    for bad in ["NaN", "2147483647", "2147483648"] {
        let around = svg.find(bad).map(|i| svg[i.saturating_sub(200)..].lines().take(3).collect::<String>());
        assert_eq!(around, None);
    }
}

#[test]
fn front_is_exactly_what_nothing_beats() {
    // A full grid with a few repeats, so that ties on either count occur.
    let points: Vec<(f64, f64)> = (0..60).map(|i| (f64::from(i * 7 % 11), f64::from(i * 5 % 13))).collect();
    let on = pareto(&points);
    for (i, a) in points.iter().enumerate() {
        let beaten = points.iter().any(|b| b != a && b.0 <= a.0 && b.1 >= a.1);
        assert_eq!(on[i], !beaten, "{a:?}");
    }
    assert_eq!(pareto(&[(1.0, f64::INFINITY), (2.0, f64::INFINITY)]), [true, false]);
    assert_eq!(pareto(&[(f64::NAN, 9.0), (1.0, 1.0), (1.0, 1.0)]), [false, true, true]);
    assert!(pareto(&[]).is_empty());
}

#[test]
fn nothing_to_draw_is_said() {
    let svg = sweep_svg("v", "", &[]).unwrap();
    sound(&svg);
    assert_eq!(svg.matches("no settings to draw").count(), 3);
    let svg = stability_svg("v", "", &[]).unwrap();
    sound(&svg);
    assert!(svg.contains("no repetitions to draw"));
    let untraced = sweep_svg("v", "", &[point("bc7", "", 2.0, Some(40.0))]).unwrap();
    assert!(untraced.contains("no GPU here: not traced"));
}

#[test]
fn names_cannot_break_the_page() {
    let mut p = point("<b>&\"m\"", "k < 3 & \u{1}é", 1.0, Some(f64::MAX.log10()));
    p.volume = "a & <b> \"c\"\u{0}".into();
    p.failures = vec!["<script>".into()];
    let svg = sweep_svg(&p.volume.clone(), "<i>", &[p]).unwrap();
    sound(&svg);
    assert!(svg.contains("<title>a &amp; &lt;b&gt; &quot;c&quot;: quality"));
    assert!(!svg.contains("<script>") && !svg.contains("<i>") && !svg.contains("<b>"));
    assert!(!svg.contains('\u{0}') && !svg.contains('\u{1}'));
}

#[test]
fn failed_points_are_named_and_never_win() {
    let mut bad = point("kmeans", "k = 9", 1.0, Some(90.0));
    bad.failures = vec!["signs flipped".into()];
    let svg = sweep_svg("v", "", &[bad, point("bc7", "", 2.0, Some(40.0))]).unwrap();
    assert!(svg.contains("Best for their size: bc7 at 2 bits per voxel, 40 dB. Failed: kmeans, k = 9."));
    assert!(svg.contains("kmeans, k = 9: signs flipped\n"));
}

#[test]
fn odd_numbers_are_skipped_or_fit() {
    let odd = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 0.0, -1.0, 1e-300, 1e300, 5e-324, f64::MAX, 1.0];
    let mut points = Vec::new();
    for a in odd {
        for b in odd {
            let mut p = point("adaptive", &format!("psnr = {}", points.len()), a, Some(b));
            (p.build_seconds, p.trace_ms, p.gpu_bytes) = (b, Some(a), u64::MAX);
            sound(&sweep_svg("v", "", &[p.clone()]).unwrap());
            points.push(p);
            let mut s = spread("m", (a, b));
            (s.bits_per_voxel, s.max_error, s.blockiness) = ((b, a), (a, b), (a, a));
            sound(&stability_svg("v", "", &[s]).unwrap());
        }
    }
    sound(&sweep_svg("v", "", &points).unwrap());
    let same = vec![point("f16", "", 16.0, None); 3];
    sound(&sweep_svg("v", "", &same).unwrap());
}

#[test]
fn same_input_same_bytes_in_any_style() {
    let points: Vec<Point> =
        (0..80).map(|i| point(&format!("m{i}"), "s", f64::from(i + 1), Some(f64::from(i)))).collect();
    assert_eq!(sweep_svg("v", "s", &points).unwrap(), sweep_svg("v", "s", &points).unwrap());
    let reversed: Vec<&str> = points.iter().rev().map(|p| p.method.as_str()).collect();
    assert!(looks(points.iter().map(|p| p.method.as_str())) == looks(reversed.into_iter()));
    let distinct = looks(points[..50].iter().map(|p| p.method.as_str()));
    assert!(distinct.iter().all(|a| distinct.iter().filter(|b| a.1 == b.1).count() == 1));
}
