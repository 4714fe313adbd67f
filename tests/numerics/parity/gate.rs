//! gate, and the parts of gather that a step without waits needs: the device decides and lists as the twins do.

use super::pages::read;
use super::rows::camera;
use crate::support::gpu::open;
use crate::twins;
use crate::twins::gather::{self, GatherInput};
use gsscale::base::rng::{Purpose, Stream};
use gsscale::gpu::{Buffer, GpuOptions, groups_1d};
use gsscale::kernels::deferred::DeferredTables;
use gsscale::kernels::gate::{self, GateUniforms, StepVerdict};
use gsscale::kernels::uniforms::{DevicePage, GatherUniforms};
use gsscale::optim::adam::AdamConfig;
use gsscale::optim::deferred::DeferredAdam;
use gsscale::optim::rates::Rates;
use gsscale::scene::columns::{Column, Columns};
use gsscale::scene::optimizer_numbers::SplitLimits;
use gsscale::scene::page_layout::{capacity_bytes, write_page};
use gsscale::scene::state::SceneState;

/// A step within all limits, and its limits.
fn sound() -> (GateUniforms, StepVerdict) {
    let u = GateUniforms {
        rows_room: 40_000,
        isects_room: 1 << 20,
        list_room: 8192,
        rows_per_unusable: 10_000,
        rows_at: 3,
        isects_at: 5,
        has_loss: 1,
        pad: 0,
    };
    let sums = [12.5f32, 3.0, -8.0, 1.0].map(f32::to_bits);
    let (rows, isects, list_max, unusable) = (39_999, 1 << 20, 8000, 3);
    (u, StepVerdict { closed: 0, rows, isects, list_max, unusable, sums, pad0: 0, pad1: 0, pad2: 0 })
}

fn cases() -> Vec<(GateUniforms, u32, StepVerdict, u32)> {
    let (u, v) = sound();
    let bad = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY].map(f32::to_bits);
    let with = |i: usize, bits: u32| {
        let mut sums = v.sums;
        sums[i] = bits;
        StepVerdict { sums, ..v }
    };
    let mut all = vec![
        (u, 0, v, 0),
        (u, gate::LOSS, v, gate::BY_EARLIER),
        (u, 0, StepVerdict { rows: 40_001, ..v }, gate::ROWS),
        (u, 0, StepVerdict { isects: u32::MAX, ..v }, gate::ISECTS),
        (u, 0, StepVerdict { list_max: 8193, ..v }, gate::LIST),
        (u, 0, StepVerdict { unusable: 4, ..v }, gate::GRADIENTS),
        (u, 0, StepVerdict { rows: 9_999, unusable: 1, ..v }, gate::GRADIENTS),
        (u, 0, StepVerdict { rows: 9_999, unusable: 0, ..v }, 0),
        (u, 0, with(1, bad[1]), 0),
        (GateUniforms { has_loss: 0, ..u }, 0, with(0, bad[0]), 0),
        (u, 1, StepVerdict { rows: 40_001, ..with(2, bad[0]) }, gate::BY_EARLIER | gate::ROWS | gate::LOSS),
    ];
    all.extend(bad.iter().flat_map(|&bits| [0, 2].map(|i| (u, 0, with(i, bits), gate::LOSS))));
    all
}

#[test]
fn a_gate_closes_for_every_reason_and_stays_closed() {
    let gpu = open(&GpuOptions::default());
    for (i, (u, before, measured, closed)) in cases().into_iter().enumerate() {
        let want = twins::gate::decide(&u, before, &measured);
        assert_eq!(want.closed, closed, "case {i}");
        let Some(gpu) = &gpu else { continue };
        let mut recorder = gpu.begin("gate");
        let mut counts = [0; 4];
        counts[u.rows_at as usize] = measured.rows;
        let mut offsets = [0; 6];
        offsets[u.isects_at as usize] = measured.isects;
        let inputs: [&[u32]; 6] =
            [&counts, &offsets, &[measured.list_max], &[measured.unusable], &measured.sums, &[before]];
        let buffers = inputs.map(|words| recorder.buffer_with("input", words).unwrap());
        let verdict = recorder.buffer_zeroed("verdict", size_of::<StepVerdict>() as u64).unwrap();
        let uniform = recorder.uniform(&u).unwrap();
        let views: Vec<_> =
            [uniform].into_iter().chain(buffers.iter().map(Buffer::view)).chain([verdict.view()]).collect();
        let pipeline = gpu.pipeline("gate.wgsl", "decide", &[]).unwrap();
        recorder.dispatch("gate", &pipeline, &views, groups_1d(1, 1)).unwrap();
        gpu.submit(recorder).unwrap();
        assert_eq!(read::<StepVerdict>(gpu, &verdict, 1), [want], "case {i}");
        assert_eq!(read::<u32>(gpu, &buffers[5], 1), [closed], "case {i}: the gate");
    }
}

/// Few and many pages, columns with room, without, and with none to spare.
#[test]
fn rows_are_placed_padded_and_cut_on_the_device_as_by_the_twins() {
    let Some(gpu) = open(&GpuOptions::default()) else { return };
    let adam = DeferredAdam::new(Rates::new(1.0, 10), AdamConfig::default(), gsscale::base::simd::SimdPath::best());
    let splits = SplitLimits { grow_grad2d: 0.3, split_scale: 0.01, reach: 3.33 };
    let numbers = adam.numbers(10).unwrap();
    let (tables, step) = (DeferredTables::new(&numbers), adam.at(1).numbers());
    // All pages have the same payload, and values that stay.
    let mut columns = Columns::zeros(40, 0);
    columns.means.iter_mut().chain(&mut columns.opacities).enumerate().for_each(|(i, x)| *x = 1.0 + i as f32);
    let mut payload = vec![0u64; capacity_bytes(40, 0).div_ceil(8)];
    let layout = write_page(&SceneState::from_columns(columns), bytemuck::cast_slice_mut(&mut payload));
    let slab: &[u32] = bytemuck::cast_slice(&payload);
    for (count, room) in [(1u32, 64u32), (700, 16_000), (700, 9000), (256, 1)] {
        let mut draws = Stream::new(3, Purpose::Test, u64::from(count), 0);
        let page = |p| DevicePage { page_from_turn: p, ..DevicePage::new(layout, 0, 0, 40 * p) };
        let mut pages: Vec<DevicePage> = (0..count).map(page).collect();
        let counts: Vec<u32> = (0..count).map(|_| draws.below(41) as u32).collect();
        let found: Vec<u32> = (0..40 * count).map(|_| draws.below(40) as u32).collect();
        let mut recorder = gpu.begin("gather");
        let table = recorder.buffer_with("pages", &pages).unwrap();
        let words = [[&counts[..], &[0]].concat(), found.clone(), slab.to_vec(), tables.words().to_vec()];
        let [counted, found_there, slab_there, tables_there] =
            words.map(|words| recorder.buffer_with("words", &words).unwrap());
        let recent = recorder.buffer_with("recent", step.recent.as_flattened()).unwrap();
        let [means, quats, scales, opacities] =
            [3, 4, 3, 1].map(|width| recorder.buffer_with("column", &vec![7.0f32; width * room as usize]).unwrap());
        let uniforms = GatherUniforms {
            row_count: room,
            end_turn: count,
            chunks: 1,
            ..GatherUniforms::new(&camera(), &numbers, 1, &splits, count)
        };
        let uniform = recorder.uniform(&uniforms).unwrap();
        let [place, gather] =
            ["place", "gather_geometry"].map(|entry| gpu.pipeline("gather.wgsl", entry, &[]).unwrap());
        let views = [uniform.clone(), counted.view(), table.view()];
        recorder.dispatch("gather", &place, &views, groups_1d(1, 1)).unwrap();
        let read_there = [&table, &slab_there, &tables_there, &recent, &found_there].map(Buffer::view);
        let columns = [&means, &quats, &scales, &opacities].map(Buffer::view);
        let views: Vec<_> = std::iter::once(uniform).chain(read_there).chain(columns).collect();
        recorder.dispatch("gather", &gather, &views, groups_1d(count + room.div_ceil(64), 1)).unwrap();
        gpu.submit(recorder).unwrap();
        let total = gather::place(&mut pages, &counts);
        assert_eq!(read::<u32>(&gpu, &counted, count as usize + 1)[count as usize], total);
        let mut list = vec![[gather::UNLISTED, 0]; room as usize];
        gather::list(&pages, &counts, &found, &mut list);
        let input =
            GatherInput { uniforms: &uniforms, pages: &pages, slab, tables: (&tables).into(), recent: &step.recent };
        for (column, width, there) in [(Column::Means, 3, &means), (Column::Opacities, 1, &opacities)] {
            let mut want = vec![f32::NAN; width * room as usize];
            gather::gather(&input, (column, width), &list, &mut want);
            let got: Vec<f32> = read(&gpu, there, want.len());
            assert!(got == want, "{column:?} of {count} pages, {total} rows, room for {room}");
        }
    }
}
