//! Where a pack comes from: one JSON section, for people and for verification.

use serde::de::IgnoredAny;
use serde::{Deserialize, Serialize};

use super::layout::FrameRecord;
use super::{Pack, PackError};
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

/// Why a pack's provenance cannot be used. Its voxels can be read all the same.
#[derive(Debug, thiserror::Error)]
pub enum ProvenanceError {
    /// Its bytes are damaged.
    #[error(transparent)]
    Damaged(#[from] PackError),
    /// Its bytes are not the JSON that volpack writes.
    #[error("the pack's provenance is unreadable ({0}): its voxels can be read, but not verified")]
    Malformed(String),
    /// A setting of another version of volpack, which may change what verification has to check.
    #[error(
        "the pack was built by {tool} {version} with {setting}, which this volpack does not know: \
         verify it with that version"
    )]
    UnknownSetting {
        /// What built the pack.
        tool: String,
        /// Its version.
        version: String,
        /// The setting.
        setting: String,
    },
    /// A frame of the pack is of a source that is not listed.
    #[error("frame {frame} names source {place} of the pack's provenance, which lists {sources}")]
    NoSource {
        /// The frame's number.
        frame: i32,
        /// The place that its entry in the frame table names, from 0 on.
        place: u32,
        /// How many sources the provenance lists.
        sources: usize,
    },
}

impl ProvenanceError {
    /// Whether the pack is sound, but of a volpack that this one does not know.
    pub fn is_unsupported(&self) -> bool {
        matches!(self, Self::UnknownSetting { .. })
    }
}

/// What every version of volpack writes, whatever its settings are.
#[derive(Deserialize)]
#[allow(dead_code)] // Read to see that it is there.
struct AnyProvenance {
    tool: String,
    version: String,
    settings: IgnoredAny,
    sources: Vec<Source>,
}

impl Provenance {
    /// The section's bytes.
    ///
    /// # Errors
    /// When a number in the settings is not one that JSON has.
    pub fn to_json(&self) -> std::io::Result<Vec<u8>> {
        Ok(serde_json::to_vec_pretty(self)?)
    }

    /// What a pack says of itself.
    ///
    /// # Errors
    /// [`ProvenanceError::Damaged`], and those of [`Provenance::from_json`].
    pub fn of(pack: &Pack) -> Result<Self, ProvenanceError> {
        Self::from_json(&pack.provenance_json()?)
    }

    /// Reads the section's bytes. Settings that are missing have their defaults: an older volpack promised nothing of
    /// them. Fields outside the settings that this volpack does not know are ignored.
    ///
    /// # Errors
    /// [`ProvenanceError::UnknownSetting`] and [`ProvenanceError::Malformed`].
    pub fn from_json(json: &[u8]) -> Result<Self, ProvenanceError> {
        serde_json::from_slice(json).map_err(|error| match serde_json::from_slice::<AnyProvenance>(json) {
            Ok(AnyProvenance { tool, version, .. }) => {
                ProvenanceError::UnknownSetting { tool, version, setting: unknown_setting(&error) }
            }
            Err(error) => ProvenanceError::Malformed(error.to_string()),
        })
    }

    /// Whether a pack that says `read` of itself is the one that this would be written into. Numbers come back from
    /// JSON as near as its reader gets them.
    pub fn is(&self, read: &Self) -> bool {
        let again = self.to_json().ok().and_then(|json| Self::from_json(&json).ok());
        again.as_ref() == Some(read)
    }

    /// The source of a frame of the same pack.
    ///
    /// # Errors
    /// [`ProvenanceError::NoSource`].
    pub fn source(&self, frame: &FrameRecord) -> Result<&Source, ProvenanceError> {
        self.sources.get(frame.source as usize).ok_or(ProvenanceError::NoSource {
            frame: frame.number,
            place: frame.source,
            sources: self.sources.len(),
        })
    }
}

/// Names what serde found in the settings and did not expect.
fn unknown_setting(error: &serde_json::Error) -> String {
    let message = error.to_string();
    // serde puts the unknown name in backticks, then lists the known ones.
    match (message.split_once(" `"), message.split('`').nth(1)) {
        (Some(("unknown field", _)), Some(name)) => format!("the setting `{}`", name.escape_debug()),
        (Some(("unknown variant", _)), Some(value)) => {
            format!("the value `{}` of a setting", value.escape_debug())
        }
        _ => format!("a setting in another form ({})", message.escape_debug()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::settings::{DEFAULT_ZSTD, Encoding, Quality, TexelCodec};

    fn provenance() -> Provenance {
        Provenance {
            tool: "volpack".to_owned(),
            version: "0.3.0".to_owned(),
            encoder_isa: None,
            settings: Settings { zstd: 0, encoding: Quality::Psnr(45.0).into(), ..Settings::default() },
            sources: Vec::new(),
        }
    }

    /// The JSON of [`provenance`] with one piece of text in place of another.
    fn read(from: &str, to: &str) -> Result<Provenance, ProvenanceError> {
        let json = String::from_utf8(provenance().to_json().unwrap()).unwrap();
        assert!(json.contains(from), "{json}");
        Provenance::from_json(json.replacen(from, to, 1).as_bytes())
    }

    #[test]
    fn missing_settings_have_their_defaults_and_unknown_fields_elsewhere_are_ignored() {
        assert_eq!(read("", "").unwrap(), provenance());
        let without_zstd =
            Provenance { settings: Settings { zstd: DEFAULT_ZSTD, ..provenance().settings }, ..provenance() };
        assert_eq!(read("\"zstd\": 0,", "").unwrap(), without_zstd);
        let clustered = Encoding::Uniform { codec: TexelCodec::BC7, clustering: Some(Default::default()) };
        let provenance_of_bc7 = Provenance {
            settings: Settings { encoding: clustered, ..provenance().settings },
            ..provenance()
        };
        let json = String::from_utf8(provenance_of_bc7.to_json().unwrap()).unwrap();
        let (start, end) =
            (json.find("{\n      \"clusters\"").unwrap(), json.find(",\n    \"range\"").unwrap());
        let short = [&json[..start], "{}", &json[end..]].concat();
        assert_eq!(Provenance::from_json(short.as_bytes()).unwrap(), provenance_of_bc7);
        assert_eq!(read("\"tool\"", "\"comment\": [1, {}], \"tool\"").unwrap(), provenance());
    }

    #[test]
    fn unknown_settings_are_refused_by_name() {
        for (from, to, name) in [
            ("\"zstd\": 0", "\"filter\": \"box\", \"zstd\": 0", "the setting `filter`"),
            ("\"clustering\": null", "\"clustering\": {\"metric\": 1}", "the setting `metric`"),
            ("\"adaptive\"", "\"bc6h\"", "the value `bc6h` of a setting"),
            ("{\n      \"psnr\"", "{\"ssim\"", "the value `ssim` of a setting"),
            ("\"zstd\": 0", "\"zstd\": \"fast\"", "a setting in another form (invalid type"),
            (
                "\"clustering\": null",
                "\"clustering\": {}",
                "a setting in another form (clustering with the adaptive format",
            ),
        ] {
            let error = read(from, to).unwrap_err();
            let says = error.to_string();
            assert!(says.starts_with(&format!("the pack was built by volpack 0.3.0 with {name}")), "{says}");
            assert!(error.is_unsupported() && says.ends_with("verify it with that version"), "{says}");
        }
        for (from, to) in [
            ("{", ""),
            ("\"tool\"", "\"tooth\""),
            ("\"settings\"", "\"set\""),
            ("\"sources\": []", "\"sources\": [1]"),
        ] {
            let error = read(from, to).unwrap_err();
            assert!(matches!(error, ProvenanceError::Malformed(_)) && !error.is_unsupported(), "{error}");
        }
    }
}
