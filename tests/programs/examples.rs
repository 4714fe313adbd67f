//! The examples of `tools/examples` run on a small city.

use crate::support::scenes::stderr;
use crate::support::workdir::{TRAIN, Workdir, says};
use std::path::Path;

/// Runs an example and returns what it prints; `None`, after a printed skip, if it was not built with the tests.
fn example(work: &Workdir, name: &str, arguments: &str) -> Option<String> {
    let program =
        Path::new(TRAIN).parent().unwrap().join("examples").join(name).with_extension(std::env::consts::EXE_EXTENSION);
    if !program.is_file() {
        println!("SKIPPED: {} is not built (cargo build --examples)", program.display());
        return None;
    }
    let output = work.command(program.to_str().unwrap(), arguments).output().unwrap();
    assert!(output.status.success(), "{name}: {}", stderr(&output));
    Some(String::from_utf8(output.stdout).unwrap())
}

#[test]
fn examples_train_read_pages_and_have_their_own_strategy() {
    let work = Workdir::city(12, 96, 64, 400);
    if let Some(said) = example(&work, "train_in_memory", "scene run") {
        says(&said, &[" Gaussians after 300 steps", "PSNR ", " dB on 2 held-out photos"]);
        assert!(work.exists("run/point_cloud.ply"));
    }
    work.run("kept", "--steps 20 --keep-checkpoint");
    if let Some(said) = example(&work, "read_store", "kept") {
        let rows = work.count("kept", "gaussians");
        says(&said, &["page 0: ", &format!("{rows} Gaussians in ")]);
    }
    if let Some(said) = example(&work, "own_strategy", "scene") {
        says(&said, &["step 200: loss ", "7 rounds, PSNR "]);
    }
}
