//! Rebuilds a damaged store in a new folder from its undamaged parts.
//!
//! If the map can be verified (only its witness or some pages are damaged), the result is the last generation, with the
//! newest undamaged older version in place of each damaged one. A run can resume from it.
//!
//! If the map is lost, the result takes the newest undamaged version of every page by serial number, committed or not.
//! A process that ended before its first commit leaves serial numbers that are used again, so a version may be an
//! earlier one. A page that was split is replaced by its parts. The run state was in the map, so the result is a scene
//! at the step of its newest row, with moments and without pending events; it can be exported, started from or resumed.
//!
//! Invariants: 1. the damaged store is not written; 2. everything missing is reported; 3. the histogram of a written
//! state counts exactly the statistics of the rows in the pages, except statistics of a round that their page has yet
//! to apply. If the map is lost, the events are lost too: a page that had applied fewer events than others then holds
//! statistics of a round that will never be applied, and these are cleared. If no page had applied the last round, all
//! pages keep their statistics, and the next round covers more steps.

use super::change::{layout_for, usual_codec};
use super::{StorePlace, options_of, run_state_of};
use crate::base::error::InputError;
use crate::base::ids::PageId;
use crate::base::say::shell_word;
use crate::checkpoint::run_state::{DatasetPrint, Origin, RunIdentity, RunState};
use crate::config::file::{TrainConfig, read_resolved};
use crate::config::limits::{self, RunOptions};
use crate::densify::stats::GradHistogram;
use crate::densify::strategy::{Effect, effect_of};
use crate::page::format::slot_header::{SlotHeader, SlotRef};
use crate::page::format::spill_format::SpillFormat;
use crate::page::map::commit::CommitError;
use crate::page::tool::new_store::{NewStore, claim_new_store};
use crate::page::tool::reading::{Access, ReadError, StoreReader, WitnessRule, format_at, refuse_if_in_use};
use crate::page::tool::slot_reader::{Scan, SlotReader, scan_slots};
use crate::page::versions::slots::SlotLayout;
use crate::paging::stored::{check_values, label, layout_of, meta_from_label};
use crate::report::run_files::CONFIG_FILE;
use crate::scene::page_layout::{capacity_bytes, read_page, write_page};
use crate::scene::page_meta::PageMeta;
use crate::train::error::TrainError;
use crate::train::inputs::signals::StopFlag;
use crate::train::step::pages::SceneRules;
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

#[derive(Debug, Clone)]
pub struct SalvageRequest {
    /// The new store, a folder that does not exist.
    pub to: PathBuf,
    /// The run's config.toml, for a lost map if the user named the store instead of the run.
    pub config: Option<PathBuf>,
}

/// A page that is missing or an older version.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct LostPage {
    pub page: String,
    /// Its rows, if its label is known.
    pub rows: Option<u32>,
    /// Generation of the version taken instead; `None` if no version is undamaged.
    pub taken: Option<u64>,
    pub what: String,
}

/// Result of a salvage.
#[derive(Debug, Clone, Serialize)]
pub struct Salvaged {
    /// The new folder.
    pub to: PathBuf,
    /// Whether the map was usable, so that a run can resume from the new store.
    pub has_state: bool,
    /// Step of the run, or of the newest row.
    pub step: u32,
    pub gaussians: u64,
    pub pages: u64,
    /// Pages that are missing, incomplete or older.
    pub lost: Vec<LostPage>,
    /// Messages for the user.
    pub notes: Vec<String>,
}

/// A version to keep.
struct Kept {
    slot: SlotRef,
    label: Vec<u8>,
    /// It replaces a damaged newer version.
    is_older: bool,
}

/// Facts before pages are copied.
struct SalvageSource {
    folder: PathBuf,
    store: u128,
    layout: SlotLayout,
    scan: Scan,
    notes: Vec<String>,
}

/// Rebuilds a store.
/// Errors: the store is in use or of another version, all of it is damaged, or the new folder cannot be written. No new
/// store is left then.
pub fn salvage(place: &StorePlace, request: &SalvageRequest, stop: &StopFlag) -> Result<Salvaged, TrainError> {
    claim_new_store(&request.to)?;
    // Hold the lock until the end, so that no trainer writes meanwhile.
    let _lock = refuse_if_in_use(&place.folder)?;
    let mut notes = Vec::new();
    let map = match StoreReader::open(&place.folder, Access::Pages, WitnessRule::Ignored) {
        Ok(store) if store.generations().latest() > 0 => {
            place.check_owner(&store)?;
            Some(store)
        }
        Ok(_) => {
            notes.push("nothing was committed: pages are taken by their headers".to_string());
            None
        }
        Err(error @ ReadError::Commit(_)) => {
            notes.push(format!("the map is lost: {}", error.to_string().lines().next().unwrap_or_default()));
            None
        }
        Err(ReadError::Input(error)) => {
            notes.push(format!("the map is unusable without FORMAT: {}", error.problem));
            None
        }
    };
    let format = format_at(&place.folder).ok();
    let scan = scan_slots(&place.folder, format.map(|f| f.layout))?;
    let source = source_of(place, format, scan, notes)?;
    match map {
        Some(store) => with_state(&store, source, request, stop),
        None => without_state(place, source, request, stop),
    }
}

/// Identity and layout, from FORMAT or from the headers.
fn source_of(
    place: &StorePlace,
    format: Option<SpillFormat>,
    scan: Scan,
    mut notes: Vec<String>,
) -> Result<SalvageSource, InputError> {
    let nothing = || {
        let problem = format!("no slot header in its {} segment files is whole", scan.segments);
        InputError::new(&place.folder, problem, "check whether this is the folder that was meant")
    };
    let (&store, found) = match format {
        Some(format) => scan.found.get_key_value(&format.store).ok_or_else(nothing)?,
        None => scan.found.iter().max_by_key(|(_, found)| found.len()).ok_or_else(nothing)?,
    };
    for (other, found) in scan.found.iter().filter(|(other, _)| **other != store) {
        notes.push(format!("{} slots of another store ({other:032x}) are left out", found.len()));
    }
    for (segment, bytes) in &scan.short {
        notes.push(format!(
            "{} ends after {bytes} bytes",
            crate::page::engine::segment_files::segment_file_name(*segment)
        ));
    }
    for (at, what) in &scan.broken {
        notes.push(format!("segment {} offset {}: {what}", at.segment, at.offset));
    }
    let layout = format.map_or_else(
        || {
            // Every payload fits its slot, so the longest payload is a lower bound of the slot size.
            let bytes = found.iter().map(|h| h.slot.payload_bytes as usize).max().unwrap_or(0);
            SlotLayout::new(bytes, found.len() as u64)
        },
        |format| format.layout,
    );
    Ok(SalvageSource { folder: place.folder.clone(), store, layout, scan, notes })
}

impl SalvageSource {
    fn reader(&self) -> SlotReader {
        SlotReader::new(&self.folder, self.store, self.layout.slot_bytes)
    }

    /// Headers of every page, newest first.
    fn by_page(&mut self) -> BTreeMap<PageId, Vec<SlotHeader>> {
        let mut pages: BTreeMap<PageId, Vec<SlotHeader>> = BTreeMap::new();
        for header in self.scan.found.remove(&self.store).unwrap_or_default() {
            pages.entry(header.page).or_default().push(header);
        }
        pages.values_mut().for_each(|of| of.sort_unstable_by_key(|h| std::cmp::Reverse(h.serial)));
        pages
    }
}

/// Rebuilds the last generation, with older versions in place of damaged ones.
fn with_state(
    store: &StoreReader,
    mut source: SalvageSource,
    request: &SalvageRequest,
    stop: &StopFlag,
) -> Result<Salvaged, TrainError> {
    let latest = store.find(None)?;
    let mut state = run_state_of(store, latest)?;
    let mut reader = source.reader();
    let found = source.by_page();
    let (mut kept, mut lost) = (BTreeMap::new(), Vec::new());
    for page in store.pages_at(latest)? {
        stop.check()?;
        let rows = meta_from_label(page.page, &page.label).map(|m| m.rows);
        let what = match reader.payload(page.page, &page.slot) {
            Ok(_) => {
                kept.insert(page.page, Kept { slot: page.slot, label: page.label, is_older: false });
                continue;
            }
            Err(what) => what,
        };
        let older = found.get(&page.page).into_iter().flatten().filter(|h| h.slot.generation <= latest);
        let usable = |h: &&SlotHeader| {
            let applied = meta_from_label(h.page, &h.label).map(|m| m.events_applied as usize);
            applied.is_some_and(|applied| applied <= state.events.len()) && Whole::read(&mut reader, h).is_ok()
        };
        let instead = older.filter(|h| h.slot != page.slot).find(usable);
        lost.push(LostPage { page: page.page.to_string(), rows, taken: instead.map(|h| h.slot.generation), what });
        if let Some(h) = instead {
            kept.insert(h.page, Kept { slot: h.slot, label: h.label.clone(), is_older: true });
        }
    }
    let rows: u64 = kept.iter().filter_map(|(id, k)| meta_from_label(*id, &k.label)).map(|m| u64::from(m.rows)).sum();
    let promised = state.rows_bound.saturating_sub(state.rows);
    (state.rows, state.rows_bound) = (rows, rows + promised);
    let mut copy = NewStore::create(
        &request.to,
        layout_for(source.layout, kept.len() as u64),
        usual_codec(kept.values().map(|k| &k.slot)),
    )?;
    // Statistics of a round that their page has yet to apply are not in the next round's histogram.
    let has_pending_round = |meta: &PageMeta| {
        let missed = state.events.get(meta.events_applied as usize..).unwrap_or_default();
        missed.iter().any(|event| matches!(effect_of(&event.kind), Effect::Round(_)))
    };
    let mut histogram = GradHistogram::default();
    for (id, Kept { slot, label, is_older }) in &kept {
        stop.check()?;
        let payload = reader.payload(*id, slot).map_err(|what| changed(&source.folder, *id, &what))?;
        let meta = meta_from_label(*id, label);
        match meta.filter(|_| *is_older) {
            Some(meta) => copy.put(*id, label, &without_statistics(&meta, payload))?,
            None => {
                if let Some(meta) = meta.filter(|meta| !has_pending_round(meta)) {
                    histogram.add_rows(&layout_of(&meta).rows(payload, 0));
                }
                copy.put(*id, label, payload)?;
            }
        }
    }
    state.histogram = histogram.filled();
    copy.skip_to(latest);
    commit(copy, &state, &source)?;
    if !lost.is_empty() {
        source.notes.push("the run can resume from it, but will not end with the same bytes".into());
    }
    let (step, pages, to) = (state.trainer.step, kept.len() as u64, request.to.clone());
    Ok(Salvaged { to, has_state: true, step, gaussians: rows, pages, lost, notes: source.notes })
}

/// A page with cleared statistics. The run's histogram counts the statistics of the newer, damaged version, and growth
/// is no longer promised for rounds that only the newer version had applied. Rows without statistics neither grow in
/// such a round nor leave the histogram.
fn without_statistics(meta: &PageMeta, payload: &[u8]) -> Vec<u8> {
    let mut page = read_page(&layout_of(meta).rows(payload, 0));
    page.view_mut().clear_statistics();
    let mut words = vec![0u64; payload.len().div_ceil(8)];
    let bytes: &mut [u8] = bytemuck::cast_slice_mut(&mut words);
    let written = write_page(&page, bytes).bytes();
    bytes[..written].to_vec()
}

fn commit(mut copy: NewStore, state: &RunState, source: &SalvageSource) -> Result<(), TrainError> {
    let bytes = state.to_bytes().map_err(CommitError::Contradiction)?;
    copy.commit(&bytes, format!("salvaged from {}", source.folder.display()).as_bytes(), &[])?;
    Ok(copy.finish()?)
}

fn changed(folder: &Path, page: PageId, what: &str) -> InputError {
    InputError::new(folder, format!("page {page} changed while it was read: {what}"), "check the drive, then try again")
}

/// A version whose label, checksum and values are sound.
struct Whole {
    header: SlotHeader,
    meta: PageMeta,
    /// Step of its newest row.
    step: u32,
}

impl Whole {
    fn read(reader: &mut SlotReader, header: &SlotHeader) -> Result<Whole, String> {
        let meta = meta_from_label(header.page, &header.label).ok_or("its label is invalid")?;
        let payload = reader.payload(header.page, &header.slot)?;
        if meta.rows == 0 || layout_of(&meta).bytes() != payload.len() {
            return Err("the length of its slot differs from its label".to_string());
        }
        let rows = layout_of(&meta).rows(payload, 0);
        check_values(&rows, u32::MAX)?;
        Ok(Whole { header: header.clone(), meta, step: rows.stamp.iter().copied().max().unwrap_or(0) })
    }
}

/// Rebuilds a store without its map from the newest undamaged version of every page.
fn without_state(
    place: &StorePlace,
    mut source: SalvageSource,
    request: &SalvageRequest,
    stop: &StopFlag,
) -> Result<Salvaged, TrainError> {
    let mut reader = source.reader();
    let found = source.by_page();
    let (mut kept, mut lost) = (BTreeMap::new(), Vec::new());
    for (id, versions) in &found {
        stop.check()?;
        let mut first = None;
        let instead = versions.iter().find_map(|h| match Whole::read(&mut reader, h) {
            Ok(whole) => Some(whole),
            Err(what) => {
                first.get_or_insert(what);
                None
            }
        });
        if let Some(what) = first {
            let rows = meta_from_label(*id, &versions[0].label).map(|m| m.rows);
            let taken = instead.as_ref().map(|whole| whole.header.slot.generation);
            lost.push(LostPage { page: id.to_string(), rows, taken, what });
        }
        kept.extend(instead.map(|whole| (*id, whole)));
    }
    drop_split_pages(&mut kept, &found, &mut lost);
    if kept.is_empty() {
        let problem = format!("none of its {} pages is whole", found.len());
        return Err(InputError::new(&place.folder, problem, "there is nothing to salvage").into());
    }
    let most = |of: fn(&Whole) -> u32| kept.values().map(of).max().unwrap_or(0);
    let (page_rows, degree) = (most(|whole| whole.meta.rows), most(|whole| u32::from(whole.meta.sh_degree)) as u8);
    let (step, applied) = (most(|whole| whole.step), most(|whole| whole.meta.events_applied));
    let rows = kept.values().map(|whole| u64::from(whole.meta.rows)).sum();
    let (mut config, dataset) = config_for(place, request, (page_rows, degree), &mut source)?;
    config.steps = config.steps.max(step);
    let mut state = {
        let sh_degree_start = degree.min(RunOptions::new(&config, dataset.scene_scale).sh_degree);
        let text = toml::to_string(&config).map_err(|e| CommitError::Contradiction(e.to_string()))?;
        let simd = limits::simd_path(&config).name().to_string();
        let run = RunIdentity { id: place.id, ..RunIdentity::default() };
        let origin = Origin { config: text, simd, sh_degree_start, dataset, run };
        RunState::without_history(origin, "unknown".to_string(), rows)
    };
    state.trainer.step = step;
    let (_, options) = options_of(&source.folder, &state)?;
    let layout = SlotLayout::new(capacity_bytes(options.page_rows, options.sh_degree), kept.len() as u64);
    let codec = usual_codec(kept.values().map(|whole| &whole.header.slot));
    let mut copy = NewStore::create(&request.to, layout, codec)?;
    let rules = SceneRules::new(&options);
    let mut words = vec![0u64; capacity_bytes(options.page_rows, options.sh_degree).div_ceil(8)];
    let mut histogram = GradHistogram::default();
    for (id, Whole { header, meta, .. }) in &kept {
        let payload = reader.payload(*id, &header.slot).map_err(|what| changed(&source.folder, *id, &what))?;
        let mut page = read_page(&layout_of(meta).rows(payload, 0));
        page.raise_sh_degree(degree);
        if meta.events_applied < applied {
            page.view_mut().clear_statistics();
        }
        histogram.add_rows(&page.view());
        let bytes: &mut [u8] = bytemuck::cast_slice_mut(&mut words);
        let written = write_page(&page, bytes).bytes();
        // The events are lost with the map, so none is pending.
        let meta = PageMeta { events_applied: 0, ..rules.meta(*id, &page) };
        copy.put(*id, &label(&meta), &bytes[..written])?;
    }
    state.histogram = histogram.filled();
    commit(copy, &state, &source)?;
    source.notes.push(format!(
        "the trainer's state is lost. To train on from the step of its newest row: gsscale-train --resume OUT --spill-dir {to} \
         --accept-changes. To keep the scene alone: gsscale-ckpt export {to} --out FILE.ply",
        to = shell_word(&request.to)
    ));
    let (pages, to) = (kept.len() as u64, request.to.clone());
    Ok(Salvaged { to, has_state: false, step, gaussians: rows, pages, lost, notes: source.notes })
}

/// Drops pages that were split later, and reports missing parts. Parts older than the whole page come from before a
/// rollback and are dropped too.
fn drop_split_pages(
    kept: &mut BTreeMap<PageId, Whole>,
    found: &BTreeMap<PageId, Vec<SlotHeader>>,
    lost: &mut Vec<LostPage>,
) {
    let mut known: BTreeSet<PageId> = found.keys().copied().collect();
    let newest = |id: &PageId| found.get(id).and_then(|of| of.first()).map_or(0, |h| h.serial);
    let mut split = BTreeSet::new();
    for &id in found.keys() {
        let parts = descendants(id, &known);
        if parts.iter().map(newest).max().is_some_and(|serial| serial > newest(&id)) {
            split.insert(id);
        } else {
            parts.iter().for_each(|part| {
                known.remove(part);
            });
        }
    }
    split.retain(|id| known.contains(id));
    kept.retain(|id, _| known.contains(id) && !split.contains(id));
    lost.retain(|page| page.page.parse().is_ok_and(|id| known.contains(&id) && !split.contains(&id)));
    for id in &split {
        for child in id.children().into_iter().flatten() {
            if !known.contains(&child) && descendants(child, &known).is_empty() {
                let what = format!("page {id} was split, and this part is missing or has lost all its Gaussians");
                lost.push(LostPage { page: child.to_string(), rows: None, taken: None, what });
            }
        }
    }
}

/// All pages that a page was split into, over any number of splits: its subtree without itself.
fn descendants(id: PageId, known: &BTreeSet<PageId>) -> Vec<PageId> {
    let Some([low, high]) = id.children() else { return Vec::new() };
    // A subtree is a range of ids; it ends where the lowest bit of its root would carry.
    let half = high.to_bits() - id.to_bits();
    let (from, to) = (low.to_bits() - (half - 1), high.to_bits() + (half - 1));
    let bounds = PageId::from_bits(from).zip(PageId::from_bits(to));
    bounds.map_or_else(Vec::new, |(from, to)| known.range(from..=to).copied().filter(|p| *p != id).collect())
}

/// Config and frame of the run, from its config.toml, or the defaults; its pages have this many rows and this degree at most.
fn config_for(
    place: &StorePlace,
    request: &SalvageRequest,
    (rows, degree): (u32, u8),
    source: &mut SalvageSource,
) -> Result<(TrainConfig, DatasetPrint), InputError> {
    let file = request.config.clone().or_else(|| place.run.as_ref().map(|run| run.join(CONFIG_FILE)));
    let mut print =
        DatasetPrint { views: Vec::new(), first_rows: 0, points: 0, scene_scale: 1.0, origin: [0.0; 3], scale: 1.0 };
    let Some(file) = file else {
        source.notes.push(
            "the run's config is not known (name its output folder or --config): using default rates, local coordinates"
                .to_string(),
        );
        let config = TrainConfig { page_rows: rows.max(16), sh_degree: degree, ..TrainConfig::default() };
        return Ok((config, print));
    };
    let config = TrainConfig::read(&file)?;
    if config.page_rows < rows || config.sh_degree < degree {
        let problem = format!(
            "it has page-rows {} and sh-degree {}, but the pages have {rows} and {degree}",
            config.page_rows, config.sh_degree
        );
        return Err(InputError::new(file, problem, "give the config.toml of the run that made these pages"));
    }
    let resolved = read_resolved(&file)?;
    (print.origin, print.scale) = (resolved.origin, resolved.scale);
    print.scene_scale = (resolved.scene_scale / resolved.scale) as f32;
    Ok((config, print))
}
