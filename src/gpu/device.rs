//! Chooses and opens a device; the handle that all GPU work uses.
//!
//! Invariants: (1) discrete GPUs come before integrated ones, both before software adapters; (2) every limit that the
//! shaders need is requested, and an adapter with less is refused with the name of the limit; (3) no call here panics.

use std::fmt;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use super::belt::Belt;
use super::buffers::{Buffer, Pool};
use super::error::{Faults, GpuError, GpuResult};
use super::injected::{InjectedFault, Injector};
use super::profile::Profiler;
use super::readback::Staging;
use super::record::UniformRing;
use super::shader::PipelineCache;

/// Storage buffers that a stage may use.
const STORAGE_BUFFERS_NEEDED: u32 = 16;
/// Workgroup memory that every shader may use, bytes; up to twice this is requested if the adapter has it.
const WORKGROUP_STORAGE_NEEDED: u32 = 16 << 10;
/// Smallest accepted limit on bindings, bytes: the WebGPU default.
const BINDING_NEEDED: u64 = 128 << 20;
/// Largest binding used, bytes: the API's cap is 2^31-1, and windows must start at aligned offsets.
const BINDING_MAX: u64 = (1 << 31) - 256;

/// The device that the user requests.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum DeviceChoice {
    /// The best hardware GPU; [`GpuError::NoHardwareGpu`] if there is none.
    Auto,
    /// The best adapter, even a software one.
    Gpu,
    /// The best adapter whose name contains this text, ignoring case.
    Named(String),
}

/// Options that a test or the user's budget sets.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct GpuOptions {
    /// Lowers the largest binding, bytes.
    pub max_binding_bytes: Option<u64>,
    /// Lowers the number of rows of a column window.
    pub window_rows: Option<u64>,
    /// Waits for each submission before continuing: the baseline in tests of overlap.
    pub serial: bool,
    /// `Some(false)` disables subgroup operations.
    pub subgroups: Option<bool>,
    /// `Some(false)` disables the path for adapters whose subgroups all have 8 invocations, in favour of the general
    /// one.
    pub subgroups_of_8: Option<bool>,
    /// Most device memory to allocate, bytes (`--device-mem`); `None`: no limit.
    pub budget: Option<u64>,
    /// Measures the time of every stage, if the adapter can.
    pub profile: bool,
    /// Whether shaders read uniforms as uniform blocks (`Some(true)`) or as storage; `None`: as storage on software
    /// adapters.
    ///
    /// Mesa's lavapipe specialises a shader for the uniform values that decide branches, once per set of values, and
    /// keeps every variant as long as the pipeline: a view with new counts then costs time and some 100 KB of host
    /// memory that are never freed.
    pub uniform_blocks: Option<bool>,
    /// A fault to inject; `None`: the one that the environment variable `GSSCALE_GPU_FAULT` requests, if any.
    pub fault: Option<InjectedFault>,
}

/// Kind of an adapter, best first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum DeviceKind {
    /// Has memory of its own.
    Discrete,
    /// Shares the processor's memory.
    Integrated,
    /// A virtual machine's, or of unknown kind.
    Other,
    /// A software renderer on the processor.
    Software,
}

/// One adapter, as `--list-devices` shows it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AdapterSummary {
    /// Name given by the driver.
    pub name: String,
    /// Kind.
    pub kind: DeviceKind,
    /// Graphics API and driver.
    pub backend: String,
    /// Largest binding, bytes.
    pub max_binding_bytes: u64,
    /// Largest buffer, bytes.
    pub max_buffer_bytes: u64,
    /// Workgroup memory, bytes.
    pub workgroup_storage_bytes: u32,
    /// Smallest and largest subgroup, if subgroup operations exist.
    pub subgroup_sizes: Option<(u32, u32)>,
    /// Whether stages can be timed.
    pub timestamps: bool,
    /// Why the adapter cannot be used, if so.
    pub refusal: Option<String>,
}

impl fmt::Display for AdapterSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let kind = match self.kind {
            DeviceKind::Discrete => "discrete",
            DeviceKind::Integrated => "integrated",
            DeviceKind::Other => "other",
            DeviceKind::Software => "software",
        };
        write!(
            f,
            "{} ({kind}, {}): bindings up to {} MiB, buffers up to {} MiB, workgroup memory {} KiB",
            self.name,
            self.backend,
            self.max_binding_bytes >> 20,
            self.max_buffer_bytes >> 20,
            self.workgroup_storage_bytes >> 10
        )?;
        match self.subgroup_sizes {
            Some((low, high)) if low == high => write!(f, ", subgroups of {low}")?,
            Some((low, high)) => write!(f, ", subgroups of {low} to {high}")?,
            None => write!(f, ", no subgroup operations")?,
        }
        match &self.refusal {
            Some(reason) => write!(f, "; cannot be used: {reason}"),
            None => Ok(()),
        }
    }
}

/// Traffic over the bus since the device was opened, and memory.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Traffic {
    /// Bytes from the host to the device: uploads and uniforms.
    pub bytes_uploaded: u64,
    /// Bytes from the device to the host.
    pub bytes_read_back: u64,
    /// Device memory of live buffers, bytes.
    pub device_bytes: u64,
    /// Most device memory ever allocated, bytes, including free buffers in the pool.
    pub device_bytes_peak: u64,
    /// Buffers allocated so far: constant once warmed up.
    pub device_allocations: u64,
    /// Host memory of the staging buffers, bytes.
    pub staging_bytes: u64,
}

/// An open device.
pub struct Gpu {
    pub(super) device: wgpu::Device,
    pub(super) queue: wgpu::Queue,
    pub(super) faults: Arc<Faults>,
    pub(super) pipelines: Mutex<PipelineCache>,
    pub(super) belt: Mutex<Belt>,
    pub(super) staging: Arc<Staging>,
    pub(super) uniforms: Mutex<UniformRing>,
    pub(super) profiler: Mutex<Profiler>,
    pub(super) uploaded: AtomicU64,
    pub(super) recorders: Arc<AtomicU32>,
    pub(super) injector: Injector,
    pool: Arc<Pool>,
    summary: AdapterSummary,
    limits: wgpu::Limits,
    max_binding_bytes: u64,
    window_rows: u64,
    pub(super) serial: bool,
    subgroups: bool,
    subgroups_of_8: bool,
    uniform_blocks: bool,
}

impl fmt::Debug for Gpu {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Gpu({})", self.summary)
    }
}

impl Gpu {
    /// Opens the device that `choice` requests, with default options.
    pub fn open(choice: &DeviceChoice) -> GpuResult<Gpu> {
        Gpu::open_with(choice, &GpuOptions::default())
    }

    /// Opens the device that `choice` requests.
    pub fn open_with(choice: &DeviceChoice, options: &GpuOptions) -> GpuResult<Gpu> {
        let (adapter, summary) = choose(choice)?;
        let features = adapter.features();
        let subgroups = features.contains(wgpu::Features::SUBGROUP) && options.subgroups != Some(false);
        let mut wanted = wgpu::Features::empty();
        wanted.set(wgpu::Features::SUBGROUP, subgroups);
        wanted.set(wgpu::Features::TIMESTAMP_QUERY, summary.timestamps && options.profile);
        let limits = limits_to_ask(&adapter.limits());
        let descriptor = wgpu::DeviceDescriptor {
            label: Some("gsscale"),
            required_features: wanted,
            required_limits: limits.clone(),
            ..Default::default()
        };
        let (device, queue) = pollster::block_on(adapter.request_device(&descriptor))
            .map_err(|e| GpuError::Open { device: summary.name.clone(), message: e.to_string() })?;
        let faults = Arc::new(Faults::default());
        let reports = Arc::clone(&faults);
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| reports.report(&error)));
        let losses = Arc::clone(&faults);
        device.set_device_lost_callback(move |_, message| losses.lost(message));
        let own_max = limits.max_storage_buffer_binding_size.min(BINDING_MAX);
        let profiler = Profiler::new(&device, &queue, options.profile && summary.timestamps);
        faults.check()?;
        let alignment = limits.min_uniform_buffer_offset_alignment.max(limits.min_storage_buffer_offset_alignment);
        Ok(Gpu {
            pool: Pool::new(options.budget.unwrap_or(u64::MAX), limits.max_buffer_size),
            pipelines: Mutex::default(),
            belt: Mutex::default(),
            staging: Arc::default(),
            uniforms: Mutex::new(UniformRing::new(u64::from(alignment))),
            profiler: Mutex::new(profiler),
            uploaded: AtomicU64::new(0),
            recorders: Arc::default(),
            injector: Injector::new(options.fault.or_else(InjectedFault::from_environment)),
            max_binding_bytes: options.max_binding_bytes.map_or(own_max, |lowered| lowered.min(own_max)),
            window_rows: options.window_rows.unwrap_or(u64::MAX),
            serial: options.serial,
            subgroups,
            subgroups_of_8: summary.subgroup_sizes == Some((8, 8)) && options.subgroups_of_8 != Some(false),
            uniform_blocks: options.uniform_blocks.unwrap_or(summary.kind != DeviceKind::Software),
            device,
            queue,
            faults,
            summary,
            limits,
        })
    }

    /// The adapter.
    pub fn summary(&self) -> &AdapterSummary {
        &self.summary
    }

    /// Whether shaders are compiled with subgroup operations (the define `SUBGROUPS`).
    pub fn subgroups(&self) -> bool {
        self.subgroups
    }

    /// The defines for subgroups, applied to every shader that knows them.
    pub(super) fn subgroup_defines(&self) -> &'static [&'static str] {
        match (self.subgroups, self.subgroups_of_8) {
            (false, _) => &[],
            (true, false) => &["SUBGROUPS"],
            (true, true) => &["SUBGROUPS", "SUBGROUPS_OF_8"],
        }
    }

    /// Whether shaders read uniforms as uniform blocks; otherwise as storage.
    pub(super) fn uniform_blocks(&self) -> bool {
        self.uniform_blocks
    }

    /// Largest binding, bytes: longer columns are bound in windows.
    pub fn max_binding_bytes(&self) -> u64 {
        self.max_binding_bytes
    }

    /// Most rows of a column window, regardless of the binding limit.
    pub fn window_rows(&self) -> u64 {
        self.window_rows
    }

    /// Alignment of the offsets of bound windows, bytes.
    pub fn offset_alignment(&self) -> u64 {
        u64::from(self.limits.min_storage_buffer_offset_alignment)
    }

    /// Most rows of `row_bytes` in one binding, such that every window starts at an offset that can be bound.
    pub fn rows_per_window(&self, row_bytes: u64) -> u64 {
        let row_bytes = row_bytes.max(1);
        let alignment = self.offset_alignment();
        let step = alignment / (1 << row_bytes.trailing_zeros().min(alignment.trailing_zeros()));
        (self.max_binding_bytes / row_bytes / step * step).max(step)
    }

    /// Workgroup memory of a shader, bytes: 16 or 32 KiB.
    pub fn workgroup_storage_bytes(&self) -> u32 {
        self.limits.max_compute_workgroup_storage_size
    }

    /// A buffer of `size` bytes with arbitrary contents; see [`super::Recorder::clear`].
    ///
    /// # Errors
    /// The buffer exceeds the budget or the device's memory.
    pub fn buffer(&self, label: &'static str, size: u64) -> GpuResult<Buffer> {
        self.pool.take(&self.device, &self.faults, label, size)
    }

    /// Returns free buffers to the device.
    pub fn trim(&self) {
        self.pool.trim();
    }

    /// Traffic over the bus, and memory in use.
    pub fn traffic(&self) -> Traffic {
        let pool = self.pool.usage();
        Traffic {
            bytes_uploaded: self.uploaded.load(Ordering::Relaxed),
            bytes_read_back: self.staging.bytes_read(),
            device_bytes: pool.in_use,
            device_bytes_peak: pool.peak,
            device_allocations: pool.allocations,
            staging_bytes: super::error::lock(&self.belt).bytes() + self.staging.bytes(),
        }
    }
}

/// Every adapter of the machine, best first, including unusable ones.
pub fn list_adapters() -> Vec<AdapterSummary> {
    adapters().into_iter().map(|(_, summary)| summary).collect()
}

fn adapters() -> Vec<(wgpu::Adapter, AdapterSummary)> {
    let backends = wgpu::Backends::VULKAN | wgpu::Backends::METAL | wgpu::Backends::DX12;
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor {
        backends,
        ..wgpu::InstanceDescriptor::new_without_display_handle()
    });
    let found = pollster::block_on(instance.enumerate_adapters(backends));
    let mut found: Vec<_> = found
        .into_iter()
        .map(|adapter| {
            let summary = summarize(&adapter);
            (adapter, summary)
        })
        .collect();
    found.sort_by_key(|(_, s)| s.kind); // stable: the driver's order among equals
    found
}

fn summarize(adapter: &wgpu::Adapter) -> AdapterSummary {
    let info = adapter.get_info();
    let limits = adapter.limits();
    let features = adapter.features();
    AdapterSummary {
        kind: match info.device_type {
            wgpu::DeviceType::DiscreteGpu => DeviceKind::Discrete,
            wgpu::DeviceType::IntegratedGpu => DeviceKind::Integrated,
            wgpu::DeviceType::Cpu => DeviceKind::Software,
            wgpu::DeviceType::VirtualGpu | wgpu::DeviceType::Other => DeviceKind::Other,
        },
        backend: format!("{:?}, {} {}", info.backend, info.driver, info.driver_info).trim_end().to_string(),
        name: info.name,
        max_binding_bytes: limits.max_storage_buffer_binding_size,
        max_buffer_bytes: limits.max_buffer_size,
        workgroup_storage_bytes: limits.max_compute_workgroup_storage_size,
        subgroup_sizes: features
            .contains(wgpu::Features::SUBGROUP)
            .then_some((info.subgroup_min_size, info.subgroup_max_size)),
        timestamps: features.contains(wgpu::Features::TIMESTAMP_QUERY),
        refusal: refusal(&limits),
    }
}

/// The first limit of an adapter that is too low for the shaders.
fn refusal(has: &wgpu::Limits) -> Option<String> {
    let needs: [(&str, u64, u64); 6] = [
        ("storage buffers per stage", STORAGE_BUFFERS_NEEDED.into(), has.max_storage_buffers_per_shader_stage.into()),
        ("bytes of workgroup memory", WORKGROUP_STORAGE_NEEDED.into(), has.max_compute_workgroup_storage_size.into()),
        ("invocations per workgroup", super::WORKGROUP.into(), has.max_compute_invocations_per_workgroup.into()),
        ("workgroup size in x", super::WORKGROUP.into(), has.max_compute_workgroup_size_x.into()),
        ("workgroups per dimension", GROUPS_MAX.into(), has.max_compute_workgroups_per_dimension.into()),
        ("bytes per binding", BINDING_NEEDED, has.max_storage_buffer_binding_size),
    ];
    let (what, need, has) = needs.into_iter().find(|(_, need, has)| has < need)?;
    Some(format!("it has {has} {what}, but {need} are needed"))
}

/// Most workgroups in one dimension of a dispatch, on every device.
pub(super) const GROUPS_MAX: u32 = 65_535;

fn limits_to_ask(has: &wgpu::Limits) -> wgpu::Limits {
    wgpu::Limits {
        max_storage_buffer_binding_size: has.max_storage_buffer_binding_size,
        max_buffer_size: has.max_buffer_size,
        max_storage_buffers_per_shader_stage: STORAGE_BUFFERS_NEEDED,
        max_compute_workgroup_storage_size: has.max_compute_workgroup_storage_size.min(2 * WORKGROUP_STORAGE_NEEDED),
        max_compute_invocations_per_workgroup: super::WORKGROUP,
        max_compute_workgroup_size_x: super::WORKGROUP,
        max_compute_workgroups_per_dimension: GROUPS_MAX,
        min_storage_buffer_offset_alignment: has.min_storage_buffer_offset_alignment,
        min_uniform_buffer_offset_alignment: has.min_uniform_buffer_offset_alignment,
        ..wgpu::Limits::downlevel_defaults()
    }
}

fn choose(choice: &DeviceChoice) -> GpuResult<(wgpu::Adapter, AdapterSummary)> {
    let all = adapters();
    let found = if all.is_empty() {
        "none".to_string()
    } else {
        all.iter().map(|(_, s)| s.to_string()).collect::<Vec<_>>().join("; ")
    };
    let fits = |s: &AdapterSummary| {
        s.refusal.is_none()
            && match choice {
                DeviceChoice::Auto => s.kind != DeviceKind::Software,
                DeviceChoice::Gpu => true,
                DeviceChoice::Named(name) => s.name.to_lowercase().contains(&name.to_lowercase()),
            }
    };
    all.into_iter().find(|(_, s)| fits(s)).ok_or_else(|| match choice {
        DeviceChoice::Auto => GpuError::NoHardwareGpu { found },
        DeviceChoice::Gpu => GpuError::NoSuchDevice { wanted: "gpu".into(), found },
        DeviceChoice::Named(name) => GpuError::NoSuchDevice { wanted: name.clone(), found },
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hardware_comes_before_software() {
        let mut kinds = [DeviceKind::Software, DeviceKind::Other, DeviceKind::Integrated, DeviceKind::Discrete];
        kinds.sort();
        assert_eq!(kinds, [DeviceKind::Discrete, DeviceKind::Integrated, DeviceKind::Other, DeviceKind::Software]);
    }

    #[test]
    #[allow(clippy::unwrap_used)] // a panic is a failed test
    fn a_lost_device_is_reported_by_every_later_call() {
        let gpu = match Gpu::open(&DeviceChoice::Gpu) {
            Ok(gpu) => gpu,
            Err(GpuError::NoSuchDevice { .. }) if std::env::var_os("CI").is_none() => return,
            Err(error) => panic!("{error}"),
        };
        let mut recorder = gpu.begin("step 12");
        let buffer = recorder.buffer_zeroed("zeros", 64).unwrap();
        let readback = recorder.read_back("zeros", &buffer.view()).unwrap();
        gpu.device.destroy();
        let is_loss = |e: GpuError| matches!(e, GpuError::DeviceLost { .. });
        let submitted = gpu.submit(recorder);
        assert!(submitted.is_err() || readback.to_vec::<u32>(&gpu).is_err());
        assert!(gpu.submit(gpu.begin("step 13")).is_err_and(is_loss));
        assert!(
            gpu.buffer("another", 64).is_ok_and(|b| b.size() == 64) || gpu.buffer("big", 1 << 20).is_err_and(is_loss)
        );
    }

    #[test]
    fn an_adapter_below_a_limit_is_refused_with_the_name_of_the_limit() {
        let enough = wgpu::Limits { max_storage_buffers_per_shader_stage: 16, ..Default::default() };
        assert_eq!(refusal(&enough), None);
        let few = wgpu::Limits { max_storage_buffers_per_shader_stage: 8, ..Default::default() };
        assert_eq!(refusal(&few).as_deref(), Some("it has 8 storage buffers per stage, but 16 are needed"));
    }
}
