//! The `volpack` command: parse, call, print, exit code.

use std::process::ExitCode;

use clap::Parser;
use volpack::cli::{Cli, print_error, run};

fn main() -> ExitCode {
    if std::env::var_os("XDG_RUNTIME_DIR").is_none() {
        // SAFETY: no other thread runs yet. Without it the Vulkan drivers of Mesa complain on standard
        // error about a window system that nobody asked for.
        unsafe { std::env::set_var("XDG_RUNTIME_DIR", std::env::temp_dir()) };
    }
    match run(Cli::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            print_error(&error);
            ExitCode::from(error.exit_code())
        }
    }
}
