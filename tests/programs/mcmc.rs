//! The strategy `mcmc` through the program: what it adds to every step arrives, on the CPU and where a GPU renders.

use crate::support::a_device;
use crate::support::workdir::Workdir;

#[test]
fn noise_moves_means_and_regularisers_shrink_what_views_draw() {
    let work = Workdir::city(40, 64, 48, 2000);
    // Runs that end before their first round. Strategies that grow begin with the same pages, so rows have the same order.
    let of = |flags: &str| {
        ["default", "mcmc"].map(|strategy| {
            let keys = format!("--overwrite --refine-start 1000 --max-gaussians 3000 --strategy {strategy} {flags}");
            work.run("out", &keys);
            work.gaussians("out/point_cloud.ply").0
        })
    };
    // The means' own gradients are those of the loss in the first step, and faint rows have noise.
    let [without, with] = of("--steps 1 --init-opacity 0.01");
    assert!(without.means.iter().zip(&with.means).any(|(a, b)| a != b), "no mean has noise");
    // Rows of this opacity have no noise: what differs comes from the regularisers, which lower opacities and sizes.
    let [without, with] = of("--steps 30 --init-opacity 0.9");
    let mean = |values: &[f32]| values.iter().map(|x| f64::from(*x)).sum::<f64>() / values.len() as f64;
    assert!(mean(&with.opacities) < mean(&without.opacities), "opacities are not lower");
    assert!(mean(&with.scales) < mean(&without.scales), "Gaussians are not smaller");
}

#[test]
fn a_gpu_relocates_as_many_as_the_cpu() {
    let Some(()) = a_device() else { return };
    let work = Workdir::wide_city(6000);
    let flags = "--steps 60 --refine-start 10 --refine-every 8 --prune-opa 0.03 --page-rows 32 --strategy mcmc --max-gaussians 6100 \
        --init-opacity 0.05";
    let [cpu, gpu] = ["cpu", "gpu"].map(|device| {
        work.run(device, &format!("{flags} --device {device}"));
        work.count(device, "gaussians") as f64
    });
    // Roundings differ, so a few rows near a threshold may have another fate.
    assert!((gpu / cpu - 1.0).abs() < 0.01 && gpu > 6000.0, "{gpu}, on the CPU {cpu}");
}
