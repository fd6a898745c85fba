//! volpack turns OpenVDB volumes and animation sequences into game-ready volume packs, and proves each
//! pack against its source.
//!
//! Data walks one way, down eight [`stages`]:
//!
//! ```text
//! .vdb files ─ metadata ─ select ─ flatten ─ dedup ─ allocate ─ relayout ─ quantise ─ serialise ─ .volpack
//!                                                                                                   │
//! .vdb files ──────────────────────────────────────────────────────────────────────────────────── verify
//! ```
//!
//! - [`vdb`] reads OpenVDB files.
//! - [`volume`] has the types that flow: coordinates, masks, bricks, frames.
//! - [`component`] says which grid of a file a grid of a pack is, and [`digest`] tells files apart.
//! - [`codec`] knows how one brick becomes texels and what a GPU reads from them.
//! - [`pack`] is the file format: writer, reader, checks, decoder.
//! - [`pipeline`] strings the stages together, [`manifest`] says with what [`settings`].
//! - [`cache`] keeps what stages made, so that the second build is instant.
//! - [`verify`] compares a finished pack with its source, [`report`] puts files into figures and pages.
//! - [`render`] traces pictures of packs and sources, on the CPU and through wgpu.
//! - [`sweep`] measures many settings side by side, and how steady each is.
//! - [`cli`] is the command line; [`progress`] and [`cancel`] are how long work and its caller speak.
//!
//! To build a pack, and to read a voxel of it:
//!
//! ```
//! use volpack::pack::Pack;
//! use volpack::pipeline::{Job, Silent, VerifyLevel, build};
//! use volpack::settings::{Format, Settings};
//! use volpack::volume::Coord;
//!
//! let folder = tempfile::tempdir()?;
//! let path = folder.path().join("fog.volpack");
//! let settings = Settings { encoding: Format::BC7.into(), ..Settings::default() };
//! let job = Job::new(vec!["fixtures/fog_half_blosc.vdb".into()], path.clone(), settings, VerifyLevel::Voxels);
//! let outcome = build(&job, &mut Silent)?;
//! assert!(outcome.verification.is_some_and(|report| report.ok));
//!
//! let pack = Pack::open(&path)?;
//! let (region, _side) = pack.frame(0, 0)?.locate(Coord::new(0, 0, 0));
//! println!("{}: {region:?}", pack.grids()[0].name);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Features
//!
//! All are on by default. The code above needs none of them.
//!
//! - `cli`: the command line, and the binary. It turns on `report`.
//! - `gpu`: the wgpu tracer. Without it the CPU renders all pictures, as on a machine without a Vulkan device.
//! - `remote`: caches in a bucket of S3, Google Cloud Storage or Azure.
//! - `report`: reports as HTML, Markdown and JUnit XML, charts, and [`sweep`].

pub mod atomic_file;
pub mod cache;
pub mod cancel;
#[cfg(feature = "cli")]
pub mod cli;
pub mod codec;
pub mod component;
pub mod digest;
pub mod error;
mod file_name;
pub mod file_stamp;
pub mod manifest;
pub mod pack;
pub mod pipeline;
mod pods;
pub mod profile;
pub mod progress;
pub mod render;
pub mod report;
pub mod sequence;
pub mod settings;
pub mod stages;
#[cfg(feature = "report")]
pub mod sweep;
pub mod units;
pub mod vdb;
pub mod verify;
pub mod volume;
