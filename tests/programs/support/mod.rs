//! Small scenes, EXIF data, the programs as processes, a browser, small drives, limits on memory, a device.

#[path = "../../support/bench.rs"]
pub mod bench;
pub mod browser;
#[path = "../../support/exif.rs"]
pub mod exif;
#[cfg(unix)]
#[allow(dead_code)] // the storage tests use all of it
#[path = "../../support/faulty_engine.rs"]
pub mod faulty_engine;
#[path = "../../support/gpu.rs"]
pub mod gpu;
#[path = "../../support/lookalike.rs"]
pub mod lookalike;
#[path = "../../support/lpips.rs"]
pub mod lpips;
#[cfg(target_os = "linux")]
#[allow(dead_code)] // the benchmarks use all of it
#[path = "../../../benches/support/memory_group.rs"]
pub mod memory_group;
#[path = "../../support/scenes.rs"]
pub mod scenes;
#[path = "../../support/shared.rs"]
pub mod shared;
#[cfg(unix)]
pub mod small_drive;
pub mod workdir;

/// `None` where no device opens, after a printed skip.
pub fn a_device() -> Option<()> {
    gpu::open(&gsscale::gpu::GpuOptions::default()).map(drop)
}
