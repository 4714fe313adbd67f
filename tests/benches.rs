//! The benchmarks at their tiny sizes, so that they cannot rot, and that what they hash is the same bits twice.
#![allow(clippy::unwrap_used, clippy::expect_used)] // a panic is a failed test
#![allow(clippy::duplicate_mod)] // each benchmark is a program of its own, with its own support

#[allow(dead_code)] // its `main`
#[path = "../benches/commit.rs"]
mod commit;
#[allow(dead_code)] // its `main`
#[path = "../benches/gpu.rs"]
mod gpu;
#[allow(dead_code)] // its `main`
#[path = "../benches/image_loss.rs"]
mod image_loss;
#[allow(dead_code)] // its `main`
#[path = "../benches/render.rs"]
mod render;
#[allow(dead_code)] // its `main`
#[path = "../benches/step.rs"]
mod step;

use step::support::{Args, median};

#[test]
fn commit_runs() {
    assert!(commit::tiny());
}

#[test]
fn gpu_runs() {
    assert_eq!(gpu::tiny(), gpu::tiny());
}

#[test]
fn image_loss_runs() {
    assert_eq!(image_loss::tiny(), image_loss::tiny());
}

#[test]
fn render_runs() {
    assert_eq!(render::tiny(), render::tiny());
}

#[test]
fn step_runs_with_the_same_losses_for_any_number_of_threads() {
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(step::tiny)
    };
    assert_eq!(with(1), with(3));
}

#[test]
fn arguments_and_medians_are_what_they_say() {
    let args = |text: &str| Args::parse(text.split_whitespace().map(String::from));
    let got = args("--bench 10 brighton --path baseline --json").unwrap();
    assert!(got.real && got.json && got.sizes == [10] && got.wants("brighton_480x269_10k") && !got.wants("terrain"));
    assert_eq!(got.simd().name(), "baseline");
    assert!(!args("").unwrap().real && args("").unwrap().wants("anything"));
    assert!(args("--quick").is_err() && args("--path sse9").is_err());
    assert_eq!(median([3.0, 1.0, 2.0].into_iter()), 2.0);
    assert_eq!(median([4.0, 1.0, 2.0, 3.0].into_iter()), 2.5);
    assert_eq!(median(std::iter::empty()), 0.0);
}
