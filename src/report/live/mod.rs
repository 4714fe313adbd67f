//! A page that shows a run while it trains (`--serve`) or a scene after training (`gsscale-view`): its curves, and a picture from a
//! camera that the person watching moves. After training, also of the Gaussians that the run has saved on its way (`--save-every`).
//!
//! The run and the server share a [`Live`]. The server stores the requests for pictures. The run draws the oldest one between two
//! steps and stores its PNG. The server reads curves from the run's `metrics.jsonl`, so they cost the run nothing.
//!
//! Not here: drawing (`train::run::scene_picture`), and how often a run does it (`train::run::live`).
//!
//! Invariants: 1. a page can only request pictures, so no request changes a result; 2. the server reads one file, the metrics; 3. each
//! request gets the picture of its own camera; 4. the run never draws for a page that was closed before the picture was begun.

mod server;

use crate::base::error::{InputError, InputResult};
use crate::base::identity::draw_identity;
use serde::{Deserialize, Serialize};
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Widest picture, pixels.
pub const WIDTH_MOST: u32 = 1280;
/// Most distances of the pivot by which it is shifted.
const SHIFT_MOST: f32 = 1000.0;

/// What a picture shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PictureKind {
    /// The scene.
    #[default]
    Scene,
    /// How near it is: grey at the pivot, brighter before it.
    Depth,
    /// The photo of the training view, wherever the camera is.
    Photo,
    /// The absolute difference of the photo and the scene from the photo's place, four times as bright.
    Difference,
    /// The root of the mean of that difference around each pixel, as heat: black, blue, red, yellow, white.
    Error,
}

/// A camera on an orbit around the point that a training view looks at.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Orbit {
    /// Number of the training view where the camera starts.
    pub view: u32,
    /// Turn around the direction that points up, degrees.
    pub turn: f32,
    /// Turn around the horizontal, degrees.
    pub tilt: f32,
    /// Distance to the pivot, over the distance of the training view.
    pub distance: f32,
    /// Level shifts of the pivot, to the right of the training view and ahead, over its distance to the pivot.
    pub aside: f32,
    pub ahead: f32,
    /// Width of the picture, pixels.
    pub width: u32,
    pub show: PictureKind,
    /// A step of [`Status::saved`]; 0 for the scene as it is now.
    pub step: u32,
}

impl Default for Orbit {
    fn default() -> Orbit {
        Orbit {
            view: 0,
            turn: 0.0,
            tilt: 0.0,
            distance: 1.0,
            aside: 0.0,
            ahead: 0.0,
            width: 640,
            show: PictureKind::Scene,
            step: 0,
        }
    }
}

impl Orbit {
    /// The nearest orbit that can be drawn. A number that is not finite becomes the default.
    pub fn bounded(self) -> Orbit {
        let or = |value: f32, default: f32| if value.is_finite() { value } else { default };
        Orbit {
            turn: or(self.turn, 0.0) % 360.0,
            tilt: or(self.tilt, 0.0).clamp(-180.0, 180.0),
            distance: or(self.distance, 1.0).clamp(0.01, 100.0),
            aside: or(self.aside, 0.0).clamp(-SHIFT_MOST, SHIFT_MOST),
            ahead: or(self.ahead, 0.0).clamp(-SHIFT_MOST, SHIFT_MOST),
            width: self.width.clamp(16, WIDTH_MOST),
            ..self
        }
    }
}

#[derive(Debug, Clone, Default, Serialize)]
pub struct Status {
    /// Of the program that serves the page; another one may serve the same address later.
    pub session: String,
    /// Name of the scene.
    pub name: String,
    /// Whether the scene is still trained.
    pub is_training: bool,
    /// The view that the page shows first.
    pub overview: u32,
    /// Steps done.
    pub step: u32,
    pub steps: u32,
    pub gaussians: u64,
    /// Pages of the scene, and those of them that are in memory.
    pub pages: u64,
    pub pages_in_memory: u64,
    /// PSNR of the last step's view, dB; `None` if no pixel of its photo counts.
    pub psnr: Option<f64>,
    /// Training views, for [`Orbit::view`].
    pub views: u32,
    /// Photos that are held out.
    pub held_out: u32,
    /// The steps of which Gaussians are saved, ascending; the page asks for a picture of one by [`Orbit::step`].
    pub saved: Vec<u32>,
    /// Percent of the time that pictures may take.
    pub picture_percent: u32,
}

/// A picture as PNG, or why it could not be drawn.
pub type Picture = Result<Vec<u8>, String>;

/// The number of a request for a picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
pub struct PictureTicket(u64);

#[derive(Debug, Default)]
struct State {
    /// The file of the metrics, once the run has one.
    metrics: Option<PathBuf>,
    status: Status,
    last: PictureTicket,
    /// Requests without an answer, the oldest first.
    waiting: Vec<(PictureTicket, Orbit)>,
    /// Answers that are not fetched yet.
    answers: Vec<(PictureTicket, Arc<Picture>)>,
}

#[derive(Debug)]
struct Shared {
    address: SocketAddr,
    state: Mutex<State>,
}

/// The state that a run and the server of its page share.
#[derive(Debug, Clone)]
pub struct Live(Arc<Shared>);

impl Live {
    /// Starts the server of a page at `address`; port 0 takes a free one.
    /// Errors: the address cannot be used.
    pub fn begin(address: SocketAddr) -> InputResult<Live> {
        let remedy = "choose another port, or leave --serve out";
        let fail = |e: std::io::Error| InputError::new("--serve", format!("{address} cannot be served: {e}"), remedy);
        let listener = std::net::TcpListener::bind(address).map_err(fail)?;
        listener.set_nonblocking(true).map_err(fail)?;
        let address = listener.local_addr().map_err(fail)?;
        let status = Status { session: format!("{:032x}", draw_identity()), ..Status::default() };
        let live = Live(Arc::new(Shared { address, state: Mutex::new(State { status, ..State::default() }) }));
        let started = server::spawn(live.clone(), listener);
        started
            .map_err(|e| InputError::new("--serve", format!("the server cannot start: {e}"), "leave --serve out"))?;
        Ok(live)
    }

    pub fn address(&self) -> SocketAddr {
        self.0.address
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.0.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub fn set_metrics(&self, metrics: PathBuf) {
        self.state().metrics = Some(metrics);
    }

    /// The session is this server's own.
    pub fn set_status(&self, status: Status) {
        let mut state = self.state();
        let session = std::mem::take(&mut state.status.session);
        state.status = Status { session, ..status };
    }

    /// The oldest request that is not answered yet.
    pub fn wanted(&self) -> Option<(PictureTicket, Orbit)> {
        self.state().waiting.first().copied()
    }

    /// Answers a request, and all others for the same camera.
    pub fn show(&self, (ticket, orbit): (PictureTicket, Orbit), picture: Picture) {
        let mut state = self.state();
        let picture = Arc::new(picture);
        let is_answered = |request: &(PictureTicket, Orbit)| request.0 == ticket || request.1 == orbit;
        let (answered, waiting) = state.waiting.iter().partition(|request| is_answered(request));
        let answered: Vec<(PictureTicket, Orbit)> = answered;
        state.waiting = waiting;
        state.answers.extend(answered.into_iter().map(|(ticket, _)| (ticket, Arc::clone(&picture))));
    }

    pub fn ask(&self, orbit: Orbit) -> Request {
        let mut state = self.state();
        state.last = PictureTicket(state.last.0 + 1);
        let ticket = state.last;
        state.waiting.push((ticket, orbit.bounded()));
        Request { live: self.clone(), ticket }
    }
}

/// A request for a picture. Dropping it withdraws it.
#[derive(Debug)]
pub struct Request {
    live: Live,
    ticket: PictureTicket,
}

impl Request {
    /// The picture, once it is drawn.
    pub fn answer(&self) -> Option<Arc<Picture>> {
        let state = self.live.state();
        state.answers.iter().find(|(ticket, _)| *ticket == self.ticket).map(|(_, picture)| Arc::clone(picture))
    }
}

impl Drop for Request {
    fn drop(&mut self) {
        let mut state = self.live.state();
        state.waiting.retain(|(ticket, _)| *ticket != self.ticket);
        state.answers.retain(|(ticket, _)| *ticket != self.ticket);
    }
}

/// The address that `text` names: `HOST:PORT`, or a port of this machine alone. Errors: as text, for a command line.
pub fn parse_address(text: &str) -> Result<SocketAddr, String> {
    let port = text.strip_prefix(':').unwrap_or(text).parse::<u16>();
    let full = port.map(|port| SocketAddr::from(([127, 0, 0, 1], port)));
    full.or_else(|_| text.parse()).map_err(|_| String::from("use a port (8080), or an address with one (0.0.0.0:8080)"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_port_alone_is_one_of_this_machine() {
        for text in ["8080", ":8080", "127.0.0.1:8080"] {
            assert_eq!(parse_address(text).unwrap(), SocketAddr::from(([127, 0, 0, 1], 8080)), "{text}");
        }
        assert!(parse_address("0.0.0.0:80").is_ok() && parse_address("[::1]:80").is_ok());
        for text in ["", "70000", "localhost", "1.2.3.4"] {
            assert!(parse_address(text).unwrap_err().contains("8080"), "{text}");
        }
    }

    #[test]
    fn an_orbit_that_cannot_be_drawn_becomes_the_nearest_one_that_can() {
        let far = Orbit { tilt: 1e9, aside: -1e9, ahead: f32::NAN, width: 1 << 30, ..Orbit::default() };
        let absurd = Orbit { view: 9, turn: f32::NAN, distance: f32::INFINITY, ..far };
        let nearest = Orbit { view: 9, tilt: 180.0, aside: -SHIFT_MOST, width: WIDTH_MOST, ..Orbit::default() };
        assert_eq!(absurd.bounded(), nearest);
    }

    #[test]
    fn each_request_gets_the_picture_of_its_camera_and_a_dropped_one_is_forgotten() {
        let live = Live(Arc::new(Shared { address: SocketAddr::from(([127, 0, 0, 1], 0)), state: Mutex::default() }));
        let [here, there] = [0.0, 30.0].map(|turn| Orbit { turn, ..Orbit::default() });
        let [first, second, third] = [here, there, here].map(|orbit| live.ask(orbit));
        let wanted = live.wanted().unwrap();
        assert_eq!(wanted.1, here, "the oldest one");
        live.show(wanted, Ok(vec![1]));
        assert_eq!(first.answer().as_deref(), Some(&Ok(vec![1])));
        assert_eq!(third.answer().as_deref(), Some(&Ok(vec![1])), "of the same camera");
        assert_eq!(second.answer(), None, "of another camera");
        let wanted = live.wanted().unwrap();
        assert_eq!(wanted.1, there);
        drop(second);
        assert_eq!(live.wanted(), None, "nobody waits for it");
        live.show(wanted, Err("too late".into()));
        drop((first, third));
        assert!(live.state().answers.is_empty(), "answers that nobody fetches are not kept");
    }
}
