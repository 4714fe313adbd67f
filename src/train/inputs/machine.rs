//! What a run takes of its machine: worker threads, instruction path and renderer by the config, once, before other work; and folders on
//! the drives of its paths.

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
use std::path::{Path, PathBuf};

/// Most worker threads per core, and how many are started on any machine if asked for.
const THREADS_PER_CORE: usize = 4;
const THREADS_LEAST_BOUND: usize = 32;

/// Starts the worker threads of `config`, checks its instruction path, and makes a file size limit an ordinary error.
/// Errors: this machine lacks the instructions.
pub fn set_up(config: &TrainConfig) -> InputResult<()> {
    super::signals::survive_file_size_limit();
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
        Ok(renderer) => accept_or_refuse(choice, renderer, difference_from_cpu(choice)),
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

/// The first difference between the device and the CPU, found in about a second. The device is opened for this comparison alone, so that
/// nothing of it stays on the run's device. A software driver is compared only if `GSSCALE_CHECK_DEVICE` is set: the tests compare every
/// stage on software drivers.
#[cfg(feature = "gpu")]
fn difference_from_cpu(choice: &DeviceChoice) -> Option<String> {
    let gpu = Gpu::open_with(choice, &GpuOptions::default()).ok()?;
    if gpu.summary().kind == DeviceKind::Software && std::env::var_os("GSSCALE_CHECK_DEVICE").is_none() {
        return None;
    }
    device_check::check(&mut GpuRenderer::new(gpu).ok()?).err()
}

/// The renderer of the device, if no `difference` from the CPU was found. Otherwise the CPU renders for `auto`, with a message.
/// Errors: a difference was found on a device that the user named.
#[cfg(feature = "gpu")]
fn accept_or_refuse(
    choice: &DeviceChoice,
    renderer: Box<dyn Renderer>,
    difference: Option<String>,
) -> InputResult<(Box<dyn Renderer>, Option<String>)> {
    let Some(difference) = difference else { return Ok((renderer, None)) };
    let problem = format!("the GPU did not pass the comparison with the CPU: {difference}");
    if *choice == DeviceChoice::Auto {
        return Ok((Box::new(CpuRenderer::new()), Some(format!("the CPU renders: {problem}"))));
    }
    let remedy = "use --device cpu; an update of the driver may help, and gsscale-bench doctor tells more";
    Err(InputError::new("--device", problem, remedy))
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

#[cfg(all(test, feature = "gpu"))]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;

    #[test]
    fn a_gpu_that_differs_from_the_cpu_is_refused_or_with_auto_replaced() {
        let differs = || Some("stage sh_fwd".to_string());
        let of = |choice, wrong| accept_or_refuse(&choice, Box::new(CpuRenderer::new()), wrong);
        assert_eq!(of(DeviceChoice::Gpu, None).unwrap().1, None);
        let (renderer, message) = of(DeviceChoice::Auto, differs()).unwrap();
        assert!(renderer.name() == CpuRenderer::new().name() && message.unwrap().contains("stage sh_fwd"));
        for asked in [DeviceChoice::Gpu, DeviceChoice::Named("card".into())] {
            let refusal = of(asked, differs()).err().unwrap().to_string();
            assert!(refusal.contains("stage sh_fwd") && refusal.contains("--device cpu"), "{refusal}");
        }
    }
}
