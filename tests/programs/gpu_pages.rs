//! Runs whose optimizer is on the device (`--optimizer-on device`), through the real binary: a device that is lost for good; what
//! crosses the bus; what is refused. That slots, frames, threads, engines and kills change no byte is in `matrix`.

use crate::support::a_device;
use crate::support::scenes::stderr;
use crate::support::workdir::{TRAIN, Workdir};

/// Rounds, resets, raises and a cap within 54 steps.
const GROWING: &str = "scene --device gpu --optimizer-on device --steps 54 --refine-start 9 --refine-every 10 --grow-grad2d 0.0005 \
    --reset-every 25 --sh-every 15 --max-gaussians 7000 --page-rows 32 --view-order groups:4 --log-every 1 --quiet";

#[test]
fn a_device_that_is_lost_again_and_again_ends_the_run() {
    let Some(()) = a_device() else { return };
    let work = Workdir::wide_city(6000);
    // The variable strikes every device that the process opens. Returns what the run said.
    let fails = |out: &str, variables: &[&str], more: &str| {
        let mut run = work.command(TRAIN, &format!("{GROWING} --out {out} {more}"));
        run.env("GSSCALE_GPU_FAULT", "lost@40").envs(variables.iter().map(|name| (name, "1")));
        let output = run.output().unwrap();
        let said = stderr(&output);
        let is_loss = |line: &str| line.starts_with("error: rendering failed") && line.contains("the device was lost");
        assert!(!output.status.success() && said.lines().any(is_loss), "{said}");
        said
    };
    // Before its first commit a run begins again, three times at most, in memory and with a spill directory.
    for (out, more) in [("early", "--spill-dir spill --commit-every 0.005"), ("memory", "")] {
        let said = fails(out, &[], more);
        assert_eq!(said.matches("the run goes on in this process").count(), 3, "{said}");
    }
    // A loss during the comparison with the CPU says nothing about the device's results.
    fails("checked", &["GSSCALE_CHECK_DEVICE"], "");
}

/// Steps without events, after every page has been loaded: only the photo, tables and counts cross the bus.
#[test]
fn a_step_with_all_pages_on_the_device_moves_no_row() {
    let Some(()) = a_device() else { return };
    let work = Workdir::city(8, 64, 48, 1200);
    let flags = "--steps 60 --strategy none --sh-every 0 --log-every 1 --device gpu --optimizer-on";
    for place in ["device", "host"] {
        work.run(place, &format!("{flags} {place}"));
        work.run(&format!("halves-{place}"), &format!("{flags} {place} --moments bf16"));
    }
    let pages = work.count("device", "pages");
    for line in &work.metrics("device")[30..59] {
        let [up, down] = ["bytes_uploaded", "bytes_read_back"].map(|key| line[key].as_u64().unwrap());
        assert!(up <= 4 * 64 * 48 + (128 << 10), "step {}: {up} bytes up", line["step"]);
        assert!(down <= 64 * pages + 4096, "step {}: {down} bytes down for {pages} pages", line["step"]);
    }
    // The host's optimizer sums small second moments in f64, and divides exactly.
    let (device, host) = (work.psnr("device"), work.psnr("host"));
    println!("test PSNR after 60 steps: {device:.3} dB on the device, {host:.3} dB on the host");
    assert!((device - host).abs() < 0.05, "{device} dB on the device, {host} dB on the host");
    // Moments of 16 bits, which both round by draws of their own.
    let halves = ["halves-device", "halves-host"].map(|run| work.psnr(run));
    println!("with moments of 16 bits: {halves:.3?}");
    assert!(halves.iter().all(|psnr| (psnr - host).abs() < 0.05), "{halves:?} dB with 16 bits, {host} dB with 32");
    let uploaded = |run: &str| work.metrics(run).last().unwrap()["slots"]["bytes_loaded"].as_f64().unwrap();
    let share = uploaded("halves-device") / uploaded("device");
    assert!((0.65..0.72).contains(&share), "{share} of the bytes went up: 492 of 728 a row at degree 3");
    assert!(host > work.metrics("host")[0]["psnr"].as_f64().unwrap() + 1.0, "60 steps are training");
    // Where no GPU is, the result is evaluated all the same. The two renderers differ by roundings.
    assert!((work.eval_psnr("device --device cpu") - device).abs() < 0.01);
}

#[test]
fn what_a_device_does_not_do_is_refused_with_a_remedy() {
    let work = Workdir::city(8, 64, 48, 100);
    let mut cases =
        vec![("--device cpu", "use --device gpu"), ("--device gpu --optimizer sparse", "use --optimizer deferred")];
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
