//! A connection of the live page whose peer must read what it asked for.
//!
//! Not here: peers that send nothing (the server's limit on the head of a request).
//!
//! Invariant: a peer that reads nothing is dropped after [`WRITE_PATIENCE`] of waiting for it, and one that reads slower than
//! [`RATE_LEAST`] when that has used it up, so that a place and the bytes of an answer are never held for long.

use std::io;
use std::pin::Pin;
use std::task::{Context, Poll, ready};
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::TcpStream;
use tokio::time::{Instant, Sleep, sleep};

/// Longest time that an answer waits for its peer.
const WRITE_PATIENCE: Duration = Duration::from_secs(if cfg!(test) { 1 } else { 15 });
/// Each so many bytes that the peer takes win a second of patience again.
const RATE_LEAST: f64 = 16384.0;

/// The connection.
pub(super) struct Patient {
    stream: TcpStream,
    /// What is left of the patience.
    left: Duration,
    /// Since when a write waits, and the end of the patience with it.
    waits: Option<(Instant, Pin<Box<Sleep>>)>,
}

impl Patient {
    pub fn new(stream: TcpStream) -> Patient {
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
            let (_, end) = self.waits.get_or_insert_with(|| (Instant::now(), Box::pin(sleep(left))));
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
