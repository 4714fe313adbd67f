//! Starts this test program again for one test, in a process of its own. Such a test may change limits, rights and the
//! umask, and measure the memory of its process, while other tests run beside it.

use std::process::Command;

/// Set in the process that [`in_child`] starts.
const CHILD: &str = "GSSCALE_TEST_CHILD";

/// This program, to run the test `name` of the module `module` (the caller's `module_path!()`) and no other.
pub fn one_test(module: &str, name: &str) -> Command {
    let full_name = match module.split_once("::") {
        Some((_, inner)) => format!("{inner}::{name}"),
        None => name.to_string(),
    };
    let mut command = Command::new(std::env::current_exe().unwrap());
    command.args(["--exact", &full_name, "--nocapture", "--test-threads=1"]);
    command
}

/// Runs the test `name` of `module` again in a process of its own, and passes its failure on. True in that process.
pub fn in_child(module: &str, name: &str) -> bool {
    if std::env::var_os(CHILD).is_some() {
        return true;
    }
    let output = one_test(module, name).env(CHILD, "1").output().unwrap();
    let said = String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    assert!(said.contains("1 passed"), "the test does not exist: {said}");
    false
}
