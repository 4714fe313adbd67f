//! An open device with its memory, pipelines and counters: the handle that all GPU work uses.
//!
//! Invariants: (1) every limit that the shaders need is requested; (2) no call here panics.

use std::fmt;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use super::adapter::{AdapterSummary, DeviceKind, WORKGROUP, choose, limits_to_request, uniforms_fit_storage};
use super::belt::{Belt, UniformRing};
use super::buffers::{Buffer, Pool, Purpose};
use super::bus::EmulatedBus;
use super::driver::Driver;
use super::error::{GpuError, GpuResult};
use super::faults::lock;
use super::injected::{FaultKind, InjectedFault, Injector};
use super::profile::{Profiler, StageTime};
use super::readback::Staging;
use super::shader::{Pipeline, Pipelines};
use super::sources::{Defines, SOURCES, Source};
use super::submission_count::SubmissionCount;
use super::{DeviceChoice, Traffic, Work};

/// Smallest and largest memory block under a budget, bytes: the API raises smaller ones to 4 MiB.
const BLOCK_MIN: u64 = 4 << 20;
const BLOCK_MAX: u64 = 64 << 20;
/// The budget from which on it holds for memory blocks, bytes: blocks are a large part of smaller ones.
const BLOCKS_COUNT_FROM: u64 = 128 << 20;
/// Largest binding used, bytes: the API's cap is 2^31-1, and windows must start at aligned offsets.
const BINDING_MAX: u64 = (1 << 31) - 256;

/// Bytes of a memory block of the API under a budget.
fn block_bytes(budget: u64) -> u64 {
    (budget / 64).clamp(BLOCK_MIN, BLOCK_MAX)
}

/// The part of a budget for buffers. The API holds blocks of three kinds of memory (device, uploads, read-backs), which are
/// partly empty: measured 4 to 6 blocks in all.
pub fn bytes_for_buffers(budget: u64) -> u64 {
    if budget < BLOCKS_COUNT_FROM { budget } else { budget - 6 * block_bytes(budget) }
}

/// The least budget that leaves `bytes` bytes for buffers.
pub fn budget_for_buffers(bytes: u64) -> u64 {
    if bytes < BLOCKS_COUNT_FROM {
        return bytes;
    }
    // Blocks grow by less than a tenth of the budget, so a few rounds come within a byte.
    (0..8).fold(bytes, |budget, _| bytes + 6 * block_bytes(budget)).max(BLOCKS_COUNT_FROM + 6 * BLOCK_MIN)
}

/// How shaders add up what neighbouring invocations hold.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Subgroups {
    /// With subgroup operations, if the adapter has them and its subgroups hold their invocations in order; where all subgroups have 8
    /// invocations, on a path of their own.
    #[default]
    Best,
    /// The same without that path.
    AnySize,
    /// In workgroup memory, as if subgroups had this size: 4, 8, 16, 32 or 64; shaders refuse others. For tests of sizes that no
    /// adapter at hand has.
    Emulated(u32),
    /// Without subgroups.
    Off,
}

/// Least size of a subgroup: smaller ones have more sums than the memory of stages holds.
const SUBGROUP_LEAST: u32 = 4;

impl Subgroups {
    /// The defines of shaders on an adapter whose subgroups have these sizes, if it has any.
    fn defines(self, sizes: Option<(u32, u32)>) -> Vec<(&'static str, String)> {
        let (least, most) = match (self, sizes) {
            (Subgroups::Off, _) => (0, 0),
            (Subgroups::Emulated(size), _) => (size, size),
            (_, sizes) => sizes.unwrap_or_default(),
        };
        if least < SUBGROUP_LEAST {
            return Vec::new();
        }
        let mut defines = vec![("SUBGROUPS", String::new())];
        if let Subgroups::Emulated(size) = self {
            defines.extend([("EMULATED_SUBGROUPS", String::new()), ("SUBGROUP_SIZE", format!("{size}u"))]);
        }
        let is_of_8 = self == Subgroups::Best && (least, most) == (8, 8);
        defines.extend(is_of_8.then_some(("SUBGROUPS_OF_8", String::new())));
        defines.extend((least >= 32).then_some(("SUBGROUPS_OF_32", String::new())));
        defines
    }
}

/// Options that a test or the user's budget sets.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct GpuOptions {
    /// Lowers the largest binding, bytes.
    pub max_binding_bytes: Option<u64>,
    /// Waits for each submission before continuing: the baseline in tests of overlap.
    pub serial: bool,
    /// How shaders add up what neighbouring invocations hold.
    pub subgroups: Subgroups,
    /// Most device memory to allocate, bytes (`--device-mem`); `None`: no limit. From 128 MiB on the limit holds for the memory
    /// blocks of the API, below for the buffers in them.
    pub budget: Option<u64>,
    /// Counts submissions on the device, so that every read-back proves that the work before it was done. Devices of Metal always do.
    pub counts_submissions: bool,
    /// Measures the time of every stage, if the adapter can.
    pub profile: bool,
    /// Whether shaders read uniforms as uniform blocks (`Some(true)`) or as storage; `None`: as storage on software adapters. An adapter that
    /// binds no more storage buffers than stages use gets blocks.
    ///
    /// Mesa's lavapipe specialises a shader for the uniform values that decide branches, once per set of values, and
    /// keeps every variant as long as the pipeline: a view with new counts then costs time and some 100 KB of host
    /// memory that are never freed.
    pub uniform_blocks: Option<bool>,
    /// A fault to inject; `None`: the one that the environment variable `GSSCALE_GPU_FAULT` requests, if any.
    pub fault: Option<InjectedFault>,
    /// A bus to emulate; `None`: the one that the environment variable `GSSCALE_EMULATE_BUS` requests, if any.
    pub bus: Option<EmulatedBus>,
}

pub struct Gpu {
    pub(super) driver: Arc<Driver>,
    pub(super) staging: Arc<Staging>,
    pub(super) belt: Mutex<Belt>,
    pub(super) uniforms: Mutex<UniformRing>,
    pub(super) profiler: Mutex<Profiler>,
    pub(super) injector: Injector,
    /// `None` where the driver reports work that the device skipped.
    pub(super) submission_count: Option<SubmissionCount>,
    pub(super) uploaded: AtomicU64,
    pub(super) work: Mutex<Work>,
    /// Every open recording holds a reference.
    pub(super) recordings: Arc<()>,
    pub(super) serial: bool,
    pipelines: Pipelines,
    pool: Arc<Pool>,
    summary: AdapterSummary,
    offset_alignment: u64,
    max_binding_bytes: u64,
}

impl fmt::Debug for Gpu {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Gpu({})", self.summary)
    }
}

impl Gpu {
    /// Opens the device that `choice` requests.
    /// Errors: no adapter fits the request, or the driver refused to open it.
    pub fn open_with(choice: &DeviceChoice, options: &GpuOptions) -> GpuResult<Gpu> {
        let (adapter, summary) = choose(choice)?;
        let defines = options.subgroups.defines(summary.subgroup_sizes);
        let is_native = !defines.is_empty() && !matches!(options.subgroups, Subgroups::Emulated(_));
        let mut features = wgpu::Features::empty();
        features.set(wgpu::Features::SUBGROUP, is_native);
        features.set(wgpu::Features::TIMESTAMP_QUERY, summary.timestamps && options.profile);
        let limits = limits_to_request(&adapter.limits());
        let bus = options.bus.map_or_else(EmulatedBus::from_environment, |bus| Ok(Some(bus)))?;
        let blocks = options.budget.map(block_bytes);
        let driver = Arc::new(Driver::open(&adapter, &summary.name, features, limits.clone(), blocks, bus)?);
        let open = |defines| Gpu::on_driver(Arc::clone(&driver), summary.clone(), &limits, options, defines);
        // The check has a device of its own, so that it leaves nothing on the one that is used.
        let in_order = !is_native || open(defines.clone())?.has_subgroups_in_order()?;
        let gpu = open(if in_order { defines } else { Vec::new() })?;
        let fault = options.fault.or_else(InjectedFault::from_environment);
        let gives_up_silently = gpu.summary.backend.starts_with("Metal");
        let counts = gives_up_silently
            || options.counts_submissions
            || fault.is_some_and(|fault| fault.kind == FaultKind::GivenUp);
        let submission_count = if counts { Some(gpu.count_submissions()?) } else { None };
        Ok(Gpu { injector: Injector::new(fault), submission_count, ..gpu })
    }

    fn count_submissions(&self) -> GpuResult<SubmissionCount> {
        let pipeline = self.pipeline("submission_count.wgsl", "count", &[])?;
        let mut recorder = self.begin("submission count");
        let finished = recorder.buffer_with("finished submissions", &[1u32])?;
        let submission = self.submit(recorder)?;
        self.wait(&submission)?;
        Ok(SubmissionCount::new(pipeline, finished))
    }

    /// A device with nothing on it yet, on an open driver.
    fn on_driver(
        driver: Arc<Driver>,
        summary: AdapterSummary,
        limits: &wgpu::Limits,
        options: &GpuOptions,
        subgroup_defines: Vec<(&'static str, String)>,
    ) -> GpuResult<Gpu> {
        let budget = options.budget.map_or(u64::MAX, bytes_for_buffers);
        let block_limit = options.budget.filter(|budget| *budget >= BLOCKS_COUNT_FROM);
        let pool = Pool::new(Arc::clone(&driver), budget, block_limit, limits.max_buffer_size);
        let staging = Staging::new(Arc::clone(&driver), Arc::clone(&pool));
        let profiler = Profiler::new(&driver, Arc::clone(&staging), summary.timestamps && options.profile);
        driver.faults.check()?;
        let wants_blocks = options.uniform_blocks.unwrap_or(summary.kind != DeviceKind::Software);
        let uniform_blocks = wants_blocks || !uniforms_fit_storage(limits);
        let alignment = limits.min_uniform_buffer_offset_alignment.max(limits.min_storage_buffer_offset_alignment);
        let own_max = limits.max_storage_buffer_binding_size.min(BINDING_MAX);
        Ok(Gpu {
            staging,
            belt: Mutex::new(Belt::new(Arc::clone(&driver), Arc::clone(&pool), budget)),
            uniforms: Mutex::new(UniformRing::new(Arc::clone(&driver), Arc::clone(&pool), u64::from(alignment))),
            profiler: Mutex::new(profiler),
            injector: Injector::default(),
            submission_count: None,
            uploaded: AtomicU64::new(0),
            work: Mutex::default(),
            recordings: Arc::default(),
            serial: options.serial,
            pipelines: Pipelines::new(Arc::clone(&driver), subgroup_defines, uniform_blocks),
            pool,
            summary,
            offset_alignment: u64::from(limits.min_storage_buffer_offset_alignment),
            max_binding_bytes: options.max_binding_bytes.map_or(own_max, |lowered| lowered.min(own_max)),
            driver,
        })
    }

    /// Whether subgroups hold the invocations of a workgroup in their order, found by a scan.
    fn has_subgroups_in_order(&self) -> GpuResult<bool> {
        let check = self.pipeline("scan.wgsl", "check_order", &[])?;
        let mut recorder = self.begin("check of subgroups");
        let in_order = recorder.buffer_zeroed("order of subgroups", 4 * u64::from(WORKGROUP))?;
        recorder.dispatch("scan", &check, &[in_order.view()], [1, 1, 1])?;
        let read = recorder.read_back("scan", &in_order.view())?;
        self.submit(recorder)?;
        Ok(read.to_vec::<u32>()?.iter().all(|is_in_order| *is_in_order == 1))
    }

    /// Lets uploads take more staging memory, within the budget, instead of waiting for the device: for a host that records one step
    /// while the device works on another.
    pub fn allow_steps_in_flight(&self) {
        lock(&self.belt).allow_steps_in_flight();
    }

    pub fn summary(&self) -> &AdapterSummary {
        &self.summary
    }

    /// Whether shaders add up over subgroups (the define `SUBGROUPS`).
    pub fn subgroups(&self) -> bool {
        self.pipelines.subgroups()
    }

    /// Largest binding, bytes: longer columns are bound in windows.
    pub fn max_binding_bytes(&self) -> u64 {
        self.max_binding_bytes
    }

    /// Errors: a binding of `need` bytes exceeds the largest of the device. To be called before work on a buffer that a stage binds whole,
    /// since cutting the other buffers smaller does not help.
    pub fn check_binding(&self, stage: &str, binding: &str, need: u64) -> GpuResult<()> {
        let limit = self.max_binding_bytes;
        if need <= limit {
            return Ok(());
        }
        Err(GpuError::BindingTooLarge { stage: stage.into(), binding: binding.into(), need, limit })
    }

    /// Alignment of the offsets of bound windows, bytes.
    pub fn offset_alignment(&self) -> u64 {
        self.offset_alignment
    }

    /// The pipeline of an entry point of a shader in [`SOURCES`]; compiled on first use.
    /// Errors: the shader does not exist or does not compile, or a define is unknown to it.
    pub fn pipeline(&self, shader: &str, entry: &str, defines: Defines<'_>) -> GpuResult<Arc<Pipeline>> {
        let source = SOURCES.iter().find(|s| s.name == shader);
        self.pipeline_from(source.ok_or_else(|| GpuError::shader(shader, "no such shader"))?, entry, defines)
    }

    /// As [`Gpu::pipeline`], for a source outside the table; its imports still come from the table.
    /// Errors: as [`Gpu::pipeline`].
    pub fn pipeline_from(&self, source: &Source, entry: &str, defines: Defines<'_>) -> GpuResult<Arc<Pipeline>> {
        self.pipelines.get(source, entry, defines)
    }

    /// A buffer of `size` bytes with arbitrary contents; see [`super::Recorder::clear`].
    /// Errors: the buffer exceeds the budget or the device's memory.
    pub fn buffer(&self, label: &'static str, size: u64) -> GpuResult<Buffer> {
        self.pool.take(label, size, Purpose::Work)
    }

    /// As [`Gpu::buffer`], for a buffer that the caller can do without; `None` if there is no memory for it.
    pub fn optional_buffer(&self, label: &'static str, size: u64) -> GpuResult<Option<Buffer>> {
        self.pool.take_optional(label, size)
    }

    /// Device memory that buffers can still take, bytes; 2^64 - 1 less what is in use without a budget.
    pub fn room(&self) -> u64 {
        self.pool.room()
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
            staging_bytes: pool.kept + self.pool.read_back_bytes(),
            work: *lock(&self.work),
        }
    }

    /// Bytes that the driver has allocated for buffers, and bytes of the memory blocks that hold them; `None` if the backend
    /// reports neither.
    pub fn allocator_bytes(&self) -> Option<[u64; 2]> {
        let report = self.driver.device.generate_allocator_report()?;
        Some([report.total_allocated_bytes, report.total_reserved_bytes])
    }

    /// Time of every stage so far, in order of first use; empty without profiling. Waits for the device.
    /// Errors: the device was lost.
    pub fn stage_times(&self) -> GpuResult<Vec<StageTime>> {
        lock(&self.profiler).times()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn open() -> Option<Gpu> {
        match Gpu::open_with(&DeviceChoice::Gpu, &GpuOptions::default()) {
            Ok(gpu) => Some(gpu),
            Err(GpuError::NoSuchDevice { .. }) if std::env::var_os("CI").is_none() => None,
            Err(error) => panic!("{error}"),
        }
    }

    #[test]
    fn a_refused_optional_buffer_leaves_the_budget() {
        let Some(gpu) = open() else { return };
        let room = gpu.room();
        let refuse = || gpu.driver.faults.report(&wgpu::Error::OutOfMemory { source: "refused by the test".into() });
        refuse();
        assert!(gpu.optional_buffer("refused", 1 << 20).unwrap().is_none());
        assert_eq!(gpu.room(), room);
        assert!(gpu.optional_buffer("granted", 1 << 20).unwrap().is_some_and(|buffer| buffer.size() == 1 << 20));
        refuse();
        assert!(gpu.buffer("asked for twice", 1 << 21).is_ok_and(|buffer| buffer.size() == 1 << 21));
        assert_eq!(gpu.room(), room);
    }

    #[test]
    fn a_lost_device_is_reported_by_every_later_call() {
        let Some(gpu) = open() else { return };
        let mut recorder = gpu.begin("step 12");
        let buffer = recorder.buffer_zeroed("zeros", 64).unwrap();
        let readback = recorder.read_back("zeros", &buffer.view()).unwrap();
        gpu.driver.device.destroy();
        let is_loss = |e: GpuError| matches!(e, GpuError::DeviceLost { .. });
        let submitted = gpu.submit(recorder);
        assert!(submitted.is_err() || readback.to_vec::<u32>().is_err());
        assert!(gpu.submit(gpu.begin("step 13")).is_err_and(is_loss));
        assert!(
            gpu.buffer("another", 64).is_ok_and(|b| b.size() == 64) || gpu.buffer("big", 1 << 20).is_err_and(is_loss)
        );
    }
}
