//! The server of the live page: four addresses, all read-only.
//!
//! | address | answer |
//! | --- | --- |
//! | `/` | the page |
//! | `/status` | [`super::Status`] as JSON |
//! | `/metrics?from=BYTE` | the run's metrics.jsonl from that byte on, whole lines |
//! | `/picture?view=..&turn=..` | a PNG of the [`super::Orbit`] with these fields, and the defaults of the others |
//!
//! Invariant: whatever peers do, they hold at most [`CONNECTIONS_MOST`] connections, [`METRICS_MOST`] answers of metrics and
//! [`PICTURES_MOST`] pictures in memory, each for a bounded time.

use super::{Live, Orbit};
use axum::Router;
use axum::body::Bytes;
use axum::extract::{Query, Request, State};
use axum::http::{StatusCode, header};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::{Html, IntoResponse, Response};
use axum::routing::get;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use serde::Deserialize;
use std::io::{self, Read, Seek, SeekFrom};
use std::net::{IpAddr, TcpListener};
use std::path::Path;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::{Duration, Instant};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::TcpStream;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::{Sleep, sleep};

/// Longest time that a page waits for a picture: steps of large scenes, commits and evaluations take seconds.
const PATIENCE: Duration = Duration::from_secs(60);
/// Time between two looks whether a picture is drawn.
const LOOK_EVERY: Duration = Duration::from_millis(20);
/// Longest time until the head of a request is complete. A connection that says nothing for so long is closed.
const HEAD_PATIENCE: Duration = Duration::from_secs(if cfg!(test) { 1 } else { 15 });
/// Most connections at once; a browser opens six. Others wait, so idle connections cannot take the files that the run needs.
const CONNECTIONS_MOST: usize = 32;
/// Time until the next try after a connection could not be accepted.
const ACCEPT_AGAIN: Duration = Duration::from_millis(200);
/// Most bytes of the head of a request and its buffer.
const HEAD_BYTES: usize = 16 << 10;
/// Most bytes of metrics in one answer.
const METRICS_BYTES: u64 = 1 << 20;
/// Most answers of metrics in memory. Other requests wait.
const METRICS_MOST: usize = 8;
/// Most pictures that are asked for, or in memory, at once. They are drawn one by one, so others wait as well without.
const PICTURES_MOST: usize = 4;
/// Header of an answer of metrics: the length of their file when it was read.
const METRICS_LENGTH: &str = "x-metrics-length";

/// What all requests share.
#[derive(Clone)]
struct Served {
    live: Live,
    metrics: Arc<Semaphore>,
    pictures: Arc<Semaphore>,
}

/// The bytes of an answer and its place, which is free again when the bytes are sent.
struct HeldAnswer(Vec<u8>, #[allow(dead_code)] Option<OwnedSemaphorePermit>); // the place is held by being there

impl AsRef<[u8]> for HeldAnswer {
    fn as_ref(&self) -> &[u8] {
        &self.0
    }
}

/// Serves on a thread of its own for as long as the process lives.
pub(super) fn spawn(live: Live, listener: TcpListener) -> io::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_io().enable_time().build()?;
    let app = Router::new()
        .route("/", get(async || Html(include_str!("page.html"))))
        .route("/status", get(status))
        .route("/metrics", get(metrics))
        .route("/picture", get(picture))
        .layer(from_fn_with_state(live.clone(), check_host))
        .with_state(Served {
            live,
            metrics: Arc::new(Semaphore::new(METRICS_MOST)),
            pictures: Arc::new(Semaphore::new(PICTURES_MOST)),
        });
    std::thread::Builder::new().name("live page".into()).spawn(move || {
        if let Err(error) = runtime.block_on(serve(listener, app)) {
            crate::tell!("warning: the live page has stopped: {error}");
        }
    })?;
    Ok(())
}

/// Accepts connections for ever. A connection that cannot be accepted, for example because no file handle is left, is tried again.
async fn serve(listener: TcpListener, app: Router) -> io::Result<()> {
    let listener = tokio::net::TcpListener::from_std(listener)?;
    let places = Arc::new(Semaphore::new(CONNECTIONS_MOST));
    let mut http = http1::Builder::new();
    http.timer(TokioTimer::new()).header_read_timeout(HEAD_PATIENCE).max_buf_size(HEAD_BYTES);
    loop {
        let place = Arc::clone(&places).acquire_owned().await.map_err(io::Error::other)?;
        let Ok((stream, _)) = listener.accept().await else {
            sleep(ACCEPT_AGAIN).await;
            continue;
        };
        let served = http.serve_connection(TokioIo::new(Patient::new(stream)), TowerToHyperService::new(app.clone()));
        tokio::spawn(async move {
            // A peer that leaves in the middle of an answer is no fault of the run.
            let _left = served.await;
            drop(place);
        });
    }
}

/// Refuses a request to a loopback address whose host name is not this machine's. Otherwise a page of another site could read the
/// answer by resolving its own name to the loopback address (DNS rebinding). Pages of other sites cannot embed pictures either: browsers say
/// where a request comes from.
async fn check_host(State(live): State<Live>, request: Request, next: Next) -> Response {
    let host = request.headers().get(header::HOST).and_then(|host| host.to_str().ok()).unwrap_or_default();
    // Without its port; an IPv6 address stands in brackets.
    let name = host.rsplit_once(':').filter(|_| !host.ends_with(']')).map_or(host, |(name, _)| name);
    let is_own = name == "localhost" || name.trim_matches(['[', ']']).parse::<IpAddr>().is_ok();
    let site = request.headers().get("sec-fetch-site").and_then(|site| site.to_str().ok());
    // A link of another page may lead here.
    let is_foreign = request.uri().path() != "/" && site.is_some_and(|site| !["same-origin", "none"].contains(&site));
    // Any name if the network sees the page.
    match !is_foreign && (is_own || !live.address().ip().is_loopback()) {
        true => next.run(request).await,
        false => (StatusCode::FORBIDDEN, "this page answers only requests to its own address").into_response(),
    }
}

/// An answer that no cache keeps.
fn fresh(kind: &'static str, body: impl Into<Bytes>) -> Response {
    let body: Bytes = body.into();
    ([(header::CONTENT_TYPE, kind), (header::CACHE_CONTROL, "no-store")], body).into_response()
}

/// A place among `places`, which is always `Some`, since they are never closed.
async fn place(places: &Arc<Semaphore>) -> Option<OwnedSemaphorePermit> {
    Arc::clone(places).acquire_owned().await.ok()
}

async fn status(State(Served { live, .. }): State<Served>) -> Response {
    let status = live.state().status.clone();
    fresh("application/json", serde_json::to_vec(&status).unwrap_or_default())
}

#[derive(Deserialize)]
struct From {
    #[serde(default)]
    from: u64,
}

async fn metrics(State(served): State<Served>, Query(From { from }): Query<From>) -> Response {
    let place = place(&served.metrics).await;
    let live = served.live;
    let file = live.state().metrics.clone();
    let lines = file.map_or(Ok((Vec::new(), 0)), |file| lines_from(&file, from));
    match lines {
        Ok((lines, length)) => (
            [(METRICS_LENGTH, length.to_string())],
            fresh("application/jsonl", Bytes::from_owner(HeldAnswer(lines, place))),
        )
            .into_response(),
        Err(error) => (StatusCode::SERVICE_UNAVAILABLE, error.to_string()).into_response(),
    }
}

/// The whole lines of a file from a byte on, at most [`METRICS_BYTES`], and the length of the file. A run that goes back to its last
/// commit makes the file shorter: a page that has read further then begins again.
fn lines_from(file: &Path, from: u64) -> io::Result<(Vec<u8>, u64)> {
    let mut file = std::fs::File::open(file)?;
    let length = file.metadata()?.len();
    file.seek(SeekFrom::Start(from.min(length)))?;
    let mut lines = Vec::new();
    file.take(METRICS_BYTES).read_to_end(&mut lines)?;
    let end = lines.iter().rposition(|byte| *byte == b'\n').map_or(0, |at| at + 1);
    lines.truncate(end);
    Ok((lines, length))
}

/// Waits for a picture. The request is withdrawn when the page closes the connection, because the server then drops this future.
async fn picture(State(served): State<Served>, Query(orbit): Query<Orbit>) -> Response {
    let place = place(&served.pictures).await;
    let live = served.live;
    let (request, asked) = (live.ask(orbit), Instant::now());
    while asked.elapsed() < PATIENCE {
        match request.answer().as_deref() {
            Some(Ok(png)) => return fresh("image/png", Bytes::from_owner(HeldAnswer(png.clone(), place))),
            Some(Err(why)) => return (StatusCode::SERVICE_UNAVAILABLE, why.clone()).into_response(),
            None => sleep(LOOK_EVERY).await,
        }
    }
    (StatusCode::SERVICE_UNAVAILABLE, "the run has drawn no picture in time: it may be busy").into_response()
}

/// Longest time that an answer waits for its peer.
const WRITE_PATIENCE: Duration = Duration::from_secs(if cfg!(test) { 1 } else { 15 });
/// Each so many bytes that the peer takes win a second of patience again.
const RATE_LEAST: f64 = 16384.0;

/// A connection whose peer must read what it asked for: a peer that reads nothing is dropped after [`WRITE_PATIENCE`] of waiting for
/// it, and one that reads slower than [`RATE_LEAST`] when that has used it up.
struct Patient {
    stream: TcpStream,
    left: Duration,
    /// Since when a write waits, and the end of the patience with it.
    waits: Option<(tokio::time::Instant, Pin<Box<Sleep>>)>,
}

impl Patient {
    fn new(stream: TcpStream) -> Patient {
        Patient { stream, left: WRITE_PATIENCE, waits: None }
    }

    /// Judges a write: the peer has taken bytes, or does not yet.
    fn track_progress(
        &mut self,
        context: &mut Context<'_>,
        written: Poll<io::Result<usize>>,
    ) -> Poll<io::Result<usize>> {
        let Poll::Ready(written) = written else {
            let left = self.left;
            let (_, end) = self.waits.get_or_insert_with(|| (tokio::time::Instant::now(), Box::pin(sleep(left))));
            ready!(end.as_mut().poll(context));
            return Poll::Ready(Err(io::ErrorKind::TimedOut.into()));
        };
        if let Some((since, _)) = self.waits.take() {
            self.left = self.left.saturating_sub(since.elapsed());
        }
        let won = Duration::from_secs_f64(*written.as_ref().unwrap_or(&0) as f64 / RATE_LEAST);
        self.left = (self.left + won).min(WRITE_PATIENCE);
        Poll::Ready(written)
    }
}

impl AsyncRead for Patient {
    fn poll_read(mut self: Pin<&mut Self>, context: &mut Context<'_>, into: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_read(context, into)
    }
}

impl AsyncWrite for Patient {
    fn poll_write(mut self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write(context, bytes);
        self.track_progress(context, written)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        parts: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write_vectored(context, parts);
        self.track_progress(context, written)
    }

    /// True: the server then holds an answer's own bytes until they are written, not a copy.
    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;
    use std::net::{SocketAddr, TcpStream};

    fn request(live: &Live, path: &str) -> TcpStream {
        let mut stream = TcpStream::connect(live.address()).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
        write!(stream, "GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n").unwrap();
        stream
    }

    fn live() -> Live {
        Live::begin(SocketAddr::from(([127, 0, 0, 1], 0))).unwrap()
    }

    /// Waits until a picture is wanted, or none any more.
    fn wait_until_wanted(live: &Live, is_wanted: bool) {
        let began = Instant::now();
        while live.wanted().is_some() != is_wanted {
            assert!(began.elapsed() < Duration::from_secs(60), "wanted: {:?}", live.wanted());
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    #[test]
    fn silent_connections_are_closed_and_keep_nobody_out() {
        let live = live();
        let silent: Vec<TcpStream> =
            (0..2 * CONNECTIONS_MOST).map(|_| TcpStream::connect(live.address()).unwrap()).collect();
        let mut answer = String::new();
        request(&live, "/status").read_to_string(&mut answer).unwrap();
        assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
        drop(silent);
    }

    #[test]
    fn metrics_from_beyond_the_end_are_none() {
        let live = live();
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "{\"step\":1}\n").unwrap();
        live.set_metrics(file.path().to_path_buf());
        for (from, lines) in [(0, 1), (11, 0), (12, 0), (1 << 63, 0), (u64::MAX, 0)] {
            let mut answer = String::new();
            request(&live, &format!("/metrics?from={from}")).read_to_string(&mut answer).unwrap();
            let is_right = answer.starts_with("HTTP/1.1 200") && answer.matches("step").count() == lines;
            assert!(is_right, "{from}: {answer}");
        }
    }

    /// Peers ask for metrics and pictures, in one connection after the other, and never read the answers.
    #[test]
    fn answers_that_nobody_reads_are_dropped_and_keep_nobody_out() {
        let live = live();
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "{\"step\":1}\n".repeat(1 << 17)).unwrap();
        live.set_metrics(file.path().to_path_buf());
        let asked = |path: &str| {
            let mut stream = TcpStream::connect(live.address()).unwrap();
            let one = format!("GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n");
            // More answers than the system's buffers of a connection hold.
            let _ = stream.write_all(one.repeat(64).as_bytes());
            stream
        };
        let unread: Vec<TcpStream> = (0..CONNECTIONS_MOST).map(|_| asked("/metrics")).collect();
        let mut answer = String::new();
        request(&live, "/status").read_to_string(&mut answer).unwrap();
        assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
        answer.clear();
        request(&live, "/metrics").read_to_string(&mut answer).unwrap();
        assert!(answer.starts_with("HTTP/1.1 200") && answer.len() as u64 > METRICS_BYTES / 2, "{}", answer.len());
        drop(unread);
        // Pictures: no more than a few are asked for, so no more lie in memory.
        let unread: Vec<TcpStream> = (0..CONNECTIONS_MOST).map(|i| asked(&format!("/picture?turn={i}"))).collect();
        wait_until_wanted(&live, true);
        let (began, mut most) = (Instant::now(), 0);
        while began.elapsed() < Duration::from_secs(1) {
            most = most.max(live.state().waiting.len());
            std::thread::sleep(Duration::from_millis(5));
        }
        assert_eq!(most, PICTURES_MOST);
        drop(unread);
    }

    #[test]
    fn a_page_that_closes_its_connection_withdraws_its_request() {
        let live = live();
        let closed = request(&live, "/picture?turn=7");
        wait_until_wanted(&live, true);
        drop(closed);
        wait_until_wanted(&live, false);
        let mut open = request(&live, "/picture?turn=8");
        wait_until_wanted(&live, true);
        live.show(live.wanted().unwrap(), Ok(vec![7, 8]));
        let mut answer = Vec::new();
        open.read_to_end(&mut answer).unwrap();
        assert!(answer.starts_with(b"HTTP/1.1 200") && answer.ends_with(&[7, 8]));
    }

    #[test]
    fn metrics_end_with_a_whole_line() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "{}\n{\"a\":1}\n{\"b").unwrap();
        assert_eq!(lines_from(file.path(), 0).unwrap(), (b"{}\n{\"a\":1}\n".to_vec(), 14));
        assert_eq!(lines_from(file.path(), 3).unwrap(), (b"{\"a\":1}\n".to_vec(), 14));
        assert_eq!(lines_from(file.path(), 1000).unwrap(), (Vec::new(), 14));
        assert!(lines_from(Path::new("nowhere/metrics.jsonl"), 0).is_err());
    }
}
