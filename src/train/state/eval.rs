//! Evaluation of held-out views: PSNR, SSIM, LPIPS, and pictures of render beside photo. Leaves the scene unchanged.
//!
//! PSNR is of the pictures as they are. Three further figures have their own names and are never mixed with it: under the exposures that
//! training photos suggest ([`Predicted`]), after an affine or quadratic colour correction ([`ColorCorrected`]), and of the right halves
//! after a fit of appearance to the left halves ([`HalfFitted`]).

use crate::base::error::{InputError, InputResult};
use crate::base::png_rows::write_rgb_rows;
use crate::base::whole_file::{write_whole, write_whole_with};
use crate::config::limits::RunOptions;
use crate::dataset::loader::Dataset;
use crate::dataset::target_cache::TargetCache;
use crate::photos::PhotoParameters;
use crate::photos::exposure::AppearanceMode;
use crate::photos::exposure::fit::FittedPair;
use crate::photos::exposure::picture::{LensPlane, Look};
use crate::photos::parameter::Correction;
use crate::render::RenderOptions;
use crate::render::color_correct::{ColorCorrect, color_corrected_psnr};
use crate::render::lpips::{InputRange, Lpips};
use crate::render::metrics::{SsimVariant, mean, psnr, psnr_of_columns, ssim};
use crate::report::run_files::VIEWS_FILE;
use crate::scene::camera::Camera;
use crate::scene::image::{Image, Target};
use crate::train::error::TrainError;
use crate::train::log::report::{ColorCorrected, HalfFitted, Predicted, TestMetrics, json_psnr};
use crate::train::step::view::{SceneNow, draw};
use std::collections::HashSet;
use std::path::Path;

/// Steps of the fit to the left half of a photo: it has converged long before.
const FIT_ROUNDS: usize = 10;

/// Views and metrics of an evaluation.
pub struct EvalRequest<'a> {
    /// Indices in `dataset.views`.
    pub views: Vec<usize>,
    pub ssim: SsimVariant,
    /// Folder for pictures (render beside photo) and the figures of each view, created if missing; `None` for none.
    pub pictures: Option<&'a Path>,
    /// LPIPS network and its input range; `None` for no LPIPS.
    pub lpips: Option<(&'a Lpips, InputRange)>,
    /// The correction that training photos suggest for each view, if any.
    pub predicted: Option<Vec<Correction>>,
    /// Method of colour correction; `None` for no colour-corrected PSNR.
    pub color_correct: Option<ColorCorrect>,
    /// What is fitted to the left half of each photo; off for no such figures.
    pub appearance: AppearanceMode,
    /// Called with the number of views done, after each.
    pub progress: &'a dyn Fn(u32),
}

impl<'a> EvalRequest<'a> {
    /// That of the held-out views in a run with these options, whose `photos` may predict corrections; without LPIPS.
    pub fn of_held_out(
        dataset: &Dataset,
        options: &RunOptions,
        photos: &PhotoParameters,
        pictures: Option<&'a Path>,
        progress: &'a dyn Fn(u32),
    ) -> EvalRequest<'a> {
        let views = dataset.test_views();
        let predicted = photos.iter().find_map(|parameter| parameter.predict(dataset, &views));
        // Beside predicted colours, the best that a correction could do.
        let color_correct = options.color_correct.or(predicted.is_some().then_some(ColorCorrect::Affine));
        let (ssim, appearance) = (options.ssim_variant, options.photos.appearance);
        EvalRequest { views, ssim, pictures, lpips: None, predicted, color_correct, appearance, progress }
    }
}

/// Evaluates the scene on the requested views. Fully masked views have no
/// metrics and do not count in the means. Nor do photos that cannot be decoded, which a warning names: a photo must not cost the
/// figures of all others. `None` if no view has metrics, with a warning.
/// Errors: pages could not be pinned, the renderer failed, or a picture cannot be written.
pub fn evaluate(
    now: &mut SceneNow<'_>,
    dataset: &Dataset,
    targets: &TargetCache,
    options: &RenderOptions,
    request: &EvalRequest<'_>,
) -> Result<Option<TestMetrics>, TrainError> {
    if request.views.is_empty() {
        return Ok(None);
    }
    let (mut psnrs, mut ssims, mut distances) = (Vec::new(), Vec::new(), Vec::new());
    let (mut corrected, mut halves, mut figures) = (Vec::new(), Vec::new(), Vec::new());
    let (mut predicted, mut drawn) = ([Vec::new(), Vec::new()], Vec::new());
    let names = request.pictures.map_or(Vec::new(), |_| picture_names(dataset));
    for (i, &view) in request.views.iter().enumerate() {
        targets.prefetch(&request.views[i..request.views.len().min(i + 8)]);
        let target = match targets.get(view) {
            Ok(target) => target,
            Err(error) => {
                let name = &dataset.views[view].name;
                crate::tell!("warning: the held-out photo '{name}' cannot be read and is not compared: {error}");
                (request.progress)(i as u32 + 1);
                continue;
            }
        };
        let camera = &dataset.views[view].camera;
        draw(now, camera, options)?;
        let image = now.renderer.image()?;
        let mut of_view = (None, None);
        if target.counts() {
            psnrs.push(json_psnr(psnr(image, &target)));
            of_view.0 = psnrs.last().copied();
            let fit = request.color_correct;
            corrected.extend(fit.map(|how| json_psnr(color_corrected_psnr(image, &target, how))));
            // NaN: every SSIM window is masked although some border pixels are not.
            of_view.1 = Some(ssim(image, &target, request.ssim, options.simd)).filter(|x| !x.is_nan());
            ssims.extend(of_view.1);
            // NaN: the picture is too small for the network.
            let distance = request.lpips.map(|(lpips, range)| lpips.distance(image, &target, range));
            distances.extend(distance.filter(|x| !x.is_nan()));
        }
        if let Some(folder) = request.pictures {
            let picture = &names[view];
            write_pair(&folder.join(picture), image, &target)?;
            figures.push(serde_json::json!({ "picture": picture, "psnr": of_view.0, "ssim": of_view.1 }));
        }
        let correct = request.predicted.as_ref().and_then(|of_views| of_views.get(i)).filter(|_| target.counts());
        if let Some(correct) = correct {
            drawn.clear();
            drawn.extend_from_slice(now.renderer.picture_mut()?);
            correct(now.renderer.picture_mut()?, target.width as usize);
            let image = now.renderer.image()?;
            predicted[0].push(json_psnr(psnr(image, &target)));
            predicted[1].extend(Some(ssim(image, &target, request.ssim, options.simd)).filter(|x| !x.is_nan()));
            now.renderer.picture_mut()?.copy_from_slice(&drawn);
        }
        if request.appearance.is_on() {
            // Last, since it changes the picture in its place.
            halves.extend(half_fitted(now.renderer.picture_mut()?, &target, camera, request.appearance));
        }
        (request.progress)(i as u32 + 1);
    }
    if let Some(folder) = request.pictures {
        let name = Path::new(VIEWS_FILE).file_name().unwrap_or_default();
        write_whole(&folder.join(name), serde_json::Value::from(figures).to_string().as_bytes())?;
    }
    if psnrs.is_empty() {
        crate::tell!("warning: {}", none_counts(request.views.len()));
        return Ok(None);
    }
    let ssim = if ssims.is_empty() { 0.0 } else { mean(&ssims) };
    let lpips = (!distances.is_empty()).then(|| mean(&distances));
    let color_corrected = request.color_correct.map(|method| ColorCorrected { method, cc_psnr: mean(&corrected) });
    let half_fitted = (!halves.is_empty()).then(|| {
        let [right_psnr, fitted_right_psnr] = [0, 1].map(|i| mean(&halves.iter().map(|h| h[i]).collect::<Vec<_>>()));
        HalfFitted { model: request.appearance, right_psnr, fitted_right_psnr }
    });
    let views = psnrs.len() as u32;
    let [predicted_psnr, predicted_ssim] = predicted;
    let predicted = (!predicted_psnr.is_empty()).then(|| Predicted {
        predicted_psnr: mean(&predicted_psnr),
        predicted_ssim: if predicted_ssim.is_empty() { 0.0 } else { mean(&predicted_ssim) },
    });
    Ok(Some(TestMetrics { views, psnr: mean(&psnrs), ssim, lpips, predicted, color_corrected, half_fitted }))
}

/// Warns, before a run spends its time, if no held-out photo will have figures. Decodes photos up to the first that has.
pub fn warn_of_held_out(dataset: &Dataset, targets: &TargetCache) {
    let views = dataset.test_views();
    let mut first_error = None;
    for &view in &views {
        match targets.get(view) {
            Ok(target) if target.counts() => return,
            Ok(_) => {}
            Err(error) => _ = first_error.get_or_insert(error),
        }
    }
    if !views.is_empty() {
        let why = first_error.map_or(String::new(), |error| format!(" ({error})"));
        crate::tell!("warning: {}{why}", none_counts(views.len()));
    }
}

fn none_counts(views: usize) -> String {
    format!(
        "none of the {views} held-out photos can be compared, so there will be no figures: masks leave out all of their pixels, or \
         they cannot be read; hold out others with --test-every, or correct the masks (see --invert-masks)"
    )
}

/// PSNR of the right half of a picture, `[3][height][width]`: as it is, and under the correction that brings the left half
/// closest to the photo, which is applied in place. `None` if a half is masked.
fn half_fitted(picture: &mut [f32], target: &Target, camera: &Camera, mode: AppearanceMode) -> Option<[f64; 2]> {
    let width = target.width as usize;
    let right = width / 2..width;
    let as_it_is = psnr_of_columns(picture, target, right.clone());
    let start = Look { lens: LensPlane::of(camera), ..Look::default() };
    let pair = FittedPair { drawn: picture, photo: target };
    // NaN: no pixel of the right half counts, or the picture is not finite.
    let values =
        pair.image_values(&start, mode.image_values(), 0..width / 2, FIT_ROUNDS).filter(|_| !as_it_is.is_nan())?;
    Look { image: values, ..start }.correct(picture, width, None);
    Some([as_it_is, psnr_of_columns(picture, target, right)].map(json_psnr))
}

/// File of each view's picture: the view's name without extension, with `/` replaced by `_`, and prefixed with the view's
/// index if two views would share a file.
fn picture_names(dataset: &Dataset) -> Vec<String> {
    let flat = |name: &str| {
        let flat = name.replace(['/', '\\'], "_");
        flat.rsplit_once('.').map_or(flat.clone(), |(stem, _)| stem.to_string())
    };
    let stems: Vec<String> = dataset.views.iter().map(|view| flat(&view.name)).collect();
    let mut met = HashSet::new();
    let shared: HashSet<&String> = stems.iter().filter(|stem| !met.insert(*stem)).collect();
    let name = |(view, stem): (usize, &String)| match shared.contains(stem) {
        true => format!("{view:05}_{stem}.png"),
        false => format!("{stem}.png"),
    };
    stems.iter().enumerate().map(name).collect()
}

/// Writes render (left) beside photo (right).
fn write_pair(path: &Path, image: &Image, target: &Target) -> InputResult<()> {
    let folder = path.parent().unwrap_or(path);
    std::fs::create_dir_all(folder).map_err(|e| InputError::io(folder, "creating the folder for pictures", &e))?;
    let row_bytes = 3 * image.width as usize;
    let fill = |y: usize, row: &mut [u8]| {
        let (render, photo) = row.split_at_mut(row_bytes);
        image.row_to_rgb8(y, render);
        photo.copy_from_slice(&target.rgb[row_bytes * y..row_bytes * (y + 1)]);
    };
    write_whole_with(path, |out| write_rgb_rows(out, [2 * image.width, image.height], fill))
}
