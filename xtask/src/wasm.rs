//! Reads the conformance packs in WebAssembly, under node, and compares with the same read natively.

use std::error::Error;
use std::process::Command;

use crate::peer_programs::{cargo, root};

/// Builds the check for `wasm32-unknown-unknown` and runs it on every pack of `tests/conformance`.
///
/// # Errors
/// When a pack reads otherwise than natively, or a tool is missing.
pub fn check() -> Result<(), Box<dyn Error>> {
    let target = tempfile::tempdir()?;
    let args =
        ["build", "--release", "-p", "volpack-wasm-check", "--lib", "--target", "wasm32-unknown-unknown"];
    let mut build = cargo();
    build.args(args).arg("--target-dir").arg(target.path());
    if !build.status()?.success() {
        return Err("it does not build (rustup target add wasm32-unknown-unknown?)".into());
    }
    let wasm = target.path().join("wasm32-unknown-unknown/release/volpack_wasm_check.wasm");
    println!("module: {} bytes", std::fs::metadata(&wasm)?.len());

    let mut packs: Vec<_> = std::fs::read_dir(root().join("tests/conformance"))?
        .map(|entry| Ok(entry?.path()))
        .collect::<std::io::Result<_>>()?;
    packs.retain(|path| path.extension().is_some_and(|extension| extension == "volpack"));
    packs.sort();
    let script = root().join("crates/volpack-format/wasm-check/run.js");
    let mut frames = 0;
    for pack in &packs {
        let natively = volpack_wasm_check::summary(std::fs::read(pack)?)?;
        let output = Command::new("node").arg(&script).arg(&wasm).arg(pack).output()?;
        let in_wasm = String::from_utf8(output.stdout)?;
        let name = pack.file_name().unwrap_or_default().display();
        if !output.status.success() || in_wasm != natively {
            let says = String::from_utf8_lossy(&output.stderr);
            return Err(format!("{name}: natively\n{natively}in WebAssembly\n{in_wasm}{says}").into());
        }
        print!("{name}\n{natively}");
        frames += natively.lines().count();
    }
    println!("{} packs, {frames} frames: the same to the bit", packs.len());
    Ok(())
}
