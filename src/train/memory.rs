//! How much memory the process used at its peak.

/// The largest resident size of this process so far, bytes; `None` where the system does not tell.
pub fn host_bytes_peak() -> Option<u64> {
    status_field("VmHWM:")
}

/// The resident size of this process now, bytes; `None` where the system does not tell.
pub fn host_bytes_now() -> Option<u64> {
    status_field("VmRSS:")
}

/// Memory that programs could still take on this machine, bytes.
pub fn host_bytes_available() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    field(&text, "MemAvailable:")
}

fn status_field(name: &str) -> Option<u64> {
    let text = std::fs::read_to_string("/proc/self/status").ok()?;
    field(&text, name)
}

fn field(text: &str, name: &str) -> Option<u64> {
    let line = text.lines().find(|l| l.starts_with(name))?;
    let kib: u64 = line[name.len()..].trim().trim_end_matches("kB").trim().parse().ok()?;
    Some(kib * 1024)
}
