//! What a check of the count measures: how well views are drawn.
//!
//! Not here: the decision ([`crate::densify::growth`]), which views (`turns`).
//!
//! Invariants: 1. nothing is stored; 2. the values are a function of the scene, the step and the views; 3. memory beside the renderer's is
//! that of one batch of rows.

use crate::dataset::target_cache::TargetCache;
use crate::densify::growth::ViewMetrics;
use crate::render::RenderOptions;
use crate::render::color_correct::exposure_fitted_psnr;
use crate::render::metrics::{SsimVariant, mean, psnr, ssim};
use crate::scene::camera::Camera;
use crate::scene::image::{Image, Target};
use crate::train::error::TrainError;
use crate::train::log::report::json_psnr;
use crate::train::step::view::{SceneNow, ViewPass};

/// What views are drawn and compared with.
pub(super) struct Comparing<'a> {
    pub targets: &'a TargetCache,
    pub render: &'a RenderOptions,
    pub pages_most: usize,
    /// Fit the exposures of pictures before their PSNR is measured. SSIM is that of the pictures as they are: it is compared with the
    /// SSIM of the same views at other checks.
    pub fits_exposures: bool,
}

/// How well views are drawn, as indices in `dataset.views` with their cameras; `None` if all of them are masked as a whole.
/// Errors: a photo cannot be decoded, pages could not be had, or the renderer failed.
pub(super) fn measure(
    now: &mut SceneNow<'_>,
    comparing: &Comparing<'_>,
    views: &[(usize, Camera)],
) -> Result<Option<ViewMetrics>, TrainError> {
    let (mut psnrs, mut ssims) = (Vec::with_capacity(views.len()), Vec::with_capacity(views.len()));
    for (i, (view, camera)) in views.iter().enumerate() {
        comparing.targets.prefetch(&views[i..views.len().min(i + 2)].iter().map(|(view, _)| *view).collect::<Vec<_>>());
        let target = comparing.targets.get(*view).map_err(TrainError::Photo)?;
        if target.counts() {
            let ViewMetrics { psnr, ssim } = measure_view(now, comparing, camera, &target)?;
            psnrs.push(psnr);
            ssims.push(ssim);
        }
    }
    Ok((!psnrs.is_empty()).then(|| ViewMetrics { psnr: mean(&psnrs), ssim: mean(&ssims) }))
}

/// Draws a view, its pages in batches, and compares it with its photo.
fn measure_view(
    now: &mut SceneNow<'_>,
    comparing: &Comparing<'_>,
    camera: &Camera,
    target: &Target,
) -> Result<ViewMetrics, TrainError> {
    let pass = ViewPass::new(now.scene, camera, comparing.render, comparing.pages_most);
    pass.rows_in(now, |_| {})?;
    now.renderer.picture()?;
    Ok(metrics_of(now.renderer.image()?, target, comparing))
}

/// A broken picture has the worst values: what a commit holds is finite.
fn metrics_of(image: &Image, target: &Target, comparing: &Comparing<'_>) -> ViewMetrics {
    let psnr = match comparing.fits_exposures {
        true => exposure_fitted_psnr(image, target),
        false => psnr(image, target),
    };
    let ssim = ssim(image, target, SsimVariant::Same, comparing.render.simd);
    ViewMetrics { psnr: json_psnr(psnr), ssim: if ssim.is_nan() { 0.0 } else { ssim } }
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
    use crate::train::step::pages::{PagedScene, WorkingSet};

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
    fn the_value_is_the_same_for_any_batches() {
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
        let mut compared = |pages_most, fits_exposures| {
            let comparing = Comparing { targets: &targets, render: &render, pages_most, fits_exposures };
            let (working, renderer) = (&mut WorkingSet::default(), &mut CpuRenderer::new());
            let mut now = SceneNow { scene: &mut scene, step: 0, working, renderer };
            measure_view(&mut now, &comparing, &camera, &target).unwrap()
        };
        let [whole, few, parts, all] = [1, 16, 48, usize::MAX].map(|pages_most| compared(pages_most, false));
        assert!(whole == few && few == parts && parts == all, "{whole:?} {few:?} {parts:?} {all:?}");
        // The picture has nothing of this photo: a fit of the photo to the picture would magnify that.
        assert!(compared(48, true).psnr > whole.psnr, "a check with exposures is above one without");
        assert!((0.0..1.0).contains(&whole.ssim));
        let broken = Image { width: camera.width, height: camera.height, rgb: vec![f32::NAN; 3 * camera.pixels()] };
        let comparing = Comparing { targets: &targets, render: &render, pages_most: 1, fits_exposures: false };
        assert_eq!(metrics_of(&broken, &target, &comparing), ViewMetrics { psnr: 0.0, ssim: 0.0 });
    }
}
