//! Pages in a row along x, cameras that see some of them, and a plain model of the contents of every page.

use crate::support::faulty_engine::{Faults, FaultyEngine};
use gsscale::base::ids::{PageId, PageNo};
use gsscale::base::rng::{Purpose, Stream, mix64};
use gsscale::page::engine::memory::MemoryEngine;
use gsscale::page::engine::page_engine::PageEngine;
use gsscale::page::format::codec::Codec;
use gsscale::page::format::slot_header::HEADER_BYTES;
use gsscale::page::versions::paged_store::{PagedStore, PagedStoreConfig};
use gsscale::page::versions::slots::SlotLayout;
use gsscale::paging::error::PagingError;
use gsscale::paging::pager::{Pager, PagerConfig};
use gsscale::paging::pinned::PinnedPage;
use gsscale::scene::camera::Camera;
use gsscale::scene::page_layout::{PageLayout, capacity_bytes};
use gsscale::scene::page_meta::{PageBounds, PageMeta};
use gsscale::schedule::visibility::visible_pages;
use std::collections::BTreeMap;

pub const PAGE_ROWS: usize = 6;
pub const SH_DEGREE: u8 = 1;

pub fn config(frames: usize) -> PagerConfig {
    let in_memory = PagerConfig::in_memory(PAGE_ROWS, SH_DEGREE);
    PagerConfig { frames, prefetch_bytes: 8 * 8192, plan_bytes: 1 << 20, ..in_memory }
}

/// A store in memory that fails as `faults` says.
pub fn store(codec: Codec, faults: &Faults) -> PagedStore {
    store_over(Box::new(FaultyEngine::new(Box::new(MemoryEngine::new()), faults.clone())), codec)
}

pub fn store_over(engine: Box<dyn PageEngine>, codec: Codec) -> PagedStore {
    let layout = SlotLayout::new(capacity_bytes(PAGE_ROWS, SH_DEGREE), 16);
    PagedStore::new(engine, PagedStoreConfig { store: 5, layout, codec, generation: 1, serial: 0 })
}

/// Inserts `pages` pages of three rows each, in a row along x.
pub fn insert_pages(pager: &mut Pager, pages: u32) {
    for i in 0..pages {
        let meta = meta(PageId::initial(i), f64::from(i), 3, 1);
        pager.insert(meta, |payload| fill(payload, &meta, 0)).unwrap();
    }
}

pub fn camera(x: f64) -> Camera {
    let viewmat = [[1.0, 0.0, 0.0, -x as f32], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
    Camera::pinhole(viewmat, [100.0, 100.0, 50.0, 50.0], [100, 100])
}

/// A page of `rows` rows at `x`.
pub fn meta(id: PageId, x: f64, rows: u32, sh_degree: u8) -> PageMeta {
    let bounds = PageBounds { lo: [x as f32, -1.0, 5.0], hi: [x as f32 + 0.5, 1.0, 6.0], sigma_max: 0.01 };
    let bounds = if rows == 0 { PageBounds::EMPTY } else { bounds };
    PageMeta { id, rows, sh_degree, events_applied: 0, bounds }
}

pub fn payload_bytes(meta: &PageMeta) -> usize {
    PageLayout { rows: meta.rows as usize, sh_degree: meta.sh_degree }.bytes()
}

/// Fills a payload with bytes that no other version of any page has.
pub fn fill(payload: &mut [u8], meta: &PageMeta, version: u64) {
    let key = mix64(meta.id.to_bits() ^ mix64(version));
    for (i, b) in payload[..payload_bytes(meta)].iter_mut().enumerate() {
        *b = mix64(key ^ i as u64) as u8;
    }
}

/// Metadata and version of every page, by id.
pub type Model = BTreeMap<PageId, (PageMeta, u64)>;

pub fn check(page: &PinnedPage, model: &Model) {
    let (meta, version) = model[&page.meta.id];
    assert_eq!(page.meta, meta);
    let mut want = vec![0; payload_bytes(&meta)];
    fill(&mut want, &meta, version);
    let got = &page.buffer.as_slice()[HEADER_BYTES..][..want.len()];
    assert!(got == want, "page {} does not hold its version {version}", meta.id);
}

/// Ids of the pages that a view needs according to the model.
pub fn needed(model: &Model, camera: &Camera) -> Vec<PageId> {
    let metas: Vec<PageMeta> = model.values().map(|(meta, _)| *meta).collect();
    let mut pages = Vec::new();
    visible_pages(&metas, camera, &mut pages);
    pages.iter().map(|p| metas[p.index()]).filter(|m| m.rows > 0).map(|m| m.id).collect()
}

/// A run of random steps. The same seed gives the same steps for any pager.
pub struct Run {
    pub pager: Pager,
    pub model: Model,
    pub step: u32,
    seed: u64,
    version: u64,
    pub cameras: Vec<Camera>,
}

impl Run {
    /// `pages` pages, `steps` steps.
    pub fn new(mut pager: Pager, seed: u64, pages: u32, steps: usize) -> Result<Run, PagingError> {
        let mut draws = Stream::new(seed, Purpose::Test, 1, 1);
        let mut model = Model::new();
        for i in 0..pages {
            let rows = draws.below(PAGE_ROWS as u64 + 1) as u32;
            let meta = meta(PageId::initial(i), f64::from(i), rows, draws.below(2) as u8);
            pager.insert(meta, |payload| fill(payload, &meta, 0))?;
            model.insert(meta.id, (meta, 0));
        }
        // Views wander, so that steps share pages, and jump occasionally.
        let mut x = 0.0;
        let mut cameras = Vec::new();
        for _ in 0..steps {
            let far = draws.below(6) == 0;
            x = if far { draws.range(-3.0, f64::from(pages)) } else { x + draws.range(-1.5, 1.5) };
            cameras.push(camera(x));
        }
        Ok(Run { pager, model, step: 0, seed, version: 0, cameras })
    }

    /// One step: pages are acquired, compared, changed, split or emptied, and released.
    pub fn step(&mut self) -> Result<(), PagingError> {
        let mut draws = Stream::new(self.seed, Purpose::Test, 2, u64::from(self.step));
        let first = self.step as usize;
        let ahead = (draws.below(12) as usize).min(self.cameras.len() - first);
        let coming: Vec<&Camera> = self.cameras[first..first + ahead].iter().collect();
        self.pager.look_ahead(self.step, &coming);
        let camera = self.cameras[first];
        let mut pages = self.pager.acquire(self.step, &camera)?;
        let ids: Vec<PageId> = pages.iter().map(|p| p.meta.id).collect();
        assert_eq!(ids, needed(&self.model, &camera), "step {}", self.step);
        pages.iter().for_each(|page| check(page, &self.model));
        (0..draws.below(3)).for_each(|_| self.pager.prefetch(self.step));
        let mut upper = Vec::new();
        for page in &mut pages {
            match draws.below(12) {
                0 => match self.split(page) {
                    Ok(half) => upper.push(half),
                    Err(error) => {
                        pages.extend(upper);
                        self.pager.release(pages);
                        return Err(error);
                    }
                },
                1 if self.model.len() > 20 => self.change(page, 0, &mut draws),
                2..8 => {
                    let rows = 1 + draws.below(PAGE_ROWS as u64) as u32;
                    self.change(page, rows, &mut draws);
                }
                _ => {}
            }
        }
        let rest = pages.split_off(pages.len() / 2);
        self.pager.release(rest);
        pages.extend(upper);
        self.pager.release(pages);
        self.step += 1;
        Ok(())
    }

    fn change(&mut self, page: &mut PinnedPage, rows: u32, draws: &mut Stream) {
        self.version += 1;
        let x = f64::from(page.meta.bounds.lo[0]) + draws.range(-0.7, 0.7);
        page.meta = meta(page.meta.id, x, rows, draws.below(2) as u8);
        page.dirty = true;
        let meta = page.meta;
        fill(page.payload_mut(), &meta, self.version);
        self.model.insert(meta.id, (meta, self.version));
    }

    fn split(&mut self, page: &mut PinnedPage) -> Result<PinnedPage, PagingError> {
        let mut buffer = self.pager.take_frame()?;
        let Some([low, high]) = page.meta.id.children() else { panic!("too many splits in a row") };
        self.model.remove(&page.meta.id);
        self.version += 1;
        let x = f64::from(page.meta.bounds.lo[0]);
        let (lower, upper) = (meta(low, x, 1, 1), meta(high, x + 0.2, 2, 0));
        fill(page.payload_mut(), &lower, self.version);
        fill(&mut buffer.as_mut_slice()[HEADER_BYTES..], &upper, self.version);
        (page.meta, page.dirty) = (lower, true);
        self.model.insert(low, (lower, self.version));
        self.model.insert(high, (upper, self.version));
        Ok(self.pager.add_split(upper, buffer))
    }

    /// Checks every page, a few at a time, as an export reads them.
    pub fn check_all(&mut self, at_once: usize) -> Result<(), PagingError> {
        let pages: Vec<PageNo> = (0..self.pager.index().len() as u32).map(PageNo).collect();
        assert_eq!(pages.len(), self.model.len());
        for some in pages.chunks(at_once) {
            let pinned = self.pager.acquire_pages(some)?;
            assert_eq!(pinned.len(), some.iter().filter(|p| self.pager.index()[p.index()].rows > 0).count());
            pinned.iter().for_each(|page| check(page, &self.model));
            self.pager.release(pinned);
        }
        Ok(())
    }
}
