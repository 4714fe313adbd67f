//! Ctrl-C and SIGTERM: the first asks the loop to finish its step, the second ends the process at once. And the signal
//! about a file that is too large, which ends nothing.

use signal_hook::consts::{SIGINT, SIGTERM};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

/// Writing a file beyond the size that this process may write is an error that can be told, and not its end.
pub fn survive_file_size_limit() {
    // Where the system refuses the handler, its own stays.
    #[cfg(unix)]
    let _ = signal_hook::flag::register(signal_hook::consts::SIGXFSZ, Arc::default());
}

/// Whether, and by which signal, the process was asked to stop.
#[derive(Debug, Clone, Default)]
pub struct StopFlag {
    signal: Arc<AtomicUsize>,
    asked: Arc<AtomicBool>,
}

impl StopFlag {
    /// Starts listening. A signal after the first ends the process with the shell's code for it.
    ///
    /// # Errors
    /// The system refused a handler.
    pub fn listen() -> std::io::Result<StopFlag> {
        let flag = StopFlag::default();
        for (signal, code) in [(SIGINT, 130), (SIGTERM, 143)] {
            // Registered first, so it sees the flag that an earlier signal set, not its own.
            signal_hook::flag::register_conditional_shutdown(signal, code, Arc::clone(&flag.asked))?;
            signal_hook::flag::register(signal, Arc::clone(&flag.asked))?;
            signal_hook::flag::register_usize(signal, Arc::clone(&flag.signal), signal as usize)?;
        }
        Ok(flag)
    }

    /// The exit code of the signal that asked for a stop, if one did: 130 or 143.
    pub fn exit_code(&self) -> Option<i32> {
        match self.signal.load(Ordering::Relaxed) as i32 {
            0 => None,
            signal => Some(128 + signal),
        }
    }
}
