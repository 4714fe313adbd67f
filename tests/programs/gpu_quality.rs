//! Quality on a GPU and on the CPU when a run grows its scene, through the real binary: growth multiplies rounding differences, so single
//! runs differ as seeds do, and their means must not.

use crate::support::gpu;
use crate::support::scenes::{city, psnr, stderr, summary, text, train};
use gsscale::gpu::GpuOptions;
use tempfile::TempDir;

const SEEDS: [u32; 3] = [1, 2, 3];

/// Rounds, a reset and raises of colour bands.
const GROWS: &[&str] = &[
    "--steps",
    "400",
    "--refine-start",
    "60",
    "--refine-every",
    "40",
    "--grow-grad2d",
    "0.0006",
    "--max-gaussians",
    "4000",
    "--reset-every",
    "200",
    "--sh-every",
    "100",
    "--quiet",
];

/// `cargo nextest run --test programs --run-ignored only -E 'test(/gpu_quality/)' --no-capture`
#[test]
#[ignore = "trains for minutes"]
fn the_means_of_three_seeds_agree_within_the_spread_of_the_seeds() {
    if gpu::open(&GpuOptions::default()).is_none() {
        return;
    }
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 32, 128, 96, 1200);
    let of_device = |name: &str, flags: &[&str]| {
        SEEDS.map(|seed| {
            let (out, seed) = (folder.path().join(format!("{name}{seed}")), seed.to_string());
            let of_run = [text(&scene), "--out", text(&out), "--seed", &seed];
            let output = train(&[&of_run[..], flags, GROWS].concat());
            assert!(output.status.success(), "{}", stderr(&output));
            let gaussians = summary(&out)["gaussians"].as_u64().unwrap();
            println!("{name}, seed {seed}: {:.3} dB, {gaussians} Gaussians", psnr(&out));
            assert!(gaussians > 1500, "{gaussians} Gaussians: the scene did not grow");
            psnr(&out)
        })
    };
    let on_cpu = of_device("cpu", &["--device", "cpu"]);
    let mean = |of: [f64; 3]| of.iter().sum::<f64>() / 3.0;
    let most = on_cpu.into_iter().fold(f64::MIN, f64::max);
    let spread = most - on_cpu.into_iter().fold(f64::MAX, f64::min);
    for place in ["host", "device"] {
        let on_gpu = of_device(place, &["--device", "gpu", "--optimizer-on", place]);
        let differ = (mean(on_gpu) - mean(on_cpu)).abs();
        println!("optimizer on the {place}: means differ by {differ:.3} dB, seeds by {spread:.3} dB");
        assert!(differ <= spread, "{on_gpu:?} on the GPU, {on_cpu:?} on the CPU");
    }
}
