//! The examples of `tools/examples` do what they say on a small city.

use crate::support::workdir::Workdir;

#[allow(dead_code)] // its `main`
#[path = "../../tools/examples/own_strategy.rs"]
mod own_strategy;
#[allow(dead_code)] // its `main`
#[path = "../../tools/examples/read_store.rs"]
mod read_store;
#[allow(dead_code)] // its `main`
#[path = "../../tools/examples/train_in_memory.rs"]
mod train_in_memory;

#[test]
fn examples_train_read_pages_and_have_their_own_strategy() {
    let work = Workdir::city(12, 96, 64, 400);
    let summary = train_in_memory::train(work.scene(), work.path("run")).unwrap().summary.unwrap();
    assert!(summary.steps == 300 && summary.test.unwrap().views == 2 && work.exists("run/point_cloud.ply"));
    work.run("kept", "--steps 20 --keep-checkpoint");
    let [pages, rows, solid] = read_store::count(&work.path("kept")).unwrap();
    assert!(pages > 0 && rows as u64 == work.count("kept", "gaussians") && solid < rows, "{pages} {rows} {solid}");
    let (rounds, psnr) = own_strategy::train(&work.scene()).unwrap();
    assert!(rounds == 7 && psnr > 10.0, "{rounds} rounds, {psnr} dB");
}
