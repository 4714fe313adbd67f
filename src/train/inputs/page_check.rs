//! Whether a device that holds pages takes the optimizer's step as the CPU does: rows of generated Gaussians with a past are gathered,
//! drawn and updated in their pages on the device, once stage by stage and once recorded without waiting, and on the CPU.
//!
//! Not here: pictures and gradients, which are compared first (`render/device_check`).

use crate::base::rng::{Purpose, Stream};
use crate::base::simd::SimdPath;
use crate::kernels::gate;
use crate::kernels::uniforms::PageResult;
use crate::optim::adam::AdamConfig;
use crate::optim::deferred::DeferredAdam;
use crate::optim::moments::Moments;
use crate::optim::rates::Rates;
use crate::optim::row_kernels::{StepCounts, evaluate_rows, take_step};
use crate::render::cpu::CpuRenderer;
use crate::render::device_check::{l2, photo, scene, view};
use crate::render::pages::{DeviceSlot, PageRenderer, PageRules, RecordedUpdate, SlotPage, StepJob};
use crate::render::{LossOptions, RenderError, RenderOptions, RowBatches};
use crate::scene::camera::Camera;
use crate::scene::columns::{Column, Columns};
use crate::scene::optimizer_numbers::SplitLimits;
use crate::scene::page_layout::{PageLayout, read_page, write_page};
use crate::scene::state::SceneState;

/// Steps of the run, and those done before the first that is compared.
const STEPS: u32 = 100;
const DONE: u32 = 40;
/// Rows of each page: one, as many as a workgroup has invocations, and more.
const PAGES: [usize; 4] = [1, 700, 256, 1043];
const SIZE: [u32; 2] = [160, 112];
/// Relative L2 of what two steps change in a column. Gradients of the second step lie .02 % apart, as in views; values of about 1 that move
/// by 1e-4 are rounded to 6e-8, which is .06 % of the movement.
const MOVED: f64 = 3e-3;
/// The same with moments of 16 bits, which move by up to .8 % as CPU and device round them, by draws of their own.
const MOVED_WITH_HALVES: f64 = 2e-2;
/// One row in so many may be drawn on one side alone.
const ROWS_ONE_OF: u64 = 500;

/// Compares two steps. `None`: they agree. Otherwise what differs, and in which stage. Slots that the device holds are given up.
/// Errors: those of the device.
pub fn check(device: &mut dyn PageRenderer, moments: Moments) -> Result<Option<String>, RenderError> {
    let adam = DeferredAdam::new(Rates::new(1.0, STEPS), AdamConfig::default(), SimdPath::best()).with_moments(moments);
    let (columns, camera) = scene(PAGES.iter().sum(), SIZE[0], SIZE[1], false);
    let options = RenderOptions::default();
    let before = with_past(columns, moments);
    let (mut state, mut counts) = (before.clone(), [0; 2]);
    for now in [DONE, DONE + 1] {
        let of_step = step_on_cpu(&adam, &mut state, &camera, &options, now)?;
        counts = [counts[0] + of_step.updated, counts[1] + of_step.skipped_non_finite];
    }
    let Some((on_device, [updated, skipped])) = steps_on_device(device, &adam, &before, &camera, &options)? else {
        return Ok(Some(
            "a step that is recorded without waiting finds its numbers unsound: stages gather and gate".into(),
        ));
    };
    let [of_cpu, unusable] = counts.map(|count| count as u64);
    if updated.abs_diff(of_cpu) * ROWS_ONE_OF > of_cpu || skipped != unusable {
        return Ok(Some(format!(
            "two steps update {updated} Gaussians and skip {skipped}, but {of_cpu} and {unusable} on the CPU: stages gather and update"
        )));
    }
    // Moments of 16 bits are rounded by other draws on a device, which values show less.
    let (compared, most) = if moments == Moments::Bf16 { (1, MOVED_WITH_HALVES) } else { (3, MOVED) };
    for column in Column::ALL {
        let tables =
            |of: &SceneState| [&of.columns, &of.exp_avg, &of.exp_avg_sq].map(|table| table.column(column).to_vec());
        let ([got, want], old) = ([&on_device, &state].map(tables), tables(&before));
        let compared =
            got.iter().zip(&want).zip(&old).zip(["values", "first moments", "second moments"]).take(compared);
        for (((got, want), old), what) in compared {
            let moved = |now: &[f32]| -> Vec<f32> { now.iter().zip(old).map(|(now, old)| now - old).collect() };
            let error = l2(&moved(got), &moved(want));
            if error.is_nan() || error > most {
                return Ok(Some(format!(
                    "two steps change {what} of {column:?} otherwise ({error:.1e} relative): stages gather and update"
                )));
            }
        }
    }
    Ok(None)
}

/// The rows after [`DONE`] steps, some of which they missed: moments of the size that gradients of such views have.
fn with_past(columns: Columns, moments: Moments) -> SceneState {
    let mut state = SceneState::from_columns(columns);
    let mut draws = Stream::new(43, Purpose::Test, 0, 0);
    for column in Column::ALL {
        let [m, v] = [&mut state.exp_avg, &mut state.exp_avg_sq].map(|table| table.column_mut(column));
        for (m, v) in m.iter_mut().zip(v) {
            let size = libm::exp(draws.range(-14.0, -9.0));
            *m = (size * draws.normal()) as f32;
            *v = (size * size) as f32;
        }
    }
    if moments == Moments::Bf16 {
        for table in [&mut state.exp_avg, &mut state.exp_avg_sq] {
            Column::ALL.into_iter().for_each(|column| {
                table.column_mut(column).iter_mut().for_each(|x| *x = f32::from_bits(x.to_bits() & 0xffff_0000));
            });
        }
    }
    state.stamp.iter_mut().for_each(|stamp| *stamp = DONE - draws.below(8) as u32);
    state
}

fn step_on_cpu(
    adam: &DeferredAdam,
    state: &mut SceneState,
    camera: &Camera,
    options: &RenderOptions,
    now: u32,
) -> Result<StepCounts, RenderError> {
    let mut values = Columns::zeros(state.rows(), state.sh_degree());
    evaluate_rows(&adam.at(now), state.view(), |row| row, values.view_mut());
    let drawn = view(&mut CpuRenderer::new(), &values, camera, options)?;
    let rows: Vec<u32> = (0..state.rows() as u32).collect();
    Ok(take_step(adam, state, &rows, &drawn.grads.columns, now))
}

/// The state after the same two steps on the device, and how many rows they updated and skipped; `None` if the gate of the second step
/// found its numbers unsound.
fn steps_on_device(
    device: &mut dyn PageRenderer,
    adam: &DeferredAdam,
    before: &SceneState,
    camera: &Camera,
    options: &RenderOptions,
) -> Result<Option<(SceneState, [u64; 2])>, RenderError> {
    let largest = PageLayout { rows: PAGES.into_iter().max().unwrap_or(0), sh_degree: before.sh_degree() };
    let rules = PageRules {
        largest,
        numbers: adam.numbers(STEPS).unwrap_or_default(),
        splits: SplitLimits::NEVER,
        weighs: false,
    };
    device.prepare_page_storage(&rules)?;
    if device.add_slots(PAGES.len())? < PAGES.len() {
        return Err(RenderError::NoSlots { bytes: device.slot_bytes() });
    }
    let (mut pages, mut payloads, mut first) = (Vec::new(), Vec::new(), 0);
    for (slot, rows) in PAGES.into_iter().enumerate() {
        let of_page: Vec<u32> = (first..first + rows as u32).collect();
        let mut words = vec![0u64; largest.bytes().div_ceil(8)];
        let layout = write_page(&before.select(&of_page), bytemuck::cast_slice_mut(&mut words));
        // In another order than the pages.
        pages.push(SlotPage { slot: DeviceSlot((PAGES.len() - 1 - slot) as u32), layout });
        payloads.push(words);
        first += rows as u32;
    }
    let slots: Vec<(SlotPage, &[u8])> = pages
        .iter()
        .zip(&payloads)
        .map(|(page, words)| (*page, &bytemuck::cast_slice(words)[..page.layout.bytes()]))
        .collect();
    device.write_slots(&slots)?;

    let (target, loss) = (photo(SIZE[0], SIZE[1]), LossOptions::default());
    let in_stages = |device: &mut dyn PageRenderer, now: u32| {
        device.begin_view(camera, options, RowBatches::One)?;
        device.pages_in(&pages, &adam.at(now).numbers())?;
        device.picture()?;
        device.loss(&target, &loss)?;
        device.picture_back()?;
        device.pages_out(0)?;
        device.begin_update(0, &pages, true)?;
        device.finish_update()
    };
    let mut results = in_stages(device, DONE)?;
    // Room behind the last row is filled by a stage as well.
    let (numbers, rows_room, isects_most) = (adam.at(DONE + 1).numbers(), before.rows() as u32 + 100, u32::MAX);
    let job = StepJob { pages: &pages, numbers: &numbers, camera, options, rows_room, isects_most };
    let update =
        RecordedUpdate { target: &target, loss: &loss, collects: true, rows_per_unusable: 1000, closes: false };
    results.extend(match device.record_picture(&job)? && device.record_update(&update)? {
        true => {
            let done = device.finish_step()?;
            match done.closed {
                0 => done.pages,
                closed if closed & (gate::LOSS | gate::GRADIENTS) != 0 => return Ok(None),
                // A list without room says nothing about the device.
                _ => {
                    device.open_gate()?;
                    in_stages(device, DONE + 1)?
                }
            }
        }
        // Where memory is short.
        false => in_stages(device, DONE + 1)?,
    });
    let mut read: Vec<Vec<u64>> = payloads.iter().map(|words| vec![0; words.len()]).collect();
    let mut slots: Vec<(SlotPage, &mut [u8])> = pages
        .iter()
        .zip(&mut read)
        .map(|(page, words)| (*page, &mut bytemuck::cast_slice_mut(words)[..page.layout.bytes()]))
        .collect();
    device.read_slots(&mut slots)?;
    let mut after = SceneState::from_columns(Columns::zeros(0, before.sh_degree()));
    for (page, words) in pages.iter().zip(&read) {
        after.append(&read_page(&page.layout.rows(bytemuck::cast_slice(words), 0)));
    }
    let sum = |of: fn(&PageResult) -> u32| results.iter().map(|page| u64::from(of(page))).sum();
    Ok(Some((after, [sum(|page| page.updated), sum(|page| page.skipped)])))
}
