//! `volpack cache`, and what other commands say of it.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use clap::{Args, Subcommand};
use serde_json::json;

use super::progress::Reporter;
use super::style::{GOOD, TITLE, WARNING};
use super::{Common, interrupt, outln, print_json};
use crate::cache::remote::{Policy, Remote};
use crate::cache::{Cache, Fault, Removed, Verified};
use crate::error::{Error, Result};
use crate::progress::Progress;
use crate::settings::ByteSize;
use crate::units::{bytes, count};

/// Where what builds make is kept.
#[derive(Args, Clone)]
pub struct CacheArgs {
    /// Cache folder [default: the platform's cache folder]
    #[arg(
        long = "cache",
        value_name = "DIR",
        env = "VOLPACK_CACHE",
        hide_env_values = true,
        global = true,
        help_heading = "Cache"
    )]
    folder: Option<PathBuf>,
}

/// A cache behind it that machines share.
#[derive(Args, Clone)]
pub struct RemoteArgs {
    /// Remote cache that machines share: s3://bucket/prefix, gs://bucket/prefix or az://container/prefix; credentials come
    /// from AWS_*, GOOGLE_* or AZURE_* in the environment
    #[arg(
        long = "remote-cache",
        value_name = "URL",
        env = "VOLPACK_REMOTE_CACHE",
        hide_env_values = true,
        help_heading = "Cache"
    )]
    url: Option<String>,
    /// Whether to upload to the remote cache too
    #[arg(
        long = "remote-policy",
        value_name = "POLICY",
        env = "VOLPACK_REMOTE_POLICY",
        default_value = "read-write",
        help_heading = "Cache"
    )]
    policy: Policy,
}

/// The same for commands that can do without.
#[derive(Args, Clone)]
pub struct CacheChoice {
    #[command(flatten)]
    place: CacheArgs,
    /// Rebuild everything and ignore the cache
    #[arg(long, help_heading = "Cache")]
    no_cache: bool,
    /// Hash every source, also those whose size, times and inode did not change
    #[arg(long, help_heading = "Cache")]
    pub paranoid: bool,
}

impl CacheArgs {
    fn folder(&self) -> Result<PathBuf> {
        self.folder.clone().or_else(Cache::default_folder).ok_or_else(|| {
            Error::Usage("this platform names no folder for caches: give one with --cache DIR".to_owned())
        })
    }
}

impl CacheChoice {
    /// The cache; `None` where none is wanted, or none can be had: that is a warning, and a slower build.
    pub fn open(&self) -> Option<Arc<Cache>> {
        self.open_store().map(Arc::new)
    }

    /// The same, with a remote if there is to be one.
    pub fn open_with(&self, remote: &RemoteArgs) -> Option<Arc<Cache>> {
        let cache = self.open_store()?;
        let opened = remote.url.as_deref().map(|url| Remote::open(url, remote.policy)).transpose();
        let remote = opened.unwrap_or_else(|error| {
            warn(&format!("going on without a remote cache: {error}"));
            None
        });
        Some(Arc::new(match remote {
            Some(remote) => cache.with_remote(remote),
            None => cache,
        }))
    }

    fn open_store(&self) -> Option<Cache> {
        if self.no_cache {
            return None;
        }
        let opened = self.place.folder().and_then(|f| Cache::open(&f).map_err(Error::io(f)));
        opened.inspect_err(|error| warn(&format!("going on without a cache: {error}"))).ok()
    }
}

fn warn(warning: &str) {
    anstream::eprintln!("{WARNING}warning{WARNING:#}: {warning}");
}

/// Waits for what is on its way to a remote, unless the user has enough.
pub fn finish(cache: &Cache, quiet: bool) -> Result<()> {
    let mut reporter = Reporter::new("cache", quiet);
    let all = cache.waiting();
    if all > 0 {
        reporter.stage("upload", all, "entries");
    }
    let mut sent = 0;
    let warnings = cache.finish(|left| {
        let now = all.saturating_sub(left);
        reporter.advance(now.saturating_sub(sent));
        sent = now.max(sent);
        !interrupt::TOKEN.is_cancelled()
    });
    warnings.iter().for_each(|warning| reporter.warn(warning));
    reporter.finish();
    Ok(interrupt::TOKEN.check()?)
}

#[derive(Args)]
pub struct Arguments {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    place: CacheArgs,
    /// Print JSON
    #[arg(long, global = true)]
    json: bool,
}

#[derive(Subcommand)]
enum Command {
    /// Show what is in the cache
    Stats,
    /// Remove least recently used entries
    Gc {
        /// Size to shrink the cache to: 20GB, 512MiB
        #[arg(long, value_name = "SIZE", required_unless_present = "max_age")]
        max_size: Option<ByteSize>,
        /// Age from which unused entries are removed: 30d, 12h
        #[arg(long, value_name = "AGE", value_parser = age)]
        max_age: Option<Duration>,
    },
    /// Check every entry and remove damaged ones
    Verify,
    /// Remove all entries
    Clear,
}

/// `90m`, `12h`, `30d`.
fn age(text: &str) -> std::result::Result<Duration, String> {
    let syntax = || "an age is a number of minutes, hours or days: 90m, 12h, 30d".to_owned();
    let text = text.trim();
    let unit = text.chars().next_back().ok_or_else(syntax)?;
    let seconds: u64 = match unit {
        'm' => 60,
        'h' => 3600,
        'd' => 24 * 3600,
        _ => return Err(syntax()),
    };
    let number: u64 = text[..text.len() - 1].trim().parse().map_err(|_| syntax())?;
    number.checked_mul(seconds).map(Duration::from_secs).ok_or_else(syntax)
}

pub fn run(args: &Arguments, common: Common) -> Result<()> {
    let folder = args.place.folder()?;
    let cache = Cache::open(&folder).map_err(Error::io(&folder))?;
    let failed = || Error::io(&folder);
    let say = |json: serde_json::Value, text: String| {
        if args.json {
            print_json(&json);
        } else if !common.quiet {
            outln!("{TITLE}{}{TITLE:#}: {text}", folder.display());
        }
    };
    match &args.command {
        Command::Stats => {
            let stats = cache.stats().map_err(failed())?;
            let mut text = format!("{} in {} files", bytes(stats.bytes), count(stats.entries));
            for (stage, of) in &stats.stages {
                text += &format!("\n  {stage:14} {:>10} results {:>12}", count(of.results), bytes(of.bytes));
            }
            text += &format!("\n  {:14} {:>10} files", "sources known", count(stats.sources));
            say(json!({ "folder": folder, "stats": stats }), text);
        }
        Command::Gc { max_size, max_age } => {
            let removed = cache.collect(max_size.map(|s| s.0), *max_age).map_err(failed())?;
            say(json!(removed), in_words(&removed));
            none_left(&folder, &removed)?;
        }
        Command::Clear => {
            let removed = cache.clear().map_err(failed())?;
            say(json!(removed), in_words(&removed));
            none_left(&folder, &removed)?;
        }
        Command::Verify => {
            let verified = cache.verify().map_err(failed())?;
            if verified.is_sound() {
                say(json!({ "ok": true }), format!("{GOOD}ok{GOOD:#}"));
                return Ok(());
            }
            let Verified { removed, left } = verified;
            if args.json {
                print_json(&json!({ "ok": false, "removed": removed, "left": left }));
            }
            let mut message = String::new();
            if !removed.is_empty() {
                message += &format!("{} damaged entries were removed:{}", removed.len(), lines(&removed));
            }
            if !left.is_empty() {
                let separator = if message.is_empty() { "" } else { "\n" };
                message += &format!(
                    "{separator}{} entries could not be verified or removed: {CLOSE}:{}",
                    left.len(),
                    lines(&left)
                );
            }
            let message = format!("{}: {message}", folder.display());
            return Err(if removed.is_empty() { Error::Other(message) } else { Error::Input(message) });
        }
    }
    Ok(())
}

/// What to do about entries that cannot be read or removed.
const CLOSE: &str = "close the programs that use the cache, or check the permissions, and try again";

fn in_words(removed: &Removed) -> String {
    format!("removed {} in {} files", bytes(removed.bytes), count(removed.files))
}

/// Ends a command that could not remove everything it should.
fn none_left(folder: &Path, Removed { left, .. }: &Removed) -> Result<()> {
    if left.is_empty() {
        return Ok(());
    }
    let message = format!("{} files could not be removed: {CLOSE}:{}", left.len(), lines(left));
    Err(Error::Other(format!("{}: {message}", folder.display())))
}

fn lines(faults: &[Fault]) -> String {
    faults.iter().map(|fault| format!("\n  {}: {}", fault.path.display(), fault.why)).collect()
}
