//! A cache of decoded targets within a byte budget; its own threads decode ahead of use.
//!
//! The trainer announces the coming views ([`TargetCache::prefetch`]) and takes them one by one ([`TargetCache::get`]).
//! Eviction order: first targets that no coming step needs, least recently used first; then those needed last. A view
//! is never evicted for one that is needed later.
//!
//! Invariants: 1. the bytes of decoded targets (also those that a caller still holds) plus the peak bytes of decodes in flight,
//! from the files' headers, never exceed the budget, except: 2. a view that a caller waits for is decoded even if it does not fit,
//! but alone, and after evicting everything that nobody holds; 3. targets that fit the budget together, with room for the decodes
//! in flight, are decoded once; 4. the bits of a target never depend on budget, threads or order.

use super::loader::View;
use super::photo::{PhotoSource, decode};
use crate::base::error::{InputError, InputResult};
use crate::scene::image::Target;
use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

/// A cache of decoded targets, indexed like its views. Threads share it by reference; dropping it waits for the decodes
/// in flight.
#[derive(Debug)]
pub struct TargetCache {
    shared: Arc<SharedCache>,
    workers: Vec<JoinHandle<()>>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct CacheStats {
    /// Bytes in use now: targets and decodes in flight.
    pub bytes: u64,
    pub peak_bytes: u64,
    /// Finished ones.
    pub decodes: u64,
    /// Calls of `get` that found their target decoded.
    pub hits: u64,
    /// Calls of `get` that had to wait.
    pub waits: u64,
}

#[derive(Debug)]
struct SharedCache {
    photos: Vec<PhotoSource>,
    budget: u64,
    state: Mutex<CacheState>,
    /// Notified when there may be work for a worker.
    work: Condvar,
    /// Notified when a decode has ended.
    done: Condvar,
}

#[derive(Debug, Default)]
struct CacheState {
    slots: Vec<Slot>,
    /// Coming views: (position, view), positions ascending.
    plan: VecDeque<(u64, usize)>,
    /// Views that callers wait for and whose decode has not started, oldest first.
    wanted: VecDeque<usize>,
    in_flight: usize,
    clock: u64,
    stats: CacheStats,
    stop: bool,
}

#[derive(Debug, Default)]
struct Slot {
    content: Content,
    /// Positions of this view in the plan, ascending.
    uses: VecDeque<u64>,
    /// Callers in `get` that have not taken the target yet; it is not evicted meanwhile.
    waiters: u32,
    last_used: u64,
}

#[derive(Debug, Default)]
enum Content {
    #[default]
    Absent,
    Decoding,
    Ready(Arc<Target>),
    Failed(InputError),
}

/// Next use of a view that no coming step needs.
const NEVER: u64 = u64::MAX;

impl TargetCache {
    /// A cache for these views that uses at most `budget_bytes` and decodes on `threads` threads of its own. With 0
    /// threads, callers of `get` decode, and nothing is prefetched.
    /// Errors: the system refuses to start a thread.
    pub fn new(views: &[View], budget_bytes: u64, threads: usize) -> InputResult<Self> {
        let photos: Vec<PhotoSource> = views.iter().map(|v| v.photo.clone()).collect();
        let state = CacheState { slots: photos.iter().map(|_| Slot::default()).collect(), ..CacheState::default() };
        let shared = Arc::new(SharedCache {
            photos,
            budget: budget_bytes,
            state: Mutex::new(state),
            work: Condvar::new(),
            done: Condvar::new(),
        });
        let mut cache = TargetCache { shared, workers: Vec::new() };
        for i in 0..threads {
            let shared = Arc::clone(&cache.shared);
            let run = move || {
                let mut state = shared.lock();
                while !state.stop {
                    state = match shared.start_next(&mut state) {
                        Some(view) => shared.decode_unlocked(state, view),
                        None => shared.work.wait(state).unwrap_or_else(PoisonError::into_inner),
                    };
                }
            };
            let worker = std::thread::Builder::new().name(format!("decode-{i}")).spawn(run);
            cache.workers.push(worker.map_err(|e| InputError::io("decode threads", "starting a thread", &e))?);
        }
        Ok(cache)
    }

    /// Announces the coming views, the next one first; replaces the previous announcement. Decoding starts at once, as
    /// far ahead as the budget allows. Indices must be valid.
    pub fn prefetch(&self, coming: &[usize]) {
        let mut state = self.shared.lock();
        for slot in &mut state.slots {
            slot.uses.clear();
        }
        state.plan.clear();
        for (position, &view) in (0..).zip(coming) {
            state.plan.push_back((position, view));
            state.slots[view].uses.push_back(position);
        }
        drop(state);
        self.shared.work.notify_all();
    }

    /// The target of a view; waits until it is decoded. Views of the plan up to and including this one's first position
    /// count as past.
    /// Errors: the photo or mask cannot be decoded (the same error every time).
    pub fn get(&self, view: usize) -> InputResult<Arc<Target>> {
        let shared = &self.shared;
        let mut state = shared.lock();
        state.pass(view);
        let waits = matches!(state.slots[view].content, Content::Absent | Content::Decoding);
        if matches!(state.slots[view].content, Content::Absent) {
            state.wanted.push_back(view);
            shared.work.notify_all();
        }
        state.slots[view].waiters += 1;
        let result = loop {
            match &state.slots[view].content {
                Content::Ready(target) => break Ok(Arc::clone(target)),
                Content::Failed(error) => break Err(error.clone()),
                Content::Absent | Content::Decoding => {}
            }
            // Without workers the caller decodes, unless another caller is decoding this view.
            let next = if self.workers.is_empty() { shared.start_next(&mut state) } else { None };
            state = match next {
                Some(next) => shared.decode_unlocked(state, next),
                None => shared.done.wait(state).unwrap_or_else(PoisonError::into_inner),
            };
        };
        state.slots[view].waiters -= 1;
        state.clock += 1;
        let clock = state.clock;
        state.slots[view].last_used = clock;
        state.stats.waits += u64::from(waits);
        state.stats.hits += u64::from(!waits);
        drop(state);
        // The advanced plan, or a target that a caller has dropped, may have made room.
        shared.work.notify_all();
        result
    }

    pub fn stats(&self) -> CacheStats {
        self.shared.lock().stats
    }

    /// The budget at which a cache with `decodes` threads never evicts a target, and so the most that it ever uses: all
    /// targets plus the largest decodes.
    pub fn bytes_to_keep_all(views: &[View], decodes: usize) -> u64 {
        let mut peaks: Vec<u64> = views.iter().map(|v| v.photo.decode_bytes()).collect();
        peaks.sort_unstable_by(|a, b| b.cmp(a));
        let targets: u64 = views.iter().map(|v| v.photo.target_bytes()).sum();
        targets + peaks.iter().take(decodes.max(1)).sum::<u64>()
    }
}

impl Drop for TargetCache {
    fn drop(&mut self) {
        self.shared.lock().stop = true;
        self.shared.work.notify_all();
        for worker in self.workers.drain(..) {
            // Workers catch their own panics, so there is no error to report.
            let _ = worker.join();
        }
    }
}

impl SharedCache {
    fn lock(&self) -> MutexGuard<'_, CacheState> {
        // No panic can leave the state half-changed: decoding happens outside the lock.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Decodes a view that [`SharedCache::start_next`] chose, without holding the lock.
    fn decode_unlocked<'a>(&'a self, state: MutexGuard<'a, CacheState>, view: usize) -> MutexGuard<'a, CacheState> {
        drop(state);
        let photo = &self.photos[view];
        let result = catch_unwind(AssertUnwindSafe(|| decode(photo))).unwrap_or_else(|_| {
            let remedy = "save the photo again, as PNG for example";
            Err(InputError::new(&photo.image_path, "the decoder failed on this photo", remedy))
        });
        let mut state = self.lock();
        self.finish(&mut state, view, result);
        self.done.notify_all();
        self.work.notify_all();
        state
    }

    /// Chooses the next view to decode, makes room and reserves its bytes; `None` if there is nothing to do now.
    fn start_next(&self, state: &mut CacheState) -> Option<usize> {
        while let Some(&view) = state.wanted.front() {
            match state.slots[view].content {
                Content::Absent => {
                    let fits = self.make_room(state, view, None);
                    if !fits && state.in_flight > 0 {
                        return None; // the end of a decode wakes this worker again
                    }
                    state.wanted.pop_front();
                    return Some(self.start(state, view));
                }
                _ => state.wanted.pop_front(),
            };
        }
        let is_absent = |(_, view): &&(u64, usize)| matches!(state.slots[*view].content, Content::Absent);
        let &(position, view) = state.plan.iter().find(is_absent)?;
        self.make_room(state, view, Some(position)).then(|| self.start(state, view))
    }

    fn start(&self, state: &mut CacheState, view: usize) -> usize {
        state.slots[view].content = Content::Decoding;
        state.in_flight += 1;
        state.stats.bytes += self.photos[view].decode_bytes();
        state.stats.peak_bytes = state.stats.peak_bytes.max(state.stats.bytes);
        view
    }

    fn finish(&self, state: &mut CacheState, view: usize, result: InputResult<Target>) {
        state.in_flight -= 1;
        state.stats.bytes -= self.photos[view].decode_bytes();
        state.stats.decodes += 1;
        state.clock += 1;
        state.slots[view].last_used = state.clock;
        state.slots[view].content = match result {
            Ok(target) => {
                state.stats.bytes += target.bytes();
                Content::Ready(Arc::new(target))
            }
            Err(error) => Content::Failed(error),
        };
    }

    /// Evicts targets until the decode of `view` fits the budget: only targets that nobody holds or waits for and, for
    /// a prefetch at position `needed_at`, only those needed later. If it would still not fit, nothing is evicted,
    /// except for a view that is waited for while no other decode is in flight.
    fn make_room(&self, state: &mut CacheState, view: usize, needed_at: Option<u64>) -> bool {
        let needed = self.photos[view].decode_bytes();
        let mut victims: Vec<(u64, u64, usize, u64)> = Vec::new();
        for (i, slot) in state.slots.iter().enumerate() {
            let next_use = slot.uses.front().copied().unwrap_or(NEVER);
            if let Content::Ready(target) = &slot.content
                && Arc::strong_count(target) == 1
                && slot.waiters == 0
                && needed_at.is_none_or(|at| next_use > at)
            {
                victims.push((next_use, u64::MAX - slot.last_used, i, target.bytes()));
            }
        }
        // Farthest next use last; among targets never needed again, the least recently used last.
        victims.sort_unstable();
        let room: u64 = victims.iter().map(|v| v.3).sum();
        let fits = state.stats.bytes - room + needed <= self.budget;
        if !fits && (needed_at.is_some() || state.in_flight > 0) {
            return false;
        }
        while state.stats.bytes + needed > self.budget {
            let Some((_, _, victim, bytes)) = victims.pop() else { break };
            state.slots[victim].content = Content::Absent;
            state.stats.bytes -= bytes;
        }
        fits
    }
}

impl CacheState {
    /// Drops the plan up to and including the first position of `view`, if it is in the plan.
    fn pass(&mut self, view: usize) {
        let Some(&until) = self.slots[view].uses.front() else { return };
        while let Some(&(position, past)) = self.plan.front()
            && position <= until
        {
            self.plan.pop_front();
            self.slots[past].uses.pop_front();
        }
    }
}
