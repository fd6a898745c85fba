//! Compiles the small C++ and CUDA programs that run OpenVDB's and NanoVDB's code, and finds files and tools of the repository.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::process::Command;

/// The repository's root.
pub fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("xtask lies in the repository")
}

/// The cargo that runs this task, in the repository's root.
pub fn cargo() -> Command {
    let mut cargo = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    cargo.current_dir(root());
    cargo
}

/// Compiles a program against OpenVDB into `target/peers` and returns its path.
///
/// # Errors
/// When there is no compiler or no OpenVDB: the message says what to install.
pub fn compile_openvdb(source: &str) -> Result<PathBuf, Box<dyn Error>> {
    let source = root().join(source);
    let folder = root().join("target/peers");
    std::fs::create_dir_all(&folder)?;
    let program = folder.join(source.file_stem().expect("a source file"));
    let fresh = |path: &Path| path.metadata().and_then(|m| m.modified()).ok();
    if fresh(&program) > fresh(&source) {
        return Ok(program);
    }
    let status = Command::new("g++")
        .args(["-O2", "-std=c++17", "-Wno-deprecated-declarations"])
        .arg(&source)
        .arg("-o")
        .arg(&program)
        .args(["-lopenvdb", "-ltbb", "-lImath-3_1"])
        .status();
    match status {
        Ok(status) if status.success() => Ok(program),
        _ => Err("OpenVDB is not installed: apt-get install g++ libopenvdb-dev libboost-dev libtbb-dev libimath-dev"
            .into()),
    }
}

/// Writes raw figures to a JSON file, if a path is given.
///
/// # Errors
/// When the file cannot be written.
pub fn write(path: Option<&Path>, figures: &serde_json::Value) -> Result<(), Box<dyn Error>> {
    path.map_or(Ok(()), |path| Ok(std::fs::write(path, serde_json::to_string(figures)?)?))
}

/// Compiles `benches/peers/nanovdb_trace.cu` for the GPU of this machine into `target/peers`, with the NanoVDB headers of a folder,
/// or with those on the compiler's path. Returns the program and NanoVDB's version.
///
/// # Errors
/// When there is no CUDA compiler or no NanoVDB: the message says what to install.
pub fn compile_nanovdb(headers: Option<&Path>) -> Result<(PathBuf, String), Box<dyn Error>> {
    let folder = root().join("target/peers");
    std::fs::create_dir_all(&folder)?;
    let fresh = folder.join("nanovdb_trace");
    let version = nvcc(&root().join("benches/peers/nanovdb_trace.cu"), headers, &fresh)?;
    let program = folder.join(format!("nanovdb_trace-{version}"));
    std::fs::rename(&fresh, &program)?;
    Ok((program, version))
}

/// Compiles a CUDA program that uses NanoVDB for the GPU of this machine, and returns NanoVDB's version.
///
/// # Errors
/// When there is no CUDA compiler or no NanoVDB: the message says what to install.
pub fn nvcc(source: &Path, headers: Option<&Path>, program: &Path) -> Result<String, Box<dyn Error>> {
    let mut compiler = Command::new("nvcc");
    compiler.args(["-O3", "-std=c++17", "-arch=native", "--extended-lambda"]);
    if let Some(headers) = headers {
        compiler.arg("-I").arg(headers);
    }
    let status = compiler.arg(source).arg("-o").arg(program).status();
    if !status.is_ok_and(|status| status.success()) {
        return Err("nvcc or NanoVDB is not installed: the CUDA toolkit, and apt-get install libnanovdb-dev libnanovdb-tools"
            .into());
    }
    // Without arguments, it prints only its version.
    Ok(String::from_utf8(Command::new(program).output()?.stdout)?.trim().to_owned())
}

/// The release binary of volpack in this repository.
pub fn volpack() -> PathBuf {
    root().join("target/release/volpack")
}
