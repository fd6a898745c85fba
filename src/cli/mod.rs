//! The command line: one file a subcommand.

mod build;
mod cache;
pub mod exit_code;
mod explain;
mod init;
mod inspect;
mod interrupt;
mod jobs;
mod progress;
mod render;
mod report;
mod style;
mod sweep;
mod verify;
mod watch;

use std::path::PathBuf;

use clap::builder::{PathBufValueParser, TypedValueParser};
use clap::{Args, Parser, Subcommand};

use crate::error::{Error, Result};
use crate::file_name::check_name;
use crate::pipeline::VerifyLevel;
use crate::render::Device;
use crate::settings::{ByteSize, above_zero};
use crate::verify::PictureSettings;

const EXIT_CODES: &str = "\
Exit codes:
  0  done
  1  failed for another reason, such as a full disk
  2  wrong usage: an unknown option, grid or asset
  3  a file that cannot be read or is invalid
  4  verification failed: a pack does not match its source
  5  over budget
  6  not supported here: a grid type, file version or device
  130  ended by Ctrl-C: output files were not changed";

/// Turns OpenVDB volumes and animation sequences into game-ready volume packs, and verifies each pack
/// against its source.
#[derive(Parser)]
#[command(name = "volpack", version, disable_help_flag = true, after_help = EXIT_CODES, max_term_width = 100)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    common: Common,
}

#[derive(Args, Clone, Copy)]
struct Common {
    /// Print errors only
    #[arg(short, long, global = true, display_order = 100, help_heading = "General")]
    quiet: bool,
    /// Print more: seconds by stage, codecs, every frame
    #[arg(short, long, global = true, display_order = 101, help_heading = "General")]
    verbose: bool,
    /// Number of threads [default: all cores]
    #[arg(long, global = true, display_order = 102, help_heading = "General", value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    threads: Option<u16>,
    /// Print help (-h: in short)
    #[arg(short, long, global = true, display_order = 103, help_heading = "General", action = clap::ArgAction::Help)]
    help: Option<bool>,
}

#[derive(Subcommand)]
enum Command {
    /// Build packs from a manifest, or one pack from files
    Build(Box<build::BuildArgs>),
    /// Rebuild assets whenever their files change
    Watch(Box<watch::WatchArgs>),
    /// Show which stages a build would run, and why
    Explain(explain::ExplainArgs),
    /// Inspect and clean the cache
    Cache(cache::Arguments),
    /// Find the sequences in a folder and write a manifest for them
    Init(init::InitArgs),
    /// Show what is in a .vdb or a .volpack
    Inspect(inspect::InspectArgs),
    /// Verify a pack against its source
    Verify(verify::VerifyArgs),
    /// Render pictures of a pack
    Render(Box<render::RenderArgs>),
    /// Report sizes, quality and budgets as HTML, JSON, Markdown or JUnit XML
    Report(Box<report::ReportArgs>),
    /// Measure many settings of a volume and chart quality against size and speed
    Sweep(sweep::SweepArgs),
}

/// How much memory work may take.
#[derive(Args)]
struct MemoryArg {
    /// Memory limit, for example 1GB; the Vulkan driver's memory is not counted [default: none]
    #[arg(long, value_name = "SIZE", help_heading = "General")]
    memory: Option<ByteSize>,
}

impl MemoryArg {
    fn bytes(&self) -> Option<u64> {
        self.memory.map(|size| size.0)
    }
}

/// How much a pack is checked, as the command line has it.
#[derive(Args)]
struct VerifyArg {
    /// How much of the finished pack to verify [default: all, for watch: voxels]
    #[arg(long, value_name = "LEVEL", help_heading = "Verification")]
    verify: Option<VerifyLevel>,
    #[command(flatten)]
    pictures: PictureArgs,
}

/// Reads the path of an output. Names that Windows does not take are refused on every system, since scripts are shared.
fn output_path() -> impl TypedValueParser<Value = PathBuf> {
    PathBufValueParser::new().try_map(|path| {
        check_name(&path.file_name().unwrap_or_default().to_string_lossy())?;
        Ok::<_, String>(path)
    })
}

/// How pictures are compared, as the command line has it.
#[derive(Args)]
struct PictureArgs {
    /// Write pictures of source, pack and difference into this folder
    #[arg(long, value_name = "DIR", value_parser = output_path(), help_heading = "Verification")]
    images: Option<PathBuf>,
    /// Maximum visual difference (mean FLIP, 0 to 1) [default: the manifest's; if there is none, more than 0.04 is a warning]
    #[arg(long, value_name = "FLIP", value_parser = above_zero, help_heading = "Verification")]
    max_flip: Option<f64>,
    /// Device that renders the pictures
    #[arg(long, default_value = "auto", help_heading = "Verification")]
    device: Device,
}

impl PictureArgs {
    fn settings(&self, max_flip: Option<f64>) -> PictureSettings {
        PictureSettings {
            max_flip: self.max_flip.or(max_flip),
            images: self.images.clone(),
            device: self.device,
        }
    }
}

/// Runs the command that the arguments ask for.
///
/// # Errors
/// What the command failed with; [`exit_code::of`] says what the process ends with.
pub fn run(cli: Cli) -> Result<()> {
    if let Some(threads) = cli.common.threads {
        rayon::ThreadPoolBuilder::new()
            .num_threads(threads.into())
            .build_global()
            .map_err(|e| Error::Usage(format!("--threads {threads}: {e}")))?;
    }
    if matches!(cli.command, Command::Build(_) | Command::Watch(_) | Command::Verify(_) | Command::Report(_))
    {
        interrupt::catch();
    }
    match cli.command {
        Command::Build(args) => build::run(&args, cli.common),
        Command::Watch(args) => watch::run(&args, cli.common),
        Command::Explain(args) => explain::run(&args),
        Command::Cache(args) => cache::run(&args, cli.common),
        Command::Init(args) => init::run(&args, cli.common),
        Command::Inspect(args) => inspect::run(&args),
        Command::Verify(args) => verify::run(&args, cli.common),
        Command::Render(args) => render::run(&args, cli.common),
        Command::Report(args) => report::run(&args, cli.common),
        Command::Sweep(args) => sweep::run(&args, cli.common),
    }
}

/// Prints a line on standard output. A reader that went away, as `head` does, is no error; a full disk is.
macro_rules! outln {
    ($($arg:tt)*) => {{
        use std::io::Write as _;
        if let Err(error) = writeln!(anstream::stdout(), $($arg)*) {
            $crate::cli::stdout_failed(&error);
        }
    }};
}
use outln;

fn stdout_failed(error: &std::io::Error) -> ! {
    if error.kind() == std::io::ErrorKind::BrokenPipe {
        std::process::exit(0);
    }
    eprintln!("error: standard output: {error}");
    std::process::exit(1);
}

/// Prints an error whole, and where it may help how to go on.
pub fn print_error(error: &Error) {
    let style = style::ERROR;
    anstream::eprintln!("{style}error{style:#}: {error}");
}

fn print_json(value: &impl serde::Serialize) {
    let text = serde_json::to_string_pretty(value).expect("reports have string keys and finite numbers");
    outln!("{text}");
}
