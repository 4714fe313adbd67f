//! A run that decides how many Gaussians its scene needs: what it says about it, and what it refuses.

use crate::support::scenes::told;
use crate::support::workdir::{TRAIN, Workdir};
use gsscale::base::units::format_grouped;
use serde_json::Value;

const DECIDES: &str = "scene --out out --overwrite --strategy long-axis --device cpu --steps 60 --log-every 5 --refine-start 10 \
    --refine-every 10";

#[test]
fn a_run_says_why_it_has_as_many_gaussians_as_it_has() {
    let work = Workdir::city(20, 64, 48, 500);
    let run = |more: &str| told(&work.succeeds(TRAIN, &format!("{DECIDES} {more}")));
    let planned = run("--dry-run");
    assert!(planned.contains("held-out training photos") && planned.contains("--quality"), "{planned}");
    let said = run("--quality archive");
    let growth = work.summary("out")["growth"].clone();
    let checks = growth.as_array().unwrap();
    assert!(checks.len() > 1, "{growth}");
    let of = |check: &Value, name: &str| check[name].as_u64().unwrap();
    for check in checks {
        let line = format!("step {}: Gaussians ", check["step"]);
        let line = said.lines().find(|l| l.starts_with(&line)).unwrap_or_else(|| panic!("no {line} in {said}"));
        assert!(line.len() <= 100 && line.contains(&format_grouped(of(check, "allowed"))), "{line}");
        assert_eq!(line.contains("up to"), check["decision"] == "doubles", "{line}");
    }
    // The check that changes the count says what the run takes from then on.
    assert!(said.contains("\n  which takes about ") && said.contains(" of the drive\n"), "{said}");
    let last = checks.last().unwrap();
    assert!(of(last, "allowed") > 500 && last["decision"] == "ends", "{growth}");
    let lines = work.metrics("out");
    assert_eq!((&lines[0]["growth"], &lines.last().unwrap()["growth"]), (&Value::Null, last));
    let report = work.text("out/report.html");
    assert!(
        report.contains("Number of Gaussians")
            && report.contains("held out")
            && report.contains("of which allowed more")
    );
    // More steps keep the decision, from the result as from a checkpoint.
    work.train("--resume out --steps 66 --device cpu --quiet");
    assert_eq!(work.summary("out")["growth"], growth);
    // Draft asks for more of a doubling, and the last check cannot come after the last round.
    let said = run("--quality draft --refine-stop 40");
    // 17 photos of 64 x 48 pixels, and 128 pixels for a Gaussian: fewer than the 500 at the start.
    assert!(said.contains("which is as many as --quality allows"), "{said}");
    let draft = work.summary("out")["growth"].clone();
    let of_draft = draft.as_array().unwrap();
    assert!(of_draft.iter().all(|check| of(check, "step") < 40), "{draft}");
    assert!(of(of_draft.last().unwrap(), "allowed") <= of(last, "allowed"), "{draft}");
    // After the decision another quality decides nothing.
    run("--keep-checkpoint");
    let said = work.train("--resume out --steps 66 --quality draft --accept-changes --device cpu");
    assert!(said.contains("was decided before, so --quality changes nothing"), "{said}");
    // Nor where the run goes on from its result.
    work.remove("out/checkpoint");
    let said = work.train("--resume out --steps 72 --quality archive --accept-changes --device cpu");
    assert!(said.contains("was decided before, so --quality changes nothing"), "{said}");
    // A cap that is given is the user's decision.
    run("--max-gaussians 600");
    assert_eq!(work.summary("out")["growth"], Value::Null);
}

#[test]
fn a_scene_with_too_few_views_to_decide_by_keeps_its_count() {
    let work = Workdir::city(13, 64, 48, 500);
    // 11 training views.
    let run = |more: &str| {
        let said = work.train(&format!("{DECIDES} {more}"));
        (said, work.ply("out"))
    };
    let (said, ply) = run("");
    let kept = work.summary("out");
    let warned = said.lines().find(|line| line.starts_with("warning: the run keeps the number of Gaussians"));
    assert!(
        warned.is_some_and(|line| line.contains("11 training photos") && line.contains("--max-gaussians")),
        "{said}"
    );
    assert!(said.contains("which stays their number"), "{said}");
    assert!(kept["gaussians"].as_u64() <= Some(500) && kept["growth"] == Value::Null, "{kept}");
    // That is the run with its first count as the cap, and with it the scene recycles Gaussians.
    assert!(run("--max-gaussians 500").1 == ply && run("--recycle 0").1 != ply);
}

/// Three of 17 training photos are held out: the third, the eighth and the thirteenth.
#[test]
fn a_run_that_cannot_measure_its_held_out_photos_says_so() {
    let work = Workdir::city(20, 64, 48, 500);
    std::fs::create_dir(work.path("scene/masks")).unwrap();
    for photo in [3, 9, 14].map(|index| work.photos()[index].clone()) {
        let name = format!("scene/masks/{}.png", photo.file_name().unwrap().to_string_lossy());
        image::GrayImage::new(64, 48).save(work.path(&name)).unwrap();
    }
    let said = told(&work.succeeds(TRAIN, DECIDES));
    assert_eq!(said.matches("the number of Gaussians cannot be decided").count(), 1, "{said}");
    assert!(said.contains("masks of 3 of 17 training photos") && !said.contains("Gaussians up to"), "{said}");
}
