//! Staging memory on its way to the host: what state it is in, shared by who waits and who asks for the mapping.
//!
//! Invariant: a mapping is asked for after the commands that use the memory were submitted, so the API maps the memory when those are done.

use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};

/// Where staging memory is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub(super) enum MapState {
    /// Commands that use it are being recorded.
    Recorded,
    /// Those commands are submitted, or about to be; the mapping follows them.
    Pending,
    /// The host may use it.
    Mapped,
    /// It could not be mapped.
    Failed,
}

/// A [`MapState`] that several threads share.
#[derive(Debug, Clone)]
pub(super) struct SharedState(Arc<AtomicU8>);

impl SharedState {
    pub(super) fn new(state: MapState) -> SharedState {
        SharedState(Arc::new(AtomicU8::new(state as u8)))
    }

    pub(super) fn set(&self, state: MapState) {
        self.0.store(state as u8, Ordering::Release);
    }

    pub(super) fn get(&self) -> MapState {
        const BY_NUMBER: [MapState; 4] = [MapState::Recorded, MapState::Pending, MapState::Mapped, MapState::Failed];
        BY_NUMBER[usize::from(self.0.load(Ordering::Acquire)) % BY_NUMBER.len()]
    }
}

/// A mapping to ask for once the commands that use the memory are submitted.
#[derive(Debug)]
pub(super) struct Mapping {
    raw: wgpu::Buffer,
    mode: wgpu::MapMode,
    size: u64,
    state: SharedState,
}

impl Mapping {
    /// The mapping of the first `size` bytes of `raw`, which reports to `state`.
    pub(super) fn new(raw: &wgpu::Buffer, mode: wgpu::MapMode, size: u64, state: &SharedState) -> Mapping {
        Mapping { raw: raw.clone(), mode, size, state: state.clone() }
    }

    /// Notes that the commands are submitted, or about to be.
    pub(super) fn set_pending(&self) {
        self.state.set(MapState::Pending);
    }

    /// Asks for the mapping.
    pub(super) fn start(self) {
        let state = self.state;
        self.raw.map_async(self.mode, ..self.size, move |result| {
            state.set(if result.is_ok() { MapState::Mapped } else { MapState::Failed });
        });
    }
}
