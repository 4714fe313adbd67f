use std::path::PathBuf;
use std::sync::OnceLock;

pub struct Lab { device: wgpu::Device, queue: wgpu::Queue }

fn preprocess(name: &str, defines: &[&str], seen: &mut Vec<String>, out: &mut String) {
    if seen.iter().any(|s| s == name) { return }
    seen.push(name.into());
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("shaders").join(name);
    let text = std::fs::read_to_string(&path).unwrap();
    let mut on = vec![true];
    for line in text.lines() {
        let t = line.trim();
        if let Some(d) = t.strip_prefix("#ifdef ") { let v = *on.last().unwrap() && defines.contains(&d.trim()); on.push(v); }
        else if t == "#endif" { on.pop(); }
        else if !on.last().unwrap() {}
        else if let Some(i) = t.strip_prefix("#import ") { preprocess(i.trim().trim_matches('"'), defines, seen, out); }
        else { out.push_str(line); out.push('\n'); }
    }
}

pub fn lab() -> Option<&'static Lab> {
    static LAB: OnceLock<Option<Lab>> = OnceLock::new();
    LAB.get_or_init(|| {
        let instance = wgpu::Instance::new(wgpu::InstanceDescriptor { backends: wgpu::Backends::VULKAN, ..wgpu::InstanceDescriptor::new_without_display_handle() });
        let adapter = pollster::block_on(instance.request_adapter(&wgpu::RequestAdapterOptions { power_preference: wgpu::PowerPreference::HighPerformance, ..Default::default() })).ok()?;
        println!("{:?}", adapter.get_info().name);
        let (device, queue) = pollster::block_on(adapter.request_device(&wgpu::DeviceDescriptor { required_limits: adapter.limits(), ..Default::default() })).unwrap();
        Some(Lab { device, queue })
    }).as_ref()
}

impl Lab {
    pub fn run(&self, shader: &str, entry: &str, defines: &[&str], uniform: &[u8], buffers: &mut [(u32, &mut Vec<u32>)], groups: u32) {
        let mut text = String::new();
        preprocess(shader, defines, &mut Vec::new(), &mut text);
        let module = self.device.create_shader_module(wgpu::ShaderModuleDescriptor { label: Some(shader), source: wgpu::ShaderSource::Wgsl(text.as_str().into()) });
        let entry_of = |binding, ty| wgpu::BindGroupLayoutEntry { binding, visibility: wgpu::ShaderStages::COMPUTE, ty: wgpu::BindingType::Buffer { ty, has_dynamic_offset: false, min_binding_size: None }, count: None };
        let mut entries = vec![entry_of(0, wgpu::BufferBindingType::Uniform)];
        for (b, _) in buffers.iter() {
            let at = text.find(&format!("@binding({b}) ")).unwrap();
            let read_only = !text[at..].lines().next().unwrap().contains("read_write");
            entries.push(entry_of(*b, wgpu::BufferBindingType::Storage { read_only }));
        }
        let layout = self.device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label: None, entries: &entries });
        let pl = self.device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor { label: None, bind_group_layouts: &[Some(&layout)], ..Default::default() });
        let pipeline = self.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor { label: None, layout: Some(&pl), module: &module, entry_point: Some(entry), compilation_options: Default::default(), cache: None });
        let make = |bytes: &[u8], usage| {
            let b = self.device.create_buffer(&wgpu::BufferDescriptor { label: None, size: (bytes.len() as u64).max(256), usage: usage | wgpu::BufferUsages::COPY_DST, mapped_at_creation: false });
            self.queue.write_buffer(&b, 0, bytes);
            b
        };
        let ub = make(uniform, wgpu::BufferUsages::UNIFORM);
        let raw: Vec<_> = buffers.iter().map(|(_, d)| make(bytemuck::cast_slice(d), wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC)).collect();
        let mut binds = vec![wgpu::BindGroupEntry { binding: 0, resource: ub.as_entire_binding() }];
        for ((b, _), r) in buffers.iter().zip(&raw) { binds.push(wgpu::BindGroupEntry { binding: *b, resource: r.as_entire_binding() }); }
        let group = self.device.create_bind_group(&wgpu::BindGroupDescriptor { label: None, layout: &layout, entries: &binds });
        let mut enc = self.device.create_command_encoder(&Default::default());
        {
            let mut pass = enc.begin_compute_pass(&Default::default());
            pass.set_pipeline(&pipeline);
            pass.set_bind_group(0, &group, &[]);
            pass.dispatch_workgroups(groups, 1, 1);
        }
        let staging: Vec<_> = raw.iter().map(|r| { let s = self.device.create_buffer(&wgpu::BufferDescriptor { label: None, size: r.size(), usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST, mapped_at_creation: false }); enc.copy_buffer_to_buffer(r, 0, &s, 0, r.size()); s }).collect();
        self.queue.submit([enc.finish()]);
        for ((_, d), s) in buffers.iter_mut().zip(&staging) {
            s.slice(..).map_async(wgpu::MapMode::Read, |r| r.unwrap());
            self.device.poll(wgpu::PollType::wait_indefinitely()).unwrap();
            let view = s.slice(..).get_mapped_range().unwrap();
            let bytes = 4 * d.len();
            d.copy_from_slice(bytemuck::cast_slice(&view[..bytes]));
        }
    }
}

pub fn bits(values: &[f32]) -> Vec<u32> { values.iter().map(|v| v.to_bits()).collect() }
pub fn floats(values: &[u32]) -> Vec<f32> { values.iter().map(|v| f32::from_bits(*v)).collect() }
