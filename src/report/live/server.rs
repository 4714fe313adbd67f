//! The server of the live page: four addresses, all read-only.
//!
//! | address | answer |
//! | --- | --- |
//! | `/` | the page |
//! | `/status` | [`super::Status`] as JSON |
//! | `/metrics?from=BYTE` | the run's metrics.jsonl from that byte on, whole lines |
//! | `/picture?view=..&turn=..&tilt=..&distance=..&width=..` | a PNG of [`super::Orbit`] |

use super::{Live, Orbit};
use axum::Router;
use axum::extract::{Query, Request, State};
use axum::http::{StatusCode, header};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::{Html, IntoResponse, Response};
use axum::routing::get;
use serde::Deserialize;
use std::io::{Read, Seek, SeekFrom};
use std::net::{IpAddr, SocketAddr, TcpListener};
use std::path::Path;
use std::time::Duration;

/// Longest time that a page waits for a picture: steps of large scenes, commits and evaluations take seconds.
const PATIENCE: Duration = Duration::from_secs(60);
/// Most bytes of metrics in one answer.
const METRICS_BYTES: u64 = 4 << 20;

/// Serves on a thread of its own for as long as the process lives.
pub(super) fn spawn(live: Live, listener: TcpListener) -> std::io::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_io().max_blocking_threads(8).build()?;
    let app = Router::new()
        .route("/", get(async || Html(include_str!("page.html"))))
        .route("/status", get(status))
        .route("/metrics", get(metrics))
        .route("/picture", get(picture))
        .layer(from_fn_with_state(live.clone(), check_host))
        .with_state(live);
    std::thread::Builder::new().name("live page".into()).spawn(move || {
        let served = runtime.block_on(async {
            let listener = tokio::net::TcpListener::from_std(listener)?;
            axum::serve(listener, app).await
        });
        if let Err(error) = served {
            eprintln!("warning: the live page has stopped: {error}");
        }
    })?;
    Ok(())
}

/// Refuses a request to a loopback address whose host name is not this machine's. Otherwise a page of another site could read the
/// answer by resolving its own name to the loopback address (DNS rebinding).
async fn check_host(State(live): State<Live>, request: Request, next: Next) -> Response {
    let host = request.headers().get(header::HOST).and_then(|host| host.to_str().ok()).unwrap_or_default();
    match is_own_host(live.address(), host) {
        true => next.run(request).await,
        false => (StatusCode::FORBIDDEN, "this page answers only requests to its own address").into_response(),
    }
}

/// Whether `host`, with or without a port, may name a page at `address`: any name if the network sees the page.
fn is_own_host(address: SocketAddr, host: &str) -> bool {
    // An IPv6 address stands in brackets.
    let name = host.rsplit_once(':').filter(|_| !host.ends_with(']')).map_or(host, |(name, _)| name);
    !address.ip().is_loopback() || name == "localhost" || name.trim_matches(['[', ']']).parse::<IpAddr>().is_ok()
}

/// An answer that no cache keeps.
fn fresh(kind: &'static str, body: Vec<u8>) -> Response {
    ([(header::CONTENT_TYPE, kind), (header::CACHE_CONTROL, "no-store")], body).into_response()
}

async fn status(State(live): State<Live>) -> Response {
    let status = live.state().status.clone();
    fresh("application/json", serde_json::to_vec(&status).unwrap_or_default())
}

#[derive(Deserialize)]
struct From {
    #[serde(default)]
    from: u64,
}

async fn metrics(State(live): State<Live>, Query(From { from }): Query<From>) -> Response {
    let file = live.state().metrics.clone();
    let lines = file.map_or(Ok(Vec::new()), |file| lines_from(&file, from));
    match lines {
        Ok(lines) => fresh("application/jsonl", lines),
        Err(error) => (StatusCode::SERVICE_UNAVAILABLE, error.to_string()).into_response(),
    }
}

/// The whole lines of a file from a byte on, at most [`METRICS_BYTES`].
fn lines_from(file: &Path, from: u64) -> std::io::Result<Vec<u8>> {
    let mut file = std::fs::File::open(file)?;
    file.seek(SeekFrom::Start(from))?;
    let mut lines = Vec::new();
    file.take(METRICS_BYTES).read_to_end(&mut lines)?;
    let end = lines.iter().rposition(|byte| *byte == b'\n').map_or(0, |at| at + 1);
    lines.truncate(end);
    Ok(lines)
}

async fn picture(State(live): State<Live>, Query(orbit): Query<Orbit>) -> Response {
    let asked = tokio::task::spawn_blocking(move || live.ask(orbit, PATIENCE)).await;
    match asked {
        Ok(Some(Ok(png))) => fresh("image/png", png),
        Ok(Some(Err(why))) => (StatusCode::SERVICE_UNAVAILABLE, why).into_response(),
        _ => (StatusCode::SERVICE_UNAVAILABLE, "the run has drawn no picture in time: it may be busy").into_response(),
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;

    #[test]
    fn a_page_on_the_loopback_answers_to_its_own_names_alone() {
        let [loopback, network] = [[127, 0, 0, 1], [0, 0, 0, 0]].map(|ip| SocketAddr::from((ip, 8080)));
        for host in ["127.0.0.1:8080", "localhost:8080", "localhost", "[::1]:8080", "[::1]"] {
            assert!(is_own_host(loopback, host), "{host}");
        }
        for host in ["evil.example:8080", "evil.example", "", "127.0.0.1.evil.example"] {
            assert!(!is_own_host(loopback, host), "{host}");
        }
        assert!(is_own_host(network, "my-machine:8080"));
    }

    #[test]
    fn metrics_end_with_a_whole_line() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "{}\n{\"a\":1}\n{\"b").unwrap();
        assert_eq!(lines_from(file.path(), 0).unwrap(), b"{}\n{\"a\":1}\n");
        assert_eq!(lines_from(file.path(), 3).unwrap(), b"{\"a\":1}\n");
        assert_eq!(lines_from(file.path(), 1000).unwrap(), b"");
        assert!(lines_from(Path::new("nowhere/metrics.jsonl"), 0).is_err());
    }
}
