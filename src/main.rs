//! The `volpack` command: parse, call, print, exit code.

use std::process::ExitCode;

use clap::Parser;
use volpack::cli::{Cli, print_error, run};

fn main() -> ExitCode {
    match run(Cli::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            print_error(&error);
            ExitCode::from(error.exit_code())
        }
    }
}
