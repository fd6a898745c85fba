//! Whole packs and reports that were made before.

use std::path::Path;

use super::{Job, Made, VerifyLevel};
use crate::cache::{Blob, Cache, Key, Namespace};
use crate::cancel::CancelToken;
use crate::codec::TexelCodec;
use crate::digest::digest;
use crate::error::{Error, Result};
use crate::file_stamp::Stamp;
use crate::pack::{FinishedPack, Pack, PackError, Provenance, RepackError, repack};
use crate::render::Device;
use crate::render::gpu::Gpu;
use crate::settings::Settings;
use crate::stages::metadata::{Digests, KnownDigests};
use crate::verify::VerifyReport;

const PACK: Namespace = Namespace { name: "pack", version: 1, travels: true };
/// A pack whose level of zstd is not what was asked for, but all else is.
const ANY_LEVEL: Namespace = Namespace { name: "pack-any-zstd", version: 1, travels: true };
const VERIFY: Namespace = Namespace { name: "verify", version: 5, travels: true };
/// A verification whose pictures were traced by the CPU alone, since no device could.
const VERIFY_ON_CPU: Namespace = Namespace { name: "verify-on-cpu", version: 3, travels: true };

impl KnownDigests for Cache {
    fn remembered(&self, path: &Path, stamp: &Stamp) -> Option<blake3::Hash> {
        self.remembered(path, stamp)
    }

    fn remember(&self, path: &Path, stamp: &Stamp, digest: &blake3::Hash) {
        self.remember(path, stamp, digest);
    }
}

/// What the cache may have for a job.
pub(super) struct Reuse<'a> {
    cache: &'a Cache,
    exact: Key,
    any_level: Key,
    /// The pack, once it is known.
    pack: Option<Blob>,
}

/// What packs that differ in their level of zstd have in common.
fn any_level(provenance: &Provenance) -> Provenance {
    let settings = Settings { zstd: 0, ..provenance.settings.clone() };
    Provenance { settings, ..provenance.clone() }
}

/// What it had.
pub(super) enum Reused {
    Nothing,
    /// The output is the pack already.
    Unchanged,
    /// The pack, beside its place.
    Pack(Made, FinishedPack),
}

impl<'a> Reuse<'a> {
    /// A pack's bytes depend on its provenance, and on the codecs that an adaptive build can choose from.
    pub fn new(cache: &'a Cache, provenance: &Provenance) -> Self {
        let key = |stage, provenance: &Provenance| {
            let codecs = TexelCodec::ALL.map(TexelCodec::name);
            Key::new(stage, &(provenance.to_json().expect("settings are finite numbers"), codecs))
        };
        Self {
            cache,
            exact: key(&PACK, provenance),
            any_level: key(&ANY_LEVEL, &any_level(provenance)),
            pack: None,
        }
    }

    /// The pack, if it is there already, in the cache, or there at another level of zstd.
    pub fn find(&mut self, job: &Job, provenance: &Provenance, cancel: &CancelToken) -> Result<Reused> {
        self.pack = self.cache.blob(&self.exact);
        let found = match self.pack {
            Some(blob) if self.is_at(&job.output, &blob, job.paranoid) => Reused::Unchanged,
            Some(blob) => self.copy(job, &blob)?.map_or(Reused::Nothing, |p| Reused::Pack(Made::Copied, p)),
            None => Reused::Nothing,
        };
        let found = match found {
            Reused::Nothing => self.repack(job, provenance, cancel)?,
            found => found,
        };
        self.cache.count(&self.exact, !matches!(found, Reused::Nothing));
        Ok(found)
    }

    /// Whether the cache has the pack, or it at another level of zstd, and whether the output is the pack.
    pub fn look(&mut self, job: &Job) -> (bool, bool, bool) {
        self.pack = self.cache.blob(&self.exact);
        let is_there = self.pack.is_some_and(|blob| self.is_at(&job.output, &blob, job.paranoid));
        (self.cache.has(&self.exact), self.cache.has(&self.any_level), is_there)
    }

    /// Whether the cache has the verification as the job asks for it.
    pub fn is_verified(&self, job: &Job) -> bool {
        self.verify_keys(job).any(|key| self.cache.has(&key))
    }

    /// Whether a file has a blob's bytes.
    fn is_at(&self, path: &Path, blob: &Blob, paranoid: bool) -> bool {
        let Ok(stamp) = Stamp::of(path) else { return false };
        if stamp.bytes() != blob.bytes {
            return false;
        }
        let digests = Digests { known: Some(self.cache), paranoid };
        digests.of(path, &stamp, stamp.is_settled()).is_ok_and(|digest| digest == blob.digest)
    }

    fn copy(&self, job: &Job, blob: &Blob) -> Result<Option<FinishedPack>> {
        FinishedPack::filled(&job.output, |file| self.cache.get_file(blob, file))
            .map_err(Error::io(&job.output))
    }

    fn repack(&self, job: &Job, provenance: &Provenance, cancel: &CancelToken) -> Result<Reused> {
        let Some(blob) = self.cache.blob(&self.any_level) else { return Ok(Reused::Nothing) };
        let Some(copy) = self.copy(job, &blob)? else { return Ok(Reused::Nothing) };
        let level = (job.settings.zstd != 0).then_some(job.settings.zstd);
        // Its digest was right; whether it is the pack that its key says is another matter.
        let pack = Pack::open(copy.path()).ok();
        let is_wanted = |found: &Provenance| any_level(provenance).is(&any_level(found));
        let pack = pack.filter(|pack| Provenance::of(pack).is_ok_and(|found| is_wanted(&found)));
        let pack = pack.map(|pack| repack(&pack, &job.output, provenance, level, cancel)).transpose();
        match pack {
            Ok(Some(pack)) => Ok(Reused::Pack(Made::Repacked, pack)),
            Err(RepackError::Pack(PackError::Io(e))) => Err(Error::io(&job.output)(e)),
            Err(RepackError::Cancelled(e)) => Err(e.into()),
            Ok(None) | Err(RepackError::Pack(_)) => Ok(Reused::Nothing),
        }
    }

    /// Keeps a pack that was made.
    pub fn keep(&mut self, path: &Path) -> Result<()> {
        let (digest, bytes) = digest(path)?;
        let blob = Blob { digest: digest.into(), bytes };
        self.pack = Some(blob);
        self.cache.put_file(&self.exact, path, blob).map_err(Error::io(path))?;
        self.cache.put_alias(&self.any_level, blob);
        Ok(())
    }

    /// What verification as the job asks for it found in the same pack.
    pub fn verification(&self, job: &Job) -> Option<Option<VerifyReport>> {
        let mut keys = self.verify_keys(job).peekable();
        let first = *keys.peek()?;
        let found = keys.find_map(|key| self.cache.peek(&key));
        self.cache.count(&first, found.is_some());
        found
    }

    /// Keeps what verification found. Failures are found again.
    pub fn keep_verification(&self, job: &Job, report: Option<&VerifyReport>) {
        if report.is_some_and(|report| !report.ok) {
            return;
        }
        let pictures = report.and_then(|report| report.pictures.as_ref());
        let is_on_cpu = pictures.is_some_and(|pictures| pictures.skipped.is_some());
        if let Some(key) = self.verify_keys(job).nth(usize::from(is_on_cpu)) {
            self.cache.put(&key, &report);
        }
    }

    /// The keys under which the verification of a pack may be: as it was asked for, and without a device where that was
    /// left out. The latter holds as long as the device, or that there is none, is the same: which takes a look at it, and
    /// is worked out when the former is not there. A pack names its sources by their digests, so its own stands for them
    /// too. None where files are to be written, or nothing to be found.
    fn verify_keys(&self, job: &Job) -> impl Iterator<Item = Key> {
        let asked = (job.verify != VerifyLevel::None && job.pictures.images.is_none()).then_some(self.pack);
        let asked =
            asked.flatten().map(|blob| (blob.digest, job.verify, job.pictures.max_flip, job.pictures.device));
        let may_lack_device = job.verify == VerifyLevel::All && job.pictures.device == Device::Auto;
        let on_cpu = asked.filter(|_| may_lack_device).into_iter();
        let on_cpu = on_cpu.map(|asked| Key::new(&VERIFY_ON_CPU, &(asked, Gpu::identity())));
        asked.map(|asked| Key::new(&VERIFY, &asked)).into_iter().chain(on_cpu)
    }
}
