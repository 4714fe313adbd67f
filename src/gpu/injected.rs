//! Faults of a device on purpose, so that how a program ends after one can be tried and tested with the real thing.
//!
//! Not here: how faults are reported (`error`). Without a plan nothing happens and nothing is read but a counter.

use std::sync::atomic::{AtomicU64, Ordering};

/// What goes wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FaultKind {
    /// The device is destroyed, as when it is unplugged or reset.
    Lost,
    /// A command is recorded that the graphics API refuses.
    Validation,
    /// The driver says that it has no memory left. Reported as the driver would: filling a device that shares the
    /// machine's memory would take the machine with it.
    OutOfMemory,
    /// The device is filled until the driver refuses, for real. On one that shares the machine's memory, do this under a
    /// limit of the address space (`ulimit -v`).
    Full,
}

/// A fault at one submission.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct InjectedFault {
    /// What goes wrong.
    pub kind: FaultKind,
    /// At which submission since the device was opened, counted from 1.
    pub submission: u64,
}

/// Names a fault for any program: `lost@40`, `validation@40`, `memory@40`, `full@40`.
const VARIABLE: &str = "GSSCALE_GPU_FAULT";

impl InjectedFault {
    /// Reads `lost@40`.
    pub fn parse(text: &str) -> Option<InjectedFault> {
        let (kind, at) = text.split_once('@')?;
        let kind = match kind {
            "lost" => FaultKind::Lost,
            "validation" => FaultKind::Validation,
            "memory" => FaultKind::OutOfMemory,
            "full" => FaultKind::Full,
            _ => return None,
        };
        Some(InjectedFault { kind, submission: at.parse().ok()? })
    }

    /// What the environment asks for.
    pub(super) fn from_environment() -> Option<InjectedFault> {
        InjectedFault::parse(std::env::var(VARIABLE).ok()?.as_str())
    }
}

/// A plan with the count of submissions.
#[derive(Debug, Default)]
pub(super) struct Injector {
    plan: Option<InjectedFault>,
    submissions: AtomicU64,
}

impl Injector {
    pub(super) fn new(plan: Option<InjectedFault>) -> Injector {
        Injector { plan, submissions: AtomicU64::new(0) }
    }

    /// Counts a submission; what is to go wrong in it.
    pub(super) fn next(&self) -> Option<FaultKind> {
        let number = self.submissions.fetch_add(1, Ordering::Relaxed) + 1;
        self.plan.filter(|plan| plan.submission == number).map(|plan| plan.kind)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plan_strikes_once_at_its_submission() {
        let plan = InjectedFault::parse("memory@2");
        assert_eq!(plan, Some(InjectedFault { kind: FaultKind::OutOfMemory, submission: 2 }));
        let injector = Injector::new(plan);
        let struck: Vec<_> = (0..4).map(|_| injector.next()).collect();
        assert_eq!(struck, [None, Some(FaultKind::OutOfMemory), None, None]);
        assert!(["", "lost", "lost@", "lost@x", "fire@3"].iter().all(|text| InjectedFault::parse(text).is_none()));
    }
}
