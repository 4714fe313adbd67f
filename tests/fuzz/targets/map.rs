//! Page maps with valid seals around wrong values, as an attacker could write them; and run states.

use super::pages::{PAGE_ROWS, label_of_a_page, payload_bytes_of_a_page};
use super::with_mode;
use crate::{ONE_AT_A_TIME, Target};
use gsscale::base::ids::PageId;
use gsscale::checkpoint::run_state::{
    DatasetPrint, IdleSteps, LastTest, Origin, RunIdentity, RunState, TrainerState, VERSION, ViewPrint,
};
use gsscale::densify::growth::{GrowthCheck, GrowthDecision, GrowthState};
use gsscale::densify::stats::GradHistogram;
use gsscale::page::engine::memory::MemoryEngine;
use gsscale::page::engine::page_engine::Place;
use gsscale::page::folder::protocol_files::Folder;
use gsscale::page::format::codec::Codec;
use gsscale::page::format::encoding;
use gsscale::page::format::slot_header::{SlotRef, StoredAs};
use gsscale::page::map::commit::{CommitConfig, Cut, MAP_NAME, PageChange, WITNESS_NAME};
use gsscale::page::map::entries::{MapBatch, MapVersion};
use gsscale::page::map::manifest::Manifest;
use gsscale::page::map::opening::Opened;
use gsscale::page::map::witness::Witness;
use gsscale::page::versions::paged_store::PagedStore;
use gsscale::page::versions::slots::SlotLayout;
use gsscale::paging::frames::evict::EvictPolicy;
use gsscale::paging::pager::{Pager, PagerConfig};
use gsscale::paging::prefetch::Transfers;
use gsscale::paging::stats::PagerStats;
use gsscale::photos::exposure::state::AppearanceState;
use gsscale::photos::outlier::blocks::look;
use gsscale::photos::outlier::views::ViewOutliers;
use gsscale::photos::parameter::{Encoded, SavedValues};
use gsscale::photos::pose::PoseState;
use gsscale::scene::events::{Event, EventKind, RoundThresholds};
use gsscale::scene::image;
use redb::StorageBackend;
use redb::backends::InMemoryBackend;
use std::collections::BTreeMap;
use std::io;
use std::sync::{Arc, Mutex, PoisonError};

const STORE: u128 = 0xf00d;
const CONFIG: CommitConfig = CommitConfig { store: STORE, cache_bytes: 1 << 18, reserve_bytes: 0 };

#[derive(Clone, Default)]
struct MemoryFolder(Arc<Mutex<BTreeMap<String, Arc<dyn StorageBackend>>>>);

impl Folder for MemoryFolder {
    fn open(&self, name: &str) -> io::Result<Option<Arc<dyn StorageBackend>>> {
        Ok(self.0.lock().unwrap().get(name).cloned())
    }

    fn create(&self, name: &str) -> io::Result<Arc<dyn StorageBackend>> {
        let file: Arc<dyn StorageBackend> = Arc::new(InMemoryBackend::new());
        self.0.lock().unwrap().insert(name.to_string(), Arc::clone(&file));
        Ok(file)
    }

    fn rename(&self, from: &str, to: &str) -> io::Result<()> {
        let file = self.0.lock().unwrap().remove(from).ok_or(io::ErrorKind::NotFound)?;
        self.0.lock().unwrap().insert(to.to_string(), file);
        Ok(())
    }

    fn remove(&self, name: &str) -> io::Result<()> {
        self.0.lock().unwrap().remove(name);
        Ok(())
    }

    fn sync(&self) -> io::Result<()> {
        Ok(())
    }
}

/// Reads values from the input; zeros after its end.
struct Reader<'a>(&'a [u8]);

impl<'a> Reader<'a> {
    fn bytes(&mut self, count: usize) -> &'a [u8] {
        let (taken, rest) = self.0.split_at(count.min(self.0.len()));
        self.0 = rest;
        taken
    }

    fn byte(&mut self) -> u8 {
        self.bytes(1).first().copied().unwrap_or(0)
    }

    fn u64(&mut self) -> u64 {
        let mut bytes = [0; 8];
        let taken = self.bytes(8);
        bytes[..taken.len()].copy_from_slice(taken);
        u64::from_le_bytes(bytes)
    }
}

fn slot_bytes() -> u64 {
    PAGES.frame_bytes() as u64
}

/// Input: latest and next generation number; a run state with its length; versions (page, generation, kind, value with
/// its length); pins.
pub fn map_values() -> Target {
    let slot = |offset: u64| {
        let place = Place { segment: 0, offset };
        let codec = StoredAs::Raw;
        let bytes = payload_bytes_of_a_page() as u32;
        let slot = SlotRef { place, stored_bytes: bytes, payload_bytes: bytes, generation: 1, checksum: 1, codec };
        [&slot.to_bytes()[..], &label_of_a_page()].concat()
    };
    let build = |next: u64, versions: &[(u8, u8, Vec<u8>)]| {
        let mut bytes = [2u64, next].map(u64::to_le_bytes).concat();
        let state = sample().to_bytes().unwrap();
        bytes.extend((state.len() as u16).to_le_bytes());
        bytes.extend(state);
        for (page, generation, value) in versions {
            bytes.extend([*page, *generation, 1, value.len() as u8]);
            bytes.extend(value);
        }
        bytes
    };
    let (a, b, c) = (slot(0), slot(slot_bytes()), slot(2 * slot_bytes()));
    let seeds = vec![
        build(3, &[(0, 1, a.clone()), (1, 1, b.clone()), (0, 2, c)]),
        build(9, &[(0, 1, a.clone()), (1, 1, b)]),
        build(3, &[(0, 2, a)]),
    ];
    Target { name: "map_values", run: run_map, seeds, words: &[], cases: 1_000, memory: [48 << 20, 64] }
}

/// Builds the map that the input describes, sealed as the program seals it.
fn folder_of(input: &[u8]) -> Option<MemoryFolder> {
    let mut input = Reader(input);
    let (latest, next) = (input.u64(), input.u64());
    let state_bytes = usize::from(input.byte()) | usize::from(input.byte()) << 8;
    let run_state = input.bytes(state_bytes).to_vec();
    let mut batch = MapBatch { latest, next, ..MapBatch::default() };
    batch.put_generation = Some((latest, Vec::new(), run_state));
    while !input.0.is_empty() && batch.put_versions.len() < 40 {
        let (page, generation, kind, len) = (input.byte(), input.byte(), input.byte(), input.byte());
        let value = input.bytes(usize::from(len)).to_vec();
        let generation = if generation == 200 { u64::MAX } else { u64::from(generation) };
        if kind == 2 {
            batch.put_pins.push((format!("pin{page}"), generation));
            continue;
        }
        let value = (kind == 1).then_some(value);
        batch.put_versions.push(MapVersion { page: PageId::initial(u32::from(page)), generation, value });
    }
    let folder = MemoryFolder::default();
    Witness::create(folder.create(WITNESS_NAME).unwrap(), STORE).unwrap();
    let mut map = Manifest::create(folder.create(MAP_NAME).unwrap(), STORE, CONFIG.cache_bytes).ok()?;
    map.apply(&batch).ok()?;
    Some(folder)
}

fn run_map(input: &[u8]) {
    let Some(folder) = folder_of(input) else { return };
    let Ok(opened) = Opened::open(Box::new(folder.clone()), CONFIG) else { return };
    let kept: Vec<u64> = opened.commits.generations().kept().collect();
    for &generation in &kept {
        let _ = opened.pages_at(generation);
        let _ = opened.commits.run_state(generation);
    }
    if let Ok(state) = RunState::from_bytes(&opened.run_state) {
        check_state(&state);
    }
    let to = kept.first().copied();
    let again = || Opened::open(Box::new(folder.clone()), CONFIG);
    use_pages(opened, false);
    if let Ok(opened) = again() {
        use_pages(opened, true);
    }
    if let (Ok(opened), Some(to)) = (again(), to) {
        let _ = opened.commits.rollback(to);
        let _ = again();
    }
}

const PAGES: PagerConfig = PagerConfig {
    page_rows: PAGE_ROWS,
    sh_degree: 3,
    frames: 8,
    policy: EvictPolicy::FarthestNextUse,
    prefetch_bytes: 0,
    plan_bytes: 0,
    transfers: Transfers::Overlap,
};

/// The pages of a map over an engine without segments.
fn store_of(opened: &Opened) -> Option<PagedStore> {
    let layout = SlotLayout { slot_bytes: PAGES.frame_bytes() as u64, slots_per_segment: 4 };
    opened.paged_store(Box::new(MemoryEngine::new()), layout, Codec::Raw).ok()
}

/// Opens the pages, if the map allows it, and commits once more: with the pages, or without any.
fn use_pages(mut opened: Opened, without: bool) {
    let Some(mut store) = store_of(&opened) else { return };
    if without {
        let gone = opened.pages.iter().map(|p| PageChange { page: p.page, version: None });
        let cut = Cut { changes: &gone.collect::<Vec<_>>(), run_state: b"", note: b"", pin: Some("x") };
        let _ = opened.commits.commit(&mut store, &mut Vec::new(), &cut);
        return;
    }
    let Ok(mut pager) = Pager::open(PAGES, store, &opened.pages, 2) else { return };
    assert!(pager.index().iter().all(|meta| meta.rows > 0));
    if pager.flush().is_ok() {
        let _ = pager.commit(&mut opened.commits, b"", b"", None);
    }
}

/// Values of every kind: of two photos, the second of which has moved, and was looked at: it is black, and its picture has one white block.
fn photos() -> SavedValues {
    let mut poses = PoseState::new(2);
    poses.learn(1, &[0.0, 1.0, -0.5, 0.25, 0.25, 0.25], 1.5, 1e-3);
    let photo = image::Target::new([8, 32], vec![0; 3 * 256]);
    let picture: Vec<f32> = (0..3 * 256).map(|i| f32::from(u8::from(i % 256 / 8 < 4 && i % 8 < 4))).collect();
    let values = [
        ("appearance", Encoded::of(&(AppearanceState::new(&[0, 1]), 2u32, 5u32))),
        ("outliers", Encoded::of(&ViewOutliers::new(2))),
        ("blocks", Encoded::of(&vec![Vec::new(), look(&[], &picture, &photo).unwrap()])),
        ("poses", Encoded::of(&poses)),
    ];
    values.map(|(name, values)| (name.to_string(), values.unwrap())).into()
}

fn sample() -> RunState {
    let thresholds =
        RoundThresholds { grow_grad2d: f32::INFINITY, split_scale: 0.5, prune_opacity: -0.0, prune_scale: 2.0 };
    let events = vec![
        Event { step: 4, kind: EventKind::RaiseShDegree { degree: 1 } },
        Event { step: 4, kind: EventKind::Densify(thresholds) },
        Event { step: 8, kind: EventKind::ResetOpacity { max_opacity: 0.01 } },
    ];
    let check = |step, gaussians, decision| GrowthCheck {
        step,
        gaussians,
        psnr: 20.0,
        trained_psnr: 20.0,
        ssim: 0.5,
        trained_ssim: 0.5,
        decision,
        allowed: 10,
    };
    RunState {
        origin: Origin {
            config: "steps = 20\n".to_string(),
            simd: "avx2".to_string(),
            sh_degree_start: 0,
            dataset: DatasetPrint {
                views: vec![ViewPrint { pose: 5, photo: u64::MAX }],
                first_rows: 7,
                points: 3,
                scene_scale: 1.25,
                origin: [5e5, -1.0, 0.0],
                scale: 2.5,
            },
            run: RunIdentity {
                id: "00112233445566778899aabbccddeeff".parse().unwrap(),
                out: "/a".into(),
                scene: "/b".into(),
            },
        },
        device: "cpu".to_string(),
        trainer: TrainerState {
            step: 9,
            rows_skipped: 1,
            steps_skipped: 2,
            steps_skipped_in_a_row: 1,
            idle: IdleSteps { steps: 4, masked: 3, with_rows: 2, with_drawn: 1 },
            train_seconds: 0.1,
            test: Some(LastTest { step: 8, views: 2, psnr: 20.5, ssim: 0.75 }),
            growth: GrowthState {
                first: 7,
                checks: vec![check(5, 7, GrowthDecision::Doubles), check(8, 10, GrowthDecision::Ends)],
            },
        },
        photos: photos(),
        events,
        histogram: vec![(3, 1), (32767, 9)],
        rows: 10,
        rows_bound: 12,
        metrics_bytes: 1234,
        traffic: PagerStats { bytes_read: 9, ..PagerStats::default() },
    }
}

fn check_state(state: &RunState) {
    assert!(state.event_log().is_ok() && state.rows <= state.rows_bound);
    GradHistogram::from_filled(&state.histogram);
    let bytes = state.to_bytes().unwrap();
    assert_eq!(RunState::from_bytes(&bytes).unwrap().to_bytes().unwrap(), bytes);
}

/// Mode 0: a run state. Other modes: small values of the map, as the decoding library reads them.
pub fn run_state() -> Target {
    let state = sample().to_bytes().unwrap();
    let mut long = sample();
    long.origin.dataset.views = (0..300).map(|pose| ViewPrint { pose, photo: 1 }).collect();
    long.origin.config = "a = 1\n".repeat(100);
    let texts = (7u64, vec!["abc".to_string(), "d".to_string()], Some(vec![1u8, 2]));
    let seeds = vec![
        with_mode(0, &state),
        with_mode(0, &long.to_bytes().unwrap()),
        with_mode(1, &encoding::to_bytes(&texts).unwrap()),
    ];
    Target { name: "run_state", run: run_run_state, seeds, words: &[], cases: 40_000, memory: [3 << 20, 40] }
}

fn run_run_state(input: &[u8]) {
    let (mode, rest) = super::split_mode(input);
    if mode == 1 {
        type Texts = (u64, Vec<String>, Option<Vec<u8>>);
        if let Ok(value) = encoding::from_bytes::<Texts>(rest) {
            assert_eq!(encoding::to_bytes(&value).unwrap(), rest);
        }
        return;
    }
    match RunState::from_bytes(rest) {
        Ok(state) => check_state(&state),
        Err(error) => assert!(!error.to_string().is_empty()),
    }
}

#[test]
fn states_come_back_and_other_versions_do_not() {
    let _alone = ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner);
    let mut bytes = sample().to_bytes().unwrap();
    assert_eq!(RunState::from_bytes(&bytes).unwrap(), sample());
    assert!((0..bytes.len()).all(|cut| RunState::from_bytes(&bytes[..cut]).is_err()));
    for other in [0, VERSION - 1, VERSION + 1] {
        bytes[..4].copy_from_slice(&other.to_le_bytes());
        assert!(RunState::from_bytes(&bytes).is_err_and(|e| e.contains(&format!("version {other};"))));
    }
}

/// Values of appearance after a change.
fn appearance(change: fn(&mut AppearanceState)) -> SavedValues {
    let mut state = AppearanceState::new(&[0, 1]);
    change(&mut state);
    [("appearance".to_string(), Encoded::of(&(state, 0u32, 0u32)).unwrap())].into()
}

#[test]
fn impossible_states_are_refused() {
    let _alone = ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner);
    let refused = |change: fn(&mut RunState)| {
        let mut state = sample();
        change(&mut state);
        let bytes = state.to_bytes().unwrap();
        assert!(RunState::from_bytes(&bytes).is_err_and(|e| e.contains("inconsistent")));
    };
    refused(|s| s.trainer.step = 8);
    refused(|s| s.rows_bound = s.rows - 1);
    refused(|s| s.events.reverse());
    refused(|s| s.events[0].kind = EventKind::ResetOpacity { max_opacity: 0.0 });
    refused(|s| s.events[0].kind = EventKind::ResetOpacity { max_opacity: 1.0 });
    refused(|s| s.events[0].kind = EventKind::ResetOpacity { max_opacity: f32::NAN });
    refused(|s| s.origin.sh_degree_start = 4);
    refused(|s| s.histogram.reverse());
    refused(|s| s.trainer.train_seconds = f64::NAN);
    refused(|s| s.traffic.stall_seconds = -1.0);
    refused(|s| s.traffic.other_stall_seconds = f64::INFINITY);
    refused(|s| s.trainer.test = s.trainer.test.map(|t| LastTest { step: 10, ..t }));
    refused(|s| s.trainer.test = s.trainer.test.map(|t| LastTest { psnr: f64::NAN, ..t }));
    refused(|s| s.photos = appearance(|state| state.images[0].values[0] = i32::MIN));
    refused(|s| s.photos = appearance(|state| state.images[0].sightings = 1));
    refused(|s| s.photos = appearance(|state| state.cameras[1].falloff[0][0] = f64::NAN));
    refused(|s| s.photos = [("of a later program".to_string(), Encoded::default())].into());
    refused(|s| s.trainer.growth.checks.reverse());
    refused(|s| s.trainer.growth.checks[1].step = 10);
    refused(|s| s.trainer.growth.checks[0].psnr = f64::NAN);
    refused(|s| s.origin.dataset.scale = 0.0);
    refused(|s| s.origin.dataset.origin[1] = f64::INFINITY);
}
