//! The GPU runtime on any adapter, software adapters included: uploads, dispatches, read-backs, budgets and limits.
//! Without an adapter the tests print a skip; in CI they fail.

use gsscale::gpu::{
    DeviceChoice, DeviceKind, FaultKind, Gpu, GpuError, GpuOptions, InjectedFault, Source, Subgroups, groups_1d,
};

use crate::support::gpu::open;

gsscale::wgsl_struct! {
    /// Uniforms of the test kernel.
    struct TestUniforms {
        count: u32,
        add: u32,
    }
}

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
fn main(workgroup: Group, place: Place) {
    let i = linear_index(workgroup, place, 256u);
    if i >= u.count { return; }
    values_out[i] = values_in[i] * FACTOR + u.add;
}
"#,
};

/// Each workgroup adds its number to its own element.
const MARK: Source = Source {
    name: "test/mark.wgsl",
    text: r#"
#import "shared/dispatch.wgsl"
struct TestUniforms { count: u32, add: u32 }
@group(0) @binding(0) var<uniform> u: TestUniforms;
@group(0) @binding(1) var<storage, read_write> marks: array<atomic<u32>>;
@compute @workgroup_size(1)
fn main(workgroup: Group) {
    let i = linear_group(workgroup);
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
    let mut out: Vec<u32> = readback.to_vec()?;
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

#[test]
fn dispatches_fold_beyond_65535_workgroups() {
    let Some(gpu) = open(&GpuOptions::default()) else { return };
    let count = 2 * 65_535 + 3;
    let groups = groups_1d(count, 1);
    assert!(groups[1] > 1);
    let mut pass = gpu.begin("test");
    let marks = pass.buffer_zeroed("marks", u64::from(count) * 4).unwrap();
    let pipeline = gpu.pipeline_from(&MARK, "main", &[]).unwrap();
    let uniform = pass.uniform(&TestUniforms { count, add: 1 }).unwrap();
    pass.dispatch("mark", &pipeline, &[uniform, marks.view()], groups).unwrap();
    let readback = pass.read_back("mark", &marks.view()).unwrap();
    gpu.submit(pass).unwrap();
    let out: Vec<u32> = readback.to_vec().unwrap();
    assert!(out.iter().zip(1..).all(|(mark, once)| *mark == once), "each place exactly once");
}

#[test]
fn every_dispatch_has_its_own_uniforms() {
    let Some(gpu) = open(&GpuOptions::default()) else { return };
    let pipeline = gpu.pipeline_from(&MARK, "main", &[]).unwrap();
    let mut pass = gpu.begin("test");
    let marks = pass.buffer_zeroed("marks", 4).unwrap();
    let rounds = 5_000; // more than one uniform buffer of the ring, at any alignment
    for add in 1..=rounds {
        let uniform = pass.uniform(&TestUniforms { count: 1, add }).unwrap();
        pass.dispatch("mark", &pipeline, &[uniform, marks.view()], [1, 1, 1]).unwrap();
    }
    let readback = pass.read_back("mark", &marks.view()).unwrap();
    gpu.submit(pass).unwrap();
    assert_eq!(readback.to_vec::<u32>().unwrap(), [rounds * (rounds + 1) / 2]);
}

#[test]
fn uploads_larger_than_the_staging_arrive_whole() {
    let Some(gpu) = open(&GpuOptions::default()) else { return };
    let mut staging_after_first = 0;
    for round in 0..3u32 {
        let values: Vec<u32> = (0..20 << 20).map(|i: u32| i.wrapping_mul(2_654_435_761).wrapping_add(round)).collect();
        let mut pass = gpu.begin("test");
        let buffer = pass.buffer_with("values", &values).unwrap();
        let readback = pass.read_back("values", &buffer.view()).unwrap();
        gpu.submit(pass).unwrap();
        assert!(readback.to_vec::<u32>().unwrap() == values, "round {round}");
        let traffic = gpu.traffic();
        assert_eq!(traffic.bytes_uploaded, u64::from(round + 1) * (80 << 20));
        assert_eq!(traffic.bytes_read_back, u64::from(round + 1) * (80 << 20));
        assert_eq!(traffic.device_allocations, 2, "a dropped buffer is reused, and so is that of its read-back");
        // Two sets of 32 MiB to the device, one buffer of 80 MiB back; uniforms.
        assert!(traffic.staging_bytes <= (64 + 80 + 1) << 20, "{traffic:?}");
        if round == 0 {
            staging_after_first = traffic.staging_bytes;
        }
        assert_eq!(traffic.staging_bytes, staging_after_first, "nothing is allocated once warm");
    }
}

#[test]
fn uploads_of_partial_words_arrive() {
    let Some(gpu) = open(&GpuOptions::default()) else { return };
    for len in [1usize, 3, 4, 5, 4097] {
        let bytes: Vec<u8> = (0..len).map(|i| (i * 7 + 1) as u8).collect();
        let mut pass = gpu.begin("test");
        let buffer = pass.buffer_with("bytes", &bytes).unwrap();
        let readback = pass.read_back("bytes", &buffer.view()).unwrap();
        gpu.submit(pass).unwrap();
        let out: Vec<u8> = readback.to_vec().unwrap();
        assert_eq!(out[..len], bytes);
        assert!(out[len..].iter().all(|b| *b == 0));
    }
}

#[test]
fn results_of_several_submissions_can_be_under_way() {
    let Some(gpu) = open(&GpuOptions::default()) else { return };
    let mut waiting = Vec::new();
    for k in 0..5u32 {
        let mut pass = gpu.begin("test");
        let buffer = pass.buffer_with("values", &[k, k + 1]).unwrap();
        waiting.push(pass.read_back("values", &buffer.view()).unwrap());
        gpu.submit(pass).unwrap();
    }
    for (k, readback) in (0..5u32).zip(waiting) {
        assert_eq!(readback.to_vec::<u32>().unwrap(), [k, k + 1]);
    }
}

/// As Metal does: no error, and the memory of read-backs holds what it held before.
#[test]
fn work_that_the_device_gives_up_without_an_error_is_found() {
    let opened = |submission| {
        let fault = Some(InjectedFault { kind: FaultKind::GivenUp, submission });
        open(&GpuOptions { fault, ..GpuOptions::default() })
    };
    let values: Vec<u32> = (0..1000).collect();
    // The submission of the read-back itself, and one before it that reads nothing.
    for (submission, empty) in [(4, false), (3, true)] {
        let Some(gpu) = opened(submission) else { return };
        for _ in 0..2 {
            assert_eq!(run_add(&gpu, &values, 7, &[]).unwrap()[999], 1006);
        }
        gpu.submit(gpu.begin("nothing")).unwrap();
        assert!(!empty || gpu.wait(&gpu.submit(gpu.begin("more")).unwrap()).is_ok(), "nothing was reported");
        let lost =
            |error: &GpuError| matches!(error, GpuError::DeviceLost { message, .. } if message.contains("gave up"));
        assert!(run_add(&gpu, &values, 7, &[]).is_err_and(|error| lost(&error)), "submission {submission}");
        assert!(run_add(&gpu, &values, 7, &[]).is_err_and(|error| lost(&error)), "a lost device stays lost");
    }
    // The first one, whose read-back finds memory that was never written.
    let Some(gpu) = opened(1) else { return };
    assert!(matches!(run_add(&gpu, &values, 7, &[]), Err(GpuError::DeviceLost { .. })));
}

/// The memory of read-backs is reused by ones of other lengths.
#[test]
fn read_backs_of_any_length_are_told_from_what_their_memory_held() {
    let fault = Some(InjectedFault { kind: FaultKind::GivenUp, submission: 3 });
    let Some(gpu) = open(&GpuOptions { fault, ..GpuOptions::default() }) else { return };
    // Each result is the count that the third submission expects, in the place behind the results of a shorter read-back.
    assert_eq!(run_add(&gpu, &[3; 60], 0, &[]).unwrap(), [3; 60]);
    assert_eq!(run_add(&gpu, &[3; 60], 0, &[]).unwrap(), [3; 60]);
    assert!(matches!(run_add(&gpu, &[5; 40], 0, &[]), Err(GpuError::DeviceLost { .. })));
}

/// A submission that an error prevented does not count.
#[test]
fn a_device_that_counts_its_submissions_goes_on_after_an_error() {
    let fault = Some(InjectedFault { kind: FaultKind::OutOfMemory, submission: 2 });
    let Some(gpu) = open(&GpuOptions { counts_submissions: true, fault, ..GpuOptions::default() }) else { return };
    let run = || run_add(&gpu, &[1, 2, 3], 7, &[]);
    assert_eq!(run().unwrap(), [8, 9, 10]);
    assert!(run().is_err_and(|error| matches!(error, GpuError::OutOfMemory { .. })));
    assert_eq!(run().unwrap(), [8, 9, 10]);
}

#[test]
fn the_budget_is_kept_and_an_excess_names_need_and_budget() {
    let budget = 3 << 20;
    let Some(gpu) = open(&GpuOptions { budget: Some(budget), ..GpuOptions::default() }) else { return };
    let first = gpu.buffer("first", 1 << 20).unwrap();
    let second = gpu.buffer("second", 2 << 20).unwrap();
    assert_eq!(gpu.traffic().device_bytes, budget);
    match gpu.buffer("third", 1000).unwrap_err() {
        GpuError::OutOfBudget { what, need, in_use, budget: allowed } => {
            assert_eq!((what.as_str(), in_use, allowed), ("third", budget, budget));
            assert!((1000..=1250).contains(&need));
        }
        other => panic!("{other}"),
    }
    drop(first);
    let reused = gpu.buffer("reused", (1 << 20) - 5).unwrap();
    assert_eq!(gpu.traffic().device_allocations, 2);
    drop((reused, second));
    // Neither free buffer fits: both are released to make room.
    let whole = gpu.buffer("whole", 3 << 20).unwrap();
    let traffic = gpu.traffic();
    assert_eq!((traffic.device_bytes, traffic.device_bytes_peak, traffic.device_allocations), (budget, budget, 3));
    drop(whole);
    assert_eq!(gpu.traffic().device_bytes, 0);
    let text = gpu.buffer("huge", u64::MAX).unwrap_err().to_string();
    assert!(text.contains("huge needs one buffer"), "{text}");
}

#[test]
fn a_binding_beyond_the_limit_is_refused_and_windows_are_not() {
    let limit = 64 << 10;
    let Some(gpu) = open(&GpuOptions { max_binding_bytes: Some(limit), ..GpuOptions::default() }) else { return };
    assert_eq!(gpu.max_binding_bytes(), limit);
    let values: Vec<u32> = (0..40_000).collect();
    match run_add(&gpu, &values, 1, &[]).unwrap_err() {
        GpuError::BindingTooLarge { stage, binding, need, limit: allowed } => {
            assert_eq!((stage.as_str(), binding.as_str()), ("add", "values_in"));
            assert_eq!((need, allowed), (160_000, limit));
        }
        other => panic!("{other}"),
    }
    let pipeline = gpu.pipeline_from(&ADD, "main", &[]).unwrap();
    let mut pass = gpu.begin("test");
    let from = pass.buffer_with("values_in", &values).unwrap();
    let to = gpu.buffer("values_out", from.size()).unwrap();
    let rows = limit / 4;
    assert_eq!(limit % gpu.offset_alignment(), 0);
    let mut row = 0;
    while row < values.len() as u64 {
        let count = rows.min(values.len() as u64 - row);
        let uniform = pass.uniform(&TestUniforms { count: count as u32, add: 1 }).unwrap();
        let views = [uniform, from.slice(row * 4, count * 4), to.slice(row * 4, count * 4)];
        pass.dispatch("add", &pipeline, &views, groups_1d(count as u32, 256)).unwrap();
        row += count;
    }
    let readback = pass.read_back("add", &to.view()).unwrap();
    gpu.submit(pass).unwrap();
    assert!(readback.to_vec::<u32>().unwrap().iter().zip(1..).all(|(a, b)| *a == b));
}

#[test]
fn wrong_bindings_and_copies_are_errors_that_name_them() {
    let Some(gpu) = open(&GpuOptions::default()) else { return };
    let pipeline = gpu.pipeline_from(&ADD, "main", &[]).unwrap();
    let mut pass = gpu.begin("test");
    let (a, b) = (gpu.buffer("a", 1024).unwrap(), gpu.buffer("b", 1024).unwrap());
    let uniform = pass.uniform(&TestUniforms { count: 1, add: 1 }).unwrap();
    let short = pass.uniform(&1u32).unwrap();
    let cases = [
        (vec![uniform.clone(), a.view()], "values_in, values_out"),
        (vec![short, a.view(), b.view()], "u spans 4 bytes"),
        (vec![uniform.clone(), a.slice(4, 16), b.view()], "values_in begins at byte 4"),
        (vec![uniform.clone(), a.slice(1024, 512), b.view()], "beyond the end of a"),
        (vec![uniform.clone(), a.view(), a.view()], "values_out and values_in are one buffer"),
    ];
    for (views, expected) in cases {
        let text = pass.dispatch("add", &pipeline, &views, [1, 1, 1]).unwrap_err().to_string();
        assert!(text.starts_with("add: ") && text.contains(expected), "{text}");
    }
    let views = [uniform, a.view(), b.view()];
    assert!(pass.dispatch("add", &pipeline, &views, [65_536, 1, 1]).is_err());
    assert!(pass.upload(&a.view(), &[0u32; 257]).is_err());
    assert!(pass.copy(&a.view(), &a.slice(512, 512)).is_err());
    assert!(pass.clear(&a.slice(2, 4)).is_err());
    let early = pass.read_back("early", &a.view()).unwrap();
    assert!(early.to_vec::<u32>().unwrap_err().to_string().contains("before its commands were submitted"));
    drop(pass);
    let (one, two) = (gpu.begin("one"), gpu.begin("two"));
    assert!(gpu.submit(one).unwrap_err().to_string().contains("two recorders"));
    gpu.submit(two).unwrap();
    // A recording that is set aside counts as open until it is submitted or dropped.
    let mut recorder = gpu.begin("three");
    recorder.upload(&a.view(), &[7u32; 4]).unwrap();
    let recording = recorder.set_aside();
    assert!(gpu.submit(gpu.begin("four")).unwrap_err().to_string().contains("two recorders"));
    let mut recorder = gpu.resume(recording);
    let sevens = recorder.read_back("three", &a.slice(0, 16)).unwrap();
    gpu.submit(recorder).unwrap();
    assert_eq!(sevens.to_vec::<u32>().unwrap(), [7; 4]);
    drop(gpu.begin("five").set_aside());
    assert_eq!(run_add(&gpu, &[1, 2], 1, &[]).unwrap(), [2, 3], "the device is as good as before");
}

#[test]
fn shaders_that_do_not_compile_are_errors_that_name_them() {
    let Some(gpu) = open(&GpuOptions::default()) else { return };
    let error = |source: &Source, entry, defines: &[(&str, &str)]| {
        gpu.pipeline_from(source, entry, defines).unwrap_err().to_string()
    };
    assert!(error(&ADD, "main", &[("FACTR", "1u")]).contains("does not know the define FACTR"));
    assert!(error(&ADD, "main", &[("FACTOR", "2u")]).contains("none of 1u, 3u"));
    assert!(error(&ADD, "mian", &[]).contains("no compute entry point \"mian\""));
    let broken = Source { name: "test/broken.wgsl", text: "fn f() -> u32 { return 1.5; }" };
    assert!(error(&broken, "f", &[]).contains("shader test/broken.wgsl"));
    let lost = Source { name: "test/lost.wgsl", text: "#import \"shared/none.wgsl\"" };
    assert!(error(&lost, "f", &[]).contains("shared/none.wgsl"));
    let open_end = Source { name: "test/open.wgsl", text: "#ifdef A" };
    assert!(error(&open_end, "f", &[]).contains("no #endif"));
    assert!(gpu.pipeline("none.wgsl", "main", &[]).unwrap_err().to_string().contains("no such shader"));
}

#[test]
fn shaders_take_the_plain_path_without_subgroups() {
    let source = Source {
        name: "test/path.wgsl",
        text: "@group(0) @binding(0) var<storage, read_write> out: array<u32>;
            @compute @workgroup_size(256)
            fn main(@builtin(local_invocation_index) local: u32) {
            #ifdef SUBGROUPS
                let sum = subgroupAdd(1u);
                if local == 0u { out[0] = sum; }
            #else
                if local == 0u { out[0] = 0u; }
            #endif
            }",
    };
    for forced in [Subgroups::Best, Subgroups::Off] {
        let Some(gpu) = open(&GpuOptions { subgroups: forced, ..GpuOptions::default() }) else { return };
        let pipeline = gpu.pipeline_from(&source, "main", &[]).unwrap();
        let mut pass = gpu.begin("test");
        let out = gpu.buffer("out", 4).unwrap();
        pass.dispatch("path", &pipeline, &[out.view()], [1, 1, 1]).unwrap();
        let readback = pass.read_back("path", &out.view()).unwrap();
        gpu.submit(pass).unwrap();
        let sum = readback.to_vec::<u32>().unwrap()[0];
        match gpu.summary().subgroup_sizes {
            Some((low, high)) if forced == Subgroups::Best => assert!((low..=high).contains(&sum), "{sum}"),
            _ => assert_eq!(sum, 0),
        }
    }
}

#[test]
fn stages_are_timed_where_the_adapter_can() {
    let Some(gpu) = open(&GpuOptions { profile: true, ..GpuOptions::default() }) else { return };
    let values = vec![1u32; 1 << 20];
    run_add(&gpu, &values, 1, &[]).unwrap();
    run_add(&gpu, &values, 1, &[]).unwrap();
    let times = gpu.stage_times().unwrap();
    if gpu.summary().timestamps {
        assert_eq!(times.len(), 1);
        assert_eq!((times[0].stage, times[0].passes), ("add", 2));
        assert!(times[0].seconds > 0.0 && times[0].seconds < 60.0);
    } else {
        assert!(times.is_empty());
    }
}

#[test]
fn devices_are_found_by_name_and_listed() {
    let Some(gpu) = open(&GpuOptions::default()) else { return };
    let all = gsscale::gpu::list_adapters();
    assert!(all.windows(2).all(|pair| pair[0].kind <= pair[1].kind), "the best first");
    assert_eq!(all.iter().find(|s| s.refusal.is_none()), Some(gpu.summary()));
    let name = gpu.summary().name.to_uppercase();
    assert_eq!(
        Gpu::open_with(&DeviceChoice::Named(name), &GpuOptions::default()).unwrap().summary().name,
        gpu.summary().name
    );
    let text =
        Gpu::open_with(&DeviceChoice::Named("no such GPU".into()), &GpuOptions::default()).unwrap_err().to_string();
    assert!(text.contains("no such GPU") && text.contains(&gpu.summary().name), "{text}");
    match Gpu::open_with(&DeviceChoice::Auto, &GpuOptions::default()) {
        Ok(auto) => assert_ne!(auto.summary().kind, DeviceKind::Software),
        Err(error) => assert!(matches!(error, GpuError::NoHardwareGpu { .. }), "{error}"),
    }
}
