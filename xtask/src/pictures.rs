//! Measures the visual quality of each format: compares pictures of pack and source.

use std::error::Error;
use std::path::PathBuf;

use serde_json::json;
use volpack::cancel::CancelToken;
use volpack::pack::Pack;
use volpack::pipeline::{Job, Silent, VerifyLevel, build};
use volpack::render::Device;
use volpack::settings::{Format, Settings};
use volpack::verify::{PictureSettings, Sources, pictures};

use crate::{peer_programs, sequence};

#[derive(clap::Args)]
pub struct Args {
    /// Sequences, each a file or a glob
    #[arg(required = true)]
    sequences: Vec<PathBuf>,
    /// Also write the raw figures to this JSON file
    #[arg(long)]
    json: Option<PathBuf>,
    /// Device that renders the pack
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
            let report =
                pictures(&pack, &Sources::find(&pack, &frames)?, &settings, &CancelToken::default())?;
            let worst = report.pictures.iter().max_by(|a, b| a.source.flip.total_cmp(&b.source.flip));
            let worst = worst.ok_or("no pictures")?.source;
            let psnr = worst.psnr.map_or("same".to_owned(), |db| format!("{db:.1} dB"));
            println!("| {name} | {} | {:.4} | {psnr} | {:.5} |", format.name(), worst.flip, worst.rmse);
            rows.push(json!({ "volume": name, "format": format, "flip": worst.flip, "psnr": worst.psnr, "rmse": worst.rmse }));
        }
    }
    peer_programs::write(args.json.as_deref(), &json!(rows))
}
