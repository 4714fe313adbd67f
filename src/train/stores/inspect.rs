//! Looks at a store: its generations as a list, its format and run state as text, single pages, and every fault with its page and place.
//!
//! A verification always checks the map (checksum of every value, sums over all values, the witness), the state of every kept
//! generation, every entry against its run, the length of every segment, the header of every slot. Deep: checksum,
//! decoding and values of every payload.

use super::{StorePlace, options_of, run_state_of};
use crate::base::error::InputError;
use crate::base::ids::PageId;
use crate::base::math::exp32;
use crate::checkpoint::run_state::RunState;
use crate::config::file::TrainConfig;
use crate::config::values::Choice;
use crate::densify::strategy::{Effect, effect_of};
use crate::page::engine::page_engine::Place;
use crate::page::engine::segment_files::segment_file_name;
use crate::page::format::slot_header::{FORMAT_VERSION, KNOWN_FEATURES, SlotRef, StoredAs};
use crate::page::map::commit::CommitError;
use crate::page::tool::reading::{Access, ReadError, StoreReader, WitnessRule};
use crate::paging::stored::{PageLimits, check_values, layout_of, meta_from_label};
use crate::scene::events::EventKind;
use crate::scene::rows::Rows;
use crate::scene::sightings;
use crate::train::error::TrainError;
use serde::Serialize;
use std::collections::HashMap;

/// Facts of a store and of one generation.
#[derive(Debug, Clone, Serialize)]
pub struct Inspected {
    pub store: std::path::PathBuf,
    /// Its identity, hexadecimal.
    pub identity: String,
    /// The process that writes to it, if any.
    pub used_by: Option<String>,
    pub format_version: u32,
    /// Feature bits that a reader must know.
    pub features_incompatible: u32,
    /// Feature bits that a reader may ignore.
    pub features_compatible: u32,
    pub slot_bytes: u64,
    pub slots_per_segment: u32,
    pub segments: u64,
    pub segment_bytes: u64,
    pub transactions: u64,
    /// The generation to which the following fields belong.
    pub generation: u64,
    pub pages: u64,
    /// Pages by stored form, in the order of [`StoredAs::ALL`].
    pub pages_by_codec: [u64; StoredAs::ALL.len()],
    /// Bytes of payloads, decoded and stored.
    pub payload_bytes: [u64; 2],
    /// Pages stored with each SH degree.
    pub pages_by_degree: [u64; 4],
    /// Pages with pending events.
    pub pages_behind: u64,
    /// The run state as text, one fact per line.
    pub state: Vec<String>,
}

/// Inspects a generation.
/// Errors: the store cannot be opened, or the generation is not kept.
pub fn inspect(place: &StorePlace, generation: Option<&str>) -> Result<Inspected, TrainError> {
    let store = place.open(Access::Map)?;
    let generation = store.find(generation)?;
    let state = run_state_of(&store, generation)?;
    let (config, _) = options_of(&place.folder, &state)?;
    let pages = store.pages_at(generation)?;
    let segments = store.segments()?;
    let (mut by_codec, mut by_degree, mut payload, mut behind) = ([0; StoredAs::ALL.len()], [0; 4], [0; 2], 0);
    for page in &pages {
        by_codec[page.slot.codec as usize] += 1;
        payload[0] += u64::from(page.slot.payload_bytes);
        payload[1] += u64::from(page.slot.stored_bytes);
        if let Some(meta) = meta_from_label(page.page, &page.label) {
            by_degree[usize::from(meta.sh_degree)] += 1;
            behind += u64::from((meta.events_applied as usize) < state.events.len());
        }
    }
    let format = store.format();
    Ok(Inspected {
        store: place.folder.clone(),
        identity: format!("{:032x}", format.store),
        used_by: store.used_by().map(str::to_string),
        format_version: FORMAT_VERSION,
        features_incompatible: KNOWN_FEATURES,
        features_compatible: format.compatible,
        slot_bytes: format.layout.slot_bytes,
        slots_per_segment: format.layout.slots_per_segment,
        segments: segments.len() as u64,
        segment_bytes: segments.iter().map(|(_, bytes)| bytes).sum(),
        transactions: store.transactions(),
        generation,
        pages: pages.len() as u64,
        pages_by_codec: by_codec,
        payload_bytes: payload,
        pages_by_degree: by_degree,
        pages_behind: behind,
        state: words_of(&state, &config),
    })
}

fn words_of(state: &RunState, config: &TrainConfig) -> Vec<String> {
    let count = |is: fn(Effect<'_>) -> bool| state.events.iter().filter(|e| is(effect_of(&e.kind))).count();
    let rounds = count(|effect| matches!(effect, Effect::Round(_)));
    let resets = count(|effect| matches!(effect, Effect::ResetOpacity { .. }));
    let raises = count(|effect| matches!(effect, Effect::RaiseShDegree { .. }));
    let raised = state.events.iter().rev().find_map(|e| match e.kind {
        EventKind::RaiseShDegree { degree } => Some(degree),
        _ => None,
    });
    let degree = raised.unwrap_or(state.origin.sh_degree_start);
    let last = state.events.last().map_or(String::new(), |e| format!(", the last after step {}", e.step));
    let print = &state.origin.dataset;
    let [x, y, z] = print.origin;
    vec![
        format!("step {} of {}, {:.1} s of training", state.trainer.step, config.steps, state.trainer.train_seconds),
        format!("{} Gaussians in pages, at most {} after pending events", state.rows, state.rows_bound),
        format!("SH degree {degree}, up to {}; {} Gaussians per page at most", config.sh_degree, config.page_rows),
        format!("{} events: {rounds} rounds, {resets} opacity resets, {raises} SH raises{last}", state.events.len()),
        format!(
            "strategy {}, view order {}, seed {}, moments {}",
            config.strategy.word(),
            config.view_order.word(),
            config.seed,
            config.moments.word()
        ),
        format!("rendered by {}, instruction path {}", state.device, state.origin.simd),
        format!(
            "dataset of {} views, {} first Gaussians, origin {x} {y} {z}, scale {}",
            print.views.len(),
            print.first_rows,
            print.scale
        ),
        format!("{} steps and {} updates skipped: not finite", state.trainer.steps_skipped, state.trainer.rows_skipped),
        format!("{} bytes of metrics.jsonl", state.metrics_bytes),
    ]
}

/// Minimum, mean and maximum of a value.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ValueSpread {
    pub least: f64,
    pub mean: f64,
    pub most: f64,
}

#[derive(Debug, Clone, Serialize)]
pub struct PageInspected {
    pub page: String,
    /// The first generation with this version.
    pub since: u64,
    pub file: String,
    /// Offset in it, bytes.
    pub offset: u64,
    /// Serial number of the write in this store.
    pub serial: u64,
    pub codec: String,
    /// Bytes of the payload, decoded and stored.
    pub payload_bytes: [u32; 2],
    /// xxh3-128 of the stored payload, hexadecimal.
    pub checksum: String,
    pub rows: u32,
    pub sh_degree: u8,
    /// Events applied, and all events.
    pub events: [u32; 2],
    /// Box of the means now and until the page is next touched, local coordinates.
    pub bounds: [[f32; 3]; 2],
    /// Largest standard deviation, local units.
    pub sigma_max: f32,
    /// Step of the last update of its rows.
    pub stamp: ValueSpread,
    /// Rows whose moments are all zero.
    pub rows_without_moments: u64,
    /// Opacities as stored, after activation.
    pub opacity: ValueSpread,
    /// Largest standard deviation of each row as stored, local units.
    pub sigma: ValueSpread,
    /// Views that drew a row since the last round.
    pub views: ValueSpread,
    /// First invalid value, if any.
    pub fault: Option<String>,
}

/// Inspects a page: its header and its rows as stored.
/// Errors: the store is in use or cannot be opened, or the page is missing or damaged.
pub fn inspect_page(place: &StorePlace, generation: Option<&str>, id: PageId) -> Result<PageInspected, TrainError> {
    let store = place.open(Access::Pages)?;
    let generation = store.find(generation)?;
    let state = run_state_of(&store, generation)?;
    let pages = store.pages_at(generation)?;
    let refuse = |problem: String, remedy: &str| InputError::new(&place.folder, problem, remedy);
    let page = pages.iter().find(|p| p.page == id).ok_or_else(|| {
        let (first, last) = (pages.first().map(|p| p.page), pages.last().map(|p| p.page));
        let range = first.zip(last).map_or(String::new(), |(a, b)| format!(" ({a} to {b})"));
        let problem = format!("generation {generation} has no page {id} among its {}{range}", pages.len());
        refuse(problem, "a page that was split is replaced by its halves, page 7 by 7.0 and 7.1")
    })?;
    let broken = |what: String| refuse(format!("page {id}: {what}"), "gsscale-ckpt verify --deep lists all damage");
    let meta = meta_from_label(id, &page.label).ok_or_else(|| broken("its label is invalid".to_string()))?;
    let mut reader = store.slot_reader();
    let header = reader.check_header(id, &page.slot).map_err(broken)?;
    let payload = reader.payload(id, &page.slot).map_err(broken)?;
    if layout_of(&meta).bytes() != payload.len() {
        return Err(broken("the length of its slot is wrong".to_string()).into());
    }
    let rows = layout_of(&meta).rows(payload, 0);
    let slot = page.slot;
    let sigma = |s: &[f32]| f64::from(exp32(s[0].max(s[1]).max(s[2])));
    Ok(PageInspected {
        page: id.to_string(),
        since: page.since,
        file: segment_file_name(slot.place.segment),
        offset: slot.place.offset,
        serial: header.serial,
        codec: slot.codec.name().to_string(),
        payload_bytes: [slot.payload_bytes, slot.stored_bytes],
        checksum: format!("{:032x}", slot.checksum),
        rows: meta.rows,
        sh_degree: meta.sh_degree,
        events: [meta.events_applied, state.events.len() as u32],
        bounds: [meta.bounds.lo, meta.bounds.hi],
        sigma_max: meta.bounds.sigma_max,
        stamp: spread(rows.stamp.iter().map(|&s| f64::from(s))),
        rows_without_moments: rows_without_moments(&rows),
        opacity: spread(rows.columns.opacities.iter().map(|&o| 1.0 / (1.0 + f64::from(exp32(-o))))),
        sigma: spread(rows.columns.scales.chunks_exact(3).map(sigma)),
        views: spread(rows.count.iter().map(|&word| f64::from(sightings::views(word)))),
        fault: check_values(&rows, state.trainer.step).err(),
    })
}

fn spread(values: impl Iterator<Item = f64>) -> ValueSpread {
    let (mut least, mut sum, mut most, mut count) = (f64::INFINITY, 0.0, f64::NEG_INFINITY, 0.0);
    for value in values {
        (least, sum, most, count) = (least.min(value), sum + value, most.max(value), count + 1.0);
    }
    ValueSpread { least, mean: sum / count, most }
}

fn rows_without_moments(rows: &Rows<'_>) -> u64 {
    let m = &rows.exp_avg;
    let tables = [m.means, m.quats, m.scales, m.opacities, m.sh0, m.sh_n];
    let is_zero = |row: usize| {
        tables.iter().all(|table| {
            let width = table.len() / rows.rows();
            table[row * width..(row + 1) * width].iter().all(|&x| x == 0.0)
        })
    };
    (0..rows.rows()).filter(|&row| is_zero(row)).count() as u64
}

/// A kept generation.
#[derive(Debug, Clone, Serialize)]
pub struct GenerationLine {
    pub generation: u64,
    pub names: Vec<String>,
    /// Whether `--resume` continues from it.
    pub is_latest: bool,
    /// Steps done.
    pub step: u32,
    /// Held-out PSNR of the last evaluation before it, dB; `None` without one.
    pub psnr: Option<f64>,
    /// Gaussians in its pages. Pages that no view has needed since the last events have not applied them.
    pub gaussians: u64,
    /// Gaussians at most, once all pages have applied all events.
    pub gaussians_at_most: u64,
    pub pages: u64,
    /// Bytes on the drive that no other kept generation needs.
    pub bytes_alone: u64,
    /// Bytes on the drive.
    pub bytes: u64,
}

/// All kept generations of a store.
#[derive(Debug, Clone, Serialize)]
pub struct Listed {
    pub store: std::path::PathBuf,
    /// The process that writes to it, if any.
    pub used_by: Option<String>,
    pub segment_bytes: u64,
    /// Generations, ascending.
    pub generations: Vec<GenerationLine>,
}

/// Lists the kept generations.
/// Errors: the store cannot be opened, or another version of the program wrote a run state.
pub fn list(place: &StorePlace) -> Result<Listed, TrainError> {
    let store = place.open(Access::Map)?;
    let mut generations: Vec<GenerationLine> = Vec::new();
    // By place of a slot: how many generations see it, the first of them, and its bytes.
    let mut seen: HashMap<Place, (u32, u64, u64)> = HashMap::new();
    for generation in store.generations().kept() {
        let state = run_state_of(&store, generation)?;
        let pages = store.pages_at(generation)?;
        let mut bytes = 0;
        for page in &pages {
            let slot_bytes = page.slot.transfer_bytes() as u64;
            bytes += slot_bytes;
            seen.entry(page.slot.place).or_insert((0, generation, slot_bytes)).0 += 1;
        }
        generations.push(GenerationLine {
            generation,
            names: store.generations().names_of(generation),
            is_latest: generation == store.generations().latest(),
            step: state.trainer.step,
            psnr: state.trainer.test.map(|test| test.psnr),
            gaussians: state.rows,
            gaussians_at_most: state.rows_bound,
            pages: pages.len() as u64,
            bytes_alone: 0,
            bytes,
        });
    }
    for (times, generation, bytes) in seen.into_values() {
        let of = generations.iter_mut().find(|line| line.generation == generation && times == 1);
        of.into_iter().for_each(|line| line.bytes_alone += bytes);
    }
    let segment_bytes = store.segments()?.iter().map(|(_, bytes)| bytes).sum();
    let used_by = store.used_by().map(str::to_string);
    Ok(Listed { store: place.folder.clone(), used_by, segment_bytes, generations })
}

#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct StoreFault {
    /// The faulty part: map, state, segment, entry, header, payload, values.
    pub kind: &'static str,
    pub page: Option<String>,
    /// First generation of the version, or the generation of a state.
    pub generation: Option<u64>,
    /// File in the store's folder.
    pub file: Option<String>,
    /// Offset of the slot in it, bytes.
    pub offset: Option<u64>,
    pub what: String,
}

/// Result of a verification.
#[derive(Debug, Clone, Serialize)]
pub struct Verdict {
    pub store: std::path::PathBuf,
    /// Whether payloads were read.
    pub deep: bool,
    /// Kept generations checked.
    pub generations: u64,
    /// Versions of pages checked.
    pub versions: u64,
    pub bytes_read: u64,
    /// All faults, in the order map, states, segments, slots by place.
    pub faults: Vec<StoreFault>,
}

/// Verifies a store.
/// Errors: the folder is not a store, has another format version, is in use, or cannot be read. Damage is not an error
/// here.
pub fn verify(place: &StorePlace, deep: bool) -> Result<Verdict, TrainError> {
    let store = place.folder.clone();
    let mut verdict = Verdict { store, deep, generations: 0, versions: 0, bytes_read: 0, faults: Vec::new() };
    let store = match StoreReader::open(&place.folder, Access::Pages, WitnessRule::Obeyed) {
        Err(ReadError::Commit(error)) => {
            verdict.faults.push(fault_of_map(&error));
            return Ok(verdict);
        }
        store => store?,
    };
    place.check_owner(&store)?;
    let limits = check_states(&store, &mut verdict);
    let versions = match store.live_versions() {
        Err(error) => {
            verdict.faults.push(fault_of_map(&error));
            return Ok(verdict);
        }
        Ok(versions) => versions,
    };
    let slots: Vec<SlotRef> = versions.iter().map(|(_, slot, _)| *slot).collect();
    check_segments(&store, &slots, &mut verdict)?;
    let mut reader = store.slot_reader();
    for (page, slot, label) in versions {
        let mut fault = |kind, what: String| verdict.faults.push(fault_of_slot(kind, &page.to_string(), &slot, what));
        verdict.versions += 1;
        let meta = limits.map(|(limits, _)| limits.meta_of(page, &slot, &label)).transpose().unwrap_or_else(|what| {
            fault("entry", what);
            None
        });
        if let Err(what) = reader.check_header(page, &slot) {
            fault("header", what);
            continue;
        }
        if !deep {
            continue;
        }
        verdict.bytes_read += slot.transfer_bytes() as u64;
        match (reader.payload(page, &slot), meta, limits) {
            (Err(what), ..) => fault("payload", what),
            (Ok(payload), Some(meta), Some((_, step))) => {
                if let Err(what) = check_values(&layout_of(&meta).rows(payload, 0), step) {
                    fault("values", what);
                }
            }
            _ => {}
        }
    }
    Ok(verdict)
}

/// Checks every run state; returns the limits and the step of the last one.
fn check_states(store: &StoreReader, verdict: &mut Verdict) -> Option<(PageLimits, u32)> {
    let mut last = None;
    for generation in store.generations().kept() {
        verdict.generations += 1;
        let read = || -> Result<(PageLimits, u32), String> {
            let bytes = store.run_state(generation).map_err(|e| e.to_string())?;
            let state = RunState::from_bytes(&bytes)?;
            let (config, _) = options_of(store.folder(), &state).map_err(|e| e.problem)?;
            let (page_rows, events) = (config.page_rows as usize, state.events.len());
            Ok((PageLimits { page_rows, sh_degree: config.sh_degree, events }, state.trainer.step))
        };
        match read() {
            Ok(limits) => last = Some(limits),
            Err(what) => verdict.faults.push(StoreFault {
                kind: "state",
                generation: Some(generation),
                what,
                ..StoreFault::default()
            }),
        }
    }
    last
}

/// Checks that every segment with slots exists with its full length.
fn check_segments(store: &StoreReader, slots: &[SlotRef], verdict: &mut Verdict) -> Result<(), TrainError> {
    let there = store.segments()?;
    let full = store.format().layout.segment_bytes();
    let mut needed: Vec<u32> = slots.iter().map(|slot| slot.place.segment).collect();
    needed.sort_unstable();
    needed.dedup();
    for segment in needed {
        let bytes = there.iter().find(|(number, _)| *number == segment).map(|(_, bytes)| *bytes);
        let what = match bytes {
            None => "it is missing".to_string(),
            Some(bytes) if bytes != full => format!("it has {bytes} bytes instead of {full}"),
            Some(_) => continue,
        };
        let file = Some(segment_file_name(segment));
        verdict.faults.push(StoreFault { kind: "segment", file, what, ..StoreFault::default() });
    }
    Ok(())
}

fn fault_of_map(error: &CommitError) -> StoreFault {
    let file = match error {
        CommitError::File { name, .. } => name,
        _ => crate::page::map::commit::MAP_NAME,
    };
    // Drop the remedy, which follows the first line.
    let what = error.to_string().lines().next().unwrap_or_default().to_string();
    StoreFault { kind: "map", file: Some(file.to_string()), what, ..StoreFault::default() }
}

fn fault_of_slot(kind: &'static str, page: &str, slot: &SlotRef, what: String) -> StoreFault {
    StoreFault {
        kind,
        page: Some(page.to_string()),
        generation: Some(slot.generation),
        file: Some(segment_file_name(slot.place.segment)),
        offset: Some(slot.place.offset),
        what,
    }
}
