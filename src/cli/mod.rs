//! The command line: one file a subcommand.

mod build;
mod cache;
mod explain;
mod init;
mod inspect;
mod jobs;
mod progress;
mod render;
mod report;
mod style;
mod sweep;
mod verify;
mod watch;

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand};

use crate::error::{Error, Result};
use crate::pipeline::VerifyLevel;
use crate::render::Device;
use crate::settings::{
    ByteSize, ClusterArgs, DEFAULT_ZSTD, Format, Integers, Masks, NonFinite, QualityArgs, RangeMode,
    Settings, above_zero,
};
use crate::verify::PictureSettings;

const EXIT_CODES: &str = "\
Exit codes:
  0  done
  1  failed for another reason, such as a full disk
  2  wrong usage: an unknown option, grid or asset
  3  a file that cannot be read or is invalid
  4  verification failed: a pack does not say what its source says
  5  over budget
  6  not supported here: a grid type, file version or device
  130  ended by Ctrl-C: outputs are as they were";

/// Turns OpenVDB volumes and animation sequences into game-ready volume packs, and proves each pack
/// against its source.
#[derive(Parser)]
#[command(name = "volpack", version, after_help = EXIT_CODES, max_term_width = 100)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    common: Common,
}

#[derive(Args, Clone, Copy)]
struct Common {
    /// Print nothing but errors
    #[arg(short, long, global = true)]
    quiet: bool,
    /// Say more: seconds by stage, every frame
    #[arg(short, long, global = true)]
    verbose: bool,
    /// Threads to use; all cores where none are given
    #[arg(long, global = true, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    threads: Option<u16>,
}

#[derive(Subcommand)]
enum Command {
    /// Build packs from a manifest, or one pack from files
    Build(Box<build::BuildArgs>),
    /// Build what changed whenever frames land
    Watch(Box<watch::WatchArgs>),
    /// Say which stages a build would run, and why
    Explain(explain::ExplainArgs),
    /// Look after what builds keep
    Cache(cache::Arguments),
    /// Find the sequences in a folder and write a manifest for them
    Init(init::InitArgs),
    /// Say what is in a .vdb or a .volpack
    Inspect(inspect::InspectArgs),
    /// Prove a pack against its source
    Verify(verify::VerifyArgs),
    /// Trace pictures of a pack
    Render(render::RenderArgs),
    /// Put sizes, quality and budgets on one page, and into JSON, Markdown and JUnit XML
    Report(Box<report::ReportArgs>),
    /// Measure many settings of a volume and chart quality against size and speed
    Sweep(sweep::SweepArgs),
}

/// How a pack is made, for builds without a manifest.
#[derive(Args)]
struct SettingsArgs {
    /// A grid to pack; may be given more than once [default: density, else the only scalar grid]
    #[arg(short, long = "grid", value_name = "NAME")]
    grids: Vec<String>,
    /// How bricks are stored [default: adaptive]
    #[arg(short, long)]
    format: Option<Format>,
    #[command(flatten)]
    quality: QualityArgs,
    #[command(flatten)]
    clusters: ClusterArgs,
    /// What the 0 and 1 of unorm8, bc4 and bc7 texels stand for [default: brick]
    #[arg(short, long)]
    range: Option<RangeMode>,
    /// Whether bricks keep their active masks [default: auto]
    #[arg(long)]
    masks: Option<Masks>,
    /// What to do with infinities and NaNs [default: refuse]
    #[arg(long)]
    nonfinite: Option<NonFinite>,
    /// What becomes of grids of integers [default: keep]
    #[arg(long)]
    integers: Option<Integers>,
    /// zstd level of the file, 0 to store everything raw [default: 3]
    #[arg(long, value_name = "LEVEL", value_parser = clap::value_parser!(i32).range(0..=22))]
    zstd: Option<i32>,
    /// Frames per second, for engines that play the pack
    #[arg(long, value_name = "RATE", value_parser = positive)]
    fps: Option<f32>,
}

/// How much memory work may take.
#[derive(Args)]
struct MemoryArg {
    /// The most memory to take, without that of a Vulkan driver: fewer frames are read at a time
    #[arg(long, value_name = "SIZE")]
    memory: Option<ByteSize>,
}

impl MemoryArg {
    fn bytes(&self) -> Option<u64> {
        self.memory.map(|size| size.0)
    }
}

fn positive(text: &str) -> std::result::Result<f32, String> {
    match text.parse() {
        Ok(v) if v > 0.0 && f32::is_finite(v) => Ok(v),
        _ => Err("a number above 0".to_owned()),
    }
}

impl SettingsArgs {
    fn settings(&self) -> Result<Settings> {
        let format = self.format.unwrap_or_default();
        Ok(Settings {
            grids: self.grids.clone(),
            format,
            quality: self.quality.quality(format).map_err(Error::Usage)?,
            min_frame_psnr: self.quality.min_frame_psnr,
            clustering: self.clusters.clustering(format).map_err(Error::Usage)?,
            range: self.range.unwrap_or_default(),
            masks: self.masks.unwrap_or_default(),
            nonfinite: self.nonfinite.unwrap_or_default(),
            integers: self.integers.unwrap_or_default(),
            zstd: self.zstd.unwrap_or(DEFAULT_ZSTD),
            fps: self.fps,
        })
    }

    /// Whether any is given.
    fn any(&self) -> bool {
        !self.grids.is_empty()
            || self.format.is_some()
            || self.quality != QualityArgs::default()
            || self.clusters != ClusterArgs::default()
            || self.range.is_some()
            || self.masks.is_some()
            || self.nonfinite.is_some()
            || self.integers.is_some()
            || self.zstd.is_some()
            || self.fps.is_some()
    }
}

/// How much a pack is checked, as the command line has it.
#[derive(Args)]
struct VerifyArg {
    /// How much of the finished pack is checked [default: all, for watch: voxels]
    #[arg(long, value_name = "LEVEL")]
    verify: Option<VerifyLevel>,
    #[command(flatten)]
    pictures: PictureArgs,
}

/// How pictures are compared, as the command line has it.
#[derive(Args)]
struct PictureArgs {
    /// Write source, pack and difference side by side into this folder
    #[arg(long, value_name = "DIR")]
    images: Option<PathBuf>,
    /// The largest mean FLIP that passes [default: as the manifest says, else none: more than 0.04 is a warning]
    #[arg(long, value_name = "FLIP", value_parser = above_zero)]
    max_flip: Option<f64>,
    /// What traces the pack as an engine would
    #[arg(long, default_value = "auto")]
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
/// What the command failed with; its [`Error::exit_code`] is the process's.
pub fn run(cli: Cli) -> Result<()> {
    if let Some(threads) = cli.common.threads {
        rayon::ThreadPoolBuilder::new()
            .num_threads(threads.into())
            .build_global()
            .map_err(|e| Error::Usage(format!("--threads {threads}: {e}")))?;
    }
    if matches!(cli.command, Command::Build(_) | Command::Watch(_) | Command::Verify(_) | Command::Report(_))
    {
        crate::interrupt::catch();
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
