//! Runs `gsscale-bench` and parses its output.

use super::scenes::{city, stderr};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

pub fn bench(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_gsscale-bench")).args(args).output().unwrap()
}

/// The JSON lines of a successful call.
pub fn lines(args: &[&str]) -> Vec<Value> {
    let output = bench(args);
    assert!(output.status.success(), "{}", stderr(&output));
    parse(&String::from_utf8(output.stdout).unwrap())
}

pub fn parse(text: &str) -> Vec<Value> {
    text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

pub fn number(line: &Value, key: &str) -> f64 {
    line[key].as_f64().unwrap_or_else(|| panic!("{key} in {line}"))
}

/// A city whose views each see at most two thirds of it.
pub fn large_city(folder: &Path) -> PathBuf {
    city(folder, 150, 48, 32, 8000)
}
