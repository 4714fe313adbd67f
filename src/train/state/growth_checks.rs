//! What a check of the count measures: how good the held-out training views are, and the decibels that they lose without their faintest
//! Gaussians. A view is drawn twice: with all rows, and without the quarter of the drawn rows that have the least blending weight in it.
//!
//! The loss says how crowded the scene is. Where Gaussians are scarce, even the faintest carry detail; where they abound,
//! neighbours hide what a removed one leaves.
//!
//! Not here: the decision ([`crate::densify::growth`]), which views (`turns`).
//!
//! Invariants: 1. nothing is stored; 2. the values are a function of the scene, the step and the views: rows are ordered by
//! weight, then by their place in the view; 3. memory beside the renderer's is that of one batch of rows, and four bytes a
//! row of the view.

use crate::dataset::target_cache::TargetCache;
use crate::densify::growth::GrowthValues;
use crate::render::color_correct::{ColorCorrect, color_corrected_psnr};
use crate::render::metrics::psnr;
use crate::render::{LossOptions, RenderOptions};
use crate::scene::camera::Camera;
use crate::scene::image::Target;
use crate::train::error::TrainError;
use crate::train::log::report::json_psnr;
use crate::train::step::view::{SceneNow, ViewPass};

/// One in this many drawn rows is left out.
const LEFT_OUT_OF: usize = 4;

/// What views are drawn and compared with.
pub(super) struct Comparing<'a> {
    pub targets: &'a TargetCache,
    pub render: &'a RenderOptions,
    pub loss: &'a LossOptions,
    /// Most pages of a batch.
    pub pages_most: usize,
    /// A correction of the pictures before they are compared.
    pub correct: Option<ColorCorrect>,
}

/// What a check measures of the views that are held out and of those that were trained on, as indices in `dataset.views` with their
/// cameras; `None` if all of either are masked as a whole.
/// Errors: a photo cannot be decoded, pages could not be had, or the renderer failed.
pub(super) fn growth_values(
    now: &mut SceneNow<'_>,
    comparing: &Comparing<'_>,
    held_out: &[(usize, Camera)],
    trained: &[(usize, Camera)],
) -> Result<Option<GrowthValues>, TrainError> {
    now.renderer.weigh_rows(true)?;
    let held_out = mean_psnr(now, comparing, held_out, |draw| draw.psnr_without_faint())?;
    let trained = mean_psnr(now, comparing, trained, |mut draw| Ok([draw.picture(None)?]))?;
    let (Some([psnr, lost]), Some([trained_psnr])) = (held_out, trained) else { return Ok(None) };
    Ok(Some(GrowthValues { psnr, trained_psnr, lost: psnr - lost }))
}

/// Means of values of these views, dB; `None` if none of them counts.
fn mean_psnr<const N: usize>(
    now: &mut SceneNow<'_>,
    comparing: &Comparing<'_>,
    views: &[(usize, Camera)],
    of_view: impl Fn(ViewToDraw<'_, '_>) -> Result<[f64; N], TrainError>,
) -> Result<Option<[f64; N]>, TrainError> {
    let mut values: Vec<[f64; N]> = Vec::with_capacity(views.len());
    for (i, (view, camera)) in views.iter().enumerate() {
        comparing.targets.prefetch(&views[i..views.len().min(i + 2)].iter().map(|(view, _)| *view).collect::<Vec<_>>());
        let target = comparing.targets.get(*view)?;
        if target.counts() {
            values.push(of_view(ViewToDraw::new(now, comparing, camera, &target))?);
        }
    }
    let mean = |k: usize| values.iter().map(|of_view| of_view[k]).sum::<f64>() / values.len() as f64;
    Ok((!values.is_empty()).then(|| std::array::from_fn(mean)))
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

/// A view whose pages are drawn in batches, as often as wanted.
struct ViewToDraw<'a, 'n> {
    now: &'a mut SceneNow<'n>,
    comparing: &'a Comparing<'a>,
    target: &'a Target,
    pass: ViewPass<'a>,
}

impl<'a, 'n> ViewToDraw<'a, 'n> {
    fn new(
        now: &'a mut SceneNow<'n>,
        comparing: &'a Comparing<'a>,
        camera: &'a Camera,
        target: &'a Target,
    ) -> ViewToDraw<'a, 'n> {
        let pass = ViewPass::new(now.scene, camera, comparing.render, comparing.pages_most);
        ViewToDraw { now, comparing, target, pass }
    }

    /// PSNR with all rows, and without the faintest quarter of the rows drawn, dB.
    fn psnr_without_faint(mut self) -> Result<[f64; 2], TrainError> {
        let whole = self.picture(None)?;
        let weights = self.weights()?;
        let without = self.picture(Some(&are_kept(&weights)))?;
        Ok([whole, without])
    }

    /// Draws the rows that stay, all without a list, and compares the picture; returns its PSNR.
    fn picture(&mut self, kept: Option<&[bool]>) -> Result<f64, TrainError> {
        let mut first = 0;
        self.pass.rows_in(self.now, |columns| {
            let rows = columns.rows();
            if let Some(kept) = kept {
                columns.retain_rows(|_, row| kept[first + row]);
            }
            first += rows;
        })?;
        self.now.renderer.picture()?;
        let (image, target) = (self.now.renderer.image()?, self.target);
        Ok(json_psnr(match self.comparing.correct {
            Some(how) => color_corrected_psnr(image, target, how),
            None => psnr(image, target),
        }))
    }

    /// The blending weights of all rows of the picture that was drawn last.
    fn weights(&mut self) -> Result<Vec<f32>, TrainError> {
        self.now.renderer.loss(self.target, self.comparing.loss)?;
        self.now.renderer.picture_back()?;
        let mut parts = Vec::new();
        self.pass.rows_out(self.now, |gradients| {
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
    use crate::render::Renderer;
    use crate::render::cpu::CpuRenderer;
    use crate::scene::columns::Columns;
    use crate::train::step::pages::PagedScene;
    use crate::train::step::pages::WorkingSet;

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
        let camera = Camera::pinhole(viewmat, [50.0, 50.0, 40.0, 30.0], [80, 60]);
        let rgb = (0..3 * camera.pixels()).map(|i| (i * 7 % 256) as u8).collect();
        let target = Target::new([camera.width, camera.height], rgb);
        let pages = scene.pager.pages_of_view(&camera).len();
        assert!(pages > 2 * 48, "{pages} pages");
        let render = RenderOptions { sh_degree: scene.rules.sh_degree, ..options.render };
        let targets = TargetCache::new(&[], 0, 1).unwrap();
        let [whole, few, parts, all] = [1, 16, 48, usize::MAX].map(|pages_most| {
            let comparing =
                Comparing { targets: &targets, render: &render, loss: &options.loss, pages_most, correct: None };
            let (working, renderer) = (&mut WorkingSet::default(), &mut CpuRenderer::new());
            renderer.weigh_rows(true).unwrap();
            let mut now = SceneNow { scene: &mut scene, step: 0, working, renderer };
            ViewToDraw::new(&mut now, &comparing, &camera, &target).psnr_without_faint().unwrap()
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
