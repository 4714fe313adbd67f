//! Every config file parses and passes its checks; default.toml equals the built-in defaults.

use gsscale::config::file::{ConfigKey, KEYS, Shown, TrainConfig, default_file};
use gsscale::config::values::ByteSize;
use gsscale::train::run::viewer::config_to_show;
use std::path::PathBuf;

fn configs() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("configs")
}

#[test]
fn default_file_is_the_default() {
    let path = configs().join("default.toml");
    let written = std::fs::read_to_string(&path).unwrap_or_default();
    if std::env::var_os("GSSCALE_WRITE_DEFAULT_CONFIG").is_some() {
        std::fs::write(&path, default_file()).unwrap();
        return;
    }
    let other = default_file().lines().find(|line| !written.contains(line)).unwrap_or("a line too much").to_string();
    assert!(
        written == default_file(),
        "configs/default.toml is out of date ({other}): run the test once with GSSCALE_WRITE_DEFAULT_CONFIG=1"
    );
    assert_eq!(TrainConfig::read(&path).unwrap(), TrainConfig::default());
    for name in KEYS.iter().map(ConfigKey::name) {
        assert!(written.contains(&format!("\n{name} = ")), "{name} is not in default.toml");
    }
}

#[test]
fn keys_that_help_does_not_show_are_in_the_readme() {
    let readme = std::fs::read_to_string(configs().join("README.md")).unwrap();
    let section = readme.split("\n## ").find(|section| section.starts_with("Keys that help")).unwrap();
    for key in KEYS {
        let is_listed = section.contains(&format!("`{}`", key.name()));
        assert_eq!(is_listed, key.shown == Shown::Nowhere, "{}", key.name());
    }
}

#[test]
fn every_config_file_is_valid() {
    let mut seen = 0;
    for entry in std::fs::read_dir(configs()).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_none_or(|extension| extension != "toml") {
            continue;
        }
        TrainConfig::read(&path).unwrap().check().unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        seen += 1;
    }
    assert!(seen >= 3, "only {seen} config files");
}

/// The memory of a run was for pages on a drive that is gone.
#[test]
fn a_viewer_has_its_own_memory() {
    let of_run = TrainConfig { host_mem: ByteSize(1 << 20), spill_dir: "pages".to_string(), ..TrainConfig::default() };
    let own = config_to_show(of_run.clone(), "a.ply".as_ref(), None, None);
    assert_eq!((own.host_mem, own.spill_dir.as_str()), (ByteSize(0), ""));
    let asked = config_to_show(of_run, "a.ply".as_ref(), None, Some(ByteSize(7 << 20)));
    assert_eq!(asked.host_mem, ByteSize(7 << 20));
}
