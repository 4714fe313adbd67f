//! The adapters of the machine: which exist, which can be used, which one a request means.
//!
//! Invariants: (1) discrete GPUs come before integrated ones, both before software adapters; (2) an adapter below a
//! limit that the shaders need is refused with the name of the limit.

use std::fmt;

use super::DeviceChoice;
use super::error::{GpuError, GpuResult};

/// Invocations of a workgroup, unless a shader needs another number.
pub const WORKGROUP: u32 = 256;
/// Most workgroups in one dimension of a dispatch, on every device.
pub(super) const GROUPS_MAX: u32 = 65_535;
/// Storage buffers that a stage may use beside its uniform block: what drivers of older devices and SwiftShader offer.
pub const STORAGE_BUFFERS_MOST: u32 = 10;
/// Workgroup memory that every shader may use, bytes; up to twice this is requested if the adapter has it.
const WORKGROUP_STORAGE_NEEDED: u32 = 16 << 10;
/// Smallest accepted limit on bindings, bytes: the WebGPU default.
const BINDING_NEEDED: u64 = 128 << 20;

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
    pub kind: DeviceKind,
    /// Graphics API and driver.
    pub backend: String,
    pub max_binding_bytes: u64,
    pub max_buffer_bytes: u64,
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
        if self.subgroup_sizes.is_none() && self.backend.starts_with("Dx12") {
            // The old compiler of Direct3D knows none.
            write!(
                f,
                " (faster with dxcompiler.dll and dxil.dll, of the DirectX Shader Compiler, beside the program)"
            )?;
        }
        match &self.refusal {
            Some(reason) => write!(f, "; cannot be used: {reason}"),
            None => Ok(()),
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
        ("storage buffers per stage", STORAGE_BUFFERS_MOST.into(), has.max_storage_buffers_per_shader_stage.into()),
        ("bytes of workgroup memory", WORKGROUP_STORAGE_NEEDED.into(), has.max_compute_workgroup_storage_size.into()),
        ("invocations per workgroup", WORKGROUP.into(), has.max_compute_invocations_per_workgroup.into()),
        ("workgroup size in x", WORKGROUP.into(), has.max_compute_workgroup_size_x.into()),
        ("workgroups per dimension", GROUPS_MAX.into(), has.max_compute_workgroups_per_dimension.into()),
        ("bytes per binding", BINDING_NEEDED, has.max_storage_buffer_binding_size),
    ];
    let (what, need, has) = needs.into_iter().find(|(_, need, has)| has < need)?;
    Some(format!("it has {has} {what}, but {need} are needed"))
}

/// Whether an adapter with these limits binds one storage buffer more than stages use, as a uniform read from storage needs.
pub(super) fn uniforms_fit_storage(has: &wgpu::Limits) -> bool {
    has.max_storage_buffers_per_shader_stage > STORAGE_BUFFERS_MOST
}

/// The limits to request from an adapter that has `has`: those of the shaders, and the largest buffers it offers.
pub(super) fn limits_to_request(has: &wgpu::Limits) -> wgpu::Limits {
    wgpu::Limits {
        max_storage_buffer_binding_size: has.max_storage_buffer_binding_size,
        max_buffer_size: has.max_buffer_size,
        max_storage_buffers_per_shader_stage: has.max_storage_buffers_per_shader_stage.min(STORAGE_BUFFERS_MOST + 1),
        max_compute_workgroup_storage_size: has.max_compute_workgroup_storage_size.min(2 * WORKGROUP_STORAGE_NEEDED),
        max_compute_invocations_per_workgroup: WORKGROUP,
        max_compute_workgroup_size_x: WORKGROUP,
        max_compute_workgroups_per_dimension: GROUPS_MAX,
        min_storage_buffer_offset_alignment: has.min_storage_buffer_offset_alignment,
        min_uniform_buffer_offset_alignment: has.min_uniform_buffer_offset_alignment,
        ..wgpu::Limits::downlevel_defaults()
    }
}

/// Whether a name, in part and in any case, means the adapter: `4090`, `vulkan`, or `#2` for the second of the list.
fn is_named(adapter: &AdapterSummary, number: usize, name: &str) -> bool {
    match name.strip_prefix('#') {
        Some(wanted) => wanted.parse() == Ok(number),
        None => format!("{} ({})", adapter.name, adapter.backend).to_lowercase().contains(&name.to_lowercase()),
    }
}

/// The best adapter that `choice` means.
pub(super) fn choose(choice: &DeviceChoice) -> GpuResult<(wgpu::Adapter, AdapterSummary)> {
    let all = adapters();
    let found = if all.is_empty() {
        "none".to_string()
    } else {
        all.iter().map(|(_, s)| s.to_string()).collect::<Vec<_>>().join("; ")
    };
    let fits = |number: usize, s: &AdapterSummary| {
        s.refusal.is_none()
            && match choice {
                DeviceChoice::Auto => s.kind != DeviceKind::Software,
                DeviceChoice::Gpu => true,
                DeviceChoice::Named(name) => is_named(s, number, name),
            }
    };
    let found_at = (1..).zip(&all).position(|(number, (_, s))| fits(number, s));
    found_at.and_then(|at| all.into_iter().nth(at)).ok_or_else(|| match choice {
        DeviceChoice::Auto => GpuError::NoHardwareGpu { found },
        DeviceChoice::Gpu => GpuError::NoSuchDevice { wanted: "gpu".into(), found },
        DeviceChoice::Named(name) => GpuError::NoSuchDevice { wanted: name.clone(), found },
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn card(name: &str, backend: &str) -> AdapterSummary {
        AdapterSummary {
            name: name.into(),
            kind: DeviceKind::Discrete,
            backend: backend.into(),
            max_binding_bytes: 0,
            max_buffer_bytes: 0,
            workgroup_storage_bytes: 0,
            subgroup_sizes: None,
            timestamps: false,
            refusal: None,
        }
    }

    #[test]
    fn adapters_of_one_name_are_told_apart_by_their_number_or_their_api() {
        let adapter = card("NVIDIA RTX 4090", "Dx12");
        for name in ["rtx 4090", "4090 (dx12", "dx12", "#2"] {
            assert!(is_named(&adapter, 2, name), "{name}");
        }
        for name in ["vulkan", "#1", "#", "#22"] {
            assert!(!is_named(&adapter, 2, name), "{name}");
        }
    }

    #[test]
    fn direct3d_without_its_new_compiler_says_what_is_missing() {
        let summary = card("card", "Dx12, driver 1");
        assert!(summary.to_string().contains("dxcompiler.dll"));
        let with_subgroups = AdapterSummary { subgroup_sizes: Some((32, 32)), ..summary.clone() };
        let of_vulkan = AdapterSummary { backend: "Vulkan".into(), ..summary };
        assert!([with_subgroups, of_vulkan].iter().all(|other| !other.to_string().contains("dxcompiler")));
    }

    #[test]
    fn an_adapter_below_a_limit_is_refused_with_the_name_of_the_limit() {
        let enough = wgpu::Limits { max_storage_buffers_per_shader_stage: 10, ..Default::default() };
        assert_eq!(refusal(&enough), None);
        let few = wgpu::Limits { max_storage_buffers_per_shader_stage: 8, ..Default::default() };
        assert_eq!(refusal(&few).as_deref(), Some("it has 8 storage buffers per stage, but 10 are needed"));
    }
}
