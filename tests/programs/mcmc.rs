//! The strategy `mcmc` through the program: what it adds to every step arrives, on the CPU and where a GPU renders.

use crate::support::gpu;
use crate::support::scenes::{city, stderr, summary, text, train, wide_city};
use gsscale::exchange::ply::{PlyContent, read_ply};
use gsscale::gpu::GpuOptions;
use gsscale::scene::columns::Columns;
use std::path::Path;
use tempfile::TempDir;

/// The result of a run that ends before its first round. Strategies that grow begin with the same pages, so rows have the same order.
fn result(scene: &Path, out: &Path, keys: &[&str]) -> Columns {
    let fixed = ["--quiet", "--device", "cpu", "--refine-start", "1000", "--max-gaussians", "3000"];
    let output = train(&[&[text(scene), "--out", text(out)], &fixed[..], keys].concat());
    assert!(output.status.success(), "{}", stderr(&output));
    match read_ply(&out.join("point_cloud.ply")).unwrap() {
        PlyContent::Gaussians { columns, .. } => columns,
        PlyContent::Points { .. } => panic!("the result has no Gaussians"),
    }
}

#[test]
fn noise_moves_means_and_regularisers_shrink_what_views_draw() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 40, 64, 48, 2000);
    let of = |name: &str, keys: &[&str]| {
        ["default", "mcmc"].map(|strategy| {
            let out = folder.path().join(format!("{name}-{strategy}"));
            result(&scene, &out, &[keys, &["--strategy", strategy]].concat())
        })
    };
    // The means' own gradients are those of the loss in the first step, and faint rows have noise.
    let [without, with] = of("noise", &["--steps", "1", "--init-opacity", "0.01"]);
    let moved = without.means.iter().zip(&with.means).filter(|(a, b)| a != b).count();
    assert!(moved > 0, "no mean has noise");
    // Rows of this opacity have no noise: what differs comes from the regularisers, which lower opacities and sizes.
    let [without, with] = of("regularisers", &["--steps", "30", "--init-opacity", "0.9"]);
    let mean = |values: &[f32]| values.iter().map(|x| f64::from(*x)).sum::<f64>() / values.len() as f64;
    assert!(mean(&with.opacities) < mean(&without.opacities), "opacities are not lower");
    assert!(mean(&with.scales) < mean(&without.scales), "Gaussians are not smaller");
}

#[test]
fn a_gpu_renders_relocations_in_memory_and_through_the_drive() {
    if gpu::open(&GpuOptions::default()).is_none() {
        return;
    }
    let folder = TempDir::new().unwrap();
    let scene = wide_city(folder.path(), 6_000);
    let rounds =
        ["--steps", "60", "--refine-start", "10", "--refine-every", "8", "--prune-opa", "0.03", "--page-rows", "32"];
    let strategy = ["--strategy", "mcmc", "--max-gaussians", "6100", "--init-opacity", "0.05", "--quiet"];
    let run = |name: &str, more: &[&str]| {
        let out = folder.path().join(name);
        let output = train(&[&[text(&scene), "--out", text(&out)], &rounds[..], &strategy, more].concat());
        assert!(output.status.success(), "{}", stderr(&output));
        (std::fs::read(out.join("point_cloud.ply")).unwrap(), summary(&out))
    };
    let (in_memory, whole) = run("memory", &["--device", "gpu"]);
    let frames = (whole["pages_pinned_max"].as_u64().unwrap() / 2).to_string();
    let spill = folder.path().join("spill");
    let (paged, traffic) = run("paged", &["--device", "gpu", "--frames", &frames, "--spill-dir", text(&spill)]);
    assert!(in_memory == paged && traffic["pages_read"].as_u64().unwrap() > 0, "{traffic}");
    let count = |summary: &serde_json::Value| summary["gaussians"].as_f64().unwrap();
    let (_, on_cpu) = run("cpu", &["--device", "cpu"]);
    // Roundings differ, so a few rows near a threshold may have another fate.
    assert!((count(&whole) / count(&on_cpu) - 1.0).abs() < 0.01, "{whole}, on the CPU {on_cpu}");
    assert!(count(&whole) > 6_000.0, "nothing was copied");
}
