//! Checks that all readers apply to the numbers in a file, and the wording of their warnings.

use crate::base::error::{InputError, InputResult};
use crate::dataset::model::{Intrinsics, Lens, RawView};
use std::collections::BTreeMap;
use std::path::Path;

/// Largest width or height accepted, pixels: the limit of JPEG.
const MAX_SIDE: u64 = 65_535;
/// Range of focal lengths accepted, in units of the longer side. Satellite views come near the upper end.
const FOCAL_RANGE: (f64, f64) = (1e-3, 1e6);
/// Farthest principal point accepted, in units of the longer side (crops are off centre, but less than this).
const MAX_CENTRE: f64 = 1e3;
/// Largest coordinate of a pose that is accepted.
pub(super) const MAX_COORDINATE: f64 = 1e15;
const LISTED: usize = 10;

/// Checks that the numbers can be a camera's intrinsics, and returns them or the problem. A radial lens without
/// distortion becomes a pinhole, which is the same mapping.
pub(super) fn checked_intrinsics(
    (width, height): (u64, u64),
    focal: [f64; 2],
    centre: [f64; 2],
    lens: Lens,
) -> Result<Intrinsics, String> {
    if width == 0 || height == 0 || width > MAX_SIDE || height > MAX_SIDE {
        return Err(format!("an image of {width} x {height} pixels (each side must be 1 to {MAX_SIDE})"));
    }
    let side = width.max(height) as f64;
    for f in focal {
        if !(FOCAL_RANGE.0 * side..=FOCAL_RANGE.1 * side).contains(&f) {
            return Err(format!("a focal length of {f} pixels for an image of {width} x {height}"));
        }
    }
    for c in centre {
        if c.is_nan() || c.abs() > MAX_CENTRE * side {
            return Err(format!("a principal point at {c} pixels for an image of {width} x {height}"));
        }
    }
    if let Some(k) = lens.coefficients().iter().find(|k| !k.is_finite()) {
        return Err(format!("a distortion coefficient of {k}"));
    }
    let ([fx, fy], [cx, cy]) = (focal, centre);
    Ok(Intrinsics { width: width as u32, height: height as u32, fx, fy, cx, cy, lens: lens.simplified() })
}

/// Sorts the views by name and refuses duplicate names and photos.
pub(super) fn sort_views(file: &Path, views: &mut [RawView]) -> InputResult<()> {
    views.sort_by(|a, b| a.name.cmp(&b.name));
    if let Some(pair) = views.windows(2).find(|pair| pair[0].name == pair[1].name) {
        let problem = format!("two views have the name '{}'", pair[0].name);
        return Err(InputError::new(file, problem, "every photo may be listed once: remove one of the two entries")
            .at(format!("image '{}'", pair[0].name)));
    }
    let mut by_photo = BTreeMap::new();
    for view in views.iter() {
        if let Some(other) = by_photo.insert(&view.image_path, &view.name) {
            let problem = format!("the views '{other}' and '{}' have the same photo", view.name);
            return Err(InputError::new(
                &view.image_path,
                problem,
                "name the folder with a photo for each view with --images",
            ));
        }
    }
    Ok(())
}

/// The warning about views that a reader leaves out.
pub(super) fn left_out(file: &Path, names: &[String], why: &str) -> String {
    format!("{}: {} view(s) left out, {why}: {}", file.display(), names.len(), listed(names))
}

/// The first names of a list, and the number of further ones.
pub(super) fn listed(names: &[String]) -> String {
    let shown = names.iter().take(LISTED).map(|n| format!("'{n}'")).collect::<Vec<_>>().join(", ");
    match names.len().saturating_sub(LISTED) {
        0 => shown,
        more => format!("{shown} and {more} more"),
    }
}
