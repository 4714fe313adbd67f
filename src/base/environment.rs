//! The environment of the process, before it starts threads.
//!
//! Not here: reading settings. gsscale has none in the environment but those that imitate hardware in tests and measurements
//! (`gpu`: faults, a slower bus).

/// Keeps Wayland's library quiet, which a Vulkan driver may use: without `XDG_RUNTIME_DIR`, as in containers and services,
/// it prints `error: XDG_RUNTIME_DIR is invalid or not set` for a program that opens no window. Sets the variable to a
/// folder that does not exist, so no server is found there. Call this first in `main`; later, or on systems other than
/// Linux, it does nothing.
pub fn quiet_wayland() {
    #[cfg(target_os = "linux")]
    if std::env::var_os("XDG_RUNTIME_DIR").is_none() && has_one_thread() {
        // SAFETY: the process has one thread, this one, so nothing reads the environment meanwhile.
        #[allow(unsafe_code)] // argued above
        unsafe {
            std::env::set_var("XDG_RUNTIME_DIR", "/nonexistent");
        }
    }
}

#[cfg(target_os = "linux")]
fn has_one_thread() -> bool {
    std::fs::read_dir("/proc/self/task").is_ok_and(|tasks| tasks.count() == 1)
}
