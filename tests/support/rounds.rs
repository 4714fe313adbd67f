//! Scenes for rounds of densification: random rows, and steps with statistics that depend on a row's uid and the step alone.

use gsscale::base::rng::{Purpose, Stream};
use gsscale::base::simd::SimdPath;
use gsscale::densify::stats::{DrawnRows, GradHistogram};
use gsscale::densify::strategy::Strategy;
use gsscale::optim::adam::AdamConfig;
use gsscale::optim::deferred::DeferredAdam;
use gsscale::optim::rates::Rates;
use gsscale::optim::row_kernels::take_step;
use gsscale::scene::columns::{Column, Columns, Gradients};
use gsscale::scene::state::SceneState;

pub const SEED: u64 = 11;

pub fn adam(scene_scale: f64) -> DeferredAdam {
    DeferredAdam::new(Rates::new(scene_scale, 5000), AdamConfig::default(), SimdPath::best())
}

pub fn scene(rows: usize, sh_degree: u8) -> SceneState {
    let mut columns = Columns::zeros(rows, sh_degree);
    let mut draws = Stream::new(3, Purpose::Test, rows as u64, 0);
    for column in Column::ALL {
        columns.column_mut(column).iter_mut().for_each(|x| *x = draws.normal() as f32);
    }
    // Sigmas around the split size of 0.01; opacities around the pruning limit (logit -5.3).
    columns.scales.iter_mut().for_each(|x| *x = *x * 1.2 - 5.5);
    columns.opacities.iter_mut().for_each(|x| *x = *x * 1.5 - 3.5);
    SceneState::from_columns(columns)
}

/// One optimizer step and its statistics for the rows that `is_drawn` names.
pub fn touch(
    state: &mut SceneState,
    (adam, strategy): (&DeferredAdam, &dyn Strategy),
    step: u32,
    histogram: &mut GradHistogram,
    is_drawn: impl Fn(u64) -> bool,
) {
    let rows: Vec<u32> = (0..state.rows() as u32).filter(|&r| is_drawn(state.uid[r as usize])).collect();
    let mut grads = Columns::zeros(rows.len(), state.sh_degree());
    let mut gradients = Gradients::default();
    for (i, &row) in rows.iter().enumerate() {
        let mut draws = Stream::new(4, Purpose::Test, state.uid[row as usize], u64::from(step));
        for column in Column::ALL {
            grads.row_mut(column, i).iter_mut().for_each(|x| *x = (draws.normal() * 1e-4) as f32);
        }
        gradients.means2d.push([(draws.normal() * 2e-5) as f32, (draws.normal() * 2e-5) as f32]);
        gradients.radii.push([draws.below(8) as u32, draws.below(8) as u32]);
        let weights = [(draws.uniform() * 9.0) as f32, draws.uniform() as f32];
        gradients.weights.extend(strategy.needs_weights().then_some(weights));
    }
    take_step(adam, state, &rows, &grads, step);
    strategy.after_update(&mut state.view_mut(), &rows, step);
    let drawn = DrawnRows { step, rows: &rows, gradients: &gradients, first: 0, image_size: [20, 30] };
    strategy.collect(&mut state.view_mut(), &drawn, histogram);
}
