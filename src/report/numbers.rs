//! Numbers in few characters, for charts and reports.

/// Scale and letter that shorten a number.
fn unit(value: f64) -> (f64, &'static str) {
    match value.abs() {
        m if m >= 1e9 => (1e9, "G"),
        m if m >= 1e6 => (1e6, "M"),
        m if m >= 1e4 => (1e3, "k"),
        _ => (1.0, ""),
    }
}

/// A number in few characters, such as 1.2M, 350k, 0.25.
pub fn short(value: f64) -> String {
    let (scale, unit) = unit(value);
    let scaled = value / scale;
    let digits = match scaled.abs() {
        s if s >= 100.0 || s == 0.0 => 0,
        s if s >= 10.0 => 1,
        s if s >= 1.0 => 2,
        _ => 3,
    };
    let mut text = format!("{scaled:.digits$}");
    if text.contains('.') {
        text.truncate(text.trim_end_matches('0').trim_end_matches('.').len());
    }
    text + unit
}

/// The label of a tick on an axis that covers `span`, with enough digits to tell neighbours apart.
pub(super) fn tick(value: f64, span: f64) -> String {
    let (scale, unit) = unit(value);
    // About eight ticks; one digit more than their distance needs.
    let digits = (1.0 - (span / scale / 8.0).log10()).floor().clamp(0.0, 12.0) as usize;
    let text = format!("{:.digits$}", value / scale);
    let text = if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { &text };
    if text == "-0" { "0".to_string() } else { format!("{text}{unit}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_short() {
        let cases = [(0.0, "0"), (0.25, "0.25"), (26.7, "26.7"), (12_345.0, "12.3k"), (2.5e6, "2.5M"), (-3e9, "-3G")];
        for (value, want) in cases {
            assert_eq!(short(value), want);
        }
    }

    #[test]
    fn ticks_of_a_narrow_axis_differ() {
        let ticks = [19.3, 19.35, 19.4].map(|v| tick(v, 0.3));
        assert_eq!(ticks, ["19.3", "19.35", "19.4"]);
        assert_eq!([0.0, 0.0005, 0.001].map(|v| tick(v, 0.003)), ["0", "0.0005", "0.001"]);
        assert_eq!([tick(25_000.0, 1e5), tick(3000.0, 3000.0), tick(-0.0, 1.0)], ["25k", "3000", "0"]);
        let ticks = [149_880.0, 149_890.0, 149_900.0, 149_950.0].map(|v| tick(v, 77.0));
        assert_eq!(ticks, ["149.88k", "149.89k", "149.9k", "149.95k"]);
        assert_eq!([1.5e6, 2e6, -2e6].map(|v| tick(v, 3e6)), ["1.5M", "2M", "-2M"]);
        assert_eq!([2_000_000.0, 2_000_010.0].map(|v| tick(v, 70.0)), ["2M", "2.00001M"]);
    }
}
