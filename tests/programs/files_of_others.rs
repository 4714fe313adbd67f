//! No command replaces or removes files of the user: photos, poses, models, results of another kind.

use crate::support::workdir::Workdir;

/// A folder of photos and poses may have the name and the file names of the city of a demo.
#[test]
fn a_demo_takes_a_scene_for_its_own_only_by_the_mark() {
    let work = Workdir::city(3, 32, 24, 50);
    std::fs::create_dir(work.path("mine")).unwrap();
    std::fs::rename(work.scene(), work.path("mine/scene")).unwrap();
    std::fs::remove_file(work.path("mine/scene/.gsscale-city")).unwrap();
    let before = work.files("mine");
    work.refuses("--demo --out mine --steps 2 --device cpu", &["mine", "exists already"]);
    let words = ["mine/scene/sparse", ".gsscale-city", "nothing was overwritten"];
    work.refuses("--demo --out mine --steps 2 --device cpu --overwrite", &words);
    assert!(work.files("mine") == before);
}
