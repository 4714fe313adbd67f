//! What a config asks of the machine: worker threads and the instruction path. Done once, before any work.

use crate::base::error::{InputError, InputResult};
use crate::config::file::TrainConfig;
use crate::config::limits::simd_path;

/// Starts the worker threads that `config` asks for and checks its instruction path.
///
/// # Errors
/// This machine lacks the instructions.
pub fn set_up(config: &TrainConfig) -> InputResult<()> {
    if config.threads > 0 {
        // A pool that exists already (a library user's) is kept: results do not depend on it.
        let _ = rayon::ThreadPoolBuilder::new().num_threads(config.threads as usize).build_global();
    }
    let path = simd_path(config);
    if path.is_supported() {
        return Ok(());
    }
    let problem = format!("this machine cannot run {}", path.name());
    Err(InputError::new("--simd", problem, "use --simd auto"))
}
