//! The C library's allocator: when the system has freed memory again.
//!
//! A run counts the bytes of its buffers, and gives the memory that it frees to frames of pages. glibc does not give a freed
//! block back to the system if the block is smaller than the largest one that was freed before, up to 32 MiB: the process
//! stays as large as at the peak of each of its parts, and the sum of these exceeds the budget.
//!
//! Not here: the budget (`train::memory`).

/// Blocks of this size and more are mapped on their own. Smaller ones hardly count in a budget.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
const MAPPED_BYTES: i32 = 4 << 20;

/// From now on, a block of 4 MiB and more returns to the system when it is freed. Call this at the start of `main`. Without
/// glibc, it does nothing.
pub fn return_freed_blocks() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: mallopt may be called at any time and takes plain numbers. With refused values, it changes nothing.
    #[allow(unsafe_code)] // argued above
    unsafe {
        libc::mallopt(libc::M_MMAP_THRESHOLD, MAPPED_BYTES);
        libc::mallopt(libc::M_TRIM_THRESHOLD, MAPPED_BYTES);
    }
}

/// Returns the whole pages of memory within freed blocks below 4 MiB to the system: for a part of a run that gave up many of
/// them to a part that needs large ones. Takes milliseconds. Without glibc, it does nothing.
pub fn return_small_blocks() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: malloc_trim may be called at any time, and moves no block in use.
    #[allow(unsafe_code)] // argued above
    unsafe {
        libc::malloc_trim(0);
    }
}

#[cfg(all(test, target_os = "linux", target_env = "gnu"))]
mod tests {
    use super::*;

    /// Resident size of this process, KiB.
    fn resident_kib() -> u64 {
        let text = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
        let line = text.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap_or_default();
        line.trim().trim_end_matches("kB").trim().parse().unwrap_or_default()
    }

    #[test]
    fn a_freed_block_returns_to_the_system_after_a_larger_one_was_freed() {
        return_freed_blocks();
        drop(std::hint::black_box(vec![1u8; 31 << 20]));
        let block = std::hint::black_box(vec![1u8; 16 << 20]);
        let full = resident_kib();
        // Else the block is the last of the heap, which returns without any setting.
        let behind = std::hint::black_box(vec![1u8; 100_000]);
        drop(block);
        let left = resident_kib();
        // Other tests of this process take less than 1 MiB meanwhile.
        assert!(left + (15 << 10) <= full, "{full} KiB with a block of 16 MiB, {left} KiB without");
        drop(behind);
    }
}
