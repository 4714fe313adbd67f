//! The decibels that a view loses without its faintest Gaussians. The view is drawn twice: with all rows, and without the
//! quarter of the drawn rows that have the least blending weight in this view.
//!
//! The loss says how crowded the scene is. Where Gaussians are scarce, even the faintest carry detail; where they abound,
//! neighbours hide what a removed one leaves ([`crate::densify::growth`] decides by it).
//!
//! Invariants: 1. nothing is stored; 2. the loss is a function of the scene, the step and the view: rows are ordered by
//! weight, then by their place in the view; 3. memory beside the renderer's is that of one batch of rows, and four bytes a
//! row of the view.

use crate::render::color_correct::{ColorCorrect, color_corrected_psnr};
use crate::render::metrics::psnr;
use crate::render::{LossOptions, RenderOptions, Renderer};
use crate::scene::camera::Camera;
use crate::scene::image::Target;
use crate::train::error::TrainError;
use crate::train::log::report::json_psnr;
use crate::train::step::pages::PagedScene;
use crate::train::step::view::{Now, ViewPass};
use crate::train::step::working_set::WorkingSet;

/// One in this many drawn rows is left out.
const LEFT_OUT_OF: usize = 4;

/// What a view needs to be drawn and compared.
pub(super) struct Compared<'a> {
    pub camera: &'a Camera,
    pub target: &'a Target,
    pub render: &'a RenderOptions,
    pub loss: &'a LossOptions,
    /// Most pages of a batch.
    pub pages_most: usize,
    /// A correction of the pictures before they are compared.
    pub correct: Option<ColorCorrect>,
}

/// PSNR of a view with all rows, dB.
///
/// # Errors
/// Pages could not be had, or the renderer failed.
pub(super) fn psnr_of_view(
    now: Now<'_>,
    renderer: &mut dyn Renderer,
    view: &Compared<'_>,
) -> Result<[f64; 1], TrainError> {
    drawn(now, renderer, view, |draw| Ok([draw.picture(None)?]))
}

/// PSNR of a view with all rows, and without the faintest quarter of the rows drawn, dB.
///
/// # Errors
/// Pages could not be had, or the renderer failed.
pub(super) fn psnr_without_faint(
    now: Now<'_>,
    renderer: &mut dyn Renderer,
    view: &Compared<'_>,
) -> Result<[f64; 2], TrainError> {
    renderer.weigh_rows(true)?;
    drawn(now, renderer, view, |draw| {
        let whole = draw.picture(None)?;
        let weights = draw.weights()?;
        let without = draw.picture(Some(&are_kept(&weights)))?;
        Ok([whole, without])
    })
}

/// What `measure` finds of a view, whose pages are drawn in batches.
fn drawn<T>(
    (scene, now, working): Now<'_>,
    renderer: &mut dyn Renderer,
    view: &Compared<'_>,
    measure: impl FnOnce(&mut Draw<'_, '_>) -> Result<T, TrainError>,
) -> Result<T, TrainError> {
    let pass = ViewPass::new(scene, view.camera, view.render, view.pages_most);
    measure(&mut Draw { scene, now, working, renderer, view, pass: &pass })
}

/// Whether each row stays: all but the faintest quarter of those that were drawn.
fn are_kept(weights: &[f32]) -> Vec<bool> {
    let mut drawn: Vec<u32> = (0..weights.len() as u32).filter(|&row| weights[row as usize] > 0.0).collect();
    let left_out = drawn.len() / LEFT_OUT_OF;
    let mut kept = vec![true; weights.len()];
    if left_out > 0 {
        // Weights are positive here, so their bits are in the order of their values.
        drawn.select_nth_unstable_by_key(left_out - 1, |&row| (weights[row as usize].to_bits(), row));
        drawn[..left_out].iter().for_each(|&row| kept[row as usize] = false);
    }
    kept
}

struct Draw<'a, 'v> {
    scene: &'a mut PagedScene,
    now: u32,
    working: &'a mut WorkingSet,
    renderer: &'a mut dyn Renderer,
    view: &'a Compared<'v>,
    pass: &'a ViewPass<'v>,
}

impl Draw<'_, '_> {
    /// Draws the rows that stay, all without a list, and compares the picture; returns its PSNR.
    fn picture(&mut self, kept: Option<&[bool]>) -> Result<f64, TrainError> {
        let mut first = 0;
        self.pass.rows_in((&mut *self.scene, self.now, &mut *self.working), &mut *self.renderer, |columns| {
            let rows = columns.rows();
            if let Some(kept) = kept {
                columns.retain_rows(|_, row| kept[first + row]);
            }
            first += rows;
        })?;
        self.renderer.picture()?;
        let (image, target) = (self.renderer.image()?, self.view.target);
        Ok(json_psnr(match self.view.correct {
            Some(how) => color_corrected_psnr(image, target, how),
            None => psnr(image, target),
        }))
    }

    /// The blending weights of all rows of the picture that was drawn last.
    fn weights(&mut self) -> Result<Vec<f32>, TrainError> {
        self.renderer.loss(self.view.target, self.view.loss)?;
        self.renderer.picture_back()?;
        let mut parts = Vec::new();
        self.pass.rows_out((&mut *self.scene, self.now, &mut *self.working), &mut *self.renderer, |gradients| {
            parts.push(gradients.weights.iter().map(|[weight, _]| *weight).collect::<Vec<f32>>());
        })?;
        parts.reverse();
        Ok(parts.concat())
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;
    use crate::base::rng::{Purpose, Stream};
    use crate::config::file::TrainConfig;
    use crate::config::limits::RunOptions;
    use crate::paging::pager::{Pager, PagerConfig};
    use crate::render::cpu::CpuRenderer;
    use crate::scene::columns::Columns;

    /// More pages than a batch of any size below, in front of a camera that sees all of them.
    fn scene(options: &RunOptions) -> PagedScene {
        let mut draws = Stream::new(7, Purpose::Test, 0, 0);
        let mut columns = Columns::zeros(2000, 1);
        columns.means.iter_mut().for_each(|x| *x = draws.range(-2.0, 2.0) as f32);
        columns.quats.chunks_exact_mut(4).for_each(|q| q[0] = 1.0);
        columns.scales.iter_mut().for_each(|x| *x = draws.range(-4.0, -3.0) as f32);
        columns.opacities.iter_mut().for_each(|x| *x = draws.range(-2.0, 3.0) as f32);
        columns.sh0.iter_mut().for_each(|x| *x = draws.normal() as f32);
        let pager = Pager::in_memory(PagerConfig::in_memory(options.page_rows, options.sh_degree));
        PagedScene::new(&columns, pager, options).unwrap()
    }

    /// A batch is gathered in parts, and the rows of all parts count.
    #[test]
    fn the_loss_is_the_same_for_any_batches() {
        let options = RunOptions::new(&TrainConfig { page_rows: 16, sh_degree: 1, ..TrainConfig::default() }, 1.0);
        let mut scene = scene(&options);
        let viewmat = [[1.0, 0.0, 0.0, 0.1], [0.0, 1.0, 0.0, -0.2], [0.0, 0.0, 1.0, 4.5]];
        let (near_plane, far_plane) = (0.01, 1e10);
        let camera =
            Camera { viewmat, fx: 50.0, fy: 50.0, cx: 40.0, cy: 30.0, width: 80, height: 60, near_plane, far_plane };
        let rgb = (0..3 * camera.pixels()).map(|i| (i * 7 % 256) as u8).collect();
        let target = Target { width: camera.width, height: camera.height, rgb, mask: None };
        let pages = scene.pager.pages_of_view(&camera).len();
        assert!(pages > 2 * 48, "{pages} pages");
        let render = RenderOptions { sh_degree: scene.rules.sh_degree(), ..options.render };
        let [whole, few, parts, all] = [1, 16, 48, usize::MAX].map(|pages_most| {
            let view = Compared {
                camera: &camera,
                target: &target,
                render: &render,
                loss: &options.loss,
                pages_most,
                correct: None,
            };
            let now = (&mut scene, 0, &mut WorkingSet::default());
            psnr_without_faint(now, &mut CpuRenderer::new(), &view).unwrap()
        });
        assert!(whole == few && few == parts && parts == all, "{whole:?} {few:?} {parts:?} {all:?}");
        assert!(whole[0] != whole[1], "{whole:?}");
    }

    #[test]
    fn a_quarter_of_the_drawn_rows_is_left_out_the_faintest_first() {
        let kept = are_kept(&[0.0, 3.0, 1.0, 2.0, 1.0, 4.0, 0.0, 5.0, 6.0, 7.0]);
        // Eight rows are drawn; of the two that weigh 1, both go. Rows that are not drawn cost nothing.
        assert_eq!(kept, [true, true, false, true, false, true, true, true, true, true]);
        assert_eq!(are_kept(&[1.0; 4]), [false, true, true, true], "the first of equals");
        assert!(are_kept(&[1.0; 3]).iter().all(|kept| *kept) && are_kept(&[]).is_empty());
    }
}
