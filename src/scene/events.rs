//! The log of global changes: what every row applies, now or when it is next touched.
//!
//! An event of step s acts on rows as the optimizer step s left them, so on values that contain s + 1 steps. Whether
//! it is applied at once or later makes no difference: its thresholds are decided when it is logged, and a row that
//! nobody touched in between still is a function of its stored state.
//!
//! Invariants: 1. the log only grows; 2. steps never decrease in it; 3. the index of an event is its name: it is
//! part of the uids of the rows that it makes.

use serde::{Deserialize, Serialize};

/// Children of a split lie within this many standard deviations of their parent, in its own axes: bounds of pages
/// count on it. 1.1 % of draws are drawn again.
pub const SPLIT_SIGMAS: f64 = 3.33;

/// What a densification round decides by. Everything absolute, so that a late application decides the same.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct RoundThresholds {
    /// Rows grow whose mean gradient norm (NDC units) is greater. Infinite: nothing grows.
    pub grow_grad2d: f32,
    /// Growing rows whose largest standard deviation is greater are split, the others duplicated.
    pub split_scale: f32,
    /// Rows are pruned whose opacity is smaller.
    pub prune_opacity: f32,
    /// Rows are pruned whose largest standard deviation is greater. Infinite: none.
    pub prune_scale: f32,
}

/// One kind of global change.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum EventKind {
    /// Opacities above the given one are set to it; the moments of all opacities become zero.
    ResetOpacity {
        /// Largest opacity (after activation) that remains.
        max_opacity: f32,
    },
    /// Bands up to this degree are rendered from now on. Rows that are stored without them get zeros.
    RaiseShDegree {
        /// The degree.
        degree: u8,
    },
    /// A densification round.
    Densify(RoundThresholds),
}

/// One global change and its time.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Event {
    /// 0-based optimizer step after which it happens.
    pub step: u32,
    /// What happens.
    pub kind: EventKind,
}

impl Event {
    /// Number of optimizer steps contained in the values that the event acts on.
    pub fn now(&self) -> u32 {
        self.step + 1
    }
}

/// The events of a run so far.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct EventLog {
    events: Vec<Event>,
}

impl EventLog {
    /// A log from its entries, for instance read back from a checkpoint; `None` when their steps decrease.
    pub fn from_events(events: Vec<Event>) -> Option<Self> {
        events.windows(2).all(|pair| pair[0].step <= pair[1].step).then_some(EventLog { events })
    }

    /// Appends an event and returns its index. Panics when its step lies before the last one's.
    pub fn push(&mut self, event: Event) -> usize {
        assert!(self.events.last().is_none_or(|last| last.step <= event.step), "events are logged in order of time");
        self.events.push(event);
        self.events.len() - 1
    }

    /// Number of events.
    pub fn len(&self) -> usize {
        self.events.len()
    }

    /// Whether nothing has happened yet.
    pub fn is_empty(&self) -> bool {
        self.events.is_empty()
    }

    /// All events in order; the position is the index.
    pub fn events(&self) -> &[Event] {
        &self.events
    }

    /// The events that rows still miss which have applied the first `applied` ones, with their indices.
    pub fn pending(&self, applied: usize) -> impl Iterator<Item = (usize, Event)> + '_ {
        self.events.iter().copied().enumerate().skip(applied)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pending_events_come_with_their_index_in_order() {
        let mut log = EventLog::default();
        assert!(log.is_empty());
        for (i, step) in [1000, 3000, 3000].into_iter().enumerate() {
            let kind = EventKind::RaiseShDegree { degree: i as u8 };
            assert_eq!(log.push(Event { step, kind }), i);
        }
        let pending: Vec<usize> = log.pending(1).map(|(i, _)| i).collect();
        assert_eq!(pending, [1, 2]);
        assert_eq!(log.events()[2].now(), 3001);
        assert_eq!(EventLog::from_events(log.events().to_vec()), Some(log.clone()));
        let mut wrong = log.events().to_vec();
        wrong.reverse();
        assert_eq!(EventLog::from_events(wrong), None);
    }
}
