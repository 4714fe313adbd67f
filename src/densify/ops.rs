//! The edits of rounds and resets: growing, pruning and resetting of values, moments, stamps, uids and statistics.
//!
//! Not here: the decision about each row ([`Round`]).
//!
//! An event acts on the values of the event's own step. A row that is neither grown, pruned nor reset keeps its stored
//! state. Applying an event late therefore gives the same result as on time, as a set of (uid, bits).
//!
//! Invariants: 1. new rows have zero moments and the stamp of the event; 2. uids and random draws of new rows depend on
//! (seed, parent's uid, event, child) only; 3. surviving rows keep their order, and new rows follow in the order of
//! their parents; 4. new rows are finite, because the log-scales of a parent are moved into the range of the run first.

use super::strategy::{Fate, Round, RowFacts};
use crate::base::math::{exp32, logit, sigmoid};
use crate::base::rng::{Purpose, Stream, hash64};
use crate::scene::columns::{Column, Columns};
use crate::scene::events::{LONG_AXIS_OFFSET, SPLIT_SIGMAS};
use crate::scene::rotation::Rotation;
use crate::scene::rows::{BLOCK_LANES, RowBlock, Rows, RowsMut, RowsNow, first_lane, scales_of};
use crate::scene::state::SceneState;

/// Children of a split are smaller than their parent by this factor.
const SPLIT_SHRINK: f64 = 1.6;
/// Size of the children of a long-axis split over that of their parent, along the split axis and along the others.
const LONG_AXIS_SHRINK: f64 = 0.5;
const SHORT_AXES_SHRINK: f64 = 0.85;
/// Opacity of the children of a long-axis split over that of their parent, after activation.
const CHILD_OPACITY: f64 = 0.6;
/// Children of a split in place ([`Fate::SplitInPlace`]).
const IN_PLACE_CHILDREN: usize = 2;
/// Least opacity of such a child.
const IN_PLACE_OPACITY_LEAST: f32 = 0.005;

#[derive(Debug, Clone)]
pub struct RoundEdits {
    /// Rows to remove, numbered in the view, ascending.
    pub removed: Vec<u32>,
    /// Rows to append.
    pub added: SceneState,
}

/// Computes the edits of a round to the rows of a view; changes no row.
pub fn plan_round<V: RowsNow>(values: &V, rows: &Rows<'_>, round: &dyn Round, seed: u64, event: u64) -> RoundEdits {
    let mut removed = Vec::new();
    let mut new_rows = NewRows { columns: Columns::zeros(0, rows.columns.sh_degree), uid: Vec::new() };
    let mut block = [0.0; BLOCK_LANES];
    let (mut log_scales, mut opacities) = (vec![0.0; rows.rows()], vec![0.0; rows.rows()]);
    values.sizes_and_opacities(rows, &mut log_scales, &mut opacities);
    for row in 0..rows.rows() {
        let fate = round.fate(&RowFacts {
            grad2d: rows.grad2d[row],
            count: rows.count[row],
            log_scale: log_scales[row],
            opacity: opacities[row],
        });
        if matches!(
            fate,
            Fate::Split { .. } | Fate::SplitLongAxis | Fate::SplitInPlace | Fate::Duplicate { pruned: false }
        ) {
            values.evaluate_row(rows, row, &mut block);
            values.log_scales().clamp_all(scales_of(&mut block));
        }
        let uid = |child: u64| child_uid(rows.uid[row], event, child);
        let children = match fate {
            Fate::Keep => continue,
            Fate::Duplicate { pruned: false } => {
                new_rows.push(uid(0), &block);
                continue;
            }
            Fate::Prune | Fate::Duplicate { pruned: true } | Fate::Split { children_pruned: true } => None,
            Fate::Split { children_pruned: false } => {
                Some([0, 1].map(|child| split_child(&block, seed, uid(child), event)))
            }
            Fate::SplitLongAxis => Some(long_axis_children(&block)),
            Fate::SplitInPlace => Some([in_place_child(&block); IN_PLACE_CHILDREN]),
        };
        removed.push(row as u32);
        for (child, block) in (0..).zip(children.iter().flatten()) {
            new_rows.push(uid(child), block);
        }
    }
    RoundEdits { removed, added: new_rows.into_state(values.now()) }
}

/// Applies the edits of all rows of a table. Clears the statistics.
pub fn apply_edits(state: &mut SceneState, edits: &RoundEdits) {
    state.remove(&edits.removed);
    // If the reservation fails, `append` fails too, with the allocator's own message.
    let _ = state.try_reserve_exact(edits.added.rows());
    state.append(&edits.added);
    state.view_mut().clear_statistics();
}

/// Caps the opacities of the rows of a view and clears the moments of the opacities. A row whose opacity is at most the
/// cap and has no moments (never drawn, new, or reset before) is not rewritten.
pub fn reset_opacity_rows<V: RowsNow>(values: &V, rows: &mut RowsMut<'_>, max_opacity: f32) -> usize {
    let cap = logit(max_opacity);
    let mut rewritten = 0;
    for row in 0..rows.rows() {
        let has_moments = rows.exp_avg.opacities[row] != 0.0 || rows.exp_avg_sq.opacities[row] != 0.0;
        if !has_moments && rows.columns.opacities[row] <= cap {
            continue;
        }
        values.settle_row(rows, row);
        rows.columns.opacities[row] = rows.columns.opacities[row].min(cap);
        rows.exp_avg.opacities[row] = 0.0;
        rows.exp_avg_sq.opacities[row] = 0.0;
        rewritten += 1;
    }
    rewritten
}

pub fn child_uid(parent: u64, event: u64, child: u64) -> u64 {
    hash64(&[parent, event, child])
}

/// A child of a split: the mean is drawn from the parent's Gaussian, the scales shrink, other values are copied.
fn split_child(parent: &RowBlock, seed: u64, uid: u64, event: u64) -> RowBlock {
    let mut child = *parent;
    let (scales, quats) = (first_lane(Column::Scales), first_lane(Column::Quats));
    let mut draws = Stream::new(seed, Purpose::Split, uid, event);
    let z = loop {
        let z = [draws.normal(), draws.normal(), draws.normal()];
        if z.iter().map(|x| x * x).sum::<f64>() <= SPLIT_SIGMAS * SPLIT_SIGMAS {
            break z;
        }
    };
    let offset: [f64; 3] = std::array::from_fn(|i| z[i] * libm::exp(f64::from(parent[scales + i])));
    let r = rotation(std::array::from_fn(|i| f64::from(parent[quats + i])));
    for i in 0..3 {
        let moved = r[i][0] * offset[0] + r[i][1] * offset[1] + r[i][2] * offset[2];
        child[i] = (f64::from(parent[i]) + moved) as f32;
        child[scales + i] = (f64::from(parent[scales + i]) - libm::log(SPLIT_SHRINK)) as f32;
    }
    child
}

/// The children of a long-axis split: their means lie on the longest axis of the parent (the first of equal ones), at
/// [`LONG_AXIS_OFFSET`] of its standard deviation on both sides; that axis shrinks to [`LONG_AXIS_SHRINK`], the others to
/// [`SHORT_AXES_SHRINK`], and the opacity to [`CHILD_OPACITY`] of the parent's. Other values are copied. Nothing is drawn
/// at random.
///
/// The factors were the best of those measured (children at 0.5 or 0.87 sigma, unshrunk short axes and full opacity were
/// worse by 0.1 dB each): the children together cover the length of the parent and occlude about as much as the parent
/// did.
fn long_axis_children(parent: &RowBlock) -> [RowBlock; 2] {
    let (scales, quats, opacity) =
        (first_lane(Column::Scales), first_lane(Column::Quats), first_lane(Column::Opacities));
    let axis = (1..3).fold(0, |longest, i| if parent[scales + i] > parent[scales + longest] { i } else { longest });
    let reach = LONG_AXIS_OFFSET * libm::exp(f64::from(parent[scales + axis]));
    let r = rotation(std::array::from_fn(|i| f64::from(parent[quats + i])));
    let odds = libm::exp(f64::from(parent[opacity]));
    [1.0, -1.0].map(|side| {
        let mut child = *parent;
        for i in 0..3 {
            let shrink = if i == axis { LONG_AXIS_SHRINK } else { SHORT_AXES_SHRINK };
            child[i] = (f64::from(parent[i]) + side * reach * r[i][axis]) as f32;
            child[scales + i] = (f64::from(parent[scales + i]) + libm::log(shrink)) as f32;
        }
        // With p = odds / (1 + odds), the logit of q = c p is ln(q / (1 - q)) = ln c + ln odds - ln(1 + (1 - c) odds).
        let less = libm::log1p((1.0 - CHILD_OPACITY) * odds);
        child[opacity] = if odds.is_finite() {
            (libm::log(CHILD_OPACITY) + f64::from(parent[opacity]) - less) as f32
        } else {
            libm::log(CHILD_OPACITY / (1.0 - CHILD_OPACITY)) as f32
        };
        child
    })
}

/// A child of a split in place; all [`IN_PLACE_CHILDREN`] are equal. Values other than opacity and scales are those of the parent.
fn in_place_child(parent: &RowBlock) -> RowBlock {
    let mut row = *parent;
    let (scales, opacity) = (first_lane(Column::Scales), first_lane(Column::Opacities));
    let [shared, shrink] = relocation_values(f64::from(sigmoid(parent[opacity])), IN_PLACE_CHILDREN as u32);
    // gsplat's limits of the opacity; a logit must be finite.
    row[opacity] = logit((shared as f32).clamp(IN_PLACE_OPACITY_LEAST, 1.0 - f32::EPSILON));
    for scale in &mut row[scales..scales + 3] {
        *scale = (f64::from(*scale) + libm::log(shrink)) as f32;
    }
    row
}

/// Opacity of each of `n` equal rows that together let as much light through as one row of this opacity, and the factor on its
/// standard deviations that keeps the integral of the picture (Kheradmand et al. 2024, equation 9). The factor is at most 1.
fn relocation_values(opacity: f64, n: u32) -> [f64; 2] {
    let shared = -libm::expm1(libm::log1p(-opacity) / f64::from(n));
    let mut sum = 0.0;
    for i in 1..=n {
        let mut binomial = 1.0;
        for k in 0..i {
            let sign = if k % 2 == 0 { 1.0 } else { -1.0 };
            sum += binomial * sign * libm::pow(shared, f64::from(k + 1)) / f64::from(k + 1).sqrt();
            binomial *= f64::from(i - 1 - k) / f64::from(k + 1);
        }
    }
    [shared, if sum > 0.0 { (opacity / sum).min(1.0) } else { 1.0 }]
}

/// Log-scale of a split's child, with the rounding of [`split_child`].
pub(super) fn child_log_scale(parent: f32) -> f32 {
    (f64::from(parent) - libm::log(SPLIT_SHRINK)) as f32
}

/// Rotation matrix of a quaternion (w, x, y, z) of any length; a zero quaternion gives the identity.
pub(super) fn rotation(q: [f64; 4]) -> [[f64; 3]; 3] {
    let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
    Rotation::from_quaternion(q.map(|c| c / length)).unwrap_or(Rotation::IDENTITY).matrix()
}

struct NewRows {
    columns: Columns,
    uid: Vec<u64>,
}

impl NewRows {
    fn push(&mut self, uid: u64, block: &RowBlock) {
        let row = self.uid.len();
        self.uid.push(uid);
        self.columns.resize(row + 1);
        self.columns.view_mut().store_row_any(row, block);
    }

    fn into_state(self, now: u32) -> SceneState {
        let mut state = SceneState::from_columns(self.columns);
        state.uid = self.uid;
        state.stamp.fill(now);
        state
    }
}

/// Standard deviation of a log-scale, with the rounding that the decisions use.
pub(super) fn sigma(log_scale: f32) -> f32 {
    exp32(log_scale)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The farthest point of a child at 3.33 of its sigmas is 0.75 + 3.33 x 0.5 = 2.42 sigma away along the axis, and
    /// 2.98 sigma at most in any direction: see the bounds of pages.
    #[test]
    fn children_of_a_long_axis_split_lie_on_the_axis_and_share_the_opacity() {
        let mut draws = Stream::new(8, Purpose::Test, 0, 0);
        let (quats, scales) = (first_lane(Column::Quats), first_lane(Column::Scales));
        for case in 0..500 {
            let mut parent = [0.0f32; BLOCK_LANES];
            (0..3).for_each(|i| parent[i] = draws.normal() as f32);
            parent[3] = draws.range(-9.0, 9.0) as f32;
            (0..4).for_each(|i| parent[quats + i] = draws.normal() as f32);
            (0..3).for_each(|i| parent[scales + i] = draws.range(-6.0, 1.0) as f32);
            parent[BLOCK_LANES - 20] = 0.5;
            let sigmas: [f64; 3] = std::array::from_fn(|i| f64::from(parent[scales + i]).exp());
            let axis = (0..3).max_by(|&a, &b| sigmas[a].total_cmp(&sigmas[b])).unwrap_or(0);
            let children = long_axis_children(&parent);
            let opacity = |block: &RowBlock| 1.0 / (1.0 + (-f64::from(block[3])).exp());
            let r = rotation(std::array::from_fn(|i| f64::from(parent[quats + i])));
            for (child, side) in children.iter().zip([0.75, -0.75]) {
                for i in 0..3 {
                    let want = f64::from(parent[i]) + side * sigmas[axis] * r[i][axis];
                    // One f32 rounding of a mean of size up to 5.
                    assert!((f64::from(child[i]) - want).abs() < 1e-6, "case {case}");
                    let shrink = f64::from(child[scales + i]).exp() / sigmas[i];
                    // One f32 rounding of a log-scale of size up to 8.
                    assert!((shrink - if i == axis { 0.5 } else { 0.85 }).abs() < 1e-6, "case {case}");
                }
                // One f32 rounding of a logit of size up to 9.
                assert!((opacity(child) / opacity(&parent) - 0.6).abs() < 2e-6, "case {case}");
                assert_eq!((&child[quats..quats + 4], child[BLOCK_LANES - 20]), (&parent[quats..quats + 4], 0.5));
            }
            let middle: [f32; 3] = std::array::from_fn(|i| 0.5 * (children[0][i] + children[1][i]));
            assert!((0..3).all(|i| (middle[i] - parent[i]).abs() < 1e-6), "the children lie around the parent");
        }
        let certain = long_axis_children(&[1000.0; BLOCK_LANES]);
        assert!((certain[0][3] - logit(0.6)).abs() < 1e-6, "one f32 rounding");
    }

    /// The light that a row lets through along a line through its middle, at a distance of t standard deviations.
    #[test]
    fn children_of_a_split_in_place_look_like_their_parent() {
        for opacity in [0.01, 0.1, 0.5, 0.9, 0.999] {
            for n in 1..=8 {
                let [shared, shrink] = relocation_values(opacity, n);
                // One f64 rounding of each of a few functions.
                assert!(((1.0 - shared).powi(n as i32) - (1.0 - opacity)).abs() < 1e-13, "{opacity}, {n}");
                // The integral of 1 - (1 - o' g(x / s))^n over x equals that of o g(x): the paper's condition.
                let gaussian = |x: f64| (-0.5 * x * x).exp();
                let (step, points) = (1e-3, -10_000..=10_000);
                let together = |x: f64| 1.0 - (1.0 - shared * gaussian(x / shrink)).powi(n as i32);
                let integral: f64 = points.clone().map(|i| together(f64::from(i) * step) * step).sum();
                let whole = opacity * (2.0 * std::f64::consts::PI).sqrt();
                // The cut at 10 sigma and the sum of 20,000 terms.
                assert!((integral / whole - 1.0).abs() < 1e-9, "{opacity}, {n}: {integral} of {whole}");
                assert!(shrink <= 1.0);
            }
        }
        let mut parent = [0.0f32; BLOCK_LANES];
        let opacity = first_lane(Column::Opacities);
        for logit_opacity in [-1000.0, -5.0, 0.0, 9.0, 1000.0] {
            parent[opacity] = logit_opacity;
            assert!(in_place_child(&parent).iter().all(|x| x.is_finite()), "{logit_opacity}");
        }
    }

    #[test]
    fn children_are_drawn_from_the_parent_within_the_cut() {
        let mut parent = [0.0f32; BLOCK_LANES];
        // A quarter turn about z (x to y), sigmas 1, 0.1, 0.01.
        let (quats, scales) = (first_lane(Column::Quats), first_lane(Column::Scales));
        parent[quats..quats + 4].copy_from_slice(&[2.0, 0.0, 0.0, 2.0]);
        parent[scales..scales + 3].copy_from_slice(&[0.0, -std::f32::consts::LN_10, -2.0 * std::f32::consts::LN_10]);
        let n = 20_000;
        let mut sums = [0.0f64; 3];
        for uid in 0..n {
            let child = split_child(&parent, 1, uid, 3);
            let z = [f64::from(child[1]), f64::from(child[0]) / 0.1, f64::from(child[2]) / 0.01];
            let norm2 = z.iter().map(|x| x * x).sum::<f64>();
            // The bounds of pages assume 3.33; the slack covers f32 positions and the rounded log-scales above.
            assert!(norm2 <= 3.33 * 3.33 * (1.0 + 1e-5));
            (0..3).for_each(|i| sums[i] += z[i] * z[i]);
            assert_eq!(child[scales + 1], child_log_scale(parent[scales + 1]));
        }
        for sum in sums {
            // Cutting the draws removes 3.3 % of the variance; five standard errors of sqrt(2 / n) are 5 %.
            assert!((sum / n as f64 - 0.967).abs() < 0.05, "{sum}");
        }
    }
}
