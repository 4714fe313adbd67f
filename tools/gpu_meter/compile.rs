//! Compiles every shader as stages do, on the first Vulkan device, and announces each pipeline on standard error, where a driver that is
//! asked to prints its statistics. Reads none of them: `run` and `table.py` beside this file do. With METER_UNCHECKED set, indices and
//! loops are compiled without the checks that stages have.

use std::collections::BTreeSet;
use std::error::Error;

use gsscale::gpu::{SOURCES, preprocess, validate, variants};
use gsscale::tell;

/// Defines that a stage has in this order: with degree 2 of the spherical harmonics the first two.
const DEGREES: [&str; 3] = ["SH_DEGREE_1", "SH_DEGREE_2", "SH_DEGREE_3"];
/// Defines of every shader that knows them, on a device whose subgroups have at least 32 invocations.
const OF_DEVICE: [&str; 2] = ["SUBGROUPS", "SUBGROUPS_OF_32"];
/// Defines of no shader on such a device.
const OF_OTHERS: [&str; 2] = ["SUBGROUPS_OF_8", "EMULATED_SUBGROUPS"];

/// Whether a stage has these defines, of those that its shader knows.
fn is_used(defines: &BTreeSet<&str>, known: &BTreeSet<&str>) -> bool {
    OF_DEVICE.iter().all(|name| defines.contains(name) == known.contains(name))
        && !OF_OTHERS.iter().any(|name| defines.contains(name))
        && DEGREES.windows(2).all(|pair| defines.contains(pair[0]) || !defines.contains(pair[1]))
}

fn open() -> Result<wgpu::Device, Box<dyn Error>> {
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor {
        backends: wgpu::Backends::VULKAN,
        // The checks have shaders of their own, whose statistics are not wanted.
        flags: wgpu::InstanceFlags::empty(),
        ..wgpu::InstanceDescriptor::new_without_display_handle()
    });
    let adapters = pollster::block_on(instance.enumerate_adapters(wgpu::Backends::VULKAN));
    let adapter = adapters.first().ok_or("there is no Vulkan device")?;
    let info = adapter.get_info();
    tell!("METER_DEVICE {}, {}", info.name, info.driver_info);
    let (device, _queue) = pollster::block_on(adapter.request_device(&wgpu::DeviceDescriptor {
        required_features: wgpu::Features::SUBGROUP,
        required_limits: adapter.limits(),
        ..Default::default()
    }))?;
    Ok(device)
}

fn main() -> Result<(), Box<dyn Error>> {
    let device = open()?;
    let is_checked = std::env::var_os("METER_UNCHECKED").is_none();
    for source in SOURCES.iter().filter(|source| !source.name.starts_with("shared/")) {
        let all = variants(source)?;
        let known: BTreeSet<&str> = all.iter().flatten().map(|(name, _)| name.as_str()).collect();
        let mut seen = BTreeSet::new();
        for variant in &all {
            let defines: Vec<(&str, &str)> =
                variant.iter().map(|(name, value)| (name.as_str(), value.as_str())).collect();
            let switches: BTreeSet<&str> =
                defines.iter().filter(|(_, v)| v.is_empty()).map(|(name, _)| *name).collect();
            let text = preprocess(source, &defines)?;
            // A parameter that the variant does not use gives the same text again.
            if !is_used(&switches, &known) || !seen.insert(text.clone()) {
                continue;
            }
            let (module, _) = validate(source.name, &text, true)?;
            let descriptor = wgpu::ShaderModuleDescriptor {
                label: Some(source.name),
                source: wgpu::ShaderSource::Wgsl(text.into()),
            };
            let shader = match is_checked {
                true => device.create_shader_module(descriptor),
                #[allow(unsafe_code)] // argued below
                // SAFETY: pipelines are compiled here and never run.
                false => unsafe {
                    device.create_shader_module_trusted(descriptor, wgpu::ShaderRuntimeChecks::unchecked())
                },
            };
            for entry in &module.entry_points {
                let [threads, ..] = entry.workgroup_size;
                let words: Vec<&str> = [source.name, &entry.name].into_iter().chain(switches.iter().copied()).collect();
                tell!("METER_PIPELINE {threads} {}", words.join(" "));
                let _pipeline = device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                    label: Some(&entry.name),
                    layout: None,
                    module: &shader,
                    entry_point: Some(&entry.name),
                    compilation_options: wgpu::PipelineCompilationOptions {
                        zero_initialize_workgroup_memory: false,
                        ..Default::default()
                    },
                    cache: None,
                });
            }
        }
    }
    Ok(())
}
