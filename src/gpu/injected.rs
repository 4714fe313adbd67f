//! Injected device faults, to test how a program ends after a fault with the real error path.
//!
//! Not here: the reporting of faults (`error`). Without a plan the only cost is a counter.

use std::sync::atomic::{AtomicU64, Ordering};

use super::driver::Driver;

/// Bytes of a buffer that fills the device, and most such buffers: a tebibyte in total.
const FILL_BYTES: u64 = 128 << 20;
const FILL_BUFFERS: usize = 8192;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FaultKind {
    /// The device is destroyed, as if unplugged or reset.
    Lost,
    /// The device skips the commands without an error.
    GivenUp,
    /// A command is recorded that the graphics API refuses.
    Validation,
    /// The driver reports that memory has run out. The report is simulated, because really filling a device that shares
    /// the machine's memory would exhaust the machine.
    OutOfMemory,
    /// The device's memory is really filled until the driver refuses. On a device that shares the machine's memory,
    /// limit the address space first (`ulimit -v`).
    Full,
}

/// A fault at a given submission.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct InjectedFault {
    pub kind: FaultKind,
    /// Number of the submission, counted from 1 since the device was opened.
    pub submission: u64,
}

/// Environment variable that injects a fault into any program: `lost@40`, `given-up@40`, `validation@40`,
/// `memory@40`, `full@40`.
const VARIABLE: &str = "GSSCALE_GPU_FAULT";

impl InjectedFault {
    /// Parses text such as `lost@40`.
    pub fn parse(text: &str) -> Option<InjectedFault> {
        let (kind, at) = text.split_once('@')?;
        let kind = match kind {
            "lost" => FaultKind::Lost,
            "given-up" => FaultKind::GivenUp,
            "validation" => FaultKind::Validation,
            "memory" => FaultKind::OutOfMemory,
            "full" => FaultKind::Full,
            _ => return None,
        };
        Some(InjectedFault { kind, submission: at.parse().ok()? })
    }

    pub(super) fn from_environment() -> Option<InjectedFault> {
        InjectedFault::parse(std::env::var(VARIABLE).ok()?.as_str())
    }
}

/// Environment variable that makes a shader compute something else, as a driver that compiles it wrongly does: `sh_fwd.wgsl:0.28209479=0.3`
/// replaces a text in the source of that shader.
const WRONG_SHADER: &str = "GSSCALE_SHADER_FAULT";

/// The source of a shader as the environment wants it.
pub(super) fn with_shader_fault(shader: &str, source: String) -> String {
    let Ok(fault) = std::env::var(WRONG_SHADER) else { return source };
    let parts = fault.split_once(':').filter(|(of, _)| *of == shader).and_then(|(_, change)| change.split_once('='));
    parts.map_or_else(|| source.clone(), |(right, wrong)| source.replace(right, wrong))
}

/// The planned fault and the count of submissions.
#[derive(Debug, Default)]
pub(super) struct Injector {
    plan: Option<InjectedFault>,
    submissions: AtomicU64,
}

impl Injector {
    pub(super) fn new(plan: Option<InjectedFault>) -> Injector {
        Injector { plan, submissions: AtomicU64::new(0) }
    }

    /// Counts a submission; returns the fault to inject into it.
    pub(super) fn next(&self) -> Option<FaultKind> {
        let number = self.submissions.fetch_add(1, Ordering::Relaxed) + 1;
        self.plan.filter(|plan| plan.submission == number).map(|plan| plan.kind)
    }
}

/// Allocates memory until the driver refuses, then frees it; the refusal stays reported.
pub(super) fn fill_device(driver: &Driver) {
    let mut taken = Vec::new();
    while !driver.faults.is_reported() && taken.len() < FILL_BUFFERS {
        taken.push(driver.buffer("filling the device", FILL_BYTES, wgpu::BufferUsages::STORAGE));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_planned_fault_happens_once_at_its_submission() {
        let plan = InjectedFault::parse("memory@2");
        assert_eq!(plan, Some(InjectedFault { kind: FaultKind::OutOfMemory, submission: 2 }));
        let injector = Injector::new(plan);
        let struck: Vec<_> = (0..4).map(|_| injector.next()).collect();
        assert_eq!(struck, [None, Some(FaultKind::OutOfMemory), None, None]);
        assert!(["", "lost", "lost@", "lost@x", "fire@3"].iter().all(|text| InjectedFault::parse(text).is_none()));
    }
}
