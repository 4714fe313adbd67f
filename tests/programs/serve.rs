//! The live page (`--serve`): what it answers, that it changes no byte of the result, and what is refused.

use crate::support::workdir::{EVAL, Running, TRAIN, VIEW, Workdir};
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::time::Duration;

struct Served<'a> {
    run: Running<'a>,
    address: SocketAddr,
}

/// Starts a run and reads the address of its page.
fn begin<'a>(work: &'a Workdir, flags: &str) -> Served<'a> {
    serve(work, TRAIN, &format!("scene --out out {flags}"))
}

/// Starts a program with a page and reads its address.
fn serve<'a>(work: &'a Workdir, program: &str, flags: &str) -> Served<'a> {
    let mut run = Running::spawn(work, &mut work.command(program, &format!("{flags} --serve 127.0.0.1:0")));
    let said = run.says("/\n");
    let address = said.split("live page: http://").nth(1).and_then(|rest| rest.split('/').next());
    let address = address.unwrap_or_else(|| panic!("no address: {said}")).parse().unwrap();
    Served { run, address }
}

impl Served<'_> {
    /// Status line, headers and body of an answer.
    fn get(&self, path: &str) -> (String, Vec<u8>) {
        self.get_as(path, &self.address.to_string())
    }

    /// The same, of a browser that knows the page by this name.
    fn get_as(&self, path: &str, host: &str) -> (String, Vec<u8>) {
        let mut stream = TcpStream::connect(self.address).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(120))).unwrap();
        write!(stream, "GET {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n").unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        let end = answer.windows(4).position(|four| four == b"\r\n\r\n").unwrap();
        let head = String::from_utf8(answer[..end].to_vec()).unwrap();
        (head, answer.split_off(end + 4))
    }

    fn json(&self, path: &str) -> serde_json::Value {
        let (head, body) = self.get(path);
        assert!(head.starts_with("HTTP/1.1 200"), "{path}: {head}");
        serde_json::from_slice(&body).unwrap_or_else(|e| panic!("{path}: {e}"))
    }

    /// The picture at an address, and its size.
    fn picture(&self, query: &str) -> image::RgbImage {
        let (head, body) = self.get(&format!("/picture?{query}"));
        assert!(head.starts_with("HTTP/1.1 200") && head.contains("image/png"), "{query}: {head}");
        image::load_from_memory(&body).unwrap().to_rgb8()
    }
}

/// Sum of the absolute differences of two pictures of one size.
fn difference(a: &image::RgbImage, b: &image::RgbImage) -> u64 {
    assert_eq!(a.dimensions(), b.dimensions());
    a.iter().zip(b.iter()).map(|(a, b)| u64::from(a.abs_diff(*b))).sum()
}

#[test]
fn a_page_shows_the_run_and_changes_no_byte_of_it() {
    let work = Workdir::wide_city(6000);
    // Rounds grow the scene while pictures are drawn, and there are fewer frames than pages. The last 700 steps are time that a
    // slow machine may need for its answers.
    let flags = "--steps 1600 --refine-start 100 --refine-every 100 --max-gaussians 7000 --page-rows 32 --log-every 10 --device cpu";
    work.run("alone", flags);
    let served = begin(&work, &format!("{flags} --spill-dir spill --frames 90"));

    let (head, page) = served.get("/");
    assert!(head.contains("text/html") && String::from_utf8_lossy(&page).contains("/picture?"), "{head}");
    let first = served.picture("view=0&width=48");
    assert!(first.pixels().any(|pixel| pixel != first.get_pixel(0, 0)), "a picture of something");
    let turned = served.picture("view=0&turn=25&width=48");
    let far = served.picture("view=3&distance=1.5&tilt=-10&width=32");
    assert_eq!((turned.width(), far.width()), (48, 32));
    assert!(difference(&first, &turned) > 48 * 36, "a turned camera sees something else");
    // Numbers that no camera can have are brought into range; words are an error of the request.
    served.picture("view=4000000000&turn=1e30&tilt=-1e30&distance=0&width=1");
    assert!(served.get("/picture?turn=left").0.starts_with("HTTP/1.1 400"));
    assert!(served.get("/../config.toml").0.starts_with("HTTP/1.1 404"), "nothing but the page is served");

    let rebound = served.get_as("/status", "evil.example").0;
    assert!(rebound.starts_with("HTTP/1.1 403"), "a name of another site: {rebound}");

    let asked_by =
        |site: &str, path: &str| served.get_as(path, &format!("{}\r\nSec-Fetch-Site: {site}", served.address)).0;
    assert!(asked_by("cross-site", "/picture?show=photo").starts_with("HTTP/1.1 403"), "a page of another site");
    assert!(asked_by("same-origin", "/status").starts_with("HTTP/1.1 200"));
    assert!(asked_by("cross-site", "/").starts_with("HTTP/1.1 200"), "a link");

    let status = served.json("/status");
    assert!(status["step"].as_u64().unwrap() > 0 && status["steps"] == 1600, "{status}");
    assert!(status["gaussians"].as_u64().unwrap() >= 6000 && status["views"].as_u64().unwrap() > 3, "{status}");
    let (_, lines) = served.get("/metrics?from=0");
    let lines = String::from_utf8(lines).unwrap();
    let first: serde_json::Value = serde_json::from_str(lines.lines().next().unwrap()).unwrap();
    assert_eq!(first["step"], 10);
    let after_first = || served.get(&format!("/metrics?from={}", lines.find('\n').unwrap() + 1)).1;
    while after_first().is_empty() {
        assert!(served.json("/status")["step"].as_u64().unwrap() < 900, "no second line");
    }
    let later = String::from_utf8(after_first()).unwrap();
    assert!(later.starts_with("{\"step\":20,"), "{later}");
    // Pictures all through the rounds.
    let mut drawn = 0;
    while served.json("/status")["step"].as_u64().unwrap() < 900 {
        served.picture(&format!("view={drawn}&turn={drawn}&width=48"));
        drawn += 1;
    }
    assert!(drawn > 3, "{drawn} pictures");
    served.run.ends(0);
    assert!(work.ply("alone") == work.ply("out"), "a watched run gives another scene");
}

#[test]
fn a_picture_of_more_gaussians_than_the_budget_allows_is_refused_and_the_run_goes_on() {
    let work = Workdir::wide_city(80_000);
    let flags = "--steps 200 --host-mem 64MiB --page-rows 512 --device cpu --strategy none --spill-dir spill";
    let served = begin(&work, flags);
    served.picture("view=0&width=48");
    // Far enough for the whole city.
    let (head, body) = served.get("/picture?view=0&distance=100&width=48");
    let said = String::from_utf8_lossy(&body);
    assert!(
        head.starts_with("HTTP/1.1 503") && said.contains("80000 Gaussians") && said.contains("move nearer"),
        "{said}"
    );
    served.picture("view=0&width=48");
    served.run.ends(0);
}

/// The same Gaussians from a PLY in memory, from SOGs, from a store, and through a spill directory with few frames.
#[test]
fn a_finished_run_is_shown_beside_its_photos() {
    let work = Workdir::wide_city(3000);
    work.run(
        "out",
        "--steps 120 --max-gaussians 3000 --device cpu --export sog --keep-checkpoint --log-every 40 --save-every 40",
    );
    let held_out = work.json_of(EVAL, "out");
    let before = work.files("out");
    let (mut first, mut sessions): (Option<image::RgbImage>, _) = (None, std::collections::BTreeSet::new());
    let paged = "out --spill-dir spill --host-mem 200MiB --page-rows 32";
    for flags in ["out", "out/point_cloud_sog/lod-meta.json", "out/checkpoint", paged] {
        let served = serve(&work, VIEW, &format!("{flags} --device cpu"));
        // Pictures wait until the scene is read.
        let scene = served.picture("view=2&width=64");
        let status = served.json("/status");
        assert!(status["name"] == "scene" && status["is_training"] == false, "{status}");
        assert!(status["gaussians"].as_u64().unwrap() >= 2900, "{status}");
        let view = &status["overview"];
        assert!(view.as_u64().unwrap() < status["views"].as_u64().unwrap(), "{status}");
        assert!(served.get("/metrics?from=0").1 == work.bytes("out/metrics.jsonl"), "the curves of the run");
        let count = |name: &str| status[name].as_u64().unwrap();
        assert_eq!(count("views") + count("held_out"), work.photos().len() as u64, "{status}");
        assert!(0 < count("pages_in_memory") && count("pages_in_memory") <= count("pages"), "{status}");
        let same = first.get_or_insert_with(|| scene.clone());
        // The Gaussians that the run has saved on its way, and the result again.
        assert_eq!(status["saved"], serde_json::json!([40, 80]), "{status}");
        let early = served.picture("view=2&width=64&step=40");
        assert!(difference(&early, &scene) > 64 * 48, "{flags}");
        assert_eq!(served.json("/status")["step"], 40);
        // A photo needs no Gaussians, so those of step 40 stay.
        served.picture("view=2&width=64&show=photo");
        assert_eq!(served.json("/status")["step"], 40);
        assert!(served.picture("view=2&width=64") == scene, "{flags}");
        let (head, body) = served.get("/picture?view=2&step=41");
        let said = String::from_utf8_lossy(&body);
        assert!(head.starts_with("HTTP/1.1 503") && said.contains("no Gaussians of step 41 are saved"), "{said}");
        // SOGs round colours and positions to bytes and words: two steps of a byte a value.
        // Rows lie in another order in a file than in a store, so those of equal depth blend in another order: a step of a byte in
        // one value of a hundred.
        let values = 64 * 48 * 3;
        let rounding = if flags.ends_with("json") { 2 * values } else { values / 100 };
        assert!(difference(same, &scene) <= rounding, "{flags}: {}", difference(same, &scene));

        let photo = served.picture("view=2&turn=40&show=photo");
        let whole = served.picture("view=2&width=1280");
        let differs = served.picture("view=2&turn=40&show=difference");
        assert_eq!(photo.dimensions(), whole.dimensions());
        for ((photo, whole), differs) in photo.iter().zip(whole.iter()).zip(differs.iter()) {
            let four = 4 * u32::from(photo.abs_diff(*whole));
            // The picture was rounded to bytes, the difference after it was taken.
            assert!(u32::from(*differs).abs_diff(four.min(255)) <= 4, "{differs} for {photo} and {whole}");
        }
        let heat = served.picture("view=2&turn=40&show=error");
        assert!(heat.dimensions() == differs.dimensions() && heat != differs);
        // As narrow as was asked for, too.
        for show in ["photo", "difference", "error"] {
            assert_eq!(served.picture(&format!("view=2&width=32&show={show}")).dimensions(), (32, 24), "{show}");
        }
        let session = served.json("/status")["session"].as_str().unwrap().to_string();
        assert!(session.len() == 32 && sessions.insert(session), "a session of each server");
        let depth = served.picture("view=2&width=64&show=depth");
        let grey = |pixel: &image::Rgb<u8>| pixel.0.iter().all(|value| value.abs_diff(pixel.0[0]) <= 1);
        assert!(depth.pixels().all(grey) && depth.pixels().any(|pixel| pixel != depth.get_pixel(0, 0)));
        assert!(difference(&scene, &served.picture("view=2&width=64&ahead=.2")) > 64 * 48);
        served.run.signal("INT").ends(0);
        assert!(!work.exists("spill"), "{flags}: the pages are removed");
    }
    assert!(work.files("out") == before && work.json_of(EVAL, "out") == held_out, "a viewer changes nothing of a run");
    work.refuses_with(VIEW, "out/point_cloud.spz", &["point_cloud.spz", "does not exist"]);
    work.refuses_with(VIEW, "scene", &["this folder holds no run", "gsscale-view runs/NAME"]);
    work.write("bare.ply", work.bytes("out/point_cloud.ply"));
    std::fs::create_dir(work.path("copied")).unwrap();
    std::fs::copy(work.path("bare.ply"), work.path("copied/point_cloud.ply")).unwrap();
    work.succeeds(EVAL, "copied scene --device cpu");
    work.refuses_with(VIEW, "bare.ply", &["bare.ply", "name the scene: gsscale-view FILE SCENE"]);
}

#[test]
fn an_address_that_cannot_be_served_is_refused_before_anything_is_written() {
    let work = Workdir::city(8, 64, 48, 100);
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port().to_string();
    for (address, words) in [(port.as_str(), "cannot be served"), ("localhost", "use a port (8080)")] {
        let output = work.output(TRAIN, &format!("scene --out out --steps 3 --serve {address}"));
        let said = crate::support::scenes::stderr(&output);
        assert!(!output.status.success() && said.contains("--serve") && said.contains(words), "{said}");
        assert!(!work.exists("out"));
    }
}
