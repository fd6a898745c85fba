//! Progress bars on a terminal, plain lines otherwise.

use std::io::IsTerminal;
use std::time::Duration;

use indicatif::{ProgressBar, ProgressStyle};

use super::interrupt;
use super::style::WARNING;
use crate::cancel::CancelToken;
use crate::progress::Progress;

/// Shows how one asset's build is getting on, on standard error.
pub struct Reporter {
    asset: String,
    bar: Option<ProgressBar>,
    quiet: bool,
}

impl Reporter {
    pub fn new(asset: &str, quiet: bool) -> Self {
        let show_bar = !quiet && std::io::stderr().is_terminal();
        let bar = show_bar.then(|| {
            let style =
                ProgressStyle::with_template("{prefix} {msg:17} {bar:32} {human_pos}/{human_len} {elapsed}")
                    .expect("the template is valid");
            let bar = ProgressBar::new(0).with_style(style).with_prefix(asset.to_owned());
            bar.enable_steady_tick(Duration::from_millis(100));
            bar
        });
        Self { asset: asset.to_owned(), bar, quiet }
    }

    /// Takes the bar away.
    pub fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

impl Progress for Reporter {
    fn stage(&mut self, name: &'static str, steps: u64, unit: &'static str) {
        match &self.bar {
            Some(bar) => {
                bar.set_position(0);
                bar.set_length(steps);
                bar.set_message(format!("{name}, {unit}"));
            }
            None if !self.quiet => {
                let unit = if steps == 1 { unit.trim_end_matches('s') } else { unit };
                anstream::eprintln!("{}: {name}, {steps} {unit}", self.asset);
            }
            None => {}
        }
    }

    fn advance(&mut self, steps: u64) {
        if let Some(bar) = &self.bar {
            bar.inc(steps);
        }
    }

    fn cancel_token(&self) -> CancelToken {
        interrupt::TOKEN.clone()
    }

    fn warn(&mut self, warning: &str) {
        let line = format!("{WARNING}warning{WARNING:#}: {}: {warning}", self.asset);
        match &self.bar {
            Some(bar) => bar.suspend(|| anstream::eprintln!("{line}")),
            None if !self.quiet => anstream::eprintln!("{line}"),
            None => {}
        }
    }
}
