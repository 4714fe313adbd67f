//! `gsscale`: every program as a command of one (`gsscale train` is `gsscale-train`), with completions and man pages. A link or a
//! copy that has the name of a program is that program.
//!
//! Not here: what a command does. Its file is also the root of the program of that name.
#![allow(dead_code)] // that program's `main`

mod bench;
mod cells;
mod ckpt;
mod eval;
mod iotune;
mod plan;
mod poses;
mod synth;
mod train;
mod view;

use clap::builder::Resettable::Reset;
use clap::{Arg, Command, CommandFactory, value_parser};
use clap_complete::Shell;
use gsscale::base::error::{InputError, InputResult};
use gsscale::base::say::{exit_code, set_commands, shell_word};
use gsscale::config::command_line::{in_words_of_caller, with_help_of_keys};
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// What a command is called, its command line, and what it runs.
type Entry = (&'static str, fn() -> Command, fn(Vec<OsString>) -> ExitCode);

/// In the order in which a user meets them.
const COMMANDS: [Entry; 10] = [
    ("train", train::Args::command, train::run_with),
    ("view", view::Args::command, view::run_with),
    ("poses", poses::Flags::command, poses::run_with),
    ("eval", eval::Args::command, eval::run_with),
    ("plan", plan::Args::command, plan::run_with),
    ("ckpt", ckpt::Args::command, ckpt::run_with),
    ("cells", cells::Args::command, cells::run_with),
    ("iotune", iotune::Flags::command, iotune::run_with),
    ("synth", synth::Flags::command, synth::run_with),
    ("bench", bench::command, bench::run_with),
];

/// What `gsscale` alone says.
const FIRST_STEPS: &str = "\
Try it on a generated city (some minutes):
  gsscale train --demo

Your own photos, in scans/village:
  gsscale poses scans/village                 finds where each was taken, with COLMAP or pycolmap
  gsscale train scans/village --dry-run       says what a run needs: memory, drive, time
  gsscale train scans/village                 trains; the results are in runs/village
  gsscale view runs/village                   shows them in a browser

gsscale doctor checks the GPU. gsscale --help lists all commands, gsscale help train explains one.";

fn main() -> ExitCode {
    set_commands(COMMANDS.iter().map(|(name, ..)| *name).collect());
    let mut arguments: Vec<OsString> = std::env::args_os().collect();
    let own_name = arguments.first().and_then(|own| Path::new(own).file_stem()?.to_str()?.strip_prefix("gsscale-"));
    if let Some((name, ..)) = own_name.and_then(|own| COMMANDS.iter().find(|(name, ..)| own.eq_ignore_ascii_case(name)))
    {
        arguments.splice(..1, ["gsscale", name].map(OsString::from));
    }
    // `doctor` is short for `bench doctor`, also after `help`.
    let at = 1 + usize::from(arguments.get(1).is_some_and(|name| name == "help"));
    if arguments.get(at).is_some_and(|name| name == "doctor") {
        arguments.insert(at, "bench".into());
    }
    let Some((name, _, run_with)) = arguments.get(1).and_then(|given| COMMANDS.iter().find(|(name, ..)| given == name))
    else {
        return exit_code(own_command(&arguments));
    };
    arguments.splice(..2, [format!("gsscale {name}").into()]);
    run_with(arguments)
}

/// What `gsscale` does itself. Errors: a man page cannot be written, or a scene or a flag stands where a command belongs.
fn own_command(arguments: &[OsString]) -> InputResult<()> {
    let commands = all_commands();
    let is_own = |given: &&OsString| {
        *given == "help" || *given == "--help" || *given == "--version" || commands.find_subcommand(given).is_some()
    };
    let is_for_train = |given: &&OsString| Path::new(given).exists() || given.to_string_lossy().starts_with("--");
    if let Some(given) = arguments.get(1).filter(|given| !is_own(given) && is_for_train(given)) {
        let remedy = format!("to train: gsscale train {}", shell_word(given));
        return Err(InputError::new(given, "is not a command of gsscale", remedy));
    }
    match commands.clone().get_matches_from(arguments).subcommand() {
        Some(("completions", given)) => {
            let mut script = Vec::new();
            let shell = given.get_one("SHELL").copied().unwrap_or(Shell::Bash);
            clap_complete::generate(shell, &mut without_hidden(&commands), "gsscale", &mut script);
            gsscale::say!("{}", String::from_utf8_lossy(&script));
        }
        Some(("man", given)) => {
            let folder = given.get_one::<PathBuf>("DIR").map_or(Path::new("."), PathBuf::as_path);
            let io = |e| InputError::io(folder, "writing man pages", &e);
            std::fs::create_dir_all(folder)
                .and_then(|()| clap_mangen::generate_to(with_all_help(commands), folder))
                .map_err(io)?;
        }
        _ => gsscale::say!("{FIRST_STEPS}"),
    }
    Ok(())
}

/// The command line of all commands.
fn all_commands() -> Command {
    let shell = Arg::new("SHELL").required(true).value_parser(value_parser!(Shell)).help("The shell");
    let folder = Arg::new("DIR").required(true).value_parser(value_parser!(PathBuf)).help("Folder of the pages");
    let all = Command::new("gsscale")
        .version(env!("CARGO_PKG_VERSION"))
        .about("Trains 3D Gaussian Splatting scenes bigger than memory")
        .after_help(FIRST_STEPS)
        .subcommands(COMMANDS.map(|(name, command, _)| command().name(name)))
        .subcommand(bench::doctor::Args::command().name("doctor"))
        .subcommand(Command::new("completions").about("Prints completions for a shell").arg(shell))
        .subcommand(Command::new("man").about("Writes a man page of each command").arg(folder));
    in_words_of_caller(with_help_of_keys(all, false))
}

/// The command line with the text of flags that only `--help` shows: a man page has no short form.
fn with_all_help(command: Command) -> Command {
    command.mut_args(|arg| arg.hide_short_help(false)).mut_subcommands(with_all_help)
}

/// The command line without flags that help does not show: completions would offer them.
fn without_hidden(command: &Command) -> Command {
    // A flag may name a hidden one.
    let alone = |arg: &Arg| arg.clone().conflicts_with(Reset).requires(Reset).required_unless_present(Reset);
    Command::new(command.get_name().to_string())
        .about(command.get_about().cloned().unwrap_or_default())
        .args(command.get_arguments().filter(|arg| !arg.is_hide_set()).map(alone))
        .subcommands(command.get_subcommands().map(without_hidden))
}
