//! Folders outside the repository that tests read: reference fixtures and photo scenes.

use std::path::PathBuf;

/// A folder of fixtures: `$<env>` when set, else `../shared/<name>` beside the repository. A missing folder is a failure in
/// CI (`CI` is set) and a printed skip elsewhere.
pub fn shared_folder(env: &str, name: &str) -> Option<PathBuf> {
    let path = std::env::var_os(env)
        .map_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared").join(name), PathBuf::from);
    if path.is_dir() {
        return Some(path);
    }
    assert!(
        std::env::var_os("CI").is_none(),
        "the shared fixtures are missing: {} is not a folder; set {env} to their path",
        path.display()
    );
    println!("SKIPPED: {} does not exist (set {env} to its path)", path.display());
    None
}

/// The folder of the photo scene `name`, or `None` after a printed skip.
pub fn real_scene(name: &str) -> Option<PathBuf> {
    shared_folder("GSSCALE_DATA", "data").map(|p| p.join(name))
}
