//! Runs whose device is lost with steps in flight. Through the real binary; what is left ends with the bytes of a run that nothing
//! disturbed. (Runs that are killed: `matrix`.)

use super::gpu_flights::{Bench, Span, same};
use crate::support::scenes::stderr;

/// A run whose pages are newer in their slots than in frames and on the drive, most of the time.
const SELDOM: &str = "--commit-every 0.5";

/// Submissions in the middle of the three longest stretches, and then at their quarters, of steps that are recorded behind another one, late enough for a restart to come
/// some steps farther. Commits come by time, so another run may be some submissions off.
fn submissions_in_flight(spans: &[Span]) -> Vec<usize> {
    let mut stretches: Vec<Vec<(u64, usize)>> = Vec::new();
    for span in spans.iter().filter(|s| s.name == "record step" && s.args["recorded"].as_u64() > Some(s.step())) {
        let submission = spans.iter().filter(|s| s.name == "submit" && s.began < span.began).count();
        match stretches.last_mut() {
            Some(stretch) if stretch.last().is_some_and(|(step, _)| step + 1 == span.step()) => {
                stretch.push((span.step(), submission));
            }
            _ => stretches.push(vec![(span.step(), submission)]),
        }
    }
    let submissions = spans.iter().filter(|s| s.name == "submit").count();
    stretches.retain(|stretch| stretch[stretch.len() / 2].1 > submissions * 2 / 5);
    stretches.sort_by_key(|stretch| std::cmp::Reverse(stretch.len()));
    let at = |quarter: usize| stretches.iter().take(3).map(move |stretch| stretch[stretch.len() * quarter / 4].1 + 2);
    [2, 1, 3].into_iter().flat_map(at).collect()
}

#[test]
fn a_device_that_is_lost_with_steps_in_flight_loses_the_steps_since_the_last_commit_alone() {
    let Some(bench) = Bench::new() else { return };
    assert!(bench.run("alone", "2", "", SELDOM));
    let want = bench.result("alone");
    // The fault strikes every device that a process opens, at this submission. How far a restart comes depends on the last commit, whose time is
    // that of the machine, so more restarts are allowed than usual.
    let mut lost_in_flight = 0;
    for (i, at) in submissions_in_flight(&bench.spans("alone")).into_iter().enumerate() {
        if i >= 2 && lost_in_flight > 0 {
            break;
        }
        let kind = ["lost", "given-up"][i % 2];
        let name = format!("{kind}{at}");
        let mut run = bench.command_of(&name, &format!("{SELDOM} --restarts 9"));
        let output = run.env("GSSCALE_GPU_FAULT", format!("{kind}@{at}")).output().unwrap();
        let said = stderr(&output);
        assert!(output.status.success() && said.contains("(restart 1 of at most 9)"), "{said}");
        same(&bench.result(&name), &want, &name);
        // Every step that is recorded is finished or given up, unless the device is lost.
        let spans = bench.spans(&name);
        let count = |name: &str| spans.iter().filter(|s| s.name == name).count();
        let [recorded, finished] = [count("record step"), count("finish step")];
        println!("{name}: {recorded} steps were recorded, {finished} finished");
        lost_in_flight += usize::from(recorded > finished);
    }
    assert!(lost_in_flight > 0, "no device was lost with a step in flight behind another one");
}
