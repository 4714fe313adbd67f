//! Runs whose optimizer is on the device (`--optimizer-on device`), through the real binary: the same bytes after a lost device; what
//! crosses the bus; what is refused. That slots, frames, threads, engines and kills change no byte is in `matrix`.

use crate::support::a_device;
use crate::support::scenes::stderr;
use crate::support::workdir::{TRAIN, Workdir};

/// Rounds, resets, raises and a cap within 54 steps.
const GROWING: &str = "scene --device gpu --optimizer-on device --steps 54 --refine-start 9 --refine-every 10 --grow-grad2d 0.0005 \
    --reset-every 25 --sh-every 15 --max-gaussians 7000 --page-rows 32 --view-order groups:4 --log-every 1 --quiet";

fn losses(work: &Workdir, out: &str) -> Vec<f64> {
    work.metrics(out).iter().map(|line| line["loss"].as_f64().unwrap()).collect()
}

#[test]
fn a_lost_device_loses_the_steps_since_the_last_commit_alone() {
    let Some(()) = a_device() else { return };
    let work = Workdir::wide_city(6000);
    work.train(&format!("{GROWING} --out alone"));
    // A run whose device is lost at this submission; the variable strikes every device that the process opens. Whether it ended well, and
    // what it said.
    let run_with_loss = |out: &str, fault: &str, more: &str| {
        let mut run = work.command(TRAIN, &format!("{GROWING} --out {out} {more}"));
        let output = run.env("GSSCALE_GPU_FAULT", fault).output().unwrap();
        (output.status.success(), stderr(&output))
    };
    let drive = "--spill-dir spill --commit-every 0.005";
    let (is_done, said) = run_with_loss("out", "lost@400", &format!("{drive} --restarts 0"));
    assert!(!is_done && said.contains("the device was lost"), "{said}");
    work.train("--resume out --quiet");
    assert!(work.ply("out") == work.ply("alone"), "the resumed run gives another scene");
    // The same in one process.
    let (is_done, said) = run_with_loss("on", "lost@400", drive);
    assert!(is_done && said.contains("(restart 1 of at most 3)"), "{said}");
    assert!(work.ply("on") == work.ply("alone"), "the run that went on gives another scene");
    assert!(losses(&work, "on") == losses(&work, "alone") && work.summary("on")["finished"] == true);
    // Before its first commit a run with a spill directory has nothing to go on from.
    let (is_done, said) = run_with_loss("early", "lost@40", drive);
    let is_loss = |line: &str| line.starts_with("error: rendering failed") && line.contains("the device was lost");
    assert!(!is_done && !said.contains("(restart 1") && said.lines().any(is_loss), "{said}");
    // A run in memory begins again, three times at most.
    let (is_done, said) = run_with_loss("memory", "lost@40", "");
    let restarts = said.matches("the run goes on in this process").count();
    assert!(!is_done && restarts == 3 && said.lines().any(is_loss), "{said}");
    // A loss during the comparison with the CPU says nothing about the device's results.
    let mut run = work.command(TRAIN, &format!("{GROWING} --out checked"));
    let output = run.env("GSSCALE_GPU_FAULT", "lost@40").env("GSSCALE_CHECK_DEVICE", "1").output().unwrap();
    assert!(!output.status.success() && stderr(&output).lines().any(is_loss), "{}", stderr(&output));
}

/// Steps without events, after every page has been loaded: only the photo, tables and counts cross the bus.
#[test]
fn a_step_with_all_pages_on_the_device_moves_no_row() {
    let Some(()) = a_device() else { return };
    let work = Workdir::city(8, 128, 96, 1200);
    let flags = "--steps 60 --strategy none --sh-every 0 --log-every 1 --device gpu --optimizer-on";
    for place in ["device", "host"] {
        work.run(place, &format!("{flags} {place}"));
    }
    let pages = work.count("device", "pages");
    for line in &work.metrics("device")[30..59] {
        let [up, down] = ["bytes_uploaded", "bytes_read_back"].map(|key| line[key].as_u64().unwrap());
        assert!(up <= 4 * 128 * 96 + (128 << 10), "step {}: {up} bytes up", line["step"]);
        assert!(down <= 64 * pages + 4096, "step {}: {down} bytes down for {pages} pages", line["step"]);
    }
    // The host's optimizer sums small second moments in f64, and divides exactly.
    let (device, host) = (work.psnr("device"), work.psnr("host"));
    println!("test PSNR after 60 steps: {device:.3} dB on the device, {host:.3} dB on the host");
    assert!((device - host).abs() < 0.05, "{device} dB on the device, {host} dB on the host");
    assert!(host > work.metrics("host")[0]["psnr"].as_f64().unwrap() + 1.0, "60 steps are training");
}

#[test]
fn what_a_device_does_not_do_is_refused_with_a_remedy() {
    let work = Workdir::city(8, 64, 48, 100);
    let mut cases = vec![
        ("--device cpu", "use --device auto or gpu"),
        ("--device gpu --moments bf16", "use --moments f32"),
        ("--device gpu --optimizer sparse", "use --optimizer deferred"),
    ];
    if a_device().is_some() {
        // Without a device the lack of one is said first.
        let weighs = "--device gpu --strategy long-axis --max-gaussians 500 --growth-score mixed";
        cases.push((weighs, "use --growth-score gradient, or --optimizer-on host"));
    }
    for (more, remedy) in cases {
        let flags = format!("scene --out out --steps 3 --optimizer-on device {more}");
        work.refuses(&flags, &["--optimizer-on device", remedy]);
        assert!(!work.exists("out"));
    }
}
