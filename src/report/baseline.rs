//! An older report, to tell changes against.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Deserialize;

use super::model::{Figures, VERSION};
use crate::error::{Error, Result};

/// The figures of an older report.
pub struct Baseline {
    /// By the asset's name.
    assets: BTreeMap<String, Figures>,
}

impl Baseline {
    /// Reads the JSON of a report.
    ///
    /// # Errors
    /// When it cannot be read, is none, or is of another version.
    pub fn read(path: &Path) -> Result<Self> {
        #[derive(Deserialize)]
        struct Old {
            version: u32,
        }
        #[derive(Deserialize)]
        struct Assets {
            assets: Vec<Asset>,
        }
        #[derive(Deserialize)]
        struct Asset {
            name: String,
            pack: Option<Pack>,
        }
        #[derive(Deserialize)]
        struct Pack {
            figures: Figures,
        }
        let text = std::fs::read_to_string(path).map_err(Error::io(path))?;
        let wrong = |e: serde_json::Error| {
            Error::Input(format!("{}: not the JSON of a volpack report: {e}", path.display()))
        };
        let Old { version } = serde_json::from_str(&text).map_err(wrong)?;
        if version != VERSION {
            return Err(Error::Input(format!(
                "{}: a report of version {version}, not {VERSION}: make the baseline anew",
                path.display()
            )));
        }
        let Assets { assets } = serde_json::from_str(&text).map_err(wrong)?;
        let figures = assets.into_iter().filter_map(|asset| Some((asset.name, asset.pack?.figures)));
        Ok(Self { assets: figures.collect() })
    }

    /// What an asset was.
    pub fn figures(&self, asset: &str) -> Option<&Figures> {
        self.assets.get(asset)
    }
}
