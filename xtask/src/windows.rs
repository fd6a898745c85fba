//! Cross-builds `volpack.exe` on Linux, with MinGW.

use std::error::Error;
use std::ffi::{OsStr, OsString};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value as Json;

use crate::peer_programs;
use crate::wine;
use crate::wine_prefix::Prefix;

type Result<T> = std::result::Result<T, Box<dyn Error>>;

pub const TARGET: &str = "x86_64-pc-windows-gnu";

/// Arguments of `cargo test`. The examples in the documentation are not among them, because cargo does not pass the linker
/// arguments of `build.rs` on to those.
const ALL_TESTS: [&str; 5] =
    ["--release", "--no-fail-fast", "--package=volpack", "--package=volpack-format", "--tests"];

#[derive(clap::Args)]
pub struct Args {
    /// Also run the program under wine, and compare its packs with those of the Linux program
    #[arg(long)]
    wine: bool,
    /// Path of the Linux program to compare with
    #[arg(long, default_value = "target/release/volpack", requires = "wine")]
    volpack: PathBuf,
    /// Run tests under wine instead: all of them, or those that these arguments of `cargo test` choose, for example
    /// `--release --lib`
    #[arg(long, num_args = 0.., allow_hyphen_values = true, value_name = "ARGUMENT", conflicts_with = "wine")]
    test: Option<Vec<OsString>>,
}

pub fn run(args: &Args) -> Result<()> {
    let toolchain = Toolchain::find()?;
    let libraries = collect_libraries(&toolchain)?;
    if let Some(arguments) = &args.test {
        let prefix = Prefix::new(&toolchain.cc)?;
        let mut cargo = toolchain.cargo(&libraries);
        cargo.arg("test").args(["--target", TARGET]);
        if arguments.is_empty() {
            cargo.args(ALL_TESTS);
        } else {
            cargo.args(arguments);
        }
        cargo.env("CARGO_TARGET_X86_64_PC_WINDOWS_GNU_RUNNER", prefix.program());
        prefix.set_environment(&mut cargo);
        return succeed(&mut cargo);
    }
    succeed(toolchain.cargo(&libraries).args([
        "build",
        "--release",
        "--bin",
        "volpack",
        "--target",
        TARGET,
    ]))?;
    let exe = target_folder()?.join(TARGET).join("release/volpack.exe");
    let imported = check_imports(&exe)?;
    println!("{}: {} bytes, imports {}", exe.display(), fs::metadata(&exe)?.len(), imported.join(", "));
    if args.wine { wine::check(&exe, &args.volpack, &toolchain.cc) } else { Ok(()) }
}

/// Programs of MinGW-w64.
struct Toolchain {
    cc: OsString,
    cxx: OsString,
}

impl Toolchain {
    /// Finds MinGW and checks that Rust has the target.
    ///
    /// # Errors
    /// When one of them is missing. The message says how to install it.
    fn find() -> Result<Self> {
        let library = output(Command::new("rustc").args(["--print", "target-libdir", "--target", TARGET]))?;
        if !Path::new(library.trim()).exists() {
            return Err(format!("Rust's target {TARGET} is missing: run rustup target add {TARGET}").into());
        }
        // Debian has two variants of g++; the C++ library of the other one, `-win32`, has no threads.
        for suffix in ["-posix", ""] {
            let program = |name: &str| OsString::from(format!("x86_64-w64-mingw32-{name}{suffix}"));
            let (cc, cxx) = (program("gcc"), program("g++"));
            if [&cc, &cxx].iter().all(|program| Command::new(program).arg("--version").output().is_ok()) {
                return Ok(Self { cc, cxx });
            }
        }
        Err("x86_64-w64-mingw32-g++ is missing: install MinGW-w64, on Debian with apt-get install \
             g++-mingw-w64-x86-64-posix"
            .into())
    }

    /// Cargo with these programs for this target, and libraries from a folder.
    fn cargo(&self, libraries: &Path) -> Command {
        let mut cargo = peer_programs::cargo();
        let mut search = OsString::from("-Lnative=");
        search.push(libraries);
        cargo
            .env("CARGO_TARGET_X86_64_PC_WINDOWS_GNU_LINKER", &self.cc)
            .env("CC_x86_64_pc_windows_gnu", &self.cc)
            .env("CXX_x86_64_pc_windows_gnu", &self.cxx)
            .env("AR_x86_64_pc_windows_gnu", "x86_64-w64-mingw32-ar")
            // The only variable for flags that allows spaces in a path.
            .env("CARGO_ENCODED_RUSTFLAGS", search);
        cargo
    }
}

/// Fills a folder with the libraries to link, and returns it.
///
/// The kernels of `intel_tex_2` exist for MSVC only. MinGW's linker reads them too, under the names that the crate's build script asks
/// for. The C++ library is MinGW's own, without the import library beside it, which the linker would prefer: then the program would
/// need MinGW's DLLs.
fn collect_libraries(toolchain: &Toolchain) -> Result<PathBuf> {
    let folder = target_folder()?.join("windows-libs");
    fs::create_dir_all(&folder)?;
    let kernels = package_folder("intel_tex_2")?.join("src/ispc");
    for (from, to) in [
        ("kernelx86_64-pc-windows-msvc.lib", "libkernelx86_64-pc-windows-gnu.a"),
        ("kernel_astcx86_64-pc-windows-msvc.lib", "libkernel_astcx86_64-pc-windows-gnu.a"),
        ("ispc_texcomp_astcx86_64-pc-windows-msvc-MD.lib", "libispc_texcomp_astcx86_64-pc-windows-gnu-MD.a"),
    ] {
        copy(&kernels.join(from), &folder.join(to))?;
    }
    let found = output(Command::new(&toolchain.cxx).arg("-print-file-name=libstdc++.a"))?;
    copy(Path::new(found.trim()), &folder.join("libstdc++.a"))?;
    Ok(folder)
}

fn copy(from: &Path, to: &Path) -> Result<()> {
    fs::copy(from, to).map_err(|error| format!("{}: {error}", from.display()))?;
    Ok(())
}

/// The DLLs that a program imports.
///
/// # Errors
/// When one of them is not a part of Windows.
fn check_imports(exe: &Path) -> Result<Vec<String>> {
    let text = output(Command::new("x86_64-w64-mingw32-objdump").arg("-p").arg(exe))?;
    let mut dlls: Vec<_> =
        text.lines().filter_map(|line| line.trim().strip_prefix("DLL Name: ")).map(str::to_owned).collect();
    dlls.sort_unstable_by_key(|dll| dll.to_lowercase());
    dlls.dedup_by_key(|dll| dll.to_lowercase());
    if dlls.is_empty() {
        return Err(format!("{}: imports no DLL at all, which cannot be", exe.display()).into());
    }
    let foreign: Vec<_> = dlls.iter().filter(|dll| !is_system_dll(dll)).map(String::as_str).collect();
    if !foreign.is_empty() {
        return Err(format!(
            "{}: imports {}, which Windows does not have",
            exe.display(),
            foreign.join(", ")
        )
        .into());
    }
    Ok(dlls)
}

/// Whether Windows 10 has a DLL. Those of MinGW and of Visual C++'s runtime are not among them.
fn is_system_dll(name: &str) -> bool {
    const SYSTEM: [&str; 16] = [
        "advapi32",
        "bcrypt",
        "bcryptprimitives",
        "combase",
        "crypt32",
        "dxgi",
        "kernel32",
        "msvcrt",
        "ntdll",
        "oleaut32",
        "rpcrt4",
        "setupapi",
        "shell32",
        "user32",
        "userenv",
        "ws2_32",
    ];
    let name = name.to_lowercase();
    let stem = name.strip_suffix(".dll").unwrap_or(&name);
    stem.starts_with("api-ms-win-") || SYSTEM.contains(&stem)
}

fn metadata(arguments: &[&str]) -> Result<Json> {
    let mut command = peer_programs::cargo();
    command.args(["metadata", "--format-version", "1"]).args(arguments);
    Ok(serde_json::from_str(&output(&mut command)?)?)
}

fn target_folder() -> Result<PathBuf> {
    let metadata = metadata(&["--no-deps"])?;
    Ok(metadata["target_directory"].as_str().ok_or("cargo metadata names no target folder")?.into())
}

/// The folder of a dependency's source.
fn package_folder(name: &str) -> Result<PathBuf> {
    let metadata = metadata(&["--filter-platform", TARGET])?;
    let manifest = metadata["packages"]
        .as_array()
        .and_then(|packages| packages.iter().find(|package| package["name"] == name))
        .and_then(|package| package["manifest_path"].as_str())
        .ok_or_else(|| format!("cargo metadata has no package {name}"))?;
    Ok(Path::new(manifest).with_file_name(""))
}

fn name_of(command: &Command) -> String {
    let words: Vec<_> = std::iter::once(command.get_program())
        .chain(command.get_args())
        .map(OsStr::to_string_lossy)
        .collect();
    words.join(" ")
}

/// Runs a command to its end.
///
/// # Errors
/// When it cannot be started, or fails.
pub fn succeed(command: &mut Command) -> Result<()> {
    let status = command.status().map_err(|error| format!("{}: {error}", name_of(command)))?;
    if status.success() { Ok(()) } else { Err(format!("{}: {status}", name_of(command)).into()) }
}

/// What a command prints.
///
/// # Errors
/// When it cannot be started, or fails.
pub fn output(command: &mut Command) -> Result<String> {
    let output = command.output().map_err(|error| format!("{}: {error}", name_of(command)))?;
    if !output.status.success() {
        let said = String::from_utf8_lossy(&output.stderr);
        return Err(format!("{}: {}: {said}", name_of(command), output.status).into());
    }
    Ok(String::from_utf8(output.stdout)?)
}
