//! What a run takes of its machine: worker threads, instruction path and renderer by the config, once, before other work; folders on the
//! drives of its paths; and signals.
//!
//! The first Ctrl-C, SIGTERM or SIGHUP (the terminal is gone) asks the loop to stop after its step, the second ends the process at once.
//! SIGHUP is left alone where it was ignored when the process began, as under `nohup`. SIGXFSZ (file size limit) is ignored.

use crate::base::error::{InputError, InputResult};
use crate::config::file::TrainConfig;
use crate::config::limits::simd_path;
use crate::config::values::Device;
use crate::gpu::DeviceChoice;
#[cfg(feature = "gpu")]
use crate::gpu::{DeviceKind, Gpu, GpuError, GpuOptions, GpuResult};
use crate::render::Renderer;
use crate::render::cpu::CpuRenderer;
#[cfg(feature = "gpu")]
use crate::render::device_check;
#[cfg(feature = "gpu")]
use crate::render::gpu::GpuRenderer;
use signal_hook::consts::{SIGINT, SIGTERM};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

/// Most worker threads per core, and how many are started on any machine if asked for.
const THREADS_PER_CORE: usize = 4;
const THREADS_LEAST_BOUND: usize = 32;

/// Starts the worker threads of `config`, checks its instruction path, and makes a file size limit an ordinary error.
/// Errors: this machine lacks the instructions.
pub fn set_up(config: &TrainConfig) -> InputResult<()> {
    survive_file_size_limit();
    if config.threads > 0 {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let (asked, most) = (config.threads as usize, THREADS_LEAST_BOUND.max(THREADS_PER_CORE * cores));
        if asked > most {
            crate::tell!(
                "warning: --threads {asked}: {most} are started, since this machine has {cores} cores and every thread \
                 takes memory; the result does not depend on them"
            );
        }
        // An existing pool (of a library user) stays in use: results do not depend on it.
        let _ = rayon::ThreadPoolBuilder::new().num_threads(asked.min(most)).build_global();
    }
    let path = simd_path(config);
    if path.is_supported() {
        return Ok(());
    }
    let problem = format!("this machine cannot run {}", path.name());
    Err(InputError::new("--simd", problem, "use --simd auto"))
}

/// The renderer of `--device`, and a message about the choice. `auto` uses a working hardware GPU, else the CPU; it
/// never uses a software adapter, since the CPU renderer is faster.
/// Errors: the named device does not exist or cannot be used.
pub fn renderer(config: &TrainConfig) -> InputResult<(Box<dyn Renderer>, Option<String>)> {
    match &config.device {
        Device::Cpu => Ok((Box::new(CpuRenderer::new()), None)),
        Device::Gpu(choice) => of_gpu(config, choice),
    }
}

/// Without GPU support `auto` means the CPU.
#[cfg(not(feature = "gpu"))]
fn of_gpu(_: &TrainConfig, choice: &DeviceChoice) -> InputResult<(Box<dyn Renderer>, Option<String>)> {
    if *choice == DeviceChoice::Auto {
        return Ok((Box::new(CpuRenderer::new()), None));
    }
    let problem = "this program was built without GPU support";
    Err(InputError::new("--device", problem, "use --device cpu, or build with the feature gpu (it is on by default)"))
}

#[cfg(feature = "gpu")]
fn of_gpu(config: &TrainConfig, choice: &DeviceChoice) -> InputResult<(Box<dyn Renderer>, Option<String>)> {
    let budget = (config.device_mem.0 > 0).then_some(config.device_mem.0);
    let opened = Gpu::open_with(choice, &GpuOptions { budget, ..GpuOptions::default() }).and_then(gpu_renderer);
    match opened {
        Ok(renderer) => match wrong_stage(choice) {
            None => Ok((renderer, None)),
            Some(wrong) if *choice == DeviceChoice::Auto => Ok((
                Box::new(CpuRenderer::new()),
                Some(format!("the CPU renders, since the GPU computes wrongly: {wrong}")),
            )),
            Some(wrong) => {
                let problem = format!("this GPU or its driver computes wrongly: {wrong}");
                let remedy = "use --device cpu; an update of the driver may help, and gsscale-bench doctor tells more";
                Err(InputError::new("--device", problem, remedy))
            }
        },
        Err(GpuError::NoHardwareGpu { .. }) => {
            let word = "there is no hardware GPU: the CPU renders (--list-devices shows what was found)";
            Ok((Box::new(CpuRenderer::new()), Some(word.to_string())))
        }
        Err(error) if *choice == DeviceChoice::Auto => {
            let word = format!("the GPU cannot be used, so the CPU renders: {error}");
            Ok((Box::new(CpuRenderer::new()), Some(word)))
        }
        Err(GpuError::NoSuchDevice { wanted, found }) => {
            let problem = format!("no usable GPU matches '{wanted}'; found: {found}");
            Err(InputError::new("--device", problem, "choose one of --list-devices, or use --device cpu"))
        }
        Err(error) => Err(InputError::new("--device", error.to_string(), "use --device cpu")),
    }
}

/// The first difference between the device and the CPU, found in about a second, on an opened device of its own: the check leaves nothing
/// on that of the run. Drivers in software are those of the tests, which compare every stage, and are not checked unless
/// `GSSCALE_CHECK_DEVICE` is set.
#[cfg(feature = "gpu")]
fn wrong_stage(choice: &DeviceChoice) -> Option<String> {
    let gpu = Gpu::open_with(choice, &GpuOptions::default()).ok()?;
    if gpu.summary().kind == DeviceKind::Software && std::env::var_os("GSSCALE_CHECK_DEVICE").is_none() {
        return None;
    }
    device_check::check(&mut GpuRenderer::new(gpu).ok()?).err()
}

#[cfg(feature = "gpu")]
fn gpu_renderer(gpu: Gpu) -> GpuResult<Box<dyn Renderer>> {
    Ok(Box::new(GpuRenderer::new(gpu)?))
}

/// The nearest existing folder above the spill directory, for unnamed temporary files on its drive. The spill directory
/// itself may not exist yet and must stay empty.
pub(crate) fn folder_beside(spill_dir: &Path) -> PathBuf {
    let above = spill_dir.ancestors().skip(1).find(|folder| folder.is_dir());
    above.map_or_else(|| PathBuf::from("."), Path::to_path_buf)
}

/// An existing folder on the drive of the spill directory: itself, or the nearest folder above it.
pub(crate) fn drive_of(spill_dir: &Path) -> PathBuf {
    if spill_dir.is_dir() { spill_dir.to_path_buf() } else { folder_beside(spill_dir) }
}

/// The absolute form of a path.
pub(crate) fn absolute(path: &Path) -> PathBuf {
    std::path::absolute(path).unwrap_or_else(|_| path.to_path_buf())
}

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
    /// Installs the handlers. A second signal ends the process with exit code 129, 130 or 143.
    /// Errors: the system refused a handler.
    pub fn listen() -> std::io::Result<StopFlag> {
        let flag = StopFlag::default();
        let mut signals = vec![(SIGINT, 130), (SIGTERM, 143)];
        #[cfg(unix)]
        if !is_ignored(signal_hook::consts::SIGHUP) {
            signals.push((signal_hook::consts::SIGHUP, 129));
        }
        for (signal, code) in signals {
            // Register this handler first, so that it sees the flag of an earlier signal, not its own.
            signal_hook::flag::register_conditional_shutdown(signal, code, Arc::clone(&flag.asked))?;
            signal_hook::flag::register(signal, Arc::clone(&flag.asked))?;
            signal_hook::flag::register_usize(signal, Arc::clone(&flag.signal), signal as usize)?;
        }
        Ok(flag)
    }

    /// Exit code of the stop request, 129, 130 or 143; `None` without a request.
    pub fn exit_code(&self) -> Option<i32> {
        match self.signal.load(Ordering::Relaxed) as i32 {
            0 => None,
            signal => Some(128 + signal),
        }
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
