//! The log of global changes that every row applies, now or when it is next touched.
//!
//! An event of step s acts on rows as optimizer step s left them, so on values that contain s + 1 steps. Applying it
//! later gives the same result: its thresholds are fixed when it is logged, and an untouched row remains a function of
//! its stored state.
//!
//! Invariants: 1. the log only grows; 2. its steps never decrease; 3. an event is identified by its index, which is
//! part of the uids of the rows it creates.

use serde::{Deserialize, Serialize};

/// Children of a split are drawn within this many standard deviations of their parent, along its own axes: bounds of
/// pages rely on it. 1.1 % of draws are repeated.
pub const SPLIT_SIGMAS: f64 = 3.33;

/// Distance of the children of a long-axis split from their parent, in its largest standard deviation: bounds of pages
/// rely on it.
pub const LONG_AXIS_OFFSET: f64 = 0.75;

/// Thresholds of a densification round. All are absolute, so that a late application decides the same.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct RoundThresholds {
    /// Rows with a greater mean gradient norm (NDC units) grow. Infinity: none grows.
    pub grow_grad2d: f32,
    /// Growing rows with a greater largest standard deviation are split, the others duplicated.
    pub split_scale: f32,
    /// Rows with a smaller opacity are pruned.
    pub prune_opacity: f32,
    /// Rows with a greater largest standard deviation are pruned. Infinity: none.
    pub prune_scale: f32,
}

/// Thresholds of a round that splits rows along their longest axis and removes rows of little weight. Bins are those of
/// the histograms in [`crate::densify::stats`], so that no mean is computed again with another rounding.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct LongAxisRound {
    /// Rows split whose mean growth score lies in this bin or above; at least 1.
    pub split_from_bin: u32,
    /// Rows are removed whose mean blending weight lies below this bin; 0: none.
    pub remove_below_bin: u32,
    /// Only rows that at least this many views drew since the last round are removed by their weight.
    pub remove_views: u32,
    /// Rows with a smaller opacity are removed.
    pub prune_opacity: f32,
}

/// Thresholds of a round that removes dead rows and lets others share their place with a copy.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct RelocationRound {
    /// Rows get a copy whose mean score lies in this bin or above; at least 1.
    pub copy_from_bin: u32,
    /// Rows of this opacity or less are removed.
    pub dead_opacity: f32,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum EventKind {
    /// Opacities above the given one are lowered to it; the moments of all opacities become zero.
    ResetOpacity {
        /// After activation.
        max_opacity: f32,
    },
    /// Bands up to this degree are rendered from now on. Rows stored without them get zeros.
    RaiseShDegree {
        degree: u8,
    },
    Densify(RoundThresholds),
    LongAxis(LongAxisRound),
    Relocate(RelocationRound),
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Event {
    /// 0-based optimizer step after which it happens.
    pub step: u32,
    pub kind: EventKind,
}

impl Event {
    /// Number of optimizer steps contained in the values that the event acts on.
    pub fn now(&self) -> u32 {
        self.step + 1
    }
}

#[derive(Debug, Clone, Default, PartialEq)]
pub struct EventLog {
    events: Vec<Event>,
}

impl EventLog {
    /// A log from its entries, for instance from a checkpoint; `None` if steps decrease.
    pub fn from_events(events: Vec<Event>) -> Option<Self> {
        events.windows(2).all(|pair| pair[0].step <= pair[1].step).then_some(EventLog { events })
    }

    /// Appends an event and returns its index. Panics if its step is before the last one's.
    pub fn push(&mut self, event: Event) -> usize {
        assert!(self.events.last().is_none_or(|last| last.step <= event.step), "events are logged in order of time");
        self.events.push(event);
        self.events.len() - 1
    }

    pub fn len(&self) -> usize {
        self.events.len()
    }

    pub fn is_empty(&self) -> bool {
        self.events.is_empty()
    }

    /// All events in order; the position is the index.
    pub fn events(&self) -> &[Event] {
        &self.events
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_log_is_in_the_order_of_time() {
        let mut log = EventLog::default();
        for (i, step) in [1000, 3000, 3000].into_iter().enumerate() {
            let kind = EventKind::RaiseShDegree { degree: i as u8 };
            assert_eq!(log.push(Event { step, kind }), i);
        }
        assert_eq!(EventLog::from_events(log.events().to_vec()), Some(log.clone()));
        let mut wrong = log.events().to_vec();
        wrong.reverse();
        assert_eq!(EventLog::from_events(wrong), None);
    }
}
