//! What a config asks of the machine: worker threads, the instruction path, and what renders. Done once, before any
//! work.

use crate::base::error::{InputError, InputResult};
use crate::config::choice::Device;
use crate::config::file::TrainConfig;
use crate::config::limits::simd_path;
use crate::gpu::{DeviceChoice, Gpu, GpuError, GpuOptions, GpuResult};
use crate::render::Renderer;
use crate::render::cpu::CpuRenderer;
use crate::render::gpu::GpuRenderer;

/// Starts the worker threads that `config` asks for, checks its instruction path, and sees to it that a limit on the
/// size of files is an error like others.
///
/// # Errors
/// This machine lacks the instructions.
pub fn set_up(config: &TrainConfig) -> InputResult<()> {
    super::signals::survive_file_size_limit();
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

/// The renderer that `--device` asks for, and what is to be said about the choice. `auto` takes a hardware GPU if there
/// is one that works, else the CPU, never a software adapter: the CPU renderer is the faster one then.
///
/// # Errors
/// The device that was asked for does not exist or cannot be used.
pub fn renderer(config: &TrainConfig) -> InputResult<(Box<dyn Renderer>, Option<String>)> {
    let choice = match &config.device {
        Device::Cpu => return Ok((Box::new(CpuRenderer::new()), None)),
        Device::Gpu(choice) => choice,
    };
    let budget = (config.device_mem.0 > 0).then_some(config.device_mem.0);
    let opened = Gpu::open_with(choice, &GpuOptions { budget, ..GpuOptions::default() }).and_then(gpu_renderer);
    match opened {
        Ok(renderer) => Ok((renderer, None)),
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

fn gpu_renderer(gpu: Gpu) -> GpuResult<Box<dyn Renderer>> {
    Ok(Box::new(GpuRenderer::new(gpu)?))
}
