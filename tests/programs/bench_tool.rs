//! `gsscale-bench` as a user calls it: help texts, a run on a scene, and refused arguments.

use crate::support::workdir::{BENCH, Workdir};

#[test]
fn help_lists_the_measurements_and_each_has_help() {
    let work = Workdir::new();
    let said = |flags: &str| work.printed(BENCH, flags);
    let help = said("help");
    assert_eq!(said("--help"), help);
    let commands: Vec<&str> =
        help.lines().filter_map(|line| line.strip_prefix("  gsscale-bench ")?.split_whitespace().next()).collect();
    assert_eq!(commands, ["SCENE", "run", "doctor", "compare", "sweep"]);
    for command in &commands[1..] {
        let of_command = said(&format!("{command} --help"));
        assert!(of_command.contains("Examples:") && of_command.contains("Usage: gsscale-bench"), "{of_command}");
    }
}

#[test]
fn a_run_needs_no_name_and_wrong_input_is_refused() {
    let work = Workdir::city(10, 64, 48, 300);
    let bits = |run: &str| {
        let line = work.json_of(BENCH, &format!("{run} scene --steps 4 --threads 1"));
        line["last_loss_bits"].clone()
    };
    assert!(bits("") == bits("run") && !bits("").is_null());
    work.refuses_with(BENCH, "run /nowhere", &["nowhere"]);
    for flag in ["--spill-dir pages", "--frames 9", "--host-mem 1GiB", "--device gpu"] {
        work.refuses_with(BENCH, &format!("scene {flag}"), &[flag.split(' ').next().unwrap()]);
    }
}
