//! An emulated bus: copies between host and device take as long as on a bus of a given rate and latency, so that stalls, overlap and
//! what hides behind what can be seen on any device.
//!
//! The host makes these copies itself, to and from mapped staging memory. On a device with its own memory they cross the bus while the host
//! copies. So the emulated bus makes the host wait. The device computes meanwhile, on software drivers too (`submitter`).
//!
//! Invariants: 1. a copy takes no less than the latency plus its bytes over the rate; 2. nothing but time changes.

use super::error::{GpuError, GpuResult};
use crate::base::units::parse_bytes;
use std::time::{Duration, Instant};

/// Environment variable that emulates a bus for any program: `12GB/s,20us`.
const VARIABLE: &str = "GSSCALE_EMULATE_BUS";
/// How much longer than asked the system may sleep; the rest is waited actively.
const SLEEP_SLACK: Duration = Duration::from_micros(100);

/// Rate and latency of a bus.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EmulatedBus {
    /// Bytes per second, in each direction.
    pub bytes_per_second: f64,
    /// Time of a copy beside that of its bytes.
    pub latency: Duration,
}

impl EmulatedBus {
    /// Parses text such as `12GB/s,20us`: a size per second, and a time in ns, us, ms or s. `None` for other text, a rate of 0 or a
    /// latency of 10 s and more.
    pub fn parse(text: &str) -> Option<EmulatedBus> {
        let (rate, latency) = text.split_once(',')?;
        let rate = parse_bytes(rate.trim().strip_suffix("/s")?).ok().filter(|rate| *rate > 0)?;
        let latency = latency.trim();
        let (number, unit) = latency.split_at(latency.find(|c: char| c.is_ascii_alphabetic())?);
        let unit = match unit {
            "ns" => 1e-9,
            "us" => 1e-6,
            "ms" => 1e-3,
            "s" => 1.0,
            _ => return None,
        };
        let seconds = number.trim().parse::<f64>().ok()? * unit;
        let latency = Duration::try_from_secs_f64(seconds).ok().filter(|latency| latency.as_secs() < 10)?;
        Some(EmulatedBus { bytes_per_second: rate as f64, latency })
    }

    /// The bus that the environment requests.
    /// Errors: the variable is set to something else than a rate and a latency.
    pub(super) fn from_environment() -> GpuResult<Option<EmulatedBus>> {
        let Some(text) = std::env::var_os(VARIABLE) else { return Ok(None) };
        let text = text.to_string_lossy().into_owned();
        EmulatedBus::parse(&text).map(Some).ok_or(GpuError::EmulatedBus { variable: VARIABLE, text })
    }

    /// How long a copy takes.
    pub fn time(&self, bytes: u64) -> Duration {
        // A rate is at least one byte per second, and bytes are memory.
        self.latency + Duration::from_secs_f64(bytes as f64 / self.bytes_per_second)
    }

    /// Waits until a copy of `bytes` bytes that began at `began` has crossed the bus.
    pub(super) fn cross(&self, began: Instant, bytes: u64) {
        let time = self.time(bytes);
        while let Some(rest) = time.checked_sub(began.elapsed()) {
            match rest.checked_sub(SLEEP_SLACK) {
                Some(sleep) if !sleep.is_zero() => std::thread::sleep(sleep),
                _ => std::thread::yield_now(),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_and_latencies_parse_and_delay() {
        let bus = EmulatedBus::parse("12GB/s,20us").unwrap();
        assert_eq!(bus, EmulatedBus { bytes_per_second: 12e9, latency: Duration::from_micros(20) });
        assert_eq!(bus.time(24_000_000).as_micros(), 2020);
        assert_eq!(EmulatedBus::parse("1MiB/s, 0.5ms").unwrap().time(1 << 19).as_micros(), 500_500);
        let wrong =
            ["", "12GB/s", "12GB,20us", "0/s,1us", "12GB/s,20", "12GB/s,-1us", "12GB/s,1h", "x/s,1us", "1/s,99s"];
        assert!(wrong.iter().all(|text| EmulatedBus::parse(text).is_none()));
        let began = Instant::now();
        EmulatedBus { bytes_per_second: 1e9, latency: Duration::from_millis(2) }.cross(began, 3_000_000);
        assert!(began.elapsed() >= Duration::from_millis(5));
    }
}
