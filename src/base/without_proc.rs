//! What systems without `/proc` tell about memory and CPU time, by the `sysinfo` library. Linux tells it in files
//! ([`crate::base::machine`]), so that this file is empty there.

#[cfg(not(target_os = "linux"))]
use sysinfo::{MemoryRefreshKind, Process, ProcessRefreshKind, ProcessesToUpdate, RefreshKind, System};

/// Memory that programs can still allocate, bytes; `None` on Linux, and if the system does not tell.
pub fn memory_available() -> Option<u64> {
    #[cfg(not(target_os = "linux"))]
    {
        let memory = RefreshKind::nothing().with_memory(MemoryRefreshKind::nothing().with_ram());
        let bytes = System::new_with_specifics(memory).ok()?.available_memory();
        return Some(bytes).filter(|&bytes| bytes > 0);
    }
    #[cfg(target_os = "linux")]
    None
}

/// Resident size of this process, bytes; `None` as for [`memory_available`].
pub fn host_bytes_now() -> Option<u64> {
    #[cfg(not(target_os = "linux"))]
    return of_this_process(ProcessRefreshKind::nothing().with_memory(), Process::memory);
    #[cfg(target_os = "linux")]
    None
}

/// CPU seconds of all threads of this process; `None` as for [`memory_available`].
pub fn process_cpu_seconds() -> Option<f64> {
    #[cfg(not(target_os = "linux"))]
    return of_this_process(ProcessRefreshKind::nothing().with_cpu(), Process::accumulated_cpu_time)
        .map(|ms| ms as f64 / 1e3);
    #[cfg(target_os = "linux")]
    None
}

#[cfg(not(target_os = "linux"))]
fn of_this_process<T>(what: ProcessRefreshKind, read: impl FnOnce(&Process) -> T) -> Option<T> {
    let process = sysinfo::get_current_pid().ok()?;
    let mut system = System::new_with_specifics(RefreshKind::nothing()).ok()?;
    system.refresh_processes_specifics(ProcessesToUpdate::Some(&[process]), false, what);
    system.process(process).map(read)
}
