//! Numbers for people.

/// 1,234,567.
pub fn count(n: u64) -> String {
    let digits = n.to_string();
    let mut text = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

/// 1.23 MiB.
pub fn bytes(n: u64) -> String {
    const UNITS: [&str; 7] = ["B", "KiB", "MiB", "GiB", "TiB", "PiB", "EiB"];
    let (mut amount, mut unit) = (n as f64, 0);
    while amount >= 1024.0 {
        amount /= 1024.0;
        unit += 1;
    }
    let decimals = if unit == 0 { 0 } else { 2 };
    format!("{amount:.decimals$} {}", UNITS[unit])
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn large_numbers_are_readable() {
        for (n, expected) in [(0, "0"), (999, "999"), (1000, "1,000"), (1_234_567, "1,234,567")] {
            assert_eq!(count(n), expected);
        }
        for (n, expected) in [
            (0, "0 B"),
            (1023, "1023 B"),
            (1024, "1.00 KiB"),
            ((1 << 20) - 1, "1024.00 KiB"),
            (1_500_000, "1.43 MiB"),
            (u64::MAX, "16.00 EiB"),
        ] {
            assert_eq!(bytes(n), expected);
        }
    }
}
