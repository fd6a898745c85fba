//! A volume to measure: its exact values, its camera, and today's packs of it.

use std::error::Error;
use std::path::{Path, PathBuf};

use tempfile::TempDir;
use volpack::codec::{SequenceRange, TexelCodec};
use volpack::pack::Pack;
use volpack::pipeline::{Job, Silent, VerifyLevel, build};
use volpack::volume::CoordBox;

use super::bricks::{Choices, Coding};
use super::quality::{self, Field};
use super::view::View;
use super::voxels::Voxels;

pub struct Source {
    pub name: String,
    pub path: PathBuf,
    /// The grid's name.
    pub grid: String,
    pub level_set: bool,
    /// Its exact values: those of a pack in f32.
    pub voxels: Voxels,
    /// What errors are fractions of.
    pub peak: f64,
    /// The box of its active voxels.
    pub active: CoordBox,
    pub view: View,
    /// What ranges of bricks are fractions of.
    pub sequence: SequenceRange,
    /// The codecs of today's adaptive pack.
    pub choices: Choices,
    folder: TempDir,
}

impl Source {
    /// Reads a volume.
    pub fn open(path: &Path, size: [u32; 2]) -> Result<Self, Box<dyn Error>> {
        let folder = tempfile::tempdir()?;
        let exact = pack_of(path, Coding::Uniform(TexelCodec::F32), folder.path())?;
        let grid = &exact.grids()[0];
        let voxels = Voxels::of(&exact)?;
        let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        if voxels.bounds.is_empty() {
            return Err(format!("{name}: the grid {} is empty", grid.name).into());
        }
        let (min, max) = voxels.range();
        Ok(Self {
            name,
            path: path.to_owned(),
            grid: grid.name.clone(),
            level_set: grid.is_level_set(),
            peak: grid.peak(),
            active: CoordBox::from_array(grid.frames[0].record.bbox),
            view: View::new(grid, voxels.bounds, size)?,
            sequence: SequenceRange::around(min, max).ok_or("the range of values is wider than an f32")?,
            choices: Choices::of(&pack_of(path, Coding::Adaptive, folder.path())?, &voxels),
            voxels,
            folder,
        })
    }

    /// Today's pack with a coding.
    pub fn pack(&self, coding: Coding) -> Result<Pack, Box<dyn Error>> {
        pack_of(&self.path, coding, self.folder.path())
    }

    /// The PSNR of a field against the exact one, in the box of active voxels.
    pub fn psnr(&self, field: Field) -> f64 {
        quality::psnr(field, &|p| self.voxels.at(p), self.active, self.peak)
    }
}

fn pack_of(path: &Path, coding: Coding, folder: &Path) -> Result<Pack, Box<dyn Error>> {
    let output = folder.join("today.volpack");
    let job = Job::new(vec![path.to_owned()], output.clone(), coding.settings(), VerifyLevel::None);
    build(&job, &mut Silent)?;
    // Read whole: the next build replaces the file.
    Ok(Pack::from_bytes(std::fs::read(&output)?)?)
}
