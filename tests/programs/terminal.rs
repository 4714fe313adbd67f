//! Programs whose terminal, pipe or log file is gone: a run goes on, and stops as it is asked to.

use crate::support::scenes::{city, summary, text};
use std::fs::OpenOptions;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use tempfile::TempDir;

const FIXED: [&str; 6] = ["--strategy", "none", "--device", "cpu", "--threads", "1"];
const SHORT: [&str; 2] = ["--steps", "60"];

/// A run of `scene` into `out`, started by `before`, whose lines go nowhere yet.
fn run(before: &[&str], scene: &Path, out: &Path, more: &[&str]) -> Command {
    let words =
        [before, &[env!("CARGO_BIN_EXE_gsscale-train"), text(scene), "--out", text(out)], &FIXED, more].concat();
    let mut command = Command::new(words[0]);
    command.args(&words[1..]).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    command
}

fn ply(out: &Path) -> Vec<u8> {
    std::fs::read(out.join("point_cloud.ply")).unwrap()
}

#[test]
fn a_run_whose_lines_cannot_be_written_trains_to_the_end() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 12, 48, 36, 400);
    let whole = folder.path().join("whole");
    assert!(run(&[], &scene, &whole, &SHORT).status().unwrap().success());
    // The reader of both streams is gone before the first line, as in `2>&1 | head -0`.
    let out = folder.path().join("no reader");
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    let mut command = run(&[], &scene, &out, &SHORT);
    assert!(command.stdout(writer.try_clone().unwrap()).stderr(writer).status().unwrap().success());
    assert!(ply(&out) == ply(&whole));
    // The log is on a full drive.
    let out = folder.path().join("full log");
    let full = OpenOptions::new().write(true).open("/dev/full").unwrap();
    assert!(run(&[], &scene, &out, &SHORT).stderr(full).status().unwrap().success());
    assert!(ply(&out) == ply(&whole));
    // Every other program that warns or fails keeps its exit code.
    for program in [env!("CARGO_BIN_EXE_gsscale-eval"), env!("CARGO_BIN_EXE_gsscale-ckpt")] {
        let full = OpenOptions::new().write(true).open("/dev/full").unwrap();
        let missing: &[&str] =
            if program.ends_with("eval") { &["nowhere.ply", "nowhere"] } else { &["verify", "nowhere"] };
        let status = Command::new(program).args(missing).stdout(Stdio::null()).stderr(full).status().unwrap();
        assert_eq!(status.code(), Some(1), "{program}");
    }
}

/// Waits until the run has logged a step: then it listens to signals.
fn wait_for_first_step(child: &mut Child, out: &Path) {
    while !std::fs::read(out.join("metrics.jsonl")).is_ok_and(|text| !text.is_empty()) {
        assert!(child.try_wait().unwrap().is_none(), "the run ended before its first line");
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
}

fn hang_up(child: &Child, signal: &str) {
    assert!(Command::new("kill").args([signal, &child.id().to_string()]).status().unwrap().success());
}

/// `env` sets what a shell or `nohup` would: the default action of SIGHUP, or none.
#[test]
fn a_run_whose_terminal_is_closed_commits_and_one_under_nohup_goes_on() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 12, 48, 36, 400);
    let long = ["--steps", "4000", "--log-every", "1", "--commit-every", "1000"];
    let out = folder.path().join("hung up");
    for (signal, code) in [("-HUP", 129), ("-INT", 130)] {
        std::fs::remove_dir_all(&out).ok();
        let mut command = run(&["env", "--default-signal=HUP,INT"], &scene, &out, &long);
        // The terminal is gone with the signal.
        let (reader, writer) = std::io::pipe().unwrap();
        let mut child = command.stdout(writer.try_clone().unwrap()).stderr(writer).spawn().unwrap();
        drop(command);
        wait_for_first_step(&mut child, &out);
        drop(reader);
        hang_up(&child, signal);
        assert_eq!(child.wait().unwrap().code(), Some(code));
        assert!(out.join("checkpoint/map.redb").exists() && summary(&out)["finished"] == false);
    }
    let out = folder.path().join("nohup");
    let mut child =
        run(&["env", "--ignore-signal=HUP"], &scene, &out, &["--steps", "60", "--log-every", "1"]).spawn().unwrap();
    wait_for_first_step(&mut child, &out);
    hang_up(&child, "-HUP");
    assert!(child.wait().unwrap().success());
    assert_eq!(summary(&out)["steps"], 60);
}

/// A name from the disk cannot turn the direction of a message.
#[test]
fn direction_marks_in_names_are_printed_as_escapes() {
    let folder = TempDir::new().unwrap();
    let name = folder.path().join("a\u{202e}b\u{1b}[2J");
    let output = Command::new(env!("CARGO_BIN_EXE_gsscale-train")).arg(&name).output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("a\\u202eb\\u001b[2J"), "{said}");
    assert!(!said.contains(['\u{202e}', '\u{1b}']), "{said}");
}
