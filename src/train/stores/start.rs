//! A store as the start of a new run: the Gaussians of its last generation, page by page, in the local frame of the new
//! run. Moments, statistics and events are dropped.
//!
//! Invariant: memory is bounded by the budget for any size of scene.

use super::export::scene_at;
use super::{find_store, options_of, run_state_of};
use crate::base::error::{InputError, InputResult};
use crate::base::ids::PageNo;
use crate::checkpoint::run_state::RunState;
use crate::exchange::frames::to_local;
use crate::exchange::meta::{ExportFrame, SceneMeta};
use crate::page::tool::reading::{Access, StoreReader};
use crate::scene::columns::Columns;
use crate::scene::state::SceneState;
use crate::train::error::TrainError;
use crate::train::inputs::gaussian_pages::truncate_sh;
use crate::train::step::catch_up::evaluate_all;
use crate::train::step::pages::PagedScene;
use std::path::{Path, PathBuf};
use xxhash_rust::xxh3::xxh3_64;

/// An opened store.
pub struct StoredStart {
    folder: PathBuf,
    scene: PagedScene,
    state: RunState,
    /// Holds the lock that excludes writers.
    _store: StoreReader,
}

impl StoredStart {
    /// Opens the last generation of the store in `dir`, which may be the output folder of a run.
    /// Errors: the store cannot be opened or is in use, or 1/`share` of the budget is too small for it.
    pub fn open(dir: &Path, host_mem: u64, share: u64) -> Result<StoredStart, TrainError> {
        let place = find_store(dir)?;
        let store = place.open(Access::Pages)?;
        let folder = place.folder;
        let generation = store.find(None)?;
        let state = run_state_of(&store, generation)?;
        let (_, options) = options_of(&folder, &state)?;
        let scene = scene_at(&store, generation, &state, &options, (host_mem, share), 0)?;
        Ok(StoredStart { folder, scene, state, _store: store })
    }

    /// Upper bound of its Gaussians.
    pub fn rows_at_most(&self) -> u64 {
        self.state.rows_bound
    }

    /// Digest of the start: of the run state, from which the pages follow.
    /// Errors: the state cannot be encoded.
    pub fn digest(&self) -> InputResult<u64> {
        let bytes = self.state.to_bytes();
        let bytes = bytes.map_err(|e| InputError::new(&self.folder, e, "report this as a bug"))?;
        Ok(xxh3_64(&bytes))
    }

    /// SH degree of its Gaussians.
    pub fn sh_degree(&self) -> u8 {
        self.scene.rules.sh_degree()
    }

    /// Passes first pages to `take`: at most `page_rows` rows each, in the local frame of `origin` and `scale`, with at
    /// most `sh_degree` and with their uids. May be called repeatedly.
    /// Errors: a page cannot be read or overflows f32 in the new frame, or `take` failed.
    pub fn for_each_page(
        &mut self,
        (origin, scale): ([f64; 3], f64),
        (page_rows, sh_degree): (usize, u8),
        take: &mut dyn FnMut(SceneState) -> Result<(), TrainError>,
    ) -> Result<(), TrainError> {
        let print = &self.state.origin.dataset;
        let meta =
            SceneMeta { origin: print.origin, scale: print.scale, frame: ExportFrame::Local, ..SceneMeta::default() };
        let index = self.scene.pager.index();
        let mut pages: Vec<PageNo> = (0..index.len() as u32).map(PageNo).collect();
        pages.sort_unstable_by_key(|p| index[p.index()].id);
        let now = self.state.trainer.step;
        for page in pages {
            let (mut uid, mut columns) = (Vec::new(), Columns::default());
            self.scene.visit(&[page], &[], &mut |rules, tables| {
                uid = tables.iter().flat_map(|table| table.uid).copied().collect();
                columns = evaluate_all(tables, rules.sh_degree(), &rules.adam, now);
                Ok::<(), TrainError>(())
            })?;
            if to_local(&mut columns, &meta, origin, scale) > 0 {
                let problem = "its Gaussians are too far from the cameras for f32";
                return Err(InputError::new(&self.folder, problem, "check that it is a scene of this dataset").into());
            }
            let mut state = SceneState::from_columns(truncate_sh(columns, sh_degree));
            state.raise_sh_degree(sh_degree);
            state.uid = uid;
            let rows: Vec<u32> = (0..state.rows() as u32).collect();
            rows.chunks(page_rows).try_for_each(|rows| take(state.select(rows)))?;
        }
        Ok(())
    }
}
