//! Compiled shaders: reflection by the shader compiler (naga), and pipelines with explicit layouts.
//!
//! Invariants: (1) layouts are derived from the bindings that the entry point uses, never declared by a caller;
//! (2) equal (shader, entry, defines) give the same pipeline, compiled once; (3) a shader gets those of the
//! defines of [`super::Subgroups`] that it knows.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

use wgpu::naga;

use super::driver::Driver;
use super::error::{GpuError, GpuResult};
use super::faults::lock;
use super::injected::with_shader_fault;
use super::sources::{Defines, Source, knows, preprocess};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum BindingKind {
    /// `var<uniform>`
    Uniform,
    /// `var<storage, read>`
    Read,
    /// `var<storage, read_write>`
    ReadWrite,
}

/// One binding that an entry point uses.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Binding {
    /// Number in group 0.
    pub(super) number: u32,
    pub(super) name: String,
    pub(super) kind: BindingKind,
    /// Least bytes that a view must span; for a runtime-sized array, one element.
    pub(super) min_size: u64,
}

/// The compiler's reflection of an entry point.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Reflection {
    /// Bindings used, by number.
    pub(super) bindings: Vec<Binding>,
    /// Workgroup memory, bytes.
    pub(super) workgroup_storage: u64,
}

/// A compiled entry point.
#[derive(Debug)]
pub struct Pipeline {
    pub(super) raw: wgpu::ComputePipeline,
    pub(super) layout: wgpu::BindGroupLayout,
    /// The compiler's reflection.
    pub(super) reflection: Reflection,
}

/// Shader, entry point and defines of a pipeline.
type PipelineKey = (String, String, Vec<(String, String)>);

/// The compiled pipelines of a device.
#[derive(Debug)]
pub(super) struct Pipelines {
    driver: Arc<Driver>,
    subgroup_defines: Vec<(&'static str, String)>,
    uniform_blocks: bool,
    compiled: Mutex<BTreeMap<PipelineKey, Arc<Pipeline>>>,
}

impl Pipelines {
    /// No pipelines yet. `subgroup_defines` are set for every shader that knows them; without `uniform_blocks` shaders
    /// read uniforms as storage.
    pub(super) fn new(
        driver: Arc<Driver>,
        subgroup_defines: Vec<(&'static str, String)>,
        uniform_blocks: bool,
    ) -> Self {
        Pipelines { driver, subgroup_defines, uniform_blocks, compiled: Mutex::default() }
    }

    /// Whether shaders are compiled with subgroup operations.
    pub(super) fn subgroups(&self) -> bool {
        !self.subgroup_defines.is_empty()
    }

    /// The pipeline of an entry point; compiled on first use.
    pub(super) fn get(&self, source: &Source, entry: &str, defines: Defines<'_>) -> GpuResult<Arc<Pipeline>> {
        let mut all = defines.to_vec();
        let known = knows(source)?;
        let own = self.subgroup_defines.iter().map(|(name, value)| (*name, value.as_str()));
        all.extend(own.filter(|(name, _)| known.contains(*name)));
        all.sort_unstable();
        all.dedup();
        let owned = all.iter().map(|(n, v)| (n.to_string(), v.to_string())).collect();
        let key = (source.name.to_string(), entry.to_string(), owned);
        if let Some(found) = lock(&self.compiled).get(&key) {
            return Ok(Arc::clone(found));
        }
        let pipeline = Arc::new(self.compile(source, entry, &all)?);
        lock(&self.compiled).insert(key, Arc::clone(&pipeline));
        Ok(pipeline)
    }

    fn compile(&self, source: &Source, entry: &str, defines: Defines<'_>) -> GpuResult<Pipeline> {
        let mut text = with_shader_fault(source.name, preprocess(source, defines)?);
        if !self.uniform_blocks {
            // A struct that is valid in a uniform block has the same layout in storage.
            text = text.replace("var<uniform>", "var<storage, read>");
        }
        let reflection = reflect(source.name, &text, entry, self.subgroups())?;
        let (device, faults) = (&self.driver.device, &self.driver.faults);
        let (need, has) = (reflection.workgroup_storage, u64::from(device.limits().max_compute_workgroup_storage_size));
        if need > has {
            let problem = format!("{need} bytes of workgroup memory are needed, the device has {has}");
            return Err(GpuError::shader(source.name, problem));
        }
        faults.set_stage(source.name);
        let label = Some(source.name);
        let entries: Vec<_> = reflection.bindings.iter().map(Binding::layout_entry).collect();
        let layout = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label, entries: &entries });
        let pipeline_layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label,
            bind_group_layouts: &[Some(&layout)],
            immediate_size: 0,
        });
        let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label,
            source: wgpu::ShaderSource::Wgsl(text.into()),
        });
        let raw = device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label,
            layout: Some(&pipeline_layout),
            module: &module,
            entry_point: Some(entry),
            // Zeroing some 14 KB takes as long as a small stage's work: stages write what they read.
            compilation_options: wgpu::PipelineCompilationOptions {
                zero_initialize_workgroup_memory: false,
                ..Default::default()
            },
            cache: None,
        });
        faults.check()?;
        Ok(Pipeline { raw, layout, reflection })
    }
}

impl Binding {
    fn layout_entry(&self) -> wgpu::BindGroupLayoutEntry {
        let ty = match self.kind {
            BindingKind::Uniform => wgpu::BufferBindingType::Uniform,
            BindingKind::Read => wgpu::BufferBindingType::Storage { read_only: true },
            BindingKind::ReadWrite => wgpu::BufferBindingType::Storage { read_only: false },
        };
        let min_binding_size = wgpu::BufferSize::new(self.min_size);
        wgpu::BindGroupLayoutEntry {
            binding: self.number,
            visibility: wgpu::ShaderStages::COMPUTE,
            ty: wgpu::BindingType::Buffer { ty, has_dynamic_offset: false, min_binding_size },
            count: None,
        }
    }
}

/// Parses and validates a preprocessed text.
/// Errors: the compiler's message with the faulty line.
pub fn validate(name: &str, text: &str, subgroups: bool) -> GpuResult<(naga::Module, naga::valid::ModuleInfo)> {
    let module = naga::front::wgsl::parse_str(text).map_err(|e| GpuError::shader(name, e.emit_to_string(text)))?;
    let mut capabilities = naga::valid::Capabilities::empty();
    capabilities.set(naga::valid::Capabilities::SUBGROUP, subgroups);
    let mut validator = naga::valid::Validator::new(naga::valid::ValidationFlags::all(), capabilities);
    let info = validator.validate(&module).map_err(|e| GpuError::shader(name, e.emit_to_string(text)))?;
    Ok((module, info))
}

/// Reflects an entry point of a preprocessed text.
/// Errors: the text does not validate, the entry point does not exist, or a binding is outside group 0.
fn reflect(name: &str, text: &str, entry: &str, subgroups: bool) -> GpuResult<Reflection> {
    let (module, info) = validate(name, text, subgroups)?;
    let index = module
        .entry_points
        .iter()
        .position(|e| e.name == entry && e.stage == naga::ShaderStage::Compute)
        .ok_or_else(|| GpuError::shader(name, format!("has no compute entry point {entry:?}")))?;
    let uses = info.get_entry_point(index);
    let mut layouter = naga::proc::Layouter::default();
    layouter.update(module.to_ctx()).map_err(|e| GpuError::shader(name, e.to_string()))?;
    let mut bindings = Vec::new();
    let mut workgroup_storage = 0;
    for (_, variable) in module.global_variables.iter().filter(|(h, _)| !uses[*h].is_empty()) {
        let variable_name = variable.name.clone().unwrap_or_default();
        let kind = match variable.space {
            naga::AddressSpace::Uniform => BindingKind::Uniform,
            naga::AddressSpace::Storage { access } if access.contains(naga::StorageAccess::STORE) => {
                BindingKind::ReadWrite
            }
            naga::AddressSpace::Storage { .. } => BindingKind::Read,
            naga::AddressSpace::WorkGroup => {
                workgroup_storage += u64::from(layouter[variable.ty].size).next_multiple_of(16);
                continue;
            }
            _ => continue,
        };
        let number = match &variable.binding {
            Some(binding) if binding.group == 0 => binding.binding,
            _ => return Err(GpuError::shader(name, format!("{variable_name} is not bound in group 0"))),
        };
        let min_size = u64::from(layouter[variable.ty].size);
        bindings.push(Binding { number, name: variable_name, kind, min_size });
    }
    bindings.sort_by_key(|b| b.number);
    Ok(Reflection { bindings, workgroup_storage })
}
