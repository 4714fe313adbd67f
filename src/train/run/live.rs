//! Pictures for the live page of a run ([`crate::report::live`]), drawn between steps.
//!
//! Invariants: 1. a picture changes no bit of the result: it is drawn like an evaluation, which stores nothing; 2. pictures take at
//! most 5 % of the time before each is begun; the steps after a picture load again what it evicted, which is not counted; 3. a picture that
//! cannot be drawn, or takes too much memory, gives the page an error and does not end the run; 4. a run without a waiting page trains
//! as if it had no page.

use crate::base::error::{InputError, InputResult};
use crate::base::png_rows::write_rgb_rows;
use crate::base::trace;
use crate::base::units::format_bytes;
use crate::dataset::loader::Dataset;
use crate::report::live::{Live, Orbit, PictureTicket, Status};
use crate::scene::camera::Camera;
use crate::scene::image::Image;
use crate::train::error::TrainError;
use crate::train::state::trainer::Trainer;
use crate::train::step::pages::PagedScene;
use crate::train::step::view::draw;
use glam::{Mat3, Vec3};
use std::time::{Duration, Instant};

/// Percent of a run's time that pictures may take.
const PICTURE_PERCENT: u32 = 5;
/// The renderer may take this part of the budget for the rows of a picture, or as much as for a training view so far.
const PICTURE_SHARE: u64 = 8;
/// Time between two reports of the status.
const STATUS_EVERY: Duration = Duration::from_millis(200);

/// The live page of a run, and the time that its pictures took.
#[derive(Debug)]
pub struct LivePage {
    live: Live,
    began: Instant,
    /// Time that pictures took.
    spent: Duration,
    told: Option<Instant>,
}

impl LivePage {
    /// A page whose pictures have taken no time yet.
    pub fn new(live: Live) -> LivePage {
        LivePage { live, began: Instant::now(), spent: Duration::ZERO, told: None }
    }

    /// The request that is to be drawn now, if there is one and the share of pictures allows it.
    fn due(&self) -> Option<(PictureTicket, Orbit)> {
        self.live.wanted().filter(|_| self.may_draw())
    }

    /// Whether a picture is to be drawn after the next step.
    pub(super) fn is_due(&self) -> bool {
        self.due().is_some()
    }

    /// Whether the share of pictures allows another one.
    fn may_draw(&self) -> bool {
        100 * self.spent <= PICTURE_PERCENT * self.began.elapsed()
    }

    /// Reports the progress to the page, and draws the picture that the page requests.
    pub(super) fn show(&mut self, trainer: &mut Trainer, dataset: &Dataset, psnr: f64) {
        if self.told.is_none_or(|told| told.elapsed() >= STATUS_EVERY) {
            self.told = Some(Instant::now());
            self.live.set_status(Status {
                step: trainer.steps_done(),
                steps: trainer.options.steps,
                gaussians: trainer.scene.rows(),
                psnr,
                views: dataset.train_views().len() as u32,
                picture_percent: PICTURE_PERCENT,
            });
        }
        // A step in flight is finished first; the page waits.
        let Some((ticket, orbit)) = self.due().filter(|_| !trainer.is_ahead()) else { return };
        let started = Instant::now();
        let _span = trace::span("live picture");
        let picture = match picture(trainer, dataset, orbit) {
            Ok(image) => png(image).map_err(|e| format!("the picture cannot be written: {e}")),
            Err(error) => Err(format!("the picture cannot be drawn: {error}")),
        };
        self.live.show((ticket, orbit), picture);
        self.spent += started.elapsed();
    }
}

/// The scene after the last step, from an orbit.
fn picture<'a>(trainer: &'a mut Trainer, dataset: &Dataset, orbit: Orbit) -> Result<&'a Image, TrainError> {
    trainer.drain()?;
    let views = dataset.train_views();
    let view = views[orbit.view as usize % views.len().max(1)];
    let base = &dataset.views[view].camera;
    let pivot = median_depth(&trainer.scene, base).unwrap_or(dataset.scene_scale);
    let camera = orbit_camera(base, pivot, trainer.options.up, orbit);
    check_picture(trainer, &camera)?;
    trainer.run_memory().fit_frames_to_picture(&camera);
    let render = trainer.render_options();
    draw(&mut trainer.now(), &camera, &render)?;
    Ok(trainer.renderer.image()?)
}

/// Refuses a picture for which the renderer would need too much memory ([`PICTURE_SHARE`]). Batches bound the memory of gathered rows,
/// not that of the splats, which the renderer keeps for every visible row.
/// Errors: the camera may see too many Gaussians.
fn check_picture(trainer: &Trainer, camera: &Camera) -> InputResult<()> {
    let Some(budget) = trainer.memory.budget.filter(|_| !trainer.scene.is_in_memory()) else { return Ok(()) };
    let pager = &trainer.scene.pager;
    let rows: u64 = pager.pages_of_view(camera).iter().map(|page| u64::from(pager.index()[page.index()].rows)).sum();
    let needed = trainer.renderer.host_bytes_for_rows(rows);
    if needed <= trainer.renderer.host_bytes_of_rows().max(budget.bytes / PICTURE_SHARE) {
        return Ok(());
    }
    let problem = format!("{rows} Gaussians may be in view, which takes {} of memory", format_bytes(needed));
    Err(InputError::new("--serve", problem, "move nearer"))
}

/// Median depth of the pages that a camera sees, local units; `None` if no page is in front of the camera.
fn median_depth(scene: &PagedScene, camera: &Camera) -> Option<f32> {
    let index = scene.pager.index();
    let [_, _, axis] = camera.viewmat;
    let depth = |centre: [f32; 3]| axis[0] * centre[0] + axis[1] * centre[1] + axis[2] * centre[2] + axis[3];
    let pages = scene.pager.pages_of_view(camera);
    let mut depths: Vec<f32> = pages.iter().map(|page| depth(index[page.index()].bounds.centre())).collect();
    depths.retain(|depth| depth.is_finite() && *depth > camera.near_plane);
    depths.sort_unstable_by(f32::total_cmp);
    depths.get(depths.len() / 2).copied()
}

/// The camera of an orbit around the point `pivot`, which lies in front of `base`. `up` is the direction that points up, if it is known.
fn orbit_camera(base: &Camera, pivot: f32, up: Option<[f64; 3]>, orbit: Orbit) -> Camera {
    let row = |i: usize| Vec3::new(base.viewmat[i][0], base.viewmat[i][1], base.viewmat[i][2]);
    let (right, down, forward) = (row(0), row(1), row(2));
    let up = up.map_or(-down, |up| Vec3::from(up.map(|x| x as f32)));
    let turn = Mat3::from_axis_angle(up.try_normalize().unwrap_or(-down), orbit.turn.to_radians())
        * Mat3::from_axis_angle(right, orbit.tilt.to_radians());
    let centre = Vec3::from(base.centre());
    let pivot_point = centre + pivot * forward;
    let centre = pivot_point - orbit.distance * pivot * (turn * forward);
    let axes = [right, down, forward].map(|axis| turn * axis);
    let viewmat = axes.map(|axis| [axis.x, axis.y, axis.z, -axis.dot(centre)]);
    let scale = (orbit.width as f32 / base.width as f32).min(1.0);
    let side = |pixels: u32| ((pixels as f32 * scale).round() as u32).max(1);
    Camera {
        viewmat,
        fx: base.fx * scale,
        fy: base.fy * scale,
        cx: base.cx * scale,
        cy: base.cy * scale,
        width: side(base.width),
        height: side(base.height),
        ..*base
    }
}

fn png(image: &Image) -> std::io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    write_rgb_rows(&mut bytes, [image.width, image.height], |y, row| image.row_to_rgb8(y, row))?;
    Ok(bytes)
}

#[cfg(test)]
#[allow(clippy::expect_used)] // a panic is a failed test
mod tests {
    use super::*;

    fn base() -> Camera {
        let viewmat = [[1.0, 0.0, 0.0, -3.0], [0.0, 1.0, 0.0, 2.0], [0.0, 0.0, 1.0, -1.0]];
        Camera::pinhole(viewmat, [90.0, 80.0, 60.0, 40.0], [120, 80])
    }

    /// Coordinates of a world point before the camera.
    fn seen(camera: &Camera, point: [f32; 3]) -> [f32; 3] {
        camera.viewmat.map(|row| row[0] * point[0] + row[1] * point[1] + row[2] * point[2] + row[3])
    }

    #[test]
    fn pictures_take_their_share_of_the_time_and_the_first_is_free() {
        let live = Live::begin(std::net::SocketAddr::from(([127, 0, 0, 1], 0))).expect("a free port");
        let page = |spent: u64, seconds: u64| LivePage {
            live: live.clone(),
            began: Instant::now().checked_sub(Duration::from_secs(seconds)).expect("the machine runs for minutes"),
            spent: Duration::from_secs(spent),
            told: None,
        };
        assert!(page(0, 0).may_draw());
        assert!(page(4, 100).may_draw() && !page(6, 100).may_draw());
    }

    #[test]
    fn an_orbit_at_rest_is_the_view_and_the_pivot_stays_before_every_other() {
        let still = Orbit { width: 120, ..Orbit::default() };
        let at_rest = orbit_camera(&base(), 4.0, None, still);
        for (row, of_base) in at_rest.viewmat.iter().zip(&base().viewmat) {
            // Rounding of sums of a few numbers below 10.
            assert!(row.iter().zip(of_base).all(|(a, b)| (a - b).abs() < 1e-5), "{at_rest:?}");
        }
        let pivot = [3.0, -2.0, 5.0];
        for (turn, tilt, distance) in [(90.0, 0.0, 1.0), (10.0, 70.0, 0.5), (-200.0, -30.0, 3.0)] {
            let orbit = Orbit { turn, tilt, distance, width: 60, ..still };
            let camera = orbit_camera(&base(), 4.0, Some([0.0, -1.0, 0.0]), orbit);
            let [x, y, z] = seen(&camera, pivot);
            assert!(x.abs() < 1e-4 && y.abs() < 1e-4 && (z - 4.0 * distance).abs() < 1e-4, "{orbit:?}: {x} {y} {z}");
            assert_eq!((camera.width, camera.height, camera.fx, camera.cy), (60, 40, 45.0, 20.0));
        }
        // A turn to the right by a quarter, seen from above: the camera stands left of the pivot and looks along +x.
        let camera = orbit_camera(&base(), 4.0, Some([0.0, -1.0, 0.0]), Orbit { turn: 90.0, ..still });
        assert!((camera.viewmat[2][0].abs() - 1.0).abs() < 1e-5, "{camera:?}");
    }
}
