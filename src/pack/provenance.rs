//! Where a pack comes from: one JSON section, for people and for `verify`.

use serde::{Deserialize, Serialize};

use crate::settings::Settings;

/// What made a pack, out of what. No paths and no times: the same input gives the same bytes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Provenance {
    /// `volpack`.
    pub tool: String,
    /// Its version.
    pub version: String,
    /// The instruction set of the block encoder, whose blocks depend on it; absent where no block
    /// format is used.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub encoder_isa: Option<String>,
    /// The settings that the bytes depend on.
    pub settings: Settings,
    /// The source files, in the order of their frames.
    pub sources: Vec<Source>,
}

impl Provenance {
    /// The section's bytes.
    ///
    /// # Errors
    /// When a number in the settings is not one that JSON has.
    pub fn to_json(&self) -> std::io::Result<Vec<u8>> {
        Ok(serde_json::to_vec_pretty(self)?)
    }

    /// Whether a pack that says `read` of itself is the one that this would be written into. Numbers come back from
    /// JSON as near as its reader gets them.
    pub fn is(&self, read: &Self) -> bool {
        let again = self.to_json().ok().and_then(|json| serde_json::from_slice::<Self>(&json).ok());
        again.as_ref() == Some(read)
    }
}

/// One source file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Source {
    /// Its name without its folder.
    pub file: String,
    /// Its frame number.
    pub frame: i32,
    /// Its length.
    pub bytes: u64,
    /// BLAKE3 of its bytes, in hexadecimal.
    pub blake3: String,
}
