//! Settings as a pack's provenance has them: one flat object, whose fields and their order every pack and every key of
//! the cache depend on.

use serde::{Deserialize, Serialize};

use super::{Clustering, Encoding, Format, Integers, Masks, NonFinite, Quality, RangeMode, Settings};

/// [`Settings`] as JSON has them.
#[derive(Serialize, Deserialize)]
#[serde(default, deny_unknown_fields, rename = "Settings")]
pub(super) struct Document {
    grids: Vec<String>,
    format: Format,
    quality: Quality,
    min_frame_psnr: Option<f64>,
    clustering: Option<Clustering>,
    range: RangeMode,
    masks: Masks,
    nonfinite: NonFinite,
    #[serde(default = "before_integers_were_kept")]
    integers: Integers,
    zstd: i32,
    fps: Option<f32>,
}

/// What packs were made with before there was a choice.
fn before_integers_were_kept() -> Integers {
    Integers::Nearest
}

impl Default for Document {
    fn default() -> Self {
        Settings::default().into()
    }
}

impl From<Settings> for Document {
    fn from(settings: Settings) -> Self {
        Self {
            format: settings.format(),
            quality: settings.quality(),
            min_frame_psnr: settings.min_frame_psnr(),
            clustering: settings.clustering().copied(),
            grids: settings.grids,
            range: settings.range,
            masks: settings.masks,
            nonfinite: settings.nonfinite,
            integers: settings.integers,
            zstd: settings.zstd,
            fps: settings.fps,
        }
    }
}

impl TryFrom<Document> for Settings {
    type Error = &'static str;

    fn try_from(document: Document) -> Result<Self, Self::Error> {
        let Document { quality, min_frame_psnr, clustering, .. } = document;
        let encoding = match (document.format.codec(), min_frame_psnr, clustering) {
            (None, _, None) => Encoding::Adaptive { quality, min_frame_psnr },
            (None, _, Some(_)) => return Err("clustering with the adaptive format"),
            // Its quality was never asked for: it is the default of the version that built the pack, and is not used.
            (Some(codec), None, clustering) => Encoding::Uniform { codec, clustering },
            (Some(_), Some(_), _) => return Err("min_frame_psnr without the adaptive format"),
        };
        Ok(Self {
            grids: document.grids,
            encoding,
            range: document.range,
            masks: document.masks,
            nonfinite: document.nonfinite,
            integers: document.integers,
            zstd: document.zstd,
            fps: document.fps,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::settings::{ErrorBound, TexelCodec};

    /// As packs had it when [`Settings`] had these fields themselves.
    fn json(grids: &str, format: &str, quality: &str, floor: &str, clustering: &str, rest: &str) -> String {
        format!(
            r#"{{"grids":{grids},"format":"{format}","quality":{quality},"min_frame_psnr":{floor},"clustering":{clustering},{rest}}}"#
        )
    }

    const BY_CLASS: &str = r#"{"by_class":{"psnr":55.0,"level_set_error":"0.05 voxels"}}"#;
    const REST: &str =
        r#""range":"brick","masks":"auto","nonfinite":"refuse","integers":"keep","zstd":0,"fps":null"#;

    fn adaptive(quality: Quality, min_frame_psnr: Option<f64>) -> Settings {
        let encoding = Encoding::Adaptive { quality, min_frame_psnr };
        Settings { grids: vec!["density".to_owned()], encoding, zstd: 0, ..Settings::default() }
    }

    #[test]
    fn json_is_what_it_was() {
        let clustering = Some(Clustering { clusters: 4, iterations: 5, variance: 0.5, seed: 7 });
        let sequence = REST.replace("brick", "sequence");
        let (psnr, size) = (Quality::Psnr(45.0), Quality::Size(60_000));
        let max_error = Quality::MaxError(ErrorBound::of_range(0.01));
        let density = r#"["density"]"#;
        let none = "null";
        let clusters = r#"{"clusters":4,"iterations":5,"variance":0.5,"seed":7}"#;
        let other =
            r#""range":"brick","masks":"drop","nonfinite":"zero","integers":"split","zstd":19,"fps":24.0"#;
        for (settings, json) in [
            (Settings { zstd: 0, ..Settings::default() }, json("[]", "adaptive", BY_CLASS, none, none, REST)),
            (adaptive(psnr, Some(40.0)), json(density, "adaptive", r#"{"psnr":45.0}"#, "40.0", none, REST)),
            (
                adaptive(max_error, None),
                json(density, "adaptive", r#"{"max_error":"0.01"}"#, none, none, REST),
            ),
            (adaptive(size, None), json(density, "adaptive", r#"{"size":60000}"#, none, none, REST)),
            (
                adaptive(Quality::BitsPerVoxel(3.0), None),
                json(density, "adaptive", r#"{"bits_per_voxel":3.0}"#, none, none, REST),
            ),
            (
                Settings { range: RangeMode::Sequence, ..adaptive(psnr, None) },
                json(density, "adaptive", r#"{"psnr":45.0}"#, none, none, &sequence),
            ),
            (
                Settings {
                    encoding: Encoding::Uniform { codec: TexelCodec::BC7, clustering },
                    ..adaptive(psnr, None)
                },
                json(density, "bc7", BY_CLASS, none, clusters, REST),
            ),
            (
                Settings {
                    encoding: TexelCodec::UNORM8.into(),
                    range: RangeMode::Sequence,
                    ..adaptive(psnr, None)
                },
                json(density, "unorm8", BY_CLASS, none, none, &sequence),
            ),
            (
                Settings {
                    grids: Vec::new(),
                    encoding: TexelCodec::F32.into(),
                    range: RangeMode::Brick,
                    masks: Masks::Drop,
                    nonfinite: NonFinite::Zero,
                    integers: Integers::Split,
                    zstd: 19,
                    fps: Some(24.0),
                },
                json("[]", "f32", BY_CLASS, none, none, other),
            ),
        ] {
            assert_eq!(serde_json::to_string(&settings).unwrap(), json);
            assert_eq!(serde_json::from_str::<Settings>(&json).unwrap(), settings);
        }
    }

    #[test]
    fn settings_that_do_not_go_together_are_an_error() {
        let read = |json: &str| serde_json::from_str::<Settings>(json).map_err(|error| error.to_string());
        let clustered = read(r#"{"clustering":{}}"#).unwrap_err();
        assert!(clustered.starts_with("clustering with the adaptive format"), "{clustered}");
        let floor = read(r#"{"format":"bc4","min_frame_psnr":30.0}"#).unwrap_err();
        assert!(floor.starts_with("min_frame_psnr without the adaptive format"), "{floor}");
        // The default of an earlier version.
        let bc4 =
            Settings { encoding: TexelCodec::BC4.into(), integers: Integers::Nearest, ..Settings::default() };
        assert_eq!(read(r#"{"format":"bc4","quality":{"psnr":45.0}}"#), Ok(bc4));
    }
}
