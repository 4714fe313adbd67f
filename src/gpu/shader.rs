//! Shaders: a small preprocessor, reflection by the shader compiler (naga), pipelines with explicit layouts.
//!
//! The preprocessor knows these directives, at the start of a line:
//!
//! - `#import "shared/x.wgsl"`: inserts the file, each file once;
//! - `#ifdef NAME`, `#ifndef NAME`, `#else`, `#endif`;
//! - `#param NAME 0 1 2 3`: replaces `NAME` by a value; the first one unless a define selects another, and only listed
//!   values are accepted, so that every variant can be tested;
//! - `#repeat NAME 0u 1u` ... `#end`: repeats the lines between, once for each value of `NAME`.
//!
//! Invariants: (1) a define that a shader does not know is an error, except `SUBGROUPS`, set for all shaders of a
//! device with subgroup operations, and `SUBGROUPS_OF_8`, set if all subgroups have 8 invocations; (2) layouts are
//! derived from what the entry point uses, never declared by a caller; (3) equal (shader, entry, defines) give the same
//! pipeline, compiled once.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use wgpu::naga;

use super::device::Gpu;
use super::error::{GpuError, GpuResult, lock};
use super::sources::SOURCES;

/// A shader file.
#[derive(Debug, Clone, Copy)]
pub struct Source {
    /// Path under `shaders/`, with forward slashes.
    pub name: &'static str,
    /// WGSL with preprocessor directives.
    pub text: &'static str,
}

/// Names and values; a switch for `#ifdef` has an empty value.
pub type Defines<'a> = &'a [(&'a str, &'a str)];

/// Kind of a binding.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BindingKind {
    /// `var<uniform>`
    Uniform,
    /// `var<storage, read>`
    Read,
    /// `var<storage, read_write>`
    ReadWrite,
}

/// One binding that an entry point uses.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Binding {
    /// Number in group 0.
    pub number: u32,
    /// Name of the variable.
    pub name: String,
    /// Kind of the binding.
    pub kind: BindingKind,
    /// Least bytes that a view must span; for a runtime-sized array, one element.
    pub min_size: u64,
}

/// The compiler's reflection of an entry point.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Reflection {
    /// Bindings used, by number.
    pub bindings: Vec<Binding>,
    /// Invocations of a workgroup, per dimension.
    pub workgroup_size: [u32; 3],
    /// Workgroup memory, bytes.
    pub workgroup_storage: u64,
}

/// A compiled entry point.
#[derive(Debug)]
pub struct Pipeline {
    pub(super) raw: wgpu::ComputePipeline,
    pub(super) layout: wgpu::BindGroupLayout,
    /// The compiler's reflection.
    pub reflection: Reflection,
}

/// Pipelines by shader, entry point and defines.
pub(super) type PipelineCache = BTreeMap<(String, String, Vec<(String, String)>), Arc<Pipeline>>;

impl Gpu {
    /// The pipeline of an entry point of a shader in [`SOURCES`]; compiled on first use.
    ///
    /// # Errors
    /// The shader does not exist or does not compile, or a define is unknown to it.
    pub fn pipeline(&self, shader: &str, entry: &str, defines: Defines<'_>) -> GpuResult<Arc<Pipeline>> {
        let source = SOURCES.iter().find(|s| s.name == shader).ok_or_else(|| failed(shader, "no such shader"))?;
        self.pipeline_from(source, entry, defines)
    }

    /// As [`Gpu::pipeline`], for a source outside the table; its imports still come from the table.
    ///
    /// # Errors
    /// As [`Gpu::pipeline`].
    pub fn pipeline_from(&self, source: &Source, entry: &str, defines: Defines<'_>) -> GpuResult<Arc<Pipeline>> {
        let mut all = defines.to_vec();
        let known = switches(source)?;
        all.extend(self.subgroup_defines().iter().filter(|name| known.contains(**name)).map(|name| (*name, "")));
        all.sort_unstable();
        all.dedup();
        let owned = all.iter().map(|(n, v)| (n.to_string(), v.to_string())).collect();
        let key = (source.name.to_string(), entry.to_string(), owned);
        if let Some(found) = lock(&self.pipelines).get(&key) {
            return Ok(Arc::clone(found));
        }
        let pipeline = Arc::new(self.compile(source, entry, &all)?);
        lock(&self.pipelines).insert(key, Arc::clone(&pipeline));
        Ok(pipeline)
    }

    fn compile(&self, source: &Source, entry: &str, defines: Defines<'_>) -> GpuResult<Pipeline> {
        let mut text = preprocess(source, defines)?;
        if !self.uniform_blocks() {
            // A struct that is valid in a uniform block has the same layout in storage.
            text = text.replace("var<uniform>", "var<storage, read>");
        }
        let reflection = reflect(source.name, &text, entry, self.subgroups())?;
        self.check_workgroup(source.name, &reflection)?;
        self.faults.set_stage(source.name);
        let entries: Vec<_> = reflection
            .bindings
            .iter()
            .map(|binding| wgpu::BindGroupLayoutEntry {
                binding: binding.number,
                visibility: wgpu::ShaderStages::COMPUTE,
                ty: wgpu::BindingType::Buffer {
                    ty: match binding.kind {
                        BindingKind::Uniform => wgpu::BufferBindingType::Uniform,
                        BindingKind::Read => wgpu::BufferBindingType::Storage { read_only: true },
                        BindingKind::ReadWrite => wgpu::BufferBindingType::Storage { read_only: false },
                    },
                    has_dynamic_offset: false,
                    min_binding_size: wgpu::BufferSize::new(binding.min_size),
                },
                count: None,
            })
            .collect();
        let device = &self.device;
        let label = Some(source.name);
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
            compilation_options: Default::default(),
            cache: None,
        });
        self.faults.check()?;
        Ok(Pipeline { raw, layout, reflection })
    }

    fn check_workgroup(&self, shader: &str, reflection: &Reflection) -> GpuResult<()> {
        let has = u64::from(self.workgroup_storage_bytes());
        if reflection.workgroup_storage > has {
            let need = reflection.workgroup_storage;
            return Err(failed(shader, format!("{need} bytes of workgroup memory are needed, the device has {has}")));
        }
        Ok(())
    }
}

fn failed(shader: &str, problem: impl Into<String>) -> GpuError {
    GpuError::Shader { shader: shader.into(), problem: problem.into() }
}

/// A source with its imports inserted.
fn stitch(source: &Source, seen: &mut BTreeSet<&'static str>, out: &mut Vec<String>) -> GpuResult<()> {
    for line in source.text.lines() {
        let Some(rest) = line.trim_start().strip_prefix("#import") else {
            out.push(line.to_string());
            continue;
        };
        let name = rest.trim().trim_matches('"');
        let import = SOURCES
            .iter()
            .find(|s| s.name == name)
            .ok_or_else(|| failed(source.name, format!("imports {name:?}, which is not in the table")))?;
        if import.name != source.name && seen.insert(import.name) {
            stitch(import, seen, out)?;
        }
    }
    Ok(())
}

fn stitched(source: &Source) -> GpuResult<Vec<String>> {
    let mut lines = Vec::new();
    stitch(source, &mut BTreeSet::new(), &mut lines)?;
    Ok(lines)
}

/// The stitched lines with repetitions expanded.
fn repeated(source: &Source) -> GpuResult<Vec<String>> {
    let mut out = Vec::new();
    let mut open: Option<(String, Vec<String>, Vec<String>)> = None;
    for line in stitched(source)? {
        match (directive(&line).as_deref(), &mut open) {
            (Some(["repeat", name, values @ ..]), None) => {
                open = Some((name.to_string(), values.iter().map(|v| v.to_string()).collect(), Vec::new()));
            }
            (Some(["end"]), Some(_)) => {
                let Some((name, values, lines)) = open.take() else { continue };
                for value in values {
                    let as_value = BTreeMap::from([(name.clone(), value)]);
                    out.extend(lines.iter().map(|line| replaced(line, &as_value)));
                }
            }
            (Some(["repeat" | "end", ..]), _) => {
                return Err(failed(source.name, format!("this directive is out of place: {line}")));
            }
            (_, Some((_, _, lines))) => lines.push(line),
            (_, None) => out.push(line),
        }
    }
    match open {
        Some(_) => Err(failed(source.name, "a #repeat has no #end")),
        None => Ok(out),
    }
}

/// The words of a preprocessor line, without the `#`.
fn directive(line: &str) -> Option<Vec<&str>> {
    line.trim_start().strip_prefix('#').map(|rest| rest.split_whitespace().collect())
}

/// Names of the `#ifdef` and `#ifndef` lines of a shader and its imports.
fn switches(source: &Source) -> GpuResult<BTreeSet<String>> {
    let lines = stitched(source)?;
    let words = lines.iter().filter_map(|l| directive(l));
    Ok(words.filter(|w| w.len() > 1 && (w[0] == "ifdef" || w[0] == "ifndef")).map(|w| w[1].to_string()).collect())
}

/// Names and values of the `#param` lines of a shader and its imports.
fn params(source: &Source) -> GpuResult<BTreeMap<String, Vec<String>>> {
    let mut found = BTreeMap::new();
    for line in stitched(source)? {
        let Some(words) = directive(&line).filter(|w| w.first() == Some(&"param")) else { continue };
        if words.len() < 3 {
            return Err(failed(source.name, format!("a parameter needs a name and values: {line}")));
        }
        found.insert(words[1].to_string(), words[2..].iter().map(|v| v.to_string()).collect());
    }
    Ok(found)
}

/// All combinations of switches and parameter values of a shader.
///
/// # Errors
/// An import is missing or a directive is malformed.
pub fn variants(source: &Source) -> GpuResult<Vec<Vec<(String, String)>>> {
    let mut all = vec![Vec::new()];
    for switch in switches(source)? {
        let with = all.iter().map(|v| [v.clone(), vec![(switch.clone(), String::new())]].concat());
        all = all.iter().cloned().chain(with.collect::<Vec<_>>()).collect();
    }
    for (name, values) in params(source)? {
        let with = |v: &Vec<(String, String)>| {
            let v = v.clone();
            let name = name.clone();
            values.clone().into_iter().map(move |value| [v.clone(), vec![(name.clone(), value)]].concat())
        };
        all = all.iter().flat_map(with).collect();
    }
    Ok(all)
}

/// The WGSL text of a variant.
///
/// # Errors
/// A define is unknown, a value is not in its list, an import is missing, or a condition is not closed.
pub fn preprocess(source: &Source, defines: Defines<'_>) -> GpuResult<String> {
    let switches = switches(source)?;
    let mut values: BTreeMap<String, String> = BTreeMap::new();
    for (name, list) in params(source)? {
        values.insert(name, list.into_iter().next().unwrap_or_default());
    }
    let lists = params(source)?;
    for (name, value) in defines {
        match lists.get(*name) {
            Some(list) if list.iter().any(|v| v == value) => {
                values.insert(name.to_string(), value.to_string());
            }
            Some(list) => {
                return Err(failed(source.name, format!("{name} = {value:?} is none of {}", list.join(", "))));
            }
            None if switches.contains(*name) => {}
            None => return Err(failed(source.name, format!("does not know the define {name}"))),
        }
    }
    let is_defined = |name: &str| defines.iter().any(|(n, _)| *n == name) || values.contains_key(name);
    let mut out = String::new();
    let mut conditions: Vec<bool> = Vec::new();
    for line in repeated(source)? {
        let wrong = || failed(source.name, format!("this directive is out of place: {line}"));
        match directive(&line).as_deref() {
            Some(["ifdef", name]) => conditions.push(is_defined(name)),
            Some(["ifndef", name]) => conditions.push(!is_defined(name)),
            Some(["else"]) => {
                let last = conditions.last_mut().ok_or_else(wrong)?;
                *last = !*last;
            }
            Some(["endif"]) => {
                conditions.pop().ok_or_else(wrong)?;
            }
            Some(["param", ..]) => {}
            Some(_) => return Err(wrong()),
            None if conditions.iter().all(|c| *c) => {
                out.push_str(&replaced(&line, &values));
                out.push('\n');
            }
            None => {}
        }
    }
    if !conditions.is_empty() {
        return Err(failed(source.name, "an #ifdef has no #endif"));
    }
    Ok(out)
}

/// A line with parameter names, as whole words, replaced by their values.
fn replaced(line: &str, values: &BTreeMap<String, String>) -> String {
    if values.is_empty() {
        return line.to_string();
    }
    let mut out = String::with_capacity(line.len());
    let mut rest = line;
    while !rest.is_empty() {
        let is_word = |c: char| c.is_alphanumeric() || c == '_';
        let first_is_word = rest.starts_with(is_word);
        let end = rest.find(|c| is_word(c) != first_is_word).unwrap_or(rest.len());
        let (piece, tail) = rest.split_at(end);
        out.push_str(values.get(piece).map_or(piece, String::as_str));
        rest = tail;
    }
    out
}

/// Parses and validates a preprocessed text.
///
/// # Errors
/// The compiler's message with the faulty line.
pub fn validate(name: &str, text: &str, subgroups: bool) -> GpuResult<(naga::Module, naga::valid::ModuleInfo)> {
    let module = naga::front::wgsl::parse_str(text).map_err(|e| failed(name, e.emit_to_string(text)))?;
    let mut capabilities = naga::valid::Capabilities::empty();
    capabilities.set(naga::valid::Capabilities::SUBGROUP, subgroups);
    let mut validator = naga::valid::Validator::new(naga::valid::ValidationFlags::all(), capabilities);
    let info = validator.validate(&module).map_err(|e| failed(name, e.emit_to_string(text)))?;
    Ok((module, info))
}

/// Reflects an entry point of a preprocessed text.
///
/// # Errors
/// The text does not validate, the entry point does not exist, or a binding is outside group 0.
pub fn reflect(name: &str, text: &str, entry: &str, subgroups: bool) -> GpuResult<Reflection> {
    let (module, info) = validate(name, text, subgroups)?;
    let index = module
        .entry_points
        .iter()
        .position(|e| e.name == entry && e.stage == naga::ShaderStage::Compute)
        .ok_or_else(|| failed(name, format!("has no compute entry point {entry:?}")))?;
    let uses = info.get_entry_point(index);
    let mut layouter = naga::proc::Layouter::default();
    layouter.update(module.to_ctx()).map_err(|e| failed(name, e.to_string()))?;
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
            _ => return Err(failed(name, format!("{variable_name} is not bound in group 0"))),
        };
        let min_size = u64::from(layouter[variable.ty].size);
        bindings.push(Binding { number, name: variable_name, kind, min_size });
    }
    bindings.sort_by_key(|b| b.number);
    let workgroup_size = module.entry_points[index].workgroup_size;
    Ok(Reflection { bindings, workgroup_size, workgroup_storage })
}
