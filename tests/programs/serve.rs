//! The live page (`--serve`): what it answers, that it changes no byte of the result, and what is refused.

use crate::support::scenes::{city, classic, stderr, text, train, wide_city};
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::Path;
use std::process::{Child, ChildStderr, Command, Stdio};
use std::time::Duration;
use tempfile::TempDir;

/// A run with a page.
struct Served {
    child: Child,
    said: BufReader<ChildStderr>,
    address: SocketAddr,
}

/// Starts a run and reads the address of its page.
fn begin(args: &[&str]) -> Served {
    let mut child = Command::new(env!("CARGO_BIN_EXE_gsscale-train"))
        .args(args)
        .args(classic(args))
        .args(["--serve", "127.0.0.1:0"])
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut said = BufReader::new(child.stderr.take().unwrap());
    let mut line = String::new();
    said.read_line(&mut line).unwrap();
    let address = line.trim().strip_prefix("live page: http://").and_then(|rest| rest.strip_suffix('/'));
    let address = address.unwrap_or_else(|| panic!("no address: {line}")).parse().unwrap();
    Served { child, said, address }
}

impl Served {
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

    /// Waits for the end of the run.
    fn end(mut self) {
        let mut said = String::new();
        self.said.read_to_string(&mut said).unwrap();
        assert!(self.child.wait().unwrap().success(), "{said}");
    }
}

/// Sum of the absolute differences of two pictures of one size.
fn difference(a: &image::RgbImage, b: &image::RgbImage) -> u64 {
    assert_eq!(a.dimensions(), b.dimensions());
    a.iter().zip(b.iter()).map(|(a, b)| u64::from(a.abs_diff(*b))).sum()
}

fn ply(out: &Path) -> Vec<u8> {
    std::fs::read(out.join("point_cloud.ply")).unwrap()
}

#[test]
fn a_page_shows_the_run_and_changes_no_byte_of_it() {
    let folder = TempDir::new().unwrap();
    let scene = wide_city(folder.path(), 6000);
    let [alone, watched, spill] = ["alone", "watched", "pages"].map(|name| folder.path().join(name));
    // Rounds grow the scene while pictures are drawn, and there are fewer frames than pages. The last 700 steps are time that a
    // slow machine may need for its answers.
    let args = "--steps 1600 --refine-start 100 --refine-every 100 --max-gaussians 7000 --page-rows 32 --log-every 10 --device cpu";
    let args: Vec<&str> = args.split(' ').collect();
    let output = train(&[&[text(&scene), "--out", text(&alone)], &args[..]].concat());
    assert!(output.status.success(), "{}", stderr(&output));
    let of_watched = [text(&scene), "--out", text(&watched), "--spill-dir", text(&spill), "--frames", "90"];
    let served = begin(&[&of_watched[..], &args].concat());

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
    served.end();
    assert!(ply(&alone) == ply(&watched), "a watched run gives another scene");
}

#[test]
fn a_picture_of_more_gaussians_than_the_budget_allows_is_refused_and_the_run_goes_on() {
    let folder = TempDir::new().unwrap();
    let scene = wide_city(folder.path(), 80_000);
    let [out, spill] = ["out", "pages"].map(|name| folder.path().join(name));
    let args = "--steps 200 --host-mem 64MiB --page-rows 512 --device cpu --strategy none";
    let args: Vec<&str> = args.split(' ').collect();
    let served = begin(&[&[text(&scene), "--out", text(&out), "--spill-dir", text(&spill)], &args[..]].concat());
    served.picture("view=0&width=48");
    // Far enough for the whole city.
    let (head, body) = served.get("/picture?view=0&distance=100&width=48");
    let said = String::from_utf8_lossy(&body);
    assert!(
        head.starts_with("HTTP/1.1 503") && said.contains("80000 Gaussians") && said.contains("move nearer"),
        "{said}"
    );
    served.picture("view=0&width=48");
    served.end();
}

#[test]
fn an_address_that_cannot_be_served_is_refused_before_anything_is_written() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 8, 64, 48, 100);
    let out = folder.path().join("out");
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port().to_string();
    for (address, words) in [(port.as_str(), "cannot be served"), ("localhost", "use a port (8080)")] {
        let output = train(&[text(&scene), "--out", text(&out), "--steps", "3", "--serve", address]);
        let said = stderr(&output);
        assert!(!output.status.success() && said.contains("--serve") && said.contains(words), "{said}");
        assert!(!out.exists());
    }
}
