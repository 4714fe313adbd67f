//! What a run takes of its machine: worker threads, instruction path and renderer by the config, once, before other work; and folders on
//! the drives of its paths.

use crate::base::error::{InputError, InputResult};
use crate::base::machine::host_bytes_now;
use crate::config::file::TrainConfig;
use crate::config::limits::simd_path;
use crate::config::values::Device;
use crate::gpu::{DeviceChoice, DeviceKind, Gpu, GpuError, GpuOptions};
use crate::optim::method::OptimizerPlace;
use crate::optim::moments::Moments;
use crate::render::cpu::CpuRenderer;
use crate::render::device_check::{self, DeviceVerdict};
use crate::render::gpu::GpuRenderer;
use crate::render::{RenderError, Renderer};
use crate::train::error::TrainError;
use crate::train::inputs::page_check;
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

/// The renderer of a run.
pub struct OpenedDevice {
    pub renderer: Box<dyn Renderer>,
    /// A message about the choice.
    pub word: Option<String>,
    /// Host memory that drivers took, bytes.
    pub driver: u64,
}

impl OpenedDevice {
    fn cpu(word: Option<&str>) -> OpenedDevice {
        OpenedDevice { renderer: Box::new(CpuRenderer::new()), word: word.map(str::to_string), driver: 0 }
    }
}

/// What a renderer is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DeviceUse {
    Training,
    /// Pictures alone: no pages are updated.
    Pictures,
}

/// The renderer of `--device`. `auto` uses a working hardware GPU, else the CPU; it never uses a software adapter, since the
/// CPU renderer is faster.
/// Errors: the named device does not exist, cannot be used, or differs from the CPU; a device was lost.
pub fn renderer(config: &TrainConfig, device_use: DeviceUse) -> Result<OpenedDevice, TrainError> {
    match &config.device {
        Device::Cpu => Ok(OpenedDevice::cpu(None)),
        // A search for a device leaves drivers in the process, whatever comes of it.
        Device::Gpu(choice) => {
            let before = host_bytes_now().unwrap_or(0);
            let opened = of_gpu(config, choice, device_use)?;
            Ok(OpenedDevice { driver: host_bytes_now().unwrap_or(0).saturating_sub(before), ..opened })
        }
    }
}

fn of_gpu(config: &TrainConfig, choice: &DeviceChoice, device_use: DeviceUse) -> Result<OpenedDevice, TrainError> {
    let is_auto = *choice == DeviceChoice::Auto;
    let updates_pages = device_use == DeviceUse::Training && config.optimizer_on.0 == Some(OptimizerPlace::Device);
    match difference_from_cpu(choice, updates_pages.then_some(config.moments)) {
        Ok(Some(difference)) => return without_device(choice, &difference),
        Ok(None) => {}
        Err(error @ RenderError::Device(GpuError::DeviceLost { .. })) => return Err(error.into()),
        // What keeps the run from its device as well is said below.
        Err(error) => crate::tell!("warning: the GPU is used without a comparison with the CPU: {error}"),
    }
    let budget = (config.device_mem.0 > 0).then_some(config.device_mem.0);
    let renderer = Gpu::open_with(choice, &GpuOptions { budget, ..GpuOptions::default() }).and_then(GpuRenderer::new);
    match renderer {
        Ok(renderer) => Ok(OpenedDevice { renderer: Box::new(renderer), ..OpenedDevice::cpu(None) }),
        Err(GpuError::NoHardwareGpu { .. }) => Ok(OpenedDevice::cpu(Some(
            "there is no hardware GPU: the CPU renders (gsscale-train --list-devices shows what was found)",
        ))),
        Err(error) if is_auto => {
            Ok(OpenedDevice::cpu(Some(&format!("the GPU cannot be used, so the CPU renders: {error}"))))
        }
        Err(GpuError::NoSuchDevice { wanted, found }) => {
            let problem = format!("no usable GPU matches '{wanted}'; found: {found}");
            let remedy = match found.as_str() {
                "none" => "install the Vulkan driver of your GPU, or use --device cpu",
                _ => "choose one of gsscale-train --list-devices, or use --device cpu",
            };
            Err(InputError::new("--device", problem, remedy).into())
        }
        Err(error) => Err(InputError::new("--device", error.to_string(), "use --device cpu").into()),
    }
}

/// In place of a device that differs from the CPU: the CPU for `auto`, with a warning.
/// Errors: the user asked for the device, or for pages on it.
fn without_device(choice: &DeviceChoice, difference: &Difference) -> Result<OpenedDevice, TrainError> {
    let problem = format!("the GPU did not pass the comparison with the CPU: {}", difference.problem);
    if difference.is_of_pages {
        return Err(InputError::new("--optimizer-on device", problem, "use --optimizer-on host").into());
    }
    if *choice == DeviceChoice::Auto {
        crate::tell!("warning: the CPU renders: {problem}");
        return Ok(OpenedDevice::cpu(None));
    }
    let remedy = "use --device cpu; an update of the driver may help, and gsscale-bench doctor tells more";
    Err(InputError::new("--device", problem, remedy).into())
}

/// What a device computes otherwise than the CPU.
struct Difference {
    problem: String,
    /// Only the stages on pages differ.
    is_of_pages: bool,
}

/// The first difference between the device and the CPU, found in about a second; of the optimizer as well, with these moments, if the device
/// updates pages. The device is opened for this alone and closed
/// before the run opens it, so that nothing of the comparison stays on it. A software driver is compared only if
/// `GSSCALE_CHECK_DEVICE` is set: the tests compare every stage on software drivers. A device that cannot be opened is not
/// compared: opening it for the run says why.
/// Errors: those of the device, which say nothing about its results.
fn difference_from_cpu(choice: &DeviceChoice, of_pages: Option<Moments>) -> Result<Option<Difference>, RenderError> {
    let Ok(gpu) = Gpu::open_with(choice, &GpuOptions::default()) else { return Ok(None) };
    if gpu.summary().kind == DeviceKind::Software && std::env::var_os("GSSCALE_CHECK_DEVICE").is_none() {
        return Ok(None);
    }
    let mut device = GpuRenderer::new(gpu)?;
    if let DeviceVerdict::Differs(problem) = device_check::check(&mut device)? {
        return Ok(Some(Difference { problem, is_of_pages: false }));
    }
    let Some(moments) = of_pages else { return Ok(None) };
    match page_check::check(&mut device, moments) {
        Ok(problem) => Ok(problem.map(|problem| Difference { problem, is_of_pages: true })),
        Err(error @ RenderError::Device(GpuError::DeviceLost { .. })) => Err(error),
        Err(error) => {
            crate::tell!("warning: pages on the GPU are used without a comparison with the CPU: {error}");
            Ok(None)
        }
    }
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

pub fn absolute(path: &Path) -> PathBuf {
    std::path::absolute(path).unwrap_or_else(|_| path.to_path_buf())
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;

    #[test]
    fn a_gpu_that_differs_from_the_cpu_is_refused_or_with_auto_replaced() {
        let of = |choice| without_device(&choice, &Difference { problem: "stage sh_fwd".into(), is_of_pages: false });
        assert_eq!(of(DeviceChoice::Auto).unwrap().renderer.name(), CpuRenderer::new().name());
        for asked in [DeviceChoice::Gpu, DeviceChoice::Named("card".into())] {
            let refusal = of(asked).err().unwrap().to_string();
            assert!(refusal.contains("stage sh_fwd") && refusal.contains("--device cpu"), "{refusal}");
        }
    }
}
