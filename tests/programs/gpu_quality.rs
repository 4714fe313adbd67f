//! Quality on a GPU and on the CPU when a run grows its scene, through the real binary: growth multiplies rounding differences, so single
//! runs differ as seeds do, and their means must not.

use crate::support::a_device;
use crate::support::workdir::Workdir;

/// Rounds, a reset and raises of colour bands.
const GROWS: &str = "--steps 400 --refine-start 60 --refine-every 40 --grow-grad2d 0.0006 --max-gaussians 4000 --reset-every 200 \
    --sh-every 100";

/// `cargo nextest run --test programs --run-ignored only -E 'test(/gpu_quality/)' --no-capture`
#[test]
#[ignore = "trains for minutes"]
fn the_means_of_three_seeds_agree_within_the_spread_of_the_seeds() {
    let Some(()) = a_device() else { return };
    let work = Workdir::city(32, 128, 96, 1200);
    let of_device = |flags: &str| {
        [1, 2, 3].map(|seed| {
            work.run("out", &format!("--overwrite --seed {seed} {GROWS} {flags}"));
            let (gaussians, psnr) = (work.count("out", "gaussians"), work.psnr("out"));
            println!("{flags}, seed {seed}: {psnr:.3} dB, {gaussians} Gaussians");
            assert!(gaussians > 1500, "{gaussians} Gaussians: the scene did not grow");
            psnr
        })
    };
    let on_cpu = of_device("--device cpu");
    let mean = |of: [f64; 3]| of.iter().sum::<f64>() / 3.0;
    let most = on_cpu.into_iter().fold(f64::MIN, f64::max);
    let spread = most - on_cpu.into_iter().fold(f64::MAX, f64::min);
    for place in ["host", "device"] {
        let on_gpu = of_device(&format!("--device gpu --optimizer-on {place}"));
        let differ = (mean(on_gpu) - mean(on_cpu)).abs();
        println!("optimizer on the {place}: means differ by {differ:.3} dB, seeds by {spread:.3} dB");
        assert!(differ <= spread, "{on_gpu:?} on the GPU, {on_cpu:?} on the CPU");
    }
}
