//! The `volpack` command: parse, call, print, exit code.

use std::process::ExitCode;

use clap::Parser;
use volpack::cli::{Cli, exit_code, print_error, run};

fn main() -> ExitCode {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    keep_what_frames_free();
    if std::env::var_os("XDG_RUNTIME_DIR").is_none() {
        // SAFETY: no other thread runs yet. Without it the Vulkan drivers of Mesa complain on standard
        // error about a window system that nobody asked for.
        unsafe { std::env::set_var("XDG_RUNTIME_DIR", std::env::temp_dir()) };
    }
    match run(Cli::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            print_error(&error);
            ExitCode::from(exit_code::of(&error))
        }
    }
}

/// Frames come and go. By itself glibc gives a megabyte that is freed back to the system and takes it anew, page by page,
/// for the next frame: a tenth of the time of a build without encoders (docs/decisions/0012-scale.md).
#[cfg(all(target_os = "linux", target_env = "gnu"))]
fn keep_what_frames_free() {
    // SAFETY: no other thread runs yet, and any value is a valid one. Where it is refused nothing changes.
    unsafe {
        libc::mallopt(libc::M_TRIM_THRESHOLD, 2 << 20);
        libc::mallopt(libc::M_MMAP_THRESHOLD, 4 << 20);
    }
}
