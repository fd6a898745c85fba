//! What each thread is doing, for `build --profile`: spans that Chrome's and Perfetto's viewers draw.

use std::path::Path;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Mutex, OnceLock};
use std::time::Instant;

use serde_json::{Value as Json, json};

use crate::atomic_file::{self, FileError};

struct Recorder {
    start: Instant,
    spans: Mutex<Vec<Done>>,
}

struct Done {
    name: &'static str,
    thread: u32,
    start: f64,
    micros: f64,
}

static RECORDER: OnceLock<Recorder> = OnceLock::new();

/// Begins to record.
pub fn record() {
    RECORDER.get_or_init(|| Recorder { start: Instant::now(), spans: Mutex::default() });
}

/// A piece of work, which lasts until this is dropped.
pub struct Span(Option<(&'static Recorder, &'static str, Instant)>);

/// Begins a piece of work. Nothing but a look at a flag where nobody records.
pub fn span(name: &'static str) -> Span {
    Span(RECORDER.get().map(|recorder| (recorder, name, Instant::now())))
}

impl Drop for Span {
    fn drop(&mut self) {
        let Some((recorder, name, start)) = self.0 else { return };
        let micros = start.elapsed().as_secs_f64() * 1e6;
        let start = (start - recorder.start).as_secs_f64() * 1e6;
        if let Ok(mut spans) = recorder.spans.lock() {
            spans.push(Done { name, thread: thread(), start, micros });
        }
    }
}

/// A small number of this thread's own.
fn thread() -> u32 {
    static NEXT: AtomicU32 = AtomicU32::new(0);
    thread_local!(static OWN: u32 = NEXT.fetch_add(1, Ordering::Relaxed));
    OWN.with(|own| *own)
}

/// Writes what was recorded as Chrome's trace events.
///
/// # Errors
/// When the file cannot be written.
pub fn write(path: &Path) -> Result<(), FileError> {
    let Some(recorder) = RECORDER.get() else { return Ok(()) };
    let event = |done: &Done| json!({ "name": done.name, "ph": "X", "pid": 1, "tid": done.thread, "ts": done.start, "dur": done.micros });
    let spans = recorder.spans.lock().expect("nothing panics while it adds a span");
    let events: Vec<Json> = spans.iter().map(event).collect();
    atomic_file::write(path, json!({ "traceEvents": events }).to_string().as_bytes())
}
