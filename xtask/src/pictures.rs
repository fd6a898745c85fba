//! What each format costs the eye: pictures of pack and source, by the CPU tracer.

use std::error::Error;
use std::path::PathBuf;

use serde_json::json;
use volpack::pack::Pack;
use volpack::pipeline::{Job, Silent, VerifyLevel, build};
use volpack::render::Device;
use volpack::settings::{Format, Settings};
use volpack::verify::{PictureSettings, Sources, pictures};

use crate::{peers, sequence};

#[derive(clap::Args)]
pub struct Args {
    /// Sequences: a file or a glob each
    #[arg(required = true)]
    sequences: Vec<PathBuf>,
    /// Write the raw figures here too
    #[arg(long)]
    json: Option<PathBuf>,
    /// What traces the pack
    #[arg(long, default_value = "cpu")]
    device: Device,
}

/// Builds every format of each sequence and prints its worst picture.
pub fn bench(args: &Args) -> Result<(), Box<dyn Error>> {
    let folder = tempfile::tempdir()?;
    let mut rows = Vec::new();
    println!("| volume | format | FLIP | PSNR of the picture | RMSE of the picture |");
    println!("|---|---|---|---|---|");
    for sequence in &args.sequences {
        let (name, frames) = sequence::named(sequence)?;
        for format in Format::ALL {
            let job = Job::new(
                frames.clone(),
                folder.path().join("bench.volpack"),
                Settings { encoding: format.into(), ..Settings::default() },
                VerifyLevel::None,
            );
            build(&job, &mut Silent)?;
            let pack = Pack::open(&job.output)?;
            let settings = PictureSettings { device: args.device, ..PictureSettings::default() };
            let report = pictures(&pack, &Sources::find(&pack, &frames)?, &settings)?;
            let worst = report.pictures.iter().max_by(|a, b| a.source.flip.total_cmp(&b.source.flip));
            let worst = worst.ok_or("no pictures")?.source;
            let psnr = worst.psnr.map_or("same".to_owned(), |db| format!("{db:.1} dB"));
            println!("| {name} | {} | {:.4} | {psnr} | {:.5} |", format.name(), worst.flip, worst.rmse);
            rows.push(json!({ "volume": name, "format": format, "flip": worst.flip, "psnr": worst.psnr, "rmse": worst.rmse }));
        }
    }
    peers::write(args.json.as_deref(), &json!(rows))
}
