//! Which photos are compared with which: comparing all with all takes hours beyond some dozens of photos.
//!
//! Few photos: all with all. Photos with GPS: each with the nearest ones. Others: each with those that come soon after it by name,
//! and with those that look alike ([`super::similar`]), which close the loops and join the lines of a flight.
//!
//! Invariants: 1. each pair once, the smaller index first, in order; 2. the choice depends on the photos alone.

use super::geo::metres_from;
use super::photos::FoundPhoto;
use crate::dataset::exif::GpsPlace;
use glam::DVec3;
use rayon::prelude::*;
use std::collections::BTreeSet;

/// Up to this many photos, all pairs are compared.
pub const EXHAUSTIVE_MAX: usize = 40;
/// Partners of a photo by distance, and by likeness.
const NEAREST: usize = 20;
/// Partners of a photo behind it in the sequence, where its place is known, and where it is not.
const NEXT_WITH_PLACE: usize = 2;
const NEXT: usize = 8;
/// Places of fewer photos than this share say too little.
const SHARE_OF_PLACES: f64 = 0.5;

/// How pairs were chosen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ChosenBy {
    All,
    Distance,
    SequenceAndLikeness,
}

/// How the pairs of these photos are chosen.
pub fn way_of(photos: &[FoundPhoto]) -> ChosenBy {
    let places = photos.iter().filter(|photo| photo.place.is_some()).count();
    match () {
        () if photos.len() <= EXHAUSTIVE_MAX => ChosenBy::All,
        () if places as f64 >= SHARE_OF_PLACES * photos.len() as f64 => ChosenBy::Distance,
        () => ChosenBy::SequenceAndLikeness,
    }
}

/// About how many pairs [`choose_pairs`] chooses.
pub fn count_of(photos: &[FoundPhoto]) -> u64 {
    let n = photos.len() as u64;
    match way_of(photos) {
        ChosenBy::All => n * (n - 1) / 2,
        // Half of the partners by distance or likeness are mutual.
        ChosenBy::Distance => n * (NEAREST as u64 * 3 / 4),
        ChosenBy::SequenceAndLikeness => n * (NEXT + NEAREST * 3 / 4) as u64,
    }
}

/// The pairs to compare. `alike` gives for each photo up to that many others that look alike, best first; it is asked only if
/// places do not decide.
pub fn choose_pairs(photos: &[FoundPhoto], alike: impl FnOnce(usize) -> Vec<Vec<u32>>) -> Vec<(u32, u32)> {
    let n = photos.len();
    let mut pairs = BTreeSet::new();
    let mut add = |a: usize, b: usize| {
        if a != b && b < n {
            pairs.insert((a.min(b) as u32, a.max(b) as u32));
        }
    };
    match way_of(photos) {
        ChosenBy::All => (0..n).for_each(|a| (a + 1..n).for_each(|b| add(a, b))),
        ChosenBy::Distance => {
            let places: Vec<Option<GpsPlace>> = photos.iter().map(|photo| photo.place).collect();
            for (a, near) in nearest(&places).into_iter().enumerate() {
                near.into_iter().for_each(|b| add(a, b));
                let next = if places[a].is_some() { NEXT_WITH_PLACE } else { NEXT };
                (1..=next).for_each(|step| add(a, a + step));
            }
        }
        ChosenBy::SequenceAndLikeness => {
            for (a, others) in alike(NEAREST).into_iter().enumerate() {
                others.into_iter().for_each(|b| add(a, b as usize));
                (1..=NEXT).for_each(|step| add(a, a + step));
            }
        }
    }
    pairs.into_iter().collect()
}

/// For each photo the nearest others, in metres, and of equally near ones those close to it in the sequence: places may be as coarse as
/// a street. None for one without a place.
fn nearest(places: &[Option<GpsPlace>]) -> Vec<Vec<usize>> {
    let Some(origin) = places.iter().flatten().next() else { return vec![Vec::new(); places.len()] };
    // Without the height of a place that states none: it would be that of the sea.
    let metres: Vec<Option<(DVec3, bool)>> =
        places.iter().map(|p| p.as_ref().map(|p| (metres_from(origin, p), p.altitude.is_some()))).collect();
    let near = |a: usize| -> Vec<usize> {
        let Some((at, has_height)) = metres[a] else { return Vec::new() };
        let distance = |b: usize| {
            let (other, other_has) = metres[b].filter(|_| a != b)?;
            let apart = at - other;
            let apart = if has_height && other_has { apart } else { apart.with_z(0.0) };
            Some((apart.length_squared(), a.abs_diff(b), b))
        };
        let mut others: Vec<(f64, usize, usize)> = (0..metres.len()).filter_map(distance).collect();
        let order =
            |x: &(f64, usize, usize), y: &(f64, usize, usize)| x.0.total_cmp(&y.0).then((x.1, x.2).cmp(&(y.1, y.2)));
        if others.len() > NEAREST {
            others.select_nth_unstable_by(NEAREST, order);
            others.truncate(NEAREST);
        }
        others.into_iter().map(|(_, _, b)| b).collect()
    };
    (0..metres.len()).into_par_iter().map(near).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::poses::photos::tests::photo;

    fn photos(places: impl Iterator<Item = Option<(f64, f64)>>) -> Vec<FoundPhoto> {
        let of_place = |place: Option<(f64, f64)>| FoundPhoto {
            place: place.map(|(latitude, longitude)| GpsPlace { latitude, longitude, altitude: None }),
            ..photo("")
        };
        places.map(of_place).collect()
    }

    fn chosen(photos: &[FoundPhoto], alike: Vec<Vec<u32>>) -> Vec<(u32, u32)> {
        choose_pairs(photos, |_| alike)
    }

    #[test]
    fn few_photos_are_compared_with_each_other() {
        let pairs = chosen(&photos((0..40).map(|_| None)), Vec::new());
        assert_eq!((pairs.len(), &pairs[..3]), (780, &[(0, 1), (0, 2), (0, 3)][..]));
    }

    #[test]
    fn photos_with_places_are_compared_with_their_neighbours_on_all_sides() {
        // 20 lines of 20 photos, 11 m apart in each; photo 7 has no place.
        let grid =
            |i: i32| Some((47.0 + 1e-4 * f64::from(i / 20), 9.0 + 1.5e-4 * f64::from(i % 20))).filter(|_| i != 7);
        let photos = photos((0..400).map(grid));
        let pairs = chosen(&photos, Vec::new());
        assert_eq!(way_of(&photos), ChosenBy::Distance);
        let partners = |a: u32| pairs.iter().filter(|(x, y)| *x == a || *y == a).count();
        let estimate = count_of(&photos) as usize;
        assert!(pairs.len() <= estimate && pairs.len() > estimate / 2, "{} of {estimate}", pairs.len());
        for (a, b) in [(189, 190), (190, 210), (170, 190), (190, 211), (7, 8), (7, 15), (5, 7)] {
            assert!(pairs.contains(&(a, b)), "{a}, {b}");
        }
        assert!(!pairs.contains(&(190, 390)) && (20..60).contains(&partners(190)) && partners(7) >= 10);
    }

    #[test]
    fn photos_at_one_place_are_compared_with_those_close_to_them_in_the_sequence() {
        let pairs = chosen(&photos((0..90).map(|_| Some((47.0, 9.0)))), Vec::new());
        assert!(pairs.iter().all(|(a, b)| b - a <= 20) && (0..80).all(|a| pairs.contains(&(a, a + 10))), "{pairs:?}");
    }

    #[test]
    fn photos_without_places_are_compared_in_sequence_and_with_those_that_look_alike() {
        let photos = photos((0..100).map(|i| (i < 49).then_some((47.0, 9.0 + f64::from(i)))));
        let mut alike = vec![Vec::new(); 100];
        alike[3] = vec![97, 3, 98];
        assert_eq!(way_of(&photos), ChosenBy::SequenceAndLikeness);
        let pairs = chosen(&photos, alike);
        assert!(pairs.contains(&(3, 97)) && pairs.contains(&(3, 98)) && pairs.contains(&(0, 8)));
        assert!(!pairs.contains(&(0, 9)) && pairs.iter().all(|(a, b)| a < b && *b < 100));
    }
}
