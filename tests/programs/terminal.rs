//! Programs whose terminal, pipe or log file is gone: a run goes on, and stops as it is asked to.

use crate::support::workdir::{CKPT, EVAL, TRAIN, Workdir, send};
use std::fs::{File, OpenOptions};
use std::process::{Command, Stdio};

const FIXED: &str = "scene --strategy none --device cpu --threads 1 --log-every 1";

fn scene() -> Workdir {
    Workdir::city(12, 48, 36, 400)
}

/// A command whose lines go nowhere yet.
fn quiet(mut command: Command) -> Command {
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    command
}

fn full() -> File {
    OpenOptions::new().write(true).open("/dev/full").unwrap()
}

#[test]
fn a_run_whose_lines_cannot_be_written_trains_to_the_end() {
    let work = scene();
    let run = |out: &str| quiet(work.command(TRAIN, &format!("{FIXED} --steps 60 --out {out}")));
    assert!(run("whole").status().unwrap().success());
    // The reader of both streams is gone before the first line, as in `2>&1 | head -0`.
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    assert!(run("no-reader").stdout(writer.try_clone().unwrap()).stderr(writer).status().unwrap().success());
    // The log is on a full drive.
    assert!(run("full-log").stderr(full()).status().unwrap().success());
    assert!(work.ply("no-reader") == work.ply("whole") && work.ply("full-log") == work.ply("whole"));
    // Every other program that warns or fails keeps its exit code.
    for (program, flags) in [(EVAL, "nowhere.ply nowhere"), (CKPT, "verify nowhere")] {
        let status = quiet(work.command(program, flags)).stderr(full()).status().unwrap();
        assert_eq!(status.code(), Some(1), "{program}");
    }
}

/// `env` sets what a shell or `nohup` would: the default action of SIGHUP, or none.
#[test]
fn a_run_whose_terminal_is_closed_commits_and_one_under_nohup_goes_on() {
    let work = scene();
    let under = |env: &str, out: &str, more: &str| {
        let flags = format!("{env} {TRAIN} {FIXED} --out {out} --schedule classic {more}");
        quiet(work.command("env", &flags))
    };
    // Once it has logged a step, a run listens to signals.
    let wait_for_first_step = |out: &str| {
        while work.lines(out) == 0 {
            std::thread::sleep(std::time::Duration::from_millis(5));
        }
    };
    for (signal, code) in [("HUP", 129), ("INT", 130)] {
        work.remove("out");
        let mut command = under("--default-signal=HUP,INT", "out", "--steps 4000 --commit-every 1000");
        // The terminal is gone with the signal.
        let (reader, writer) = std::io::pipe().unwrap();
        let mut child = command.stdout(writer.try_clone().unwrap()).stderr(writer).spawn().unwrap();
        drop(command);
        wait_for_first_step("out");
        drop(reader);
        assert!(send(&child, signal));
        assert_eq!(child.wait().unwrap().code(), Some(code));
        assert!(work.exists("out/checkpoint/map.redb") && work.summary("out")["finished"] == false);
    }
    let mut child = under("--ignore-signal=HUP", "nohup", "--steps 60").spawn().unwrap();
    wait_for_first_step("nohup");
    assert!(send(&child, "HUP"));
    assert!(child.wait().unwrap().success());
    assert_eq!(work.count("nohup", "steps"), 60);
}

/// A name from the disk cannot turn the direction of a message.
#[test]
fn direction_marks_in_names_are_printed_as_escapes() {
    let work = Workdir::new();
    let output = work.command(TRAIN, "").arg("a\u{202e}b\u{1b}[2J").output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("a\\u202eb\\u001b[2J"), "{said}");
    assert!(!said.contains(['\u{202e}', '\u{1b}']), "{said}");
}
