//! First exposures of photos, from the brightness that the settings of their camera give.
//!
//! A photo without a first exposure is not corrected until a step has seen it. So in the first pass over the photos each step
//! pulls the scene towards the exposure of its own photo.
//!
//! A first exposure counts as one fit, and later fits outweigh it. Camera settings can mislead: where the light changes and
//! the camera follows, photos of equal brightness have different settings.
//!
//! Not here: how a brightness is read (`dataset::exif`), and the values of a run ([`super::state`]).
//!
//! Invariants: 1. a first exposure is finite and within the bounds of [`bounded`]; 2. the order of the photos does not matter.

use super::fit::bounded;
use super::model::IMAGE_VALUES;

/// Stops of exposure per stop of light. An exposure multiplies pixel values, and pixel values are stored with a gamma of about
/// 2.2, so a stop of light changes them by 1/2.2 stops.
const PER_STOP: f64 = 1.0 / 2.2;

/// First exposures (stops) of photos with these brightnesses (stops of light; `None` where unknown): the difference to the
/// median brightness, within the bounds of the model. `None` unless more than half of the photos have a brightness.
pub fn first_exposures(brightness: &[Option<f64>]) -> Option<Vec<Option<f64>>> {
    let mut known: Vec<f64> = brightness.iter().copied().flatten().collect();
    if 2 * known.len() <= brightness.len() {
        return None;
    }
    known.sort_unstable_by(f64::total_cmp);
    let median = (known[(known.len() - 1) / 2] + known[known.len() / 2]) / 2.0;
    Some(brightness.iter().map(|stops| stops.and_then(|stops| exposure((stops - median) * PER_STOP))).collect())
}

/// An exposure within the bounds; `None` if it is not finite.
fn exposure(stops: f64) -> Option<f64> {
    let mut values = [0.0; IMAGE_VALUES];
    values[0] = stops;
    bounded(values).map(|values| values[0])
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;

    #[test]
    fn exposures_are_differences_to_the_median_within_bounds() {
        let first = first_exposures(&[Some(7.4), Some(5.2), None, Some(3.0), Some(50.0)]).unwrap();
        // The median of 3, 5.2, 7.4 and 50 lies between the two in the middle.
        let want = [Some(0.5), Some(-0.5), None, Some(-1.5), Some(4.0)];
        assert_eq!(first.len(), want.len());
        for (got, want) in first.into_iter().zip(want) {
            let is_near = got.zip(want).is_none_or(|(got, want): (f64, f64)| (got - want).abs() < 1e-12);
            assert!(is_near && got.is_some() == want.is_some(), "{got:?}, not {want:?}");
        }
    }

    #[test]
    fn half_of_the_photos_are_too_few() {
        assert_eq!(first_exposures(&[Some(1.0), None]), None);
        assert_eq!(first_exposures(&[None, None]), None);
        assert_eq!(first_exposures(&[]), None);
        assert_eq!(first_exposures(&[Some(1.0), None, Some(1.0)]), Some(vec![Some(0.0), None, Some(0.0)]));
    }
}
