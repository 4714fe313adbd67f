//! The GPU runtime on whatever adapter there is, software ones included: uploads, dispatches, read-backs, budgets and
//! limits. Without an adapter the tests say so and pass, but in CI that is a failure.
#![allow(clippy::unwrap_used, clippy::expect_used)] // a panic is a failed test

use gsscale::gpu::{Gpu, GpuError, GpuOptions, Source, groups_1d};

mod support;
use support::gpu::open;

gsscale::wgsl_struct! {
    /// Uniforms of the test kernel.
    struct TestUniforms {
        count: u32,
        add: u32,
    }
}

/// Adds a number to every element.
const ADD: Source = Source {
    name: "test/add.wgsl",
    text: r#"
#import "shared/dispatch.wgsl"
#param FACTOR 1u 3u
struct TestUniforms { count: u32, add: u32 }
@group(0) @binding(0) var<uniform> u: TestUniforms;
@group(0) @binding(1) var<storage, read> values_in: array<u32>;
@group(0) @binding(2) var<storage, read_write> values_out: array<u32>;
@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) local: u32) {
    let i = linear_index(group, groups, local, 256u);
    if i >= u.count { return; }
    values_out[i] = values_in[i] * FACTOR + u.add;
}
"#,
};

/// Writes the index of every workgroup, and counts how often each place is written.
const MARK: Source = Source {
    name: "test/mark.wgsl",
    text: r#"
#import "shared/dispatch.wgsl"
struct TestUniforms { count: u32, add: u32 }
@group(0) @binding(0) var<uniform> u: TestUniforms;
@group(0) @binding(1) var<storage, read_write> marks: array<atomic<u32>>;
@compute @workgroup_size(1)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = linear_group(group, groups);
    if i >= u.count { return; }
    atomicAdd(&marks[i], i + u.add);
}
"#,
};

fn run_add(gpu: &Gpu, values: &[u32], add: u32, defines: &[(&str, &str)]) -> Result<Vec<u32>, GpuError> {
    let pipeline = gpu.pipeline_from(&ADD, "main", defines)?;
    let mut pass = gpu.begin("test");
    let count = u32::try_from(values.len()).unwrap();
    let from = pass.buffer_with("values_in", values)?;
    let to = gpu.buffer("values_out", from.size())?;
    let uniform = pass.uniform(&TestUniforms { count, add })?;
    pass.dispatch("add", &pipeline, &[uniform, from.view(), to.view()], groups_1d(count, 256))?;
    let readback = pass.read_back("add", &to.view())?;
    gpu.submit(pass)?;
    let mut out: Vec<u32> = readback.to_vec(gpu)?;
    out.truncate(values.len());
    Ok(out)
}

#[test]
fn upload_dispatch_and_read_back() {
    let Some(gpu) = open(&GpuOptions::default()) else { return };
    let values: Vec<u32> = (0..10_007).collect();
    for (defines, factor) in [(&[][..], 1), (&[("FACTOR", "3u")][..], 3)] {
        let out = run_add(&gpu, &values, 7, defines).unwrap();
        assert!(out.iter().zip(&values).all(|(o, v)| *o == v * factor + 7));
    }
    assert!(run_add(&gpu, &[], 7, &[]).unwrap().is_empty());
}
