//! Which photos look alike, from a few hundred corners of reduced photos: without places and without a trained vocabulary.
//!
//! A corner has a direction and 256 comparisons of brightness around it, turned by this direction (ORB: Rublee, Rabaud, Konolige and
//! Bradski, "ORB: an efficient alternative to SIFT or SURF", 2011). Two photos look alike by the number of equal corners that agree in
//! one turn and one shift, as a rough Hough transform counts them.
//!
//! Not here: poses. The program that computes them compares the photos again, exactly.
//!
//! Invariant: results depend on the pixels and the order of the photos alone.

use super::photos::FoundPhoto;
use crate::base::error::InputResult;
use crate::base::rng::{Purpose, Stream};
use crate::dataset::model::{Intrinsics, Lens};
use crate::dataset::photo::{Alpha, PhotoSource, decode};
use crate::dataset::resize::{Size, divided_size, resize_area};
use rayon::prelude::*;
use std::collections::HashMap;
use std::f32::consts::TAU;

/// Longer side of a reduced photo, pixels, and the sizes relative to it at which corners are sought.
const SIDE: f64 = 480.0;
const REDUCED: [f64; 2] = [1.0, 1.6];
/// Corners of a photo at a size, and of one cell of so many pixels of it.
const CORNERS: usize = 300;
const CELL: usize = 48;
const CORNERS_OF_CELL: usize = 8;
/// Half the side of what a corner is described by, pixels.
const RADIUS: i32 = 15;
/// Most of the 256 comparisons that differ between equal corners, and the least lead over the next candidate.
const DISTANCE_MAX: u32 = 64;
const LEAD: f32 = 0.85;
/// Steps of turn and shift that count as one.
const TURNS: f32 = 12.0;
const SHIFT: f32 = 80.0;
/// Corners that must agree.
const AGREEING: u16 = 5;

#[derive(Debug, Clone)]
struct Corner {
    /// From the middle of the reduced photo, pixels.
    x: f32,
    y: f32,
    /// Radians.
    direction: f32,
    bits: [u64; 4],
}

/// Beyond so many comparisons of two photos, each photo is compared with some that are spread evenly.
const COMPARISONS_MOST: usize = 3_000_000;
/// Photos between two words about progress.
const PHOTOS_AT_ONCE: usize = 64;

/// About how many pairs of photos are compared if one photo in `stride` is compared with all others.
fn pairs_at(stride: usize, photos: usize) -> usize {
    photos * photos / 2 * (2 * stride - 1) / (stride * stride)
}

/// One photo in so many is compared with all others; the rest with these alone.
fn stride(photos: usize) -> usize {
    (1..).find(|&stride| pairs_at(stride, photos) <= COMPARISONS_MOST).unwrap_or(1)
}

/// About how many comparisons of two photos [`look_alikes`] makes.
pub fn comparisons(photos: usize) -> usize {
    pairs_at(stride(photos), photos)
}

/// For each photo up to `most` others that look alike, best first. `watch` gets how much of the work is done, in photos:
/// half of each photo is its description, half its comparisons.
/// A photo that cannot be decoded looks like none: the program that computes poses leaves it out as well.
pub fn look_alikes(photos: &[FoundPhoto], most: usize, watch: &mut dyn FnMut(usize)) -> Vec<Vec<u32>> {
    let pattern = pattern();
    let describe = |photo: &FoundPhoto| match reduced(photo) {
        Ok((gray, size)) => corners(&gray, size, &pattern),
        Err(_) => Vec::new(),
    };
    // Some half of the work.
    let mut corners: Vec<Vec<Corner>> = Vec::with_capacity(photos.len());
    for some in photos.chunks(PHOTOS_AT_ONCE) {
        watch(corners.len() / 2);
        corners.par_extend(some.par_iter().map(describe));
    }
    let (n, stride) = (corners.len(), stride(photos.len()));
    let of_row = |a: usize| {
        let is_compared = |b: &usize| a.is_multiple_of(stride) || b.is_multiple_of(stride);
        let score = |b: usize| (agreeing(&corners[a], &corners[b]), b);
        (a + 1..n).filter(is_compared).map(score).filter(|(score, _)| *score >= AGREEING).collect::<Vec<_>>()
    };
    let mut found: Vec<Vec<(u16, usize)>> = vec![Vec::new(); n];
    for begin in (0..n).step_by(PHOTOS_AT_ONCE) {
        watch(n / 2 + begin / 2);
        let rows: Vec<_> = (begin..n.min(begin + PHOTOS_AT_ONCE)).into_par_iter().map(of_row).collect();
        for (a, row) in (begin..).zip(rows) {
            for (score, b) in row {
                found[a].push((score, b));
                found[b].push((score, a));
            }
        }
    }
    watch(n);
    let best = |mut others: Vec<(u16, usize)>| {
        others.sort_by_key(|&(score, b)| (u16::MAX - score, b));
        others.into_iter().take(most).map(|(_, b)| b as u32).collect()
    };
    found.into_iter().map(best).collect()
}

/// The photo in gray, reduced.
fn reduced(photo: &FoundPhoto) -> InputResult<(Vec<u8>, Size)> {
    let (width, height) = (photo.header.width, photo.header.height);
    let target = divided_size((width, height), (f64::from(width.max(height)) / SIDE).max(1.0));
    let (fx, fy, cx, cy, lens) = (1.0, 1.0, 0.0, 0.0, Lens::Pinhole);
    let intrinsics = Intrinsics { width, height, fx, fy, cx, cy, lens };
    let alpha = Alpha::Over([0; 3]);
    let image_path = photo.path.clone();
    let source = PhotoSource { image_path, header: photo.header, intrinsics, target, mask: None, alpha };
    let rgb = decode(&source)?.rgb;
    let gray = |pixel: &[u8; 3]| ((u32::from(pixel[0]) + 2 * u32::from(pixel[1]) + u32::from(pixel[2])) / 4) as u8;
    Ok((rgb.as_chunks::<3>().0.iter().map(gray).collect(), target))
}

/// Pairs of places that a description compares, around the corner.
fn pattern() -> Vec<[f32; 4]> {
    let mut rng = Stream::new(1, Purpose::CornerPattern, 0, 0);
    let mut at = || (rng.normal() * 5.5).clamp(-10.0, 10.0) as f32;
    (0..256).map(|_| [at(), at(), at(), at()]).collect()
}

fn corners(gray: &[u8], size: Size, pattern: &[[f32; 4]]) -> Vec<Corner> {
    let mut all = Vec::new();
    for by in REDUCED {
        let smaller = divided_size(size, by);
        let gray = if smaller == size { gray.to_vec() } else { resize_area(gray, 1, size, smaller) };
        let [scale_x, scale_y] = [size.0 as f32 / smaller.0 as f32, size.1 as f32 / smaller.1 as f32];
        let (width, height) = (smaller.0 as usize, smaller.1 as usize);
        let smooth = blurred(&blurred(&gray, width), width);
        for (x, y) in strongest(&smooth, width, height) {
            let direction = direction_at(&smooth, width, x, y);
            let bits = bits_at(&smooth, width, (x, y), direction, pattern);
            let from_middle = |at: usize, scale: f32, side: u32| at as f32 * scale - side as f32 / 2.0;
            let (x, y) = (from_middle(x, scale_x, size.0), from_middle(y, scale_y, size.1));
            all.push(Corner { x, y, direction, bits });
        }
    }
    all
}

/// The means of 3x3 pixels; the rim stays.
fn blurred(gray: &[u8], width: usize) -> Vec<u8> {
    let mut out = gray.to_vec();
    for y in 1..(gray.len() / width).saturating_sub(1) {
        for x in 1..width - 1 {
            let at = y * width + x;
            let rows = [at - width, at, at + width];
            let sum: u32 = rows.iter().flat_map(|&row| &gray[row - 1..=row + 1]).map(|&value| u32::from(value)).sum();
            out[at] = ((sum + 4) / 9) as u8;
        }
    }
    out
}

/// Pixels with the largest response of Harris's detector ("A combined corner and edge detector", 1988), spread over the picture.
fn strongest(gray: &[u8], width: usize, height: usize) -> Vec<(usize, usize)> {
    let rim = RADIUS as usize + 1;
    if width <= 2 * rim || height <= 2 * rim {
        return Vec::new();
    }
    let value = |at: usize| f32::from(gray[at]);
    let slopes = |at: usize| (value(at + 1) - value(at - 1), value(at + width) - value(at - width));
    let mut response = vec![0.0f32; gray.len()];
    for y in rim - 1..height - rim + 1 {
        for x in rim - 1..width - rim + 1 {
            let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
            for row in y - 2..=y + 2 {
                for at in row * width + x - 2..=row * width + x + 2 {
                    let (dx, dy) = slopes(at);
                    (xx, xy, yy) = (xx + dx * dx, xy + dx * dy, yy + dy * dy);
                }
            }
            response[y * width + x] = xx * yy - xy * xy - 0.05 * (xx + yy) * (xx + yy);
        }
    }
    let mut peaks = Vec::new();
    for y in rim..height - rim {
        for x in rim..width - rim {
            let at = y * width + x;
            let around = [
                at - width - 1,
                at - width,
                at - width + 1,
                at - 1,
                at + 1,
                at + width - 1,
                at + width,
                at + width + 1,
            ];
            if response[at] > 1e4 && around.iter().all(|&other| response[at] >= response[other]) {
                peaks.push(at);
            }
        }
    }
    peaks.sort_by(|&a, &b| response[b].total_cmp(&response[a]).then(a.cmp(&b)));
    let mut in_cell: HashMap<(usize, usize), usize> = HashMap::new();
    let spread = |at: &usize| {
        let count = in_cell.entry((at % width / CELL, at / width / CELL)).or_default();
        *count += 1;
        *count <= CORNERS_OF_CELL
    };
    peaks.into_iter().filter(spread).take(CORNERS).map(|at| (at % width, at / width)).collect()
}

/// From a corner to the centre of brightness around it.
fn direction_at(gray: &[u8], width: usize, x: usize, y: usize) -> f32 {
    let (mut sum_x, mut sum_y) = (0.0, 0.0);
    for dy in -RADIUS..=RADIUS {
        for dx in -RADIUS..=RADIUS {
            if dx * dx + dy * dy <= RADIUS * RADIUS {
                let value = f32::from(gray[(y as i32 + dy) as usize * width + (x as i32 + dx) as usize]);
                (sum_x, sum_y) = (sum_x + value * dx as f32, sum_y + value * dy as f32);
            }
        }
    }
    sum_y.atan2(sum_x)
}

fn bits_at(gray: &[u8], width: usize, (x, y): (usize, usize), direction: f32, pattern: &[[f32; 4]]) -> [u64; 4] {
    let (sin, cos) = direction.sin_cos();
    let value = |u: f32, v: f32| {
        let turned = |a: f32| (a.round() as i32).clamp(-RADIUS, RADIUS);
        let (dx, dy) = (turned(cos * u - sin * v), turned(sin * u + cos * v));
        gray[(y as i32 + dy) as usize * width + (x as i32 + dx) as usize]
    };
    let mut bits = [0; 4];
    for (k, &[u, v, s, t]) in pattern.iter().enumerate() {
        bits[k / 64] |= u64::from(value(u, v) < value(s, t)) << (k % 64);
    }
    bits
}

/// Equal corners of two photos that agree in turn and shift.
fn agreeing(a: &[Corner], b: &[Corner]) -> u16 {
    let mut votes: HashMap<[i32; 4], u16> = HashMap::new();
    let mut most = 0;
    for corner in a {
        let (mut first, mut second, mut at) = (u32::MAX, u32::MAX, 0);
        for (k, other) in b.iter().enumerate() {
            let distance = (0..4).map(|i| (corner.bits[i] ^ other.bits[i]).count_ones()).sum();
            if distance < first {
                (first, second, at) = (distance, first, k);
            } else if distance < second {
                second = distance;
            }
        }
        if first > DISTANCE_MAX || first as f32 > LEAD * second as f32 {
            continue;
        }
        let other = &b[at];
        let turn = (other.direction - corner.direction).rem_euclid(TAU);
        let (sin, cos) = turn.sin_cos();
        let shift_x = (other.x - (cos * corner.x - sin * corner.y)) / SHIFT;
        let shift_y = (other.y - (sin * corner.x + cos * corner.y)) / SHIFT;
        // Each counts in overlapping steps, so that none is cut by a border.
        for half in 0..8 {
            let offset = |bit: i32| if half & bit == 0 { 0.0 } else { 0.5 };
            let step = ((turn / TAU * TURNS + offset(1)) as i32).rem_euclid(TURNS as i32);
            let key = [half, step, (shift_x + offset(2)).floor() as i32, (shift_y + offset(4)).floor() as i32];
            let count = votes.entry(key).or_default();
            *count += 1;
            most = most.max(*count);
        }
    }
    most
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::photo_header::read_header;
    use crate::poses::photos::tests::photo;
    use image::{GrayImage, Luma};

    /// A ground of blots of many sizes, the same for every view.
    fn brightness(x: f32, y: f32) -> f32 {
        let mut sum = 0.0;
        for (k, size) in [9.0f32, 17.0, 33.0].into_iter().enumerate() {
            let (column, row) = ((x / size).floor(), (y / size).floor());
            let draw =
                Stream::new(7, Purpose::Test, k as u64 + 1, ((column as i64) << 32 ^ row as i64) as u64).uniform();
            sum += draw as f32 * 85.0;
        }
        sum
    }

    #[test]
    fn photos_of_one_ground_look_alike_however_they_are_turned() {
        let folder = tempfile::tempdir().unwrap();
        // Middle of the view on the ground, and turn: 0 to 2 overlap by half or more, 3 is elsewhere, 4 is beside 3.
        let views =
            [(0.0, 0.0, 0.0), (130.0, 40.0, 3.1), (-100.0, 90.0, 1.2), (3000.0, 0.0, 0.0), (3100.0, -100.0, 2.0)];
        let take = |(k, &(east, north, turn)): (usize, &(f32, f32, f32))| {
            let path = folder.path().join(format!("{k}.png"));
            let (sin, cos) = f32::sin_cos(turn);
            GrayImage::from_fn(480, 360, |x, y| {
                let (x, y) = (x as f32 - 240.0, y as f32 - 180.0);
                Luma([brightness(east + cos * x - sin * y, north + sin * x + cos * y) as u8])
            })
            .save(&path)
            .unwrap();
            let header = read_header(&path).unwrap();
            FoundPhoto { path, header, ..photo(&k.to_string()) }
        };
        let photos: Vec<FoundPhoto> = views.iter().enumerate().map(take).collect();
        let mut alike = look_alikes(&photos, 4, &mut |_| ());
        alike.iter_mut().for_each(|others| others.sort_unstable());
        assert_eq!(alike, [vec![1, 2], vec![0, 2], vec![0, 1], vec![4], vec![3]]);
        let mut done = Vec::new();
        assert_eq!(look_alikes(&photos, 1, &mut |n| done.push(n))[3], [4]);
        assert_eq!(done, [0, 2, 5]);
    }

    #[test]
    fn comparisons_are_bounded() {
        for photos in [2, 100, 2449, 2450, 5000, 40_000] {
            let compared = |a: usize, b: usize| a.is_multiple_of(stride(photos)) || b.is_multiple_of(stride(photos));
            assert_eq!(stride(photos) == 1, photos < 2450, "{photos}");
            assert!(comparisons(photos) <= COMPARISONS_MOST && comparisons(photos) >= photos / 2, "{photos}");
            if photos <= 5000 {
                let pairs = (0..photos).flat_map(|a| (a + 1..photos).map(move |b| (a, b)));
                let count = pairs.filter(|&(a, b)| compared(a, b)).count();
                // Pairs of a photo with itself, and the photos after the last that is compared with all.
                assert!(count.abs_diff(comparisons(photos)) <= 2 * photos, "{photos}: {count}");
            }
        }
    }
}
