//! Counts what is allocated, so that a target that takes more memory than its input can justify is found out.
//!
//! Invariants: 1. every allocation of the process is counted, whatever thread makes it; 2. one request beyond
//! [`REFUSED_BYTES`] is refused: code that can handle that gets its error, any other ends the process, after the target
//! and the case were named.
#![allow(unsafe_code)] // an allocator cannot be written otherwise; tests only

use std::alloc::{GlobalAlloc, Layout, System};
use std::io::Write;
use std::sync::atomic::{AtomicI64, AtomicU64, Ordering};

/// Larger allocations are refused: no target needs one.
const REFUSED_BYTES: usize = 1 << 30;

static LIVE: AtomicI64 = AtomicI64::new(0);
static PEAK: AtomicI64 = AtomicI64::new(0);
/// The running case, for the message of a refusal.
pub static CASE: AtomicU64 = AtomicU64::new(0);

struct Counting;

fn add(bytes: usize) {
    let live = LIVE.fetch_add(bytes as i64, Ordering::Relaxed) + bytes as i64;
    PEAK.fetch_max(live, Ordering::Relaxed);
}

fn is_refused(bytes: usize) -> bool {
    if bytes <= REFUSED_BYTES {
        return false;
    }
    // Nothing here may allocate.
    let mut text = [0u8; 96];
    let mut rest = text.as_mut_slice();
    let _ = writeln!(rest, "case {}: {bytes} bytes were asked for at once", CASE.load(Ordering::Relaxed));
    let unused = rest.len();
    let _ = std::io::stderr().write_all(&text[..96 - unused]);
    true
}

// SAFETY: every call goes to the system's allocator with the arguments that it came with; counting touches atomics only, and
// a null pointer is how an allocator refuses.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        if is_refused(layout.size()) {
            return std::ptr::null_mut();
        }
        add(layout.size());
        // SAFETY: as the caller promised.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        if is_refused(layout.size()) {
            return std::ptr::null_mut();
        }
        add(layout.size());
        // SAFETY: as the caller promised.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        LIVE.fetch_sub(layout.size() as i64, Ordering::Relaxed);
        // SAFETY: as the caller promised.
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, bytes: usize) -> *mut u8 {
        if is_refused(bytes) {
            return std::ptr::null_mut();
        }
        // Old and new block exist together for a moment.
        add(bytes);
        LIVE.fetch_sub(layout.size() as i64, Ordering::Relaxed);
        // SAFETY: as the caller promised.
        unsafe { System.realloc(pointer, layout, bytes) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Runs `work`; returns its peak of allocated bytes.
pub fn peak_of(work: impl FnOnce()) -> u64 {
    let before = LIVE.load(Ordering::Relaxed);
    PEAK.store(before, Ordering::Relaxed);
    work();
    (PEAK.load(Ordering::Relaxed) - before).max(0) as u64
}
