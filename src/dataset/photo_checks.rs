//! Checks the files of all views before a run: headers, shapes, masks.
//!
//! Not here: which views there are ([`super::loader`]), where masks are found ([`super::masks`]), pixels ([`super::photo`]).

use super::load_options::LoadOptions;
use super::masks::{FoundMask, MaskIndex, MaskSource};
use super::model::{Intrinsics, RawView, Split};
use super::photo::{Alpha, PhotoSource, holds_0_and_1, intrinsics_at};
use super::photo_header::read_header;
use super::resize::{Size, divided_size, same_shape};
use crate::base::error::{InputError, InputResult};
use rayon::prelude::*;
use std::path::Path;

/// Masks that are decoded before a run, to say how they are read.
const MASKS_LOOKED_AT: usize = 3;

/// Checks headers, shapes and masks of all views, in parallel; returns the first error in view order.
pub(super) fn check_photos(
    views: &[(RawView, Split)],
    options: &LoadOptions,
    (root, image_folder): (&Path, &Path),
    warnings: &mut Vec<String>,
) -> InputResult<Vec<PhotoSource>> {
    let index = if options.masks { MaskIndex::scan(root, image_folder) } else { MaskIndex::default() };
    let named: Vec<(&str, &Path)> =
        views.iter().map(|(view, _)| (view.name.as_str(), view.image_path.as_path())).collect();
    let found = index.assign(&named, warnings);
    let checked: Vec<InputResult<PhotoSource>> =
        views.par_iter().zip(found).map(|((view, _), mask)| check_photo(view, mask, options)).collect();
    let bad = checked.iter().filter(|c| c.is_err()).count();
    let mut photos = Vec::with_capacity(checked.len());
    for photo in checked {
        photos.push(photo.map_err(|mut error| {
            if bad > 1 {
                error.problem.push_str(&format!(" ({} other photos or masks cannot be used either)", bad - 1));
            }
            error
        })?);
    }
    let transparent = photos.iter().filter(|p| p.is_masked_by_alpha()).count();
    if transparent > 0 {
        warnings.push(format!(
            "{transparent} photos have an alpha channel: pixels that are less than half opaque do not count, as under a mask \
             (--masks=false shows --background there)"
        ));
    }
    let masked = photos.iter().filter(|p| p.mask.is_some()).count();
    if masked == 0 && !index.is_empty() {
        warnings.push("none of the files in the masks folder belongs to a photo: no mask is used".to_string());
    } else if masked == 0 && options.invert_masks {
        warnings.push("--invert-masks has no effect: there is no mask".to_string());
    } else if let Some(path) = masks_of_0_and_1(&photos)? {
        warnings.push(format!("masks such as {} hold 0 and 1 instead of 0 and 255: 1 counts as white", path.display()));
    }
    if masked > 0 && masked < photos.len() {
        let (without, total) = (photos.len() - masked, photos.len());
        warnings.push(format!("{without} of {total} photos have no mask: all of their pixels are used"));
    }
    Ok(photos)
}

/// A mask of 0 and 1, if the first ones are such.
fn masks_of_0_and_1(photos: &[PhotoSource]) -> InputResult<Option<&Path>> {
    for mask in photos.iter().filter_map(|photo| photo.mask.as_ref()).take(MASKS_LOOKED_AT) {
        if holds_0_and_1(mask)? {
            return Ok(Some(&mask.path));
        }
    }
    Ok(None)
}

fn check_photo(view: &RawView, found: Option<FoundMask>, options: &LoadOptions) -> InputResult<PhotoSource> {
    let header = read_header(&view.image_path)?;
    let size = (header.width, header.height);
    check_shape(view, size)?;
    let stated = view.mask_path.clone().filter(|_| options.masks).map(|path| FoundMask { path, inverted: false });
    let mask = stated.or(found);
    let checked_mask = |FoundMask { path, inverted }: FoundMask| {
        let header = read_header(&path)?;
        if same_shape((header.width, header.height), size) {
            return Ok(MaskSource { path, header, invert: inverted != options.invert_masks });
        }
        let problem = format!(
            "the mask is {} x {}, its photo {} x {}: their shapes differ",
            header.width, header.height, size.0, size.1
        );
        Err(InputError::new(path, problem, "make the mask again for this photo, or remove it"))
    };
    let mask = mask.map(checked_mask).transpose()?;
    let stated = Intrinsics { lens: view.intrinsics.lens.simplified(), ..view.intrinsics };
    Ok(PhotoSource {
        image_path: view.image_path.clone(),
        header,
        intrinsics: intrinsics_at(&stated, size),
        target: target_size(size, options),
        mask,
        alpha: if options.masks { Alpha::Mask } else { Alpha::Over(options.background) },
    })
}

/// Size of the target: the photo's divided by `data_factor`; if the longer side then exceeds `max_resolution`, the
/// photo's scaled to that limit instead (one rounding, from the full size).
fn target_size(photo: Size, options: &LoadOptions) -> Size {
    let size = divided_size(photo, options.data_factor);
    let longest = photo.0.max(photo.1);
    match options.max_resolution {
        Some(limit) if size.0.max(size.1) > limit => divided_size(photo, f64::from(longest) / f64::from(limit)),
        _ => size,
    }
}

fn check_shape(view: &RawView, size: Size) -> InputResult<()> {
    let stated = (view.intrinsics.width, view.intrinsics.height);
    if stated.0 > 0 && stated.1 > 0 && same_shape(size, stated) {
        return Ok(());
    }
    let problem = format!(
        "the photo is {} x {}, its camera {} x {}: a photo of this shape cannot belong to this camera",
        size.0, size.1, stated.0, stated.1
    );
    let turned = stated.0 > 0 && stated.1 > 0 && same_shape((size.1, size.0), stated);
    let remedy = if turned {
        "the photo is turned by 90 degrees against its camera, as viewers do when they apply EXIF orientation: \
         use the photos that the model was made from, stored the same way up"
    } else {
        "use the photos that the model was made from (other sizes are fine, cropped photos are not)"
    };
    Err(InputError::new(&view.image_path, problem, remedy).at(format!("view {}", view.name)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn targets_round_once_from_the_full_size() {
        let with = |factor: f64, limit: Option<u32>| {
            target_size((4608, 3456), &LoadOptions { data_factor: factor, max_resolution: limit, ..Default::default() })
        };
        assert_eq!(with(1.0, None), (4608, 3456));
        assert_eq!(with(3.4175, None), (1348, 1011));
        assert_eq!(with(1.0, Some(1600)), (1600, 1200));
        assert_eq!(with(4.0, Some(1600)), (1152, 864));
        assert_eq!(with(2.0, Some(1000)), (1000, 750));
    }
}
