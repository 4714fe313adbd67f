//! Opens a device for tests: the best adapter, or a software adapter.

use gsscale::gpu::{DeviceChoice, Gpu, GpuError, GpuOptions};

/// Opens a device. Without any adapter a test has nothing to do and says so; in CI (`CI` is set) that fails.
pub fn open(options: &GpuOptions) -> Option<Gpu> {
    match Gpu::open_with(&DeviceChoice::Gpu, options) {
        Ok(gpu) => Some(gpu),
        Err(GpuError::NoSuchDevice { found, .. }) if std::env::var_os("CI").is_none() => {
            eprintln!("skipped: no usable GPU adapter (found: {found}); mesa-vulkan-drivers has a software one");
            None
        }
        Err(error) => panic!("{error}"),
    }
}
