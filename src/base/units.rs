//! Sizes, counts and times in human notation: `512MiB`, `4GiB`, `2GB`, `1048576`; `30k`, `1.25M`; `45 s`, `12 min`,
//! `3.4 h`.

/// Bytes in one MiB.
pub const MIB: u64 = 1 << 20;
/// Bytes in one GiB.
pub const GIB: u64 = 1 << 30;
/// A smaller number without a unit is taken for a unit that was forgotten.
const BARE_LEAST: f64 = 1e6;

/// Parses a size: a number, then a unit. `K M G T` and `KiB ...` are powers of 1024, `KB ...` of 1000. Zero and a million
/// bytes or more need no unit.
pub fn parse_bytes(text: &str) -> Result<u64, String> {
    let text = text.trim();
    let split = text.find(|c: char| !(c.is_ascii_digit() || c == '.')).unwrap_or(text.len());
    let (number, unit) = text.split_at(split);
    let value: f64 = number.parse().map_err(|_| format!("'{text}' is not a size; write for example 4GiB"))?;
    if unit.trim().is_empty() && value > 0.0 && value < BARE_LEAST {
        return Err(format!("'{text}' would be that many bytes; give a unit, for example {text}GiB"));
    }
    let factor = match unit.trim().to_ascii_lowercase().as_str() {
        "" | "b" => 1.0,
        "k" | "kib" => 1024.0,
        "m" | "mib" => 1_048_576.0,
        "g" | "gib" => 1_073_741_824.0,
        "t" | "tib" => 1_099_511_627_776.0,
        "kb" => 1e3,
        "mb" => 1e6,
        "gb" => 1e9,
        "tb" => 1e12,
        other => return Err(format!("unknown unit '{other}' in '{text}'; use KiB, MiB, GiB or KB, MB, GB")),
    };
    let bytes = value * factor;
    if bytes.is_finite() && bytes < 9e18 { Ok(bytes as u64) } else { Err(format!("'{text}' is out of range")) }
}

/// Formats a size with two or three digits and a binary unit.
pub fn format_bytes(bytes: u64) -> String {
    format_scaled(bytes, |value| value)
}

/// As [`format_bytes`], rounded up: for sizes that a user is told to give.
pub fn format_bytes_up(bytes: u64) -> String {
    // The digits that are printed, rounded up.
    format_scaled(bytes, |value| if value >= 100.0 { value.ceil() } else { (value * 10.0).ceil() / 10.0 })
}

fn format_scaled(bytes: u64, round: impl Fn(f64) -> f64) -> String {
    let units = ["B", "KiB", "MiB", "GiB", "TiB"];
    let mut value = bytes as f64;
    let mut unit = 0;
    while value >= 1024.0 && unit + 1 < units.len() {
        value /= 1024.0;
        unit += 1;
    }
    let value = round(value);
    if unit == 0 || value >= 100.0 {
        format!("{value:.0} {}", units[unit])
    } else {
        format!("{value:.1} {}", units[unit])
    }
}

/// Parses a count: digits, which may be grouped (`30_000`, `30,000`), or a number with `k` or `M` (`30k`, `1.5M`).
/// Errors: the text is no whole number from 0 on.
pub fn parse_count(text: &str) -> Result<u64, String> {
    let wrong = || format!("'{text}' is not a count; write for example 30000 or 30k");
    // Commas part groups of three digits: `1,5M` is not 15 million.
    let are_groups = |number: &str| {
        let mut groups = number.split(',');
        let is_first = groups.next().is_some_and(|group| (1..=3).contains(&group.len()));
        is_first && number.chars().all(|c| c.is_ascii_digit() || c == ',') && groups.all(|group| group.len() == 3)
    };
    if text.contains(',') && !are_groups(text.trim()) {
        return Err(wrong());
    }
    let plain: String = text.trim().chars().filter(|c| !matches!(c, '_' | ',')).collect();
    let (number, factor) = match plain.char_indices().last() {
        Some((at, 'k' | 'K')) => (&plain[..at], 1e3),
        Some((at, 'm' | 'M')) => (&plain[..at], 1e6),
        _ => return plain.parse().map_err(|_| wrong()),
    };
    let is_number = number.chars().all(|c| c.is_ascii_digit() || c == '.');
    let value = number.parse::<f64>().ok().filter(|_| is_number).ok_or_else(wrong)? * factor;
    // Below 2^53 every whole number is an f64.
    if value < 9e15 && value == value.trunc() { Ok(value as u64) } else { Err(wrong()) }
}

/// As [`parse_count`], for keys of 32 bits. Errors: as [`parse_count`], or the count is 2^32 or more.
pub fn parse_count32(text: &str) -> Result<u32, String> {
    let too_large = |_| format!("'{text}' is too large; the most is 4,294,967,295");
    u32::try_from(parse_count(text)?).map_err(too_large)
}

/// Parses a time in seconds: a number from 0 on, then `s` (or no unit), `min`, `h` or `d`.
/// Errors: the text is no such time.
pub fn parse_seconds(text: &str) -> Result<f64, String> {
    let wrong = || format!("'{text}' is not a time; write for example 90 (seconds), 90s, 5min or 2h");
    let plain = text.trim();
    let number = plain.trim_end_matches(|c: char| c.is_ascii_alphabetic());
    let factor = match &plain[number.len()..] {
        "" | "s" | "sec" => 1.0,
        "m" | "min" => 60.0,
        "h" => 3600.0,
        "d" => 86400.0,
        _ => return Err(wrong()),
    };
    let seconds = number.trim().parse::<f64>().map_err(|_| wrong())? * factor;
    if seconds.is_finite() && seconds >= 0.0 { Ok(seconds) } else { Err(wrong()) }
}

/// Formats a count with up to three digits and `k` or `M`.
pub fn format_count(n: u64) -> String {
    let short = |value: f64, unit: &str| match value {
        v if v < 9.995 => format!("{v:.2}{unit}"),
        v if v < 99.95 => format!("{v:.1}{unit}"),
        v => format!("{v:.0}{unit}"),
    };
    match n {
        0..1000 => n.to_string(),
        1000..999_500 => short(n as f64 / 1e3, "k"),
        _ => short(n as f64 / 1e6, "M"),
    }
}

/// Formats a whole number with groups of three digits: `149,950`.
pub fn format_grouped(n: u64) -> String {
    let digits = n.to_string();
    let mut out = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            out.push(',');
        }
        out.push(digit);
    }
    out
}

/// A count with its noun: `1 photo`, `1,234 photos`.
pub fn counted(count: u64, noun: &str) -> String {
    format!("{} {noun}{}", format_grouped(count), if count == 1 { "" } else { "s" })
}

/// As [`counted`], with the verb: `1 photo is`.
pub fn counted_are(count: u64, noun: &str) -> String {
    format!("{} {}", counted(count, noun), if count == 1 { "is" } else { "are" })
}

/// Formats a time with two or three digits and a unit.
pub fn format_seconds(seconds: f64) -> String {
    const UNITS: [(f64, &str); 4] = [(1.0, "s"), (60.0, "min"), (3600.0, "h"), (86400.0, "d")];
    // The next unit starts where the number would have three digits.
    let (size, unit) = UNITS.into_iter().find(|(size, _)| seconds < 99.5 * size).unwrap_or(UNITS[3]);
    let value = seconds / size;
    if value < 9.95 { format!("{value:.1} {unit}") } else { format!("{value:.0} {unit}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_parse_and_print() {
        for (text, want) in [("30000", 30_000), ("30k", 30_000), ("1.5M", 1_500_000), ("30_000", 30_000), ("0", 0)] {
            assert_eq!(parse_count(text), Ok(want));
        }
        for wrong in [
            "",
            "k",
            "-3",
            "1.2345k",
            "30 k",
            "1e3",
            "nan",
            "infk",
            "9999999999M",
            "30kk",
            "+5k",
            "1,5k",
            "1,5M",
            "3,0000",
            ",5",
        ] {
            assert!(parse_count(wrong).is_err(), "{wrong}");
        }
        assert_eq!(parse_count32("4,294,967,295"), Ok(u32::MAX));
        assert!(parse_count32("5000M").is_err_and(|e| e.contains("too large")));
        let counts = [7, 999, 1000, 15_950, 792_000, 999_600, 1_250_000, 4_294_967_294];
        assert_eq!(counts.map(format_count), ["7", "999", "1.00k", "15.9k", "792k", "1.00M", "1.25M", "4295M"]);
        assert_eq!([5, 1234, 1_234_567].map(format_grouped), ["5", "1,234", "1,234,567"]);
        assert_eq!([0, 1, 1234].map(|n| counted_are(n, "photo")), ["0 photos are", "1 photo is", "1,234 photos are"]);
    }

    #[test]
    fn times_parse() {
        for (text, want) in [
            ("0", 0.0),
            ("90", 90.0),
            ("1.5s", 1.5),
            (" 5 min ", 300.0),
            ("1e2", 100.0),
            ("2h", 7200.0),
            ("1d", 86400.0),
        ] {
            assert_eq!(parse_seconds(text), Ok(want), "{text}");
        }
        for wrong in ["", "s", "-1", "inf", "nan", "5 weeks", "1d1", "9e307h"] {
            assert!(parse_seconds(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn sizes_parse_and_print() {
        assert_eq!(parse_bytes("4GiB"), Ok(4 * GIB));
        assert_eq!(parse_bytes("1.5 MiB"), Ok(MIB + MIB / 2));
        assert_eq!(parse_bytes("2GB"), Ok(2_000_000_000));
        assert_eq!([parse_bytes("77B"), parse_bytes("0"), parse_bytes("1048576")], [Ok(77), Ok(0), Ok(MIB)]);
        assert!(parse_bytes("8").is_err_and(|e| e.contains("8GiB")));
        assert!(parse_bytes("GiB").is_err());
        assert!(parse_bytes("4 parsecs").is_err());
        assert_eq!(format_bytes(4 * GIB), "4.0 GiB");
        assert_eq!(format_bytes(900), "900 B");
        assert_eq!([format_bytes(GIB + 1), format_bytes_up(GIB + 1)], ["1.0 GiB", "1.1 GiB"]);
        assert_eq!(
            [format_bytes_up(GIB), format_bytes_up(200 * GIB + 1), format_bytes_up(7)],
            ["1.0 GiB", "201 GiB", "7 B"]
        );
        let times = [0.25, 45.2, 99.4, 99.6, 5000.0, 7200.0, 345_600.0, 864_000.0];
        assert_eq!(times.map(format_seconds), ["0.2 s", "45 s", "99 s", "1.7 min", "83 min", "2.0 h", "96 h", "10 d"]);
    }
}
