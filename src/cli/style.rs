//! Colours. `anstream` drops them where there is no terminal or `NO_COLOR` is set.

use anstyle::{AnsiColor, Style};

pub const ERROR: Style = AnsiColor::Red.on_default().bold();
pub const WARNING: Style = AnsiColor::Yellow.on_default().bold();
pub const GOOD: Style = AnsiColor::Green.on_default();
pub const TITLE: Style = Style::new().bold();
