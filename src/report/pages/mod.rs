//! A report as HTML, Markdown and JUnit XML.

mod html;
mod junit;
mod markdown;

pub use html::{PageError, html};
pub use junit::junit;
pub use markdown::markdown;

use super::Report;
use super::model::Breach;

impl Report {
    /// The budgets that an asset exceeds; `None` for those of all assets together.
    fn breaches_of(&self, asset: Option<&str>) -> impl Iterator<Item = &Breach> {
        self.breaches.iter().filter(move |breach| breach.asset.as_deref() == asset)
    }
}
