//! Signals: Ctrl-C, SIGTERM or SIGHUP (the terminal is gone) asks the loop to stop after its step. Ctrl-C after that ends the process at
//! once. Another SIGTERM does not: schedulers send it to a whole job, whose script forwards it. The flag is one for the whole process: a signal
//! between two runs stops the second. SIGHUP is left alone where it was ignored when the process began, as under `nohup`. SIGXFSZ (file
//! size limit) is ignored.

use crate::base::error::{InputError, InputResult};
use signal_hook::consts::{SIGINT, SIGTERM};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

/// Turns writes beyond the file size limit into I/O errors, instead of ending the process.
pub fn survive_file_size_limit() {
    // If the system refuses the handler, the default action stays.
    #[cfg(unix)]
    let _ = signal_hook::flag::register(signal_hook::consts::SIGXFSZ, Arc::default());
}

/// Exit code of a run whose steps were ended by its deadline.
pub const DEADLINE_CODE: i32 = 75;

/// The stop request of the process, with its signal.
#[derive(Debug, Clone, Default)]
pub struct StopFlag {
    deadline: Option<Instant>,
    signal: Arc<AtomicUsize>,
    asked: Arc<AtomicBool>,
}

impl StopFlag {
    /// The flag of this process; installs the handlers when first called. Ctrl-C behind another signal ends the process with exit
    /// code 130.
    /// Errors: the system refused a handler.
    pub fn listen() -> std::io::Result<StopFlag> {
        static OF_PROCESS: Mutex<Option<StopFlag>> = Mutex::new(None);
        let mut of_process = OF_PROCESS.lock().unwrap_or_else(PoisonError::into_inner);
        let flag = of_process.take().map_or_else(StopFlag::install, Ok)?;
        Ok(of_process.insert(flag).clone())
    }

    fn install() -> std::io::Result<StopFlag> {
        let flag = StopFlag::default();
        #[cfg_attr(not(unix), expect(unused_mut))]
        let mut signals = vec![SIGINT, SIGTERM];
        #[cfg(unix)]
        if !is_ignored(signal_hook::consts::SIGHUP) {
            signals.push(signal_hook::consts::SIGHUP);
        }
        // First, so that the handler sees the flag of an earlier signal, not its own.
        signal_hook::flag::register_conditional_shutdown(SIGINT, 130, Arc::clone(&flag.asked))?;
        for signal in signals {
            signal_hook::flag::register(signal, Arc::clone(&flag.asked))?;
            signal_hook::flag::register_usize(signal, Arc::clone(&flag.signal), signal as usize)?;
        }
        Ok(flag)
    }

    /// The flag with a time after which no step shall begin.
    #[must_use]
    pub fn with_deadline(self, deadline: Option<Instant>) -> StopFlag {
        StopFlag { deadline, ..self }
    }

    /// Exit code of the stop request, 129, 130 or 143; `None` without a request.
    pub fn exit_code(&self) -> Option<i32> {
        match self.signal.load(Ordering::Relaxed) as i32 {
            0 => None,
            signal => Some(128 + signal),
        }
    }

    /// Errors: somebody has asked the process to stop.
    pub fn check(&self) -> InputResult<()> {
        if self.exit_code().is_none() {
            return Ok(());
        }
        Err(InputError::new("signal", "the command was stopped, and has removed what it had written", "give it again"))
    }

    /// Whether the deadline has passed. It ends steps alone: what follows the last step is never cut short by it.
    pub fn is_late(&self) -> bool {
        self.deadline.is_some_and(|at| Instant::now() >= at)
    }
}

/// Whether the process was started with this signal ignored.
#[cfg(unix)]
#[allow(unsafe_code)]
fn is_ignored(signal: i32) -> bool {
    let mut action = std::mem::MaybeUninit::<libc::sigaction>::zeroed();
    // SAFETY: without a new action the call only writes the current one to memory that is large enough for it.
    let answer = unsafe { libc::sigaction(signal, std::ptr::null(), action.as_mut_ptr()) };
    // SAFETY: zeros are a valid `sigaction`, and the call wrote at most a valid one over them.
    answer == 0 && unsafe { action.assume_init() }.sa_sigaction == libc::SIG_IGN
}
