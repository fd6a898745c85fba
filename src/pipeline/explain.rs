//! What a build would do, and why.

use serde::Serialize;
use serde_json::Value as Json;

use super::reuse::Reuse;
use super::{Job, Plan, Silent, frames, plan};
use crate::error::Result;
use crate::pack::{Pack, Provenance, Source};

/// What a build would do.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Explanation {
    /// What is not as it was when the output was made.
    pub reasons: Vec<String>,
    /// The stages that would run; none where the output is what a build would make.
    pub stages: Vec<StagePlan>,
}

/// A stage that would run.
#[derive(Clone, Debug, Serialize)]
pub struct StagePlan {
    /// Its name.
    pub stage: &'static str,
    /// What it would work on.
    pub work: String,
}

/// Says what [`super::build`] would do, without a voxel being read.
///
/// # Errors
/// As [`super::build`] for sources that cannot be read or selected.
pub fn explain(job: &Job) -> Result<Explanation> {
    let (plan, _) = plan(job, &mut Silent)?;
    let mut out = Explanation { reasons: reasons(job, &plan.provenance), stages: Vec::new() };
    let mut say = |stage, work: String| out.stages.push(StagePlan { stage, work });
    let mut reuse = job.cache.as_deref().map(|cache| Reuse::new(cache, &plan.provenance));
    let (has_pack, has_other_level, is_there) = match &mut reuse {
        Some(reuse) => reuse.look(job),
        None => (false, false, false),
    };
    let is_verified = reuse.is_some_and(|reuse| reuse.is_verified(job));
    if is_there && is_verified {
        return Ok(out);
    }
    if !has_pack && !has_other_level {
        stages(job, &plan, &mut say);
    }
    match (is_there, has_pack, has_other_level) {
        (true, ..) => {}
        (_, true, _) => say("serialise", "copy from the cache".to_owned()),
        (.., true) => say("serialise", format!("repack from the cache at zstd level {}", job.settings.zstd)),
        _ => say("serialise", "all".to_owned()),
    }
    if !is_verified {
        say("verify", "voxels and pictures".to_owned());
        if is_there {
            out.reasons.push("not yet verified with this device".to_owned());
        }
    }
    Ok(out)
}

/// Stages 3 to 7.
fn stages(job: &Job, plan: &Plan, say: &mut impl FnMut(&'static str, String)) {
    let all = plan.sequence.frames.len();
    let unknown = frames::unknown(&plan.sequence, &plan.selection, &job.settings, job.cache.as_deref());
    if !unknown.is_empty() {
        say("flatten", format!("{} of {all} frames: {}", unknown.len(), listed(&unknown)));
    }
    say("dedup", format!("{all} frames"));
    say("allocate", "all bricks, with measurements from the cache".to_owned());
    if unknown.len() == all {
        say("quantise", "all bricks".to_owned());
    } else {
        say("quantise", "the bricks of those frames, and others that are not in the cache".to_owned());
    }
}

/// Frames that are named; more are counted.
const LISTED: usize = 5;

/// What differs between the output, if it is there, and what would be made.
fn reasons(job: &Job, new: &Provenance) -> Vec<String> {
    let old = match Pack::open(&job.output) {
        Ok(pack) => match Provenance::of(&pack) {
            Ok(provenance) => provenance,
            Err(e) => return vec![format!("{}: {e}", job.output.display())],
        },
        Err(_) if !job.output.exists() => return vec![format!("{} does not exist", job.output.display())],
        Err(e) => return vec![format!("{} cannot be used: {e}", job.output.display())],
    };
    let mut reasons = Vec::new();
    if old.version != new.version {
        reasons.push(format!("built by volpack {}, this is {}", old.version, new.version));
    }
    if old.encoder_isa.is_some() && new.encoder_isa.is_some() && old.encoder_isa != new.encoder_isa {
        reasons.push("encoded for another instruction set".to_owned());
    }
    let settings = |provenance: &Provenance| {
        let mut settings = serde_json::to_value(&provenance.settings).unwrap_or_default();
        settings["quality"] = provenance.settings.quality().to_string().into();
        settings
    };
    let text = |value: &Json| value.as_str().map_or_else(|| value.to_string(), str::to_owned);
    if let (Json::Object(old), Json::Object(new)) = (settings(&old), settings(new)) {
        for (key, new) in &new {
            let old = old.get(key).unwrap_or(&Json::Null);
            if old != new {
                reasons.push(match (old, new) {
                    (Json::Null, new) => format!("{key} set to {}", text(new)),
                    (old, Json::Null) => format!("{key} removed (was {})", text(old)),
                    (old, new) => format!("{key} changed from {} to {}", text(old), text(new)),
                });
            }
        }
    }
    let was = |file: &str| old.sources.iter().find(|source| source.file == file);
    let files = |sources: &[Source], which: &dyn Fn(&Source) -> bool| -> Vec<String> {
        sources.iter().filter(|source| which(source)).map(|source| source.file.clone()).collect()
    };
    let differs = |s: &Source| was(&s.file).is_some_and(|o| o.blake3 != s.blake3);
    let is_new = |s: &Source| was(&s.file).is_none();
    let is_gone = |s: &Source| !new.sources.iter().any(|n| n.file == s.file);
    for (files, what) in [
        (files(&new.sources, &differs), "changed"),
        (files(&new.sources, &is_new), "added"),
        (files(&old.sources, &is_gone), "removed"),
    ] {
        reasons.extend((!files.is_empty()).then(|| format!("{} {what}", listed(&files))));
    }
    reasons
}

/// Names files, and counts those past the first few.
fn listed(files: &[String]) -> String {
    let rest = files.len().saturating_sub(LISTED);
    let more = if rest > 0 { format!(" and {rest} more") } else { String::new() };
    format!("{}{more}", files[..files.len() - rest].join(", "))
}
