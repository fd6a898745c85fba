//! The binary, end to end.

mod common;

use std::path::Path;
use std::process::{Command, Output};

use common::fixture;
use serde_json::Value as Json;

fn volpack(folder: &Path, args: &[&str]) -> Output {
    // A cache of its own: not the user's, and nothing in it.
    let cache = tempfile::tempdir().unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_volpack"));
    command.env("VOLPACK_CACHE", cache.path()).current_dir(folder).args(args).output().unwrap()
}

fn stdout(output: &Output) -> String {
    assert!(output.status.success(), "{output:?}");
    String::from_utf8(output.stdout.clone()).unwrap()
}

fn json(output: &Output) -> Json {
    serde_json::from_str(&stdout(output)).unwrap()
}

/// The exit code and what was said of the error.
fn failure(output: &Output) -> (i32, String) {
    (output.status.code().unwrap(), String::from_utf8(output.stderr.clone()).unwrap())
}

fn fix(name: &str) -> String {
    fixture(name).to_string_lossy().into_owned()
}

fn animation_glob() -> String {
    fix("anim_*.vdb")
}

#[test]
fn the_manifest_at_the_root_builds_and_verifies_the_fixtures() {
    let folder = tempfile::tempdir().unwrap();
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    std::fs::copy(root.join("pipeline.toml"), folder.path().join("pipeline.toml")).unwrap();
    let fixtures = folder.path().join("fixtures");
    std::fs::create_dir(&fixtures).unwrap();
    for file in common::fixtures() {
        std::fs::copy(&file, fixtures.join(file.file_name().unwrap())).unwrap();
    }
    let text = stdout(&volpack(folder.path(), &["build"]));
    assert_eq!(text.matches(", verified").count(), 4, "{text}");
    assert!(!text.contains('\x1b'), "colours without a terminal");

    // Without --source, the manifest says where the sources are.
    let report = json(&volpack(folder.path(), &["verify", "out/puff.volpack", "--json"]));
    assert_eq!(report["ok"], true);
    assert_eq!(report["frames"].as_array().unwrap().len(), 16);
    for key in ["rmse", "psnr", "max_error", "sign_flips"] {
        assert!(report["active"][key].is_number() && report["all"][key].is_number(), "{key}: {report}");
    }

    let one = stdout(&volpack(folder.path(), &["build", "--asset", "fog"]));
    assert!(one.contains("fog") && !one.contains("puff"));
    let (code, error) = failure(&volpack(folder.path(), &["build", "--asset", "fgo"]));
    assert!(code == 2 && error.contains("ball, fog, puff, tiles"), "{code} {error}");
}

#[test]
fn inspect_gives_every_figure() {
    let folder = tempfile::tempdir().unwrap();
    let file = json(&volpack(folder.path(), &["inspect", "--json", "--values", &fix("types.vdb")]));
    let grid = &file["grids"][0];
    for key in [
        "name",
        "type",
        "class",
        "map",
        "background",
        "leaves",
        "active_voxels",
        "root_tiles",
        "l1_tiles",
        "l2_tiles",
        "bbox",
        "active_leaf_voxels",
        "min",
        "max",
        "sum",
        "nonfinite",
    ] {
        assert!(!grid[key].is_null(), "{key}: {grid}");
    }
    assert_eq!(grid["bbox"].as_array().unwrap().len(), 6);

    volpack(folder.path(), &["build", &animation_glob(), "-o", "a.volpack", "-f", "bc7", "--verify", "none"]);
    let pack = json(&volpack(folder.path(), &["inspect", "--json", "a.volpack"]));
    for key in ["frames", "bricks", "unique_bricks", "tree_bytes", "mask_bytes", "texel_bytes", "file_bytes"]
    {
        assert!(pack[key].is_u64(), "{key}: {pack}");
    }
    assert_eq!(pack["frames"], 8);
    assert_eq!(pack["codecs"]["bc7"]["bytes"], pack["texel_bytes"]);
    let sum: u64 =
        ["tree_bytes", "mask_bytes", "texel_bytes"].iter().map(|k| pack[k].as_u64().unwrap()).sum();
    assert_eq!(pack["gpu_bytes"], sum);
    assert_eq!(pack["file_bytes"], std::fs::metadata(folder.path().join("a.volpack")).unwrap().len());
    assert!(stdout(&volpack(folder.path(), &["inspect", "a.volpack"])).contains("frames 1 to 8"));
}

#[test]
fn the_same_input_gives_the_same_bytes() {
    let (one, two) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    for format in ["f32", "bc4", "bc7"] {
        let build = |folder: &Path, threads: &str| {
            let args = [
                "build",
                &animation_glob(),
                "-o",
                "a.volpack",
                "-f",
                format,
                "--threads",
                threads,
                "--verify",
                "none",
            ];
            stdout(&volpack(folder, &args));
            std::fs::read(folder.join("a.volpack")).unwrap()
        };
        assert_eq!(build(one.path(), "1"), build(two.path(), "2"), "{format}");
    }
}

#[test]
fn memory_is_limited_without_a_byte_changing_and_too_little_is_told_before_a_voxel_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let build = |name: &str, memory: &[&str]| {
        let base = ["build", &animation_glob(), "-o", name, "--verify", "voxels", "--threads", "2"];
        let output = volpack(folder.path(), &[&base, memory].concat());
        (output, std::fs::read(folder.path().join(name)).ok())
    };
    let (_, free) = build("free.volpack", &[]);
    assert!(free.is_some());
    // Enough for one frame at a time, and for all that are ever read together.
    for memory in ["22MiB", "1GB"] {
        let (output, limited) = build("limited.volpack", &["--memory", memory]);
        assert!(output.status.success() && limited == free, "{memory}: {output:?}");
    }
    let (output, none) = build("none.volpack", &["--memory", "20MiB"]);
    let (code, error) = failure(&output);
    assert_eq!(code, 2, "{error}");
    assert!(error.contains("--memory 20.00 MiB: ") && error.contains("anim_000"), "{error}");
    let enough = error.split("give it ").nth(1).and_then(|rest| rest.split(" MiB").next()).unwrap();
    assert!((20.0..22.0).contains(&enough.parse::<f64>().unwrap()), "{error}");
    assert_eq!(none, None);
}

#[test]
fn scratch_lies_in_the_cache_unless_it_is_sent_elsewhere() {
    let folder = tempfile::tempdir().unwrap();
    let build = |args: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_volpack"));
        command.args(["build", &fix("tiles.vdb"), "-o", "out.volpack", "--verify", "none"]).args(args);
        // Where there is nothing: nobody may look for the system's folder. Unix has TMPDIR, Windows TMP.
        for variable in ["TMPDIR", "TMP"] {
            command.env(variable, folder.path().join("nowhere"));
        }
        command.current_dir(folder.path()).output().unwrap()
    };
    let (code, error) = failure(&build(&["--no-cache"]));
    assert!(code == 3 && error.contains("nowhere"), "{code} {error}");
    stdout(&build(&["--cache", "cache"]));
    stdout(&build(&["--no-cache", "--scratch", "scratch"]));
    let left = std::fs::read_dir(folder.path().join("scratch")).unwrap().count();
    assert_eq!(left, 0, "scratch files have no name");
}

#[test]
fn errors_say_what_to_do_and_exit_by_kind() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let build = |file: &str, more: &[&str]| {
        let file = fix(file);
        let args = [&["build", &file, "-o", "x.volpack"], more].concat();
        failure(&volpack(at, &args))
    };
    let expect = |(code, error): (i32, String), expected: i32, parts: &[&str]| {
        assert!(code == expected && parts.iter().all(|p| error.contains(p)), "{code} {error}");
    };
    expect(build("none.vdb", &[]), 3, &["none.vdb"]);
    expect(build("README.md", &[]), 3, &["README.md", "not an OpenVDB file"]);
    expect(build("types.vdb", &["-g", "velocity"]), 6, &["velocity", "vec3s", "density, temperature"]);
    expect(build("types.vdb", &["-g", "densty"]), 2, &["densty", "density (float)"]);
    expect(build("maps.vdb", &[]), 2, &["map_affine", "--grid"]);
    expect(build("frustum.vdb", &[]), 6, &["NonlinearFrustumMap"]);
    expect(build("nonfinite.vdb", &[]), 3, &["density", "nonfinite = \"zero\""]);
    expect(build("fog_half_zip.vdb", &["--format", "bc8"]), 2, &["bc7"]);
    expect(build("fog_half_zip.vdb", &["--max-error", "5"]), 2, &["5", "\"5%\""]);
    // So few bytes that nothing, or next to nothing, is left.
    let few = ["--bits-per-voxel", "1", "-g"];
    let ruined = |grid: &str| build("adversarial.vdb", &[&few[..], &[grid]].concat());
    expect(ruined("checkerboards"), 4, &["checkerboards", "none of its 4,096 active voxels"]);
    expect(
        build("adversarial.vdb", &["--size", "1KB", "-g", "two_values"]),
        4,
        &["two_values", "dB is under 20 dB"],
    );
    expect(failure(&volpack(at, &["build"])), 2, &["pipeline.toml", "-o OUT.volpack"]);
    expect(failure(&volpack(at, &["build", &fix("tiles.vdb")])), 2, &["-o OUT.volpack"]);
    expect(failure(&volpack(at, &["verify", "none.volpack"])), 3, &["none.volpack"]);
    assert_eq!(std::fs::read_dir(at).unwrap().count(), 0, "something was left behind");

    std::fs::write(at.join("pipeline.toml"), "[asset.a]\nframes = 'x.vdb'\nfromat = 'bc7'\n").unwrap();
    expect(failure(&volpack(at, &["build"])), 3, &["pipeline.toml", "line 3", "`format`"]);

    let help = stdout(&volpack(at, &["help"]));
    assert!((0..=6).all(|code| help.contains(&format!("\n  {code}  "))), "{help}");
}

#[test]
fn missing_frames_are_named_and_strict_refuses_them() {
    let folder = tempfile::tempdir().unwrap();
    let frames = [fix("anim_0001.vdb"), fix("anim_0002.vdb"), fix("anim_0005.vdb")];
    let args = ["build", &frames[0], &frames[1], &frames[2], "-o", "a.volpack"];
    let output = volpack(folder.path(), &args);
    assert!(output.status.success());
    assert!(failure(&output).1.contains("missing from the sequence: 3-4"));
    let (code, error) = failure(&volpack(folder.path(), &[&args[..], &["--strict"]].concat()));
    assert!(code == 3 && error.contains("3-4"), "{code} {error}");
}

#[test]
fn a_bad_frame_is_named_and_the_old_pack_stays() {
    let folder = tempfile::tempdir().unwrap();
    for n in 1..=3 {
        let name = format!("anim_{n:04}.vdb");
        std::fs::copy(fixture(&name), folder.path().join(name)).unwrap();
    }
    let build = || volpack(folder.path(), &["build", "anim_*.vdb", "-o", "a.volpack", "--verify", "voxels"]);
    stdout(&build());
    let before = std::fs::read(folder.path().join("a.volpack")).unwrap();

    let mut bytes = std::fs::read(folder.path().join("anim_0002.vdb")).unwrap();
    bytes.truncate(bytes.len() * 3 / 4);
    std::fs::write(folder.path().join("anim_0002.vdb"), bytes).unwrap();
    let (code, error) = failure(&build());
    assert!(code == 3 && error.contains("anim_0002.vdb"), "{code} {error}");
    assert_eq!(std::fs::read(folder.path().join("a.volpack")).unwrap(), before);
}

#[test]
fn verify_tells_a_changed_source_and_a_damaged_pack() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    std::fs::copy(fixture("fog_half_zip.vdb"), at.join("fog.vdb")).unwrap();
    stdout(&volpack(at, &["build", "fog.vdb", "-o", "a.volpack", "-f", "bc7", "--verify", "none"]));
    stdout(&volpack(at, &["verify", "a.volpack", "--source", "fog.vdb"]));
    stdout(&volpack(at, &["verify", "a.volpack", "--level", "structure"]));
    let (code, error) = failure(&volpack(at, &["verify", "a.volpack"]));
    assert!(code == 2 && error.contains("--source"), "{code} {error}");

    std::fs::copy(fixture("fog_half_blosc.vdb"), at.join("fog.vdb")).unwrap();
    let (code, error) = failure(&volpack(at, &["verify", "a.volpack", "--source", "fog.vdb"]));
    assert!(code == 4 && error.contains("fog.vdb has changed"), "{code} {error}");

    let mut bytes = std::fs::read(at.join("a.volpack")).unwrap();
    let last = bytes.len() - 1;
    bytes[last] ^= 1;
    std::fs::write(at.join("a.volpack"), bytes).unwrap();
    let (code, error) = failure(&volpack(at, &["verify", "a.volpack", "--source", "fog.vdb"]));
    assert!(code == 3 && error.contains("digest"), "{code} {error}");
}

#[test]
fn a_level_set_whose_sign_flips_fails() {
    let folder = tempfile::tempdir().unwrap();
    let coarse = ["-o", "a.volpack", "-f", "bc7", "--dedup", "kmeans", "--clusters", "1", "--variance", "1"];
    let output = volpack(folder.path(), &[&["build", &fix("levelset_half.vdb")], &coarse[..]].concat());
    let (code, error) = failure(&output);
    assert!(code == 4 && error.contains("flipped"), "{code} {error}");
}

#[test]
fn pictures_are_rendered_compared_and_kept() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let build = ["build", &animation_glob(), "-o", "a.volpack", "-f", "bc7", "--device", "cpu"];
    let text = stdout(&volpack(at, &[&build[..], &["--images", "shown"]].concat()));
    assert!(text.contains("rendered on the CPU only") && text.contains("FLIP"), "{text}");
    assert_eq!(
        std::fs::read_dir(at.join("shown")).unwrap().count(),
        3,
        "the first, a middle and the last frame"
    );

    let (code, error) = failure(&volpack(at, &[&build[..], &["--max-flip", "0.0001"]].concat()));
    assert!(code == 4 && error.contains("FLIP") && error.contains("max_flip"), "{code} {error}");

    let render = |more: &[&str]| {
        volpack(at, &[&["render", "a.volpack", "-o", "p.png", "--device", "cpu"], more].concat())
    };
    let size = || {
        let bytes = std::fs::read(at.join("p.png")).unwrap();
        assert!(bytes.starts_with(b"\x89PNG"));
        [16, 20].map(|i| u32::from_be_bytes(bytes[i..i + 4].try_into().unwrap()))
    };
    for mode in ["density", "depth", "first", "bricks", "steps", "nodes", "normals", "lit"] {
        assert!(
            stdout(&render(&["--size", "48x32", "--frame", "3", "--mode", mode])).contains("steps a ray")
        );
        assert_eq!(size(), [48, 32]);
    }
    stdout(&render(&["--size", "48x32", "--frames", "all"]));
    assert_eq!(size(), [4 * 48, 2 * 32]);
    stdout(&render(&[
        "--size", "48x32", "--frames", "2-8:3,1", "--up", "z", "--step", "0.3world", "--jitter",
    ]));
    assert_eq!(size(), [2 * 48, 2 * 32], "frames 2, 5, 8 and 1");
    for (wrong, part) in [
        (vec!["--frame", "77"], "it has 1 to 8"),
        (vec!["--grid", "heat"], "it has density"),
        (vec!["--frames", "20-24"], "no frame from 20 to 24; it has 1 to 8"),
        (vec!["--camera", "orbit:1"], "orbit:AZIMUTH"),
        (vec!["--manifest", "pipeline.toml"], "cannot be used with"),
        (vec!["--step", "0"], "0.02world"),
        (vec!["--albedo", "1.5"], "albedo is a number from 0 to 1"),
        (vec!["--emission", "heat"], "no grid \"heat\"; it has density"),
        (vec!["--size", "0x4"], "1920x1080"),
    ] {
        let (code, error) = failure(&render(&wrong));
        assert!(code == 2 && error.contains(part), "{wrong:?}: {code} {error}");
    }
    // A manifest's look is that of the same options, and the command line goes before it.
    let manifest =
        "[asset.a]\nframes = 'a.vdb'\n[asset.a.look]\nsun = [20, 30]\nalbedo = 0.5\ncamera = 'orbit:0,0'\n";
    std::fs::write(at.join("pipeline.toml"), manifest).unwrap();
    let drawn = |args: &[&str]| {
        let always = ["render", "-o", "p.png", "--size", "48x32", "--device", "cpu"];
        stdout(&volpack(at, &[&always[..], args].concat()));
        std::fs::read(at.join("p.png")).unwrap()
    };
    let by_options = ["a.volpack", "--sun", "20,30", "--albedo", "0.9", "--camera", "orbit:0,0"];
    assert_eq!(drawn(&["--asset", "a", "--albedo", "0.9"]), drawn(&by_options));
    assert_ne!(drawn(&["--asset", "a"]), drawn(&by_options));

    let (code, error) = failure(&volpack(at, &["render", "a.volpack", "-o", "p.jpg"]));
    assert!(code == 2 && error.contains(".png") && error.contains(".apng"), "{code} {error}");
}

#[test]
fn a_slip_in_the_arguments_costs_no_file() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    std::fs::copy(fixture("levelset_half.vdb"), at.join("a.vdb")).unwrap();
    std::fs::copy(fixture("levelset_float.vdb"), at.join("b.vdb")).unwrap();
    let before = std::fs::read(at.join("b.vdb")).unwrap();
    for (output, part) in [
        ("a.vdb", "output too"),
        ("b.vdb", "is not a pack"),
        ("NUL.volpack", "name of a device"),
        ("a.volpack.", "ends with a dot"),
    ] {
        let (code, error) = failure(&volpack(at, &["build", "a.vdb", "-o", output]));
        assert!(code == 2 && error.contains(part), "{code} {error}");
    }
    assert_eq!(std::fs::read(at.join("b.vdb")).unwrap(), before);

    // Nobody can tell what an output is that cannot be read. This one gives an I/O error, to root as well.
    #[cfg(target_os = "linux")]
    {
        let (_, error) = failure(&volpack(at, &["build", "a.vdb", "-o", "/proc/self/mem"]));
        assert!(error.contains("/proc/self/mem: the output exists and cannot be read, so it is"), "{error}");
    }

    // A pack that fails verification does not take the place of one that passed.
    stdout(&volpack(at, &["build", "a.vdb", "-o", "a.volpack", "--verify", "voxels"]));
    let good = std::fs::read(at.join("a.volpack")).unwrap();
    let coarse = ["-f", "bc7", "--dedup", "kmeans", "--clusters", "1", "--variance", "1", "--json"];
    let build = ["build", "a.vdb", "-o", "a.volpack", "--verify", "voxels"];
    let output = volpack(at, &[&build[..], &coarse].concat());
    assert_eq!(output.status.code(), Some(4));
    assert_eq!(std::fs::read(at.join("a.volpack")).unwrap(), good);
    let report: Json = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(report["assets"][0]["verification"]["ok"], false);
    assert!(report["assets"][0]["error"].as_str().unwrap().contains("flipped"));

    let (code, error) = failure(&volpack(at, &["render", "a.volpack", "-o", "a.volpack", "--device", "cpu"]));
    assert!(code == 2 && error.contains("written as .png"), "{code} {error}");

    for (manifest, args, expected, part) in [
        ("[asset.a]\nframes = []\n", vec!["build"], 3, "no frames"),
        (
            "[asset.con]\nframes = 'a.vdb'\n",
            vec!["build"],
            3,
            "asset \"con\": output: \"con.volpack\" is the",
        ),
        ("[asset.a]\nframes = 'a.vdb'\n", vec!["build", "-f", "bc7"], 2, "FILES"),
        ("[asset.a]\nframes = 'a.vdb'\nmax_flip = nan\n", vec!["build"], 3, "max_flip"),
        ("[asset.a]\nframes = 'no*.vdb'\n[asset.b]\nframes = 'b.vdb'\n", vec!["build"], 3, "no file matches"),
        (
            "[asset.a]\nframes = 'a.vdb'\noutput = 'x'\n[asset.b]\nframes = 'b.vdb'\noutput = 'x'\n",
            vec!["build"],
            2,
            "both",
        ),
    ] {
        std::fs::write(at.join("pipeline.toml"), manifest).unwrap();
        let (code, error) = failure(&volpack(at, &[&args[..], &["--device", "cpu"]].concat()));
        assert!(code == expected && error.contains(part), "{manifest}: {code} {error}");
    }
    assert!(at.join("b.volpack").exists(), "the asset after a bad one is built");
}

#[test]
fn init_writes_a_manifest_that_builds() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    std::fs::create_dir_all(at.join("shots/[a]")).unwrap();
    for (from, to) in [
        ("anim_0001", "shots/[a]/puff_9"),
        ("anim_0002", "shots/[a]/puff_10"),
        ("fog_half_blosc", "shots/[a]/puff_low_10"),
        ("levelset_half", "ball"),
    ] {
        std::fs::copy(fixture(&format!("{from}.vdb")), at.join(format!("{to}.vdb"))).unwrap();
    }
    std::fs::write(at.join("broken_1.vdb"), b"no volume").unwrap();
    let output = volpack(at, &["init"]);
    let text = stdout(&output);
    assert!(text.contains("puff: 2 files: density (float), temperature (float)"), "{text}");
    let broken = Path::new(".").join("broken_1.vdb").display().to_string();
    assert!(String::from_utf8_lossy(&output.stderr).contains(&format!("left out: {broken}")));

    let manifest = volpack::manifest::Manifest::read(&at.join("pipeline.toml")).unwrap();
    let files =
        |asset: &str| volpack::manifest::expand(&manifest.asset(asset).unwrap().frames).unwrap().len();
    assert_eq!([files("puff"), files("puff_low"), files("ball")], [2, 1, 1]);
    stdout(&volpack(at, &["build", "--asset", "puff", "--asset", "ball", "--verify", "voxels"]));
    assert!(at.join("packs/puff.volpack").exists() && at.join("packs/ball.volpack").exists());

    // What someone wrote is not written over.
    let (code, error) = failure(&volpack(at, &["init"]));
    assert!(code == 2 && error.contains("exists"), "{code} {error}");
    let (code, error) = failure(&volpack(at, &["init", "packs"]));
    assert!(code == 3 && error.contains("no .vdb file"), "{code} {error}");
}

#[test]
fn a_sweep_writes_tables_and_charts() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let fog = fix("fog_half_blosc.vdb");
    let sweep = ["sweep", &fog, "-o", "out", "--repeats", "1", "--trace", "0", "0"];
    let text = stdout(&volpack(at, &sweep));
    assert!(text.contains("psnr = 45") && text.contains("front"), "{text}");
    let read = |name: &str| std::fs::read_to_string(at.join("out").join(name)).unwrap();
    let json: Json = serde_json::from_str(&read("sweep.json")).unwrap();
    let points = json["points"].as_array().unwrap();
    let ours = points.iter().filter(|p| !p["method"].as_str().unwrap().starts_with("NanoVDB")).count();
    assert_eq!(ours, 29, "every setting gives a point");
    // Every point is a row, and what was asked for is in it.
    assert_eq!(read("sweep.csv").lines().count(), points.len() + 1);
    let at_45 = points.iter().find(|p| p["setting"] == "psnr = 45").unwrap();
    assert!(at_45["psnr"].as_f64().unwrap() >= 45.0 && at_45["failures"].as_array().unwrap().is_empty());
    assert!(read("sweep.svg").contains("no GPU here: not traced"));

    let (code, error) = failure(&volpack(at, &["sweep", &fog, "-o", "out", "--grid", "typo", "--stability"]));
    assert!(code == 2 && error.contains("typo"), "{code} {error}");
}
