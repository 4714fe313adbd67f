//! `gsscale-bench` as a user calls it: help texts, a run on a scene, and refused arguments.

use crate::support::bench::{bench, lines};
use crate::support::scenes::{city, stderr, text};
use std::path::Path;
use tempfile::TempDir;

#[test]
fn help_lists_the_measurements_and_each_has_help() {
    let said = |args: &[&str]| {
        let output = bench(args);
        assert!(output.status.success(), "{}", stderr(&output));
        String::from_utf8(output.stdout).unwrap()
    };
    let help = said(&["help"]);
    assert_eq!(said(&["--help"]), help);
    let commands: Vec<&str> =
        help.lines().filter_map(|line| line.strip_prefix("  gsscale-bench ")?.split_whitespace().next()).collect();
    assert_eq!(commands, ["SCENE", "run", "compare", "sweep"]);
    for command in &commands[1..] {
        let of_command = said(&[command, "--help"]);
        assert!(of_command.contains("Examples:") && of_command.contains("Usage: gsscale-bench"), "{of_command}");
    }
}

#[test]
fn a_run_needs_no_name_and_wrong_input_is_refused() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 10, 64, 48, 300);
    let line = |args: &[&str]| {
        let all = lines(&[args, &[text(&scene), "--steps", "4", "--threads", "1"]].concat());
        assert_eq!(all.len(), 1);
        all[0]["last_loss_bits"].clone()
    };
    assert_eq!(line(&[]), line(&["run"]));
    let refuses = |args: &[&str], words: &str| {
        let output = bench(args);
        assert_eq!(output.status.code(), Some(1));
        assert!(stderr(&output).contains(words) && stderr(&output).contains("remedy"), "{}", stderr(&output));
    };
    refuses(&["run", text(Path::new("/nowhere"))], "nowhere");
    for [flag, value] in [["--spill-dir", "pages"], ["--frames", "9"], ["--host-mem", "1GiB"], ["--device", "gpu"]] {
        refuses(&[text(&scene), flag, value], flag);
    }
}
