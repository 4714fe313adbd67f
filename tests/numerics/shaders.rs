//! Every shader in every variant, without a device: the shader parses and validates; its bindings, workgroup sizes,
//! struct layouts and constants equal those of the Rust side. All failures are reported at once.

use gsscale::gpu::{SOURCES, STORAGE_BUFFERS_MOST, Source, StructLayout, preprocess, validate, variants};
use gsscale::kernels::project_fwd::View;
use gsscale::kernels::{constants, gate, uniforms};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use wgpu::naga;

/// Rust twins of the structs that shaders read as uniforms (and of others that are declared in both languages).
const LAYOUTS: &[&[StructLayout]] = &[
    &[View::LAYOUT, uniforms::LossUniforms::LAYOUT],
    &[
        uniforms::DevicePage::LAYOUT,
        uniforms::PageResult::LAYOUT,
        uniforms::PageSurvey::LAYOUT,
        uniforms::GatherUniforms::LAYOUT,
        uniforms::UpdateUniforms::LAYOUT,
        gate::GateUniforms::LAYOUT,
        gate::StepVerdict::LAYOUT,
    ],
    &[
        uniforms::ScanUniforms::LAYOUT,
        uniforms::SortUniforms::LAYOUT,
        uniforms::IsectUniforms::LAYOUT,
        uniforms::OffsetsUniforms::LAYOUT,
        uniforms::RasterUniforms::LAYOUT,
        uniforms::RangeUniforms::LAYOUT,
    ],
];

/// Entry points whose workgroups are not 256 invocations in one dimension: file, entry point, size, and why.
const OTHER_WORKGROUPS: &[(&str, &str, [u32; 3], &str)] = &[
    ("submission_count.wgsl", "count", [1, 1, 1], "a count"),
    ("radix_sort.wgsl", "radix_histogram", [128, 1, 1], "the sort's"),
    (
        "radix_sort.wgsl",
        "radix_sort",
        [128, 1, 1],
        "a block of keys and their counts fill the memory that every device has",
    ),
    ("image_loss.wgsl", "ssim_map", [128, 1, 1], "two pixels of a tile to an invocation"),
    ("image_loss.wgsl", "gradient", [128, 1, 1], "two pixels of a tile to an invocation"),
    ("rasterize_fwd.wgsl", "rasterize_fwd", [64, 1, 1], "four pixels of a tile to an invocation"),
    ("rasterize_bwd.wgsl", "rasterize_bwd", [64, 1, 1], "four pixels of a tile to an invocation"),
];

/// The most variants that a shader may have: every variant is tested.
const VARIANTS_MAX: usize = 256;

fn all_layouts() -> Vec<StructLayout> {
    LAYOUTS.iter().flat_map(|table| table.iter().copied()).collect()
}

fn problems(source: &Source, layouts: &[StructLayout]) -> Vec<String> {
    let all = match variants(source) {
        Ok(all) if all.len() > VARIANTS_MAX => return vec![format!("{}: {} variants", source.name, all.len())],
        Ok(all) => all,
        Err(error) => return vec![error.to_string()],
    };
    let mut found = Vec::new();
    for variant in all {
        let defines: Vec<(&str, &str)> = variant.iter().map(|(n, v)| (n.as_str(), v.as_str())).collect();
        let subgroups = defines.iter().any(|(n, _)| n.starts_with("SUBGROUPS"));
        let checked = preprocess(source, &defines).and_then(|text| validate(source.name, &text, subgroups));
        let wrong = match checked {
            Ok((module, info)) => module_problems(source.name, &module, &info, layouts),
            Err(error) => vec![error.to_string()],
        };
        found.extend(wrong.into_iter().map(|w| format!("{} {defines:?}: {w}", source.name)));
    }
    found
}

fn module_problems(
    name: &str,
    module: &naga::Module,
    info: &naga::valid::ModuleInfo,
    layouts: &[StructLayout],
) -> Vec<String> {
    let mut wrong = Vec::new();
    let is_shared = name.starts_with("shared/");
    if is_shared != module.entry_points.is_empty() {
        wrong.push(format!("{} entry points", module.entry_points.len()));
    }
    for entry in &module.entry_points {
        let listed = OTHER_WORKGROUPS.iter().find(|(file, e, _, _)| *file == name && *e == entry.name);
        let expected = listed.map_or([256, 1, 1], |(_, _, size, _)| *size);
        if entry.workgroup_size != expected {
            wrong.push(format!("{}: workgroups of {:?}, expected {expected:?}", entry.name, entry.workgroup_size));
        }
    }
    for (e, entry) in module.entry_points.iter().enumerate() {
        let storage = module.global_variables.iter().filter(|(handle, variable)| {
            let is_storage = matches!(variable.space, naga::AddressSpace::Storage { .. });
            is_storage && !info.get_entry_point(e)[*handle].is_empty()
        });
        let count = storage.count();
        if count > STORAGE_BUFFERS_MOST as usize {
            wrong.push(format!("{}: {count} storage buffers, more than {STORAGE_BUFFERS_MOST}", entry.name));
        }
    }
    wrong.extend(binding_problems(module, info, is_shared));
    wrong.extend(layout_problems(module, layouts));
    wrong
}

fn binding_problems(module: &naga::Module, info: &naga::valid::ModuleInfo, is_shared: bool) -> Vec<String> {
    let mut wrong = Vec::new();
    let mut numbers = Vec::new();
    for (handle, variable) in module.global_variables.iter() {
        let Some(binding) = &variable.binding else { continue };
        let name = variable.name.clone().unwrap_or_default();
        if is_shared {
            wrong.push(format!("{name}: bindings are declared by the stage, not by what it imports"));
        }
        if binding.group != 0 {
            wrong.push(format!("{name} is in group {}", binding.group));
        }
        if variable.space == naga::AddressSpace::Uniform && binding.binding != 0 {
            wrong.push(format!("{name}: the uniform is binding {}, not 0", binding.binding));
        }
        let used = (0..module.entry_points.len()).any(|e| !info.get_entry_point(e)[handle].is_empty());
        if !used && !is_shared {
            wrong.push(format!("{name} is bound but used by no entry point"));
        }
        numbers.push(binding.binding);
    }
    numbers.sort_unstable();
    if !numbers.iter().copied().eq(0..numbers.len() as u32) {
        wrong.push(format!("bindings are numbered {numbers:?}"));
    }
    wrong
}

fn layout_problems(module: &naga::Module, layouts: &[StructLayout]) -> Vec<String> {
    let mut wrong = Vec::new();
    let uniforms: BTreeSet<_> = module
        .global_variables
        .iter()
        .filter(|(_, v)| v.space == naga::AddressSpace::Uniform)
        .map(|(_, v)| v.ty.index())
        .collect();
    for (handle, ty) in module.types.iter() {
        let naga::TypeInner::Struct { members, span } = &ty.inner else { continue };
        let name = ty.name.clone().unwrap_or_default();
        let Some(twin) = layouts.iter().find(|l| l.name == name) else {
            if uniforms.contains(&handle.index()) {
                wrong.push(format!("the uniform struct {name} has no Rust twin in LAYOUTS"));
            }
            continue;
        };
        // Names with a leading underscore are padding: only the others must have equal offsets.
        let shader: Vec<_> = members.iter().map(|m| (m.name.clone().unwrap_or_default(), m.offset as usize)).collect();
        let shader: Vec<_> =
            shader.iter().map(|(n, o)| (n.as_str(), *o)).filter(|(n, _)| !n.starts_with('_')).collect();
        let rust: Vec<_> = twin.fields.iter().copied().filter(|(n, _)| !n.starts_with('_')).collect();
        if shader != rust || twin.size != *span as usize {
            wrong.push(format!("{name}: {span} bytes {shader:?} here, {} bytes {rust:?} in Rust", twin.size));
        }
    }
    wrong
}

#[test]
fn every_variant_of_every_shader_validates() {
    let wrong: Vec<String> = SOURCES.iter().flat_map(|source| problems(source, &all_layouts())).collect();
    assert!(wrong.is_empty(), "{} problems:\n{}", wrong.len(), wrong.join("\n"));
}

#[test]
fn every_shader_file_is_in_the_table_and_stages_have_their_twins() {
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR"));
    let mut files = BTreeSet::new();
    let mut folders = vec![root.join("shaders")];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else {
                let name = path.strip_prefix(root.join("shaders")).unwrap().to_string_lossy().replace('\\', "/");
                files.insert(name);
            }
        }
    }
    let table: BTreeSet<String> = SOURCES.iter().map(|s| s.name.to_string()).collect();
    assert_eq!(files, table, "files under shaders/ and the table in src/gpu/sources.rs");
    assert_eq!(table.len(), SOURCES.len(), "a name stands twice in the table");
    // The count of submissions is no stage.
    for name in table.iter().filter(|n| !n.contains('/') && *n != "submission_count.wgsl") {
        let twin = Path::new(name).with_extension("rs");
        let is_there = |folder: &str| root.join(folder).join(&twin).is_file();
        assert!(is_there("src/kernels") || is_there("tests/numerics/twins"), "shaders/{name} has no CPU twin");
    }
}

#[test]
fn every_struct_of_the_tables_is_in_a_shader() {
    let mut names = BTreeSet::new();
    for source in SOURCES {
        for variant in variants(source).unwrap() {
            let defines: Vec<(&str, &str)> = variant.iter().map(|(n, v)| (n.as_str(), v.as_str())).collect();
            let text = preprocess(source, &defines).unwrap();
            let Ok(module) = naga::front::wgsl::parse_str(&text) else { continue }; // the other test reports it
            names.extend(module.types.iter().filter_map(|(_, ty)| ty.name.clone()));
        }
    }
    let lost: Vec<_> = all_layouts().into_iter().filter(|l| !names.contains(l.name)).map(|l| l.name).collect();
    assert!(lost.is_empty(), "no shader has the structs {lost:?}");
}

#[test]
fn constants_are_the_same_in_both_languages() {
    let rust: &[(&str, f64)] = &[
        ("TILE", f64::from(constants::TILE)),
        ("ALPHA_MIN", f64::from(constants::ALPHA_MIN)),
        ("TRANSMITTANCE_MIN", f64::from(constants::TRANSMITTANCE_MIN)),
        ("EPS2D", f64::from(constants::EPS2D)),
        ("EXTENT_SIGMAS", f64::from(constants::EXTENT_SIGMAS)),
    ];
    let source = SOURCES.iter().find(|s| s.name == "shared/constants.wgsl").unwrap();
    let text = preprocess(source, &[]).unwrap();
    let (module, _) = validate(source.name, &text, false).unwrap();
    let mut shader: Vec<(String, f64)> = Vec::new();
    for (_, constant) in module.constants.iter() {
        let value = match module.global_expressions[constant.init] {
            naga::Expression::Literal(naga::Literal::F32(v)) => f64::from(v),
            naga::Expression::Literal(naga::Literal::U32(v)) => f64::from(v),
            naga::Expression::Literal(naga::Literal::I32(v)) => f64::from(v),
            ref other => panic!("{:?} is {other:?}, not a number", constant.name),
        };
        shader.push((constant.name.clone().unwrap(), value));
    }
    for (name, value) in rust {
        let twin = shader.iter().find(|(n, _)| n == name);
        assert_eq!(twin.map(|(_, v)| *v), Some(*value), "{name}");
    }
    for (name, _) in &shader {
        assert!(rust.iter().any(|(n, _)| n == name), "{name} of the shaders is compared with nothing");
    }
    let file = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/src/kernels/constants.rs")).unwrap();
    for line in file.lines().filter_map(|l| l.strip_prefix("pub const ")) {
        let name = line.split(':').next().unwrap();
        assert!(rust.iter().any(|(n, _)| *n == name), "{name} of src/kernels/constants.rs is compared with nothing");
    }
}

/// The checks above find each fault in an otherwise correct shader.
#[test]
fn the_checks_find_faults() {
    const GOOD: &str = "struct U { count: u32, scale: f32 }
        @group(0) @binding(0) var<uniform> u: U;
        @group(0) @binding(1) var<storage, read_write> out: array<f32>;
        @compute @workgroup_size(256)
        fn main(@builtin(global_invocation_id) id: vec3<u32>) {
            if id.x < u.count { out[id.x] = u.scale; }
        }";
    let twin = StructLayout { name: "U", size: 8, fields: &[("count", 0), ("scale", 4)] };
    let found = |from: &str, to: &str| {
        assert!(GOOD.contains(from));
        let text: &'static str = GOOD.replace(from, to).leak();
        problems(&Source { name: "x.wgsl", text }, &[twin]).join("\n")
    };
    assert_eq!(found("u", "u"), "");
    let more: Vec<u32> = (2..12).collect();
    let sum = more.iter().map(|i| format!("b{i}[0]")).collect::<Vec<_>>().join(" + ");
    let declared = more.iter().map(|i| format!("@group(0) @binding({i}) var<storage, read> b{i}: array<f32>;\n"));
    let crowded = format!("out[id.x] = {sum}; }} }}\n{}fn rest() {{", declared.collect::<String>());
    let cases = [
        ("out[id.x] = u.scale", "out[id.x] = u.count", "x.wgsl"),
        ("@workgroup_size(256)", "@workgroup_size(16, 16)", "workgroups of [16, 16, 1]"),
        ("@binding(1)", "@binding(2)", "numbered [0, 2]"),
        ("@group(0) @binding(1)", "@group(1) @binding(1)", "in group 1"),
        ("out[id.x] = u.scale", "return", "out is bound but used by no entry point"),
        ("scale: f32", "@align(16) scale: f32", "in Rust"),
        ("scale: f32", "scale: f32, more: u32", "in Rust"),
        ("struct U", "struct V {} struct U", "x.wgsl"),
        ("@compute", "#ifdef SUBGROUPS\nnonsense\n#endif\n@compute", "SUBGROUPS"),
        ("@compute", "#param N 1 2 x\nconst N2 = N;\n@compute", "\"x\""),
        ("out[id.x] = u.scale", "\n#repeat N 0 1 x\nout[N] = u.scale;\n#end\n", "x"),
        ("@compute", "#repeat N 0 1\n@compute", "#repeat has no #end"),
        ("@compute", "#end\n@compute", "out of place"),
        ("out[id.x] = u.scale; }", &crowded, "main: 11 storage buffers"),
    ];
    for (from, to, expected) in cases {
        let report = found(from, to);
        assert!(report.contains(expected), "{from} -> {to}: {report:?} does not name {expected:?}");
    }
    let no_twin = problems(&Source { name: "x.wgsl", text: GOOD }, &[]);
    assert!(no_twin[0].contains("no Rust twin"), "{no_twin:?}");
}

/// Chrome's compiler judges stricter than naga: literals that are no f32, barriers that it cannot prove to be reached by all. Files of
/// `shared/` have no entry points and are judged as imports.
#[test]
fn every_variant_passes_tint() {
    let modules = std::env::var_os("GSSCALE_NODE_BIN").map(|bin| PathBuf::from(bin).parent().unwrap().to_path_buf());
    let Some(modules) = modules.filter(|modules| modules.join("webgpu").is_dir()) else {
        return println!("SKIPPED: no npm package webgpu beside GSSCALE_NODE_BIN");
    };
    let folder = tempfile::tempdir().unwrap();
    let mut files = Vec::new();
    for source in SOURCES.iter().filter(|source| !source.name.contains('/')) {
        for (i, variant) in variants(source).unwrap().iter().enumerate() {
            let defines: Vec<(&str, &str)> = variant.iter().map(|(n, v)| (n.as_str(), v.as_str())).collect();
            let is_native = variant.iter().any(|(name, _)| name == "SUBGROUPS" || name == "SUBGROUPS_OF_8");
            // Tint does not take what all of a subgroup have voted for as the same for all of it.
            let enable = "enable subgroups;\ndiagnostic(off, subgroup_uniformity);\n";
            let enable = if is_native { enable } else { "" };
            let text = format!("{enable}// {defines:?}\n{}", preprocess(source, &defines).unwrap());
            files.push(folder.path().join(format!("{i}-{}", source.name)));
            std::fs::write(files.last().unwrap(), text).unwrap();
        }
    }
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/numerics/tint.mjs");
    let tint = std::process::Command::new("node").arg(script).arg(modules).args(&files).output().unwrap();
    let said = [tint.stdout, tint.stderr].map(|text| String::from_utf8_lossy(&text).into_owned()).concat();
    assert!(tint.status.success() && said.is_empty(), "{said}");
}
