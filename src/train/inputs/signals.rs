//! Signals: the first Ctrl-C or SIGTERM asks the loop to stop after its step, the second ends the process at once.
//! SIGXFSZ (file size limit) is ignored.

use signal_hook::consts::{SIGINT, SIGTERM};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

/// Turns writes beyond the file size limit into I/O errors, instead of ending the process.
pub fn survive_file_size_limit() {
    // If the system refuses the handler, the default action stays.
    #[cfg(unix)]
    let _ = signal_hook::flag::register(signal_hook::consts::SIGXFSZ, Arc::default());
}

/// The stop request of the process, with its signal.
#[derive(Debug, Clone, Default)]
pub struct StopFlag {
    signal: Arc<AtomicUsize>,
    asked: Arc<AtomicBool>,
}

impl StopFlag {
    /// Installs the handlers. A second signal ends the process with exit code 130 or 143.
    ///
    /// # Errors
    /// The system refused a handler.
    pub fn listen() -> std::io::Result<StopFlag> {
        let flag = StopFlag::default();
        for (signal, code) in [(SIGINT, 130), (SIGTERM, 143)] {
            // Register this handler first, so that it sees the flag of an earlier signal, not its own.
            signal_hook::flag::register_conditional_shutdown(signal, code, Arc::clone(&flag.asked))?;
            signal_hook::flag::register(signal, Arc::clone(&flag.asked))?;
            signal_hook::flag::register_usize(signal, Arc::clone(&flag.signal), signal as usize)?;
        }
        Ok(flag)
    }

    /// Exit code of the stop request, 130 or 143; `None` without a request.
    pub fn exit_code(&self) -> Option<i32> {
        match self.signal.load(Ordering::Relaxed) as i32 {
            0 => None,
            signal => Some(128 + signal),
        }
    }
}
