//! Numbers for people.

/// 1,234,567.
pub fn count(n: u64) -> String {
    indicatif::HumanCount(n).to_string()
}

/// 1.23 MiB.
pub fn bytes(n: u64) -> String {
    indicatif::BinaryBytes(n).to_string()
}

/// A PSNR, or that there is no error.
pub fn psnr(psnr: Option<f64>) -> String {
    psnr.map_or_else(|| "exact".to_owned(), |db| format!("{db:.2} dB"))
}

/// 12 ms, or 3.4 s.
pub fn seconds(seconds: f64) -> String {
    if seconds < 1.0 { format!("{:.0} ms", seconds * 1e3) } else { format!("{seconds:.1} s") }
}

/// 1.23 %.
pub fn percent(part: f64) -> String {
    format!("{:.2} %", part * 100.0)
}

/// What is, and what may be where that is limited: 1.2 MiB of 9 MiB.
pub fn of_limit<T>(is: T, limit: Option<T>, write: impl Fn(T) -> String) -> String {
    write(is) + &limit.map(|limit| format!(" of {}", write(limit))).unwrap_or_default()
}
