//! Files of a few lines that are huge: an error names the file, and little of it is in memory.

use gsscale::base::machine::status_field;
use gsscale::base::text::{lines_of, tail_of};
use gsscale::cells::City;
use gsscale::cells::plan::CityPlan;
use gsscale::config::file::{TrainConfig, TrainOverrides, read_resolved};
use gsscale::train::run::out_folder::remedy_of_existing;
use gsscale::train::run::resume::{ResumeRequest, resume};
use std::fs::File;
use std::path::{Path, PathBuf};

/// Makes a file of 8 GiB that takes no space.
fn huge(folder: &Path, name: &str) -> PathBuf {
    std::fs::create_dir_all(folder).unwrap();
    let path = folder.join(name);
    File::create(&path).unwrap().set_len(8 << 30).unwrap();
    path
}

#[test]
fn huge_files_are_errors_that_name_them() {
    let folder = tempfile::tempdir().unwrap();
    let of = |name: &str| folder.path().join(name);
    let config = huge(folder.path(), "config.toml");
    let plan = huge(&of("city"), "plan.toml");
    let mark = huge(&of("begun"), ".gsscale-begun.toml");
    huge(&of("ended"), "summary.json");
    let again = ResumeRequest {
        out: of("begun"),
        keys: TrainOverrides::default(),
        scene: None,
        accept_changes: false,
        quiet: true,
        live: None,
        leg: None,
    };
    let errors = [
        (&config, TrainConfig::read(&config).unwrap_err().to_string()),
        (&config, read_resolved(&config).unwrap_err().to_string()),
        (&plan, CityPlan::read(&City(of("city"))).unwrap_err().to_string()),
        (&mark, resume(&again).unwrap_err().to_string()),
    ];
    for (path, error) in errors {
        assert!(error.contains(&path.display().to_string()) && error.contains("remedy"), "{}: {error}", path.display());
    }
    // A summary that nobody can read may be that of a result.
    std::fs::write(of("ended/config.toml"), "").unwrap();
    assert!(!remedy_of_existing(&of("ended")).contains("--overwrite"));
    // Nor are a log and its lines read as a whole.
    assert_eq!(tail_of(&config, 9), "\0".repeat(9));
    assert!(lines_of(&config).take(3).all(|line| line.len() == 1 << 20));
    let peak = status_field("VmHWM:").unwrap_or(0);
    assert!(peak < 1 << 30, "{peak} bytes were in memory");
}
