//! The list of steps in flight on a device that holds the pages, and the pages that they have pinned.
//!
//! Not here: how steps are recorded, taken over and given up (`device_flights`).
//!
//! Invariant: a page is pinned once, however many steps in flight use it.

use super::step_faults::{StepFaults, steps_in_flight};
use crate::base::ids::PageNo;
use crate::optim::one_step::OneStep;
use crate::paging::pinned::PinnedPage;
use crate::scene::camera::Camera;
use std::collections::{BTreeMap, VecDeque};

/// The most steps in flight.
pub const STEPS_IN_FLIGHT: usize = 2;

/// A step that is recorded and not finished.
#[derive(Debug)]
pub(super) struct Flight {
    /// Its number, 0-based.
    pub step: u32,
    pub camera: Camera,
    /// Its pages, ascending by id.
    pub pages: Vec<PageNo>,
}

/// The steps in flight and their pages.
#[derive(Debug)]
pub(super) struct Flights {
    /// In the order of their steps.
    pub steps: VecDeque<Flight>,
    /// Each page with the number of steps in flight that use it.
    pub pages: BTreeMap<PageNo, (PinnedPage, usize)>,
    /// No step before this one is recorded.
    pub not_before: u32,
    /// The most steps in flight.
    pub most: usize,
    /// Whether the step that was finished last was taken. If not, or before the first one, the predicted sizes of lists are doubtful.
    pub is_sure: bool,
    /// How far an update moves bounds.
    pub one_step: OneStep,
    pub faults: StepFaults,
}

impl Flights {
    /// No step in flight yet, for a run whose updates move bounds by at most `one_step`.
    pub fn new(one_step: OneStep) -> Flights {
        let (most, faults) = (steps_in_flight(STEPS_IN_FLIGHT), StepFaults::from_environment());
        Flights {
            steps: VecDeque::new(),
            pages: BTreeMap::new(),
            not_before: 0,
            most,
            is_sure: false,
            one_step,
            faults,
        }
    }

    /// Pages that steps in flight have pinned.
    pub fn pages(&self) -> usize {
        self.pages.len()
    }
}
