//! The report's page in a browser: nothing fails, the slider moves, the numbers are the JSON's, and nothing sticks out.
//! Skips itself where there is no Chromium, unless `VOLPACK_REQUIRE_BROWSER` is set.

mod common;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use common::{fixture, skip};
use serde_json::Value as Json;

fn chromium() -> Option<PathBuf> {
    let names = ["chromium", "chromium-browser", "google-chrome"];
    let folders: Vec<PathBuf> = std::env::split_paths(&std::env::var_os("PATH")?).collect();
    let found = names.iter().flat_map(|name| folders.iter().map(move |folder| folder.join(name)));
    found.into_iter().find(|path| path.is_file())
}

/// Goes in before the page's own script, and keeps what fails.
const LISTEN: &str = "<script>
const failures = [];
addEventListener('error', event => failures.push(String(event.message)));
console.error = console.warn = (...what) => failures.push(what.join(' '));
</script>";

/// Goes in behind everything: does what people do, and tells the frame around the page what it saw.
const ACT: &str = "<script>
addEventListener('load', () => {
  const clip = () => getComputedStyle(document.querySelector('.stack .over')).clipPath;
  const slider = document.querySelector('.compare input');
  const clips = [0, 25, 100].map(at => {
    slider.value = at;
    slider.dispatchEvent(new Event('input', { bubbles: true }));
    return clip();
  });
  const first = () => document.querySelector('.sortable tbody th').textContent.trim();
  const by_file = document.querySelectorAll('.sortable thead button')[2];
  const sorted = [0, 1].map(() => { by_file.click(); return first(); });
  const pause = document.querySelector('.strip button');
  pause.click();
  const seen = {
    failures, clips, sorted,
    paused: getComputedStyle(document.querySelector('.player')).animationPlayState,
    figures: [...document.querySelectorAll('data[data-path]')].map(d => [d.dataset.path, d.value, d.textContent]),
    unnamed: [...document.querySelectorAll('img:not([alt]), input:not([aria-label]), [role=img]:not([aria-label])')].length,
    broken: [...document.images].filter(image => !image.complete || image.naturalWidth === 0).length,
    width: innerWidth, needed: document.documentElement.scrollWidth,
  };
  parent.postMessage(btoa(unescape(encodeURIComponent(JSON.stringify(seen)))), '*');
});
</script>";

/// Opens a page in a frame, since no window is as narrow as a phone, and gives what [`ACT`] saw.
fn open(chromium: &Path, page: &Path, width: u32) -> Json {
    let around = page.with_file_name("around.html");
    let html = format!(
        "<iframe src='{}' style='width: {width}px; height: 900px; border: 0'></iframe><pre></pre>\
         <script>onmessage = event => document.querySelector('pre').textContent = event.data</script>",
        page.file_name().unwrap().to_str().unwrap()
    );
    fs::write(&around, html).unwrap();
    let mut command = Command::new(chromium);
    command.args(["--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=5000", "--dump-dom"]);
    command.arg("--window-size=1400,1000");
    command.arg(format!("--user-data-dir={}", page.with_extension("profile").display()));
    let output = command.arg(format!("file://{}", around.display())).output().unwrap();
    let dom = String::from_utf8_lossy(&output.stdout);
    let seen = dom.split_once("<pre>").and_then(|(_, rest)| rest.split_once('<')).map(|(seen, _)| seen);
    let decoded = BASE64_STANDARD.decode(seen.unwrap_or_default()).unwrap_or_default();
    serde_json::from_slice(&decoded)
        .unwrap_or_else(|e| panic!("{e}: {dom:.2000}{}", String::from_utf8_lossy(&output.stderr)))
}

/// What a number looks like to people, as the number that it stands for.
fn parsed(text: &str) -> Option<f64> {
    let text = text.split(" of ").next()?;
    let (number, unit) = text.split_once(' ').unwrap_or((text, ""));
    let scale = match unit {
        "" | "B" | "dB" | "bits" | "s" => 1.0,
        "KiB" => 1024.0,
        "MiB" => 1024.0 * 1024.0,
        "%" => 0.01,
        "ms" => 0.001,
        _ => panic!("{text} has an unknown unit"),
    };
    Some(number.replace(',', "").parse::<f64>().ok()? * scale)
}

/// Every figure that says where it stands in the JSON is what stands there, also as people read it.
fn check_figures(figures: &Json, json: &Json) {
    let figures: Vec<[String; 3]> = serde_json::from_value(figures.clone()).unwrap();
    assert!(figures.len() > 100, "only {} figures", figures.len());
    for [path, value, text] in figures {
        let in_json = json.pointer(&path).unwrap_or_else(|| panic!("{path} is not in the JSON"));
        if in_json.is_null() {
            assert!(value == "null" && ["exact", "not compared", "–"].contains(&&*text), "{path}: {text}");
            continue;
        }
        let number = in_json.as_f64().unwrap();
        assert_eq!(value.parse::<f64>().ok(), Some(number), "{path}");
        let shown = parsed(&text).unwrap_or_else(|| panic!("{path}: {text}"));
        // Two decimals of a percent, of a MiB or of a dB, four of FLIP; whole milliseconds.
        let step = if text.contains("MiB") {
            6e3
        } else if text.ends_with("KiB") {
            6.0
        } else {
            0.0051
        };
        let step = if text.ends_with('s') && !text.ends_with("bits") { 0.06 } else { step };
        assert!((shown - number).abs() <= step, "{path}: {number} is shown as {text}");
    }
}

#[test]
fn the_page_works_in_a_browser() {
    let Some(chromium) = chromium() else {
        skip("BROWSER", "there is no Chromium");
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let manifest = fs::read_to_string(root.join("pipeline.toml")).unwrap();
    let fixtures = fixture("");
    let manifest =
        manifest.replace("\"fixtures/", &format!("\"{}/", fixtures.to_str().unwrap().trim_end_matches('/')));
    fs::write(folder.path().join("pipeline.toml"), manifest).unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_volpack"));
    command.current_dir(folder.path()).env("VOLPACK_CACHE", folder.path().join("cache"));
    command.args(["report", "--html", "r.html", "--json", "r.json", "-q"]);
    assert!(command.status().unwrap().success());
    let report: Json = serde_json::from_slice(&fs::read(folder.path().join("r.json")).unwrap()).unwrap();

    let page = folder.path().join("acted.html");
    let html = fs::read_to_string(folder.path().join("r.html")).unwrap();
    assert!(
        !html.replace("http://www.w3.org/2000/svg", "").contains("http"),
        "the page needs nothing from elsewhere"
    );
    fs::write(&page, html.replacen("<style>", &format!("{LISTEN}<style>"), 1) + ACT).unwrap();

    for width in [360, 1280] {
        let seen = open(&chromium, &page, width);
        assert_eq!(seen["failures"], Json::Array(Vec::new()));
        assert_eq!(
            (&seen["broken"], &seen["unnamed"], &seen["paused"]),
            (&0.into(), &0.into(), &"paused".into())
        );
        check_figures(&seen["figures"], &report);
        let clips: Vec<&str> = seen["clips"].as_array().unwrap().iter().filter_map(Json::as_str).collect();
        assert!(clips[0] != clips[1] && clips[1] != clips[2], "the slider moves nothing: {clips:?}");
        // The largest first, then the smallest.
        let assets = report["assets"].as_array().unwrap().iter();
        let mut sizes: Vec<_> =
            assets.map(|a| (a["pack"]["figures"]["file_bytes"].as_u64(), &a["name"])).collect();
        sizes.sort_by_key(|size| size.0);
        assert_eq!(seen["sorted"], serde_json::json!([sizes[sizes.len() - 1].1, sizes[0].1]));
        // Nothing but what scrolls by itself is wider than the window.
        assert_eq!(seen["width"], width);
        assert!(seen["needed"].as_u64() <= Some(width.into()), "{} at {width}", seen["needed"]);
    }
}
