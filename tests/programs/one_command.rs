//! The program `gsscale`: its commands are the programs, links with their names too; completions and man pages.

use crate::support::scenes::{classic, stderr, stdout};
use crate::support::workdir::{Workdir, says, succeeded};
use gsscale::config::file::{KEYS, Shown};
use std::process::Command;

const GSSCALE: &str = env!("CARGO_BIN_EXE_gsscale");

#[test]
fn commands_are_the_programs() {
    let work = Workdir::city(3, 32, 24, 100);
    let told = stdout(&work.output(GSSCALE, ""));
    says(&told, &["gsscale train --demo", "gsscale poses", "gsscale view"]);
    let flags = ["scene", "--steps", "7", "--device", "cpu"];
    let mut train = work.command(GSSCALE, "train");
    succeeded(train.args(flags).args(["--out", "out"]).args(classic(&flags)).output().unwrap());
    assert!(work.ply("out") == work.run("expected", "--steps 7"));
    says(&stdout(&work.output(GSSCALE, "help plan")), &["Usage: gsscale plan [OPTIONS] <SCENE>"]);
    // Remedies and examples name the command as the user called it.
    let of_command = stderr(&work.output(GSSCALE, "train scene/images/none.ply"));
    let missing = stderr(&work.output(GSSCALE, "view scene"));
    says(&missing, &["gsscale view runs/NAME"]);
    for told in [
        of_command,
        missing,
        stdout(&work.output(GSSCALE, "train --help")),
        stdout(&work.output(GSSCALE, "help view")),
        stdout(&work.output(GSSCALE, "poses --help")),
    ] {
        assert!(!told.contains("gsscale-"), "{told}");
    }
    says(&stdout(&work.output(GSSCALE, "cells cut --help")), &["Usage: gsscale cells cut "]);
    says(&stdout(&work.output(GSSCALE, "doctor --help")), &["Usage: gsscale bench doctor "]);
    says(&stdout(&work.output(GSSCALE, "help doctor")), &["Usage: gsscale bench doctor "]);
    says(&stdout(&work.output(GSSCALE, "--help")), &["\n  doctor "]);
    says(&stdout(&work.output(GSSCALE, "--version")), &[&format!("gsscale {}", env!("CARGO_PKG_VERSION"))]);
    work.refuses_with(GSSCALE, "scene --steps 7", &["to train: gsscale train scene"]);
    work.refuses_with(GSSCALE, "--demo", &["to train: gsscale train --demo"]);
    let wrong = work.output(GSSCALE, "trian scene");
    assert_eq!(wrong.status.code(), Some(2));
    says(&stderr(&wrong), &["'trian'", "'train'"]);
}

/// Packages hold one program, and its other names as links or as these scripts.
#[cfg(unix)]
#[test]
fn other_names_of_the_program_are_its_commands() {
    use std::os::unix::fs::symlink;
    let work = Workdir::new();
    let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR"));
    let manifest = std::fs::read_to_string(root.join("Cargo.toml")).unwrap();
    let names = manifest.split("\nname = \"gsscale-").skip(1).map(|rest| rest.split('"').next().unwrap());
    assert_eq!(names.clone().count(), 10);
    let scripts = work.path("my-scripts");
    std::fs::create_dir(&scripts).unwrap();
    symlink(GSSCALE, scripts.join("gsscale")).unwrap();
    for name in names {
        let program = format!("gsscale-{name}");
        let (link, script) = (work.path(&program), scripts.join(&program));
        symlink(GSSCALE, &link).unwrap();
        std::fs::copy(root.join("tools/names/scripts").join(&program), &script).unwrap();
        // Somebody's link to the script, under a name without a dash.
        let linked = work.path(name);
        symlink(&script, &linked).unwrap();
        let help = |program: &str| stdout(&work.output(program, "--help"));
        let expected = stdout(&work.output(GSSCALE, &format!("{name} --help")));
        says(&expected, &["gsscale", "--help"]);
        assert!([&link, &script, &linked].iter().all(|program| help(program.to_str().unwrap()) == expected), "{name}");
    }
}

/// A key that help does not show, and one that it shows, as flags.
fn hidden_and_shown() -> (String, String) {
    let flag = |hidden: bool| {
        let key = KEYS.iter().find(|key| (key.shown == Shown::Nowhere) == hidden).unwrap();
        format!("--{}", key.name())
    };
    (flag(true), flag(false))
}

#[test]
fn completions_offer_what_help_shows() {
    let work = Workdir::new();
    // A folder of the name of a command changes nothing.
    std::fs::create_dir(work.path("completions")).unwrap();
    let (hidden, shown) = hidden_and_shown();
    for shell in ["bash", "zsh", "fish", "powershell"] {
        let script = stdout(&work.output(GSSCALE, &format!("completions {shell}")));
        says(&script, &["train", shown.trim_start_matches('-'), "doctor"]);
        assert!(!script.contains(hidden.trim_start_matches('-')), "{shell} offers {hidden}");
        std::fs::write(work.path(shell), script).unwrap();
    }
    let typed = "source ./bash; COMP_WORDS=(gsscale train --max-ga); COMP_CWORD=2; _gsscale gsscale --max-ga train; echo ${COMPREPLY[@]}";
    match Command::new("bash").args(["-c", typed]).current_dir(work.path("")).output() {
        Ok(output) => assert_eq!(stdout(&output).trim(), "--max-gaussians", "{}", stderr(&output)),
        Err(_) => eprintln!("skipped: bash is not installed"),
    }
}

#[test]
fn man_pages_show_what_help_shows() {
    let work = Workdir::new();
    let (hidden, shown) = hidden_and_shown();
    stdout(&work.output(GSSCALE, "man pages/man1"));
    let read = |name: &str| std::fs::read_to_string(work.path(&format!("pages/man1/{name}.1"))).unwrap();
    for name in ["gsscale-plan", "gsscale-ckpt-salvage", "gsscale-bench-doctor", "gsscale"] {
        says(&read(name), &[&format!(".TH {name} 1")]);
    }
    let page = read("gsscale-train");
    let typed = |flag: &str| flag.replace('-', "\\-");
    says(&page, &[".TH gsscale-train 1", &typed(&shown), "Generate a small city"]);
    assert!(!page.contains(&typed(&hidden)), "{hidden}");
    let man = Command::new("man")
        .args(["--warnings", "-l", "pages/man1/gsscale-train.1"])
        .current_dir(work.path(""))
        .output();
    match man {
        Ok(output) => {
            assert!(stdout(&output).contains("SYNOPSIS") && stderr(&output).is_empty(), "{}", stderr(&output))
        }
        Err(_) => eprintln!("skipped: man is not installed"),
    }
    std::fs::write(work.path("file"), "").unwrap();
    work.refuses_with(GSSCALE, "man file", &["file", "writing man pages"]);
}
