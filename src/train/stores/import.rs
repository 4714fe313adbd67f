//! Imports the Gaussians of a PLY of any size as a new store.
//!
//! Rows pass through files beside the store into pages, as a run's first Gaussians do. Values equal those of the file,
//! bit for bit, in the file's own frame; an upright file is turned back to the axes of its dataset, and an export turns it
//! upright again. Moments are zero; no step is done.
//!
//! Invariants: 1. memory is bounded by the budget; 2. pages are a function of the file and `page_rows` alone; 3. the
//! store is written whole or not at all.

use crate::base::error::{InputError, InputResult};
use crate::base::ids::PageId;
use crate::base::machine::host_bytes_peak;
use crate::base::units::{MIB, format_bytes, format_bytes_up};
use crate::base::whole_file::folder_of;
use crate::checkpoint::run_state::{DatasetPrint, Origin, RunIdentity, RunState};
use crate::config::file::TrainConfig;
use crate::config::limits::{self, RunOptions};
use crate::config::values::Up;
use crate::dataset::import::Budget;
use crate::exchange::frames::rotate_back;
use crate::exchange::meta::{ExportFrame, SceneMeta};
use crate::exchange::ply::{gaussians_header, holds_gaussians};
use crate::page::format::codec::Codec;
use crate::page::map::commit::CommitError;
use crate::page::tool::new_store::{NewStore, claim_new_store};
use crate::page::versions::slots::SlotLayout;
use crate::paging::stored::label;
use crate::scene::page_layout::{PageLayout, capacity_bytes, write_page};
use crate::scene::partition::first_fill;
use crate::scene::rotation::VIEWER_UP;
use crate::scene::state::SceneState;
use crate::train::error::TrainError;
use crate::train::inputs::dataset_print::GaussiansPrint;
use crate::train::inputs::gaussian_pages::{GaussianWriter, PositionSample, file_warnings, stream_columns};
use crate::train::inputs::signals::StopFlag;
use crate::train::step::pages::SceneRules;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Memory besides the rows: threads, the store's buffers and its map, bytes.
const FIXED_BYTES: u64 = 48 * MIB;

#[derive(Debug, Clone)]
pub struct ImportRequest {
    /// The PLY of Gaussians.
    pub file: PathBuf,
    /// The new store, a folder that does not exist.
    pub out: PathBuf,
    /// Memory, bytes.
    pub host_mem: u64,
    /// Capacity of a page, rows.
    pub page_rows: u32,
    pub codec: Codec,
}

#[derive(Debug, Clone, Serialize)]
pub struct Imported {
    /// The new folder.
    pub store: PathBuf,
    pub gaussians: u64,
    /// Dropped Gaussians with non-finite values.
    pub dropped: u64,
    pub pages: u64,
    pub sh_degree: u8,
    /// Peak memory of the process, bytes.
    pub host_bytes_peak: u64,
}

/// Imports a PLY.
/// Errors: the file cannot be read or holds no Gaussians, the budget is too small, or the folder cannot be written. No
/// store is left then.
pub fn import(request: &ImportRequest, stop: &StopFlag) -> Result<Imported, TrainError> {
    claim_new_store(&request.out)?;
    if !holds_gaussians(&request.file)? {
        let remedy = "train on points with gsscale-train --init-ply";
        return Err(InputError::new(&request.file, "it holds points, not Gaussians", remedy).into());
    }
    let budget = Budget { folder: folder_of(&request.out), bytes: memory_for_rows(request)? };
    let mut rows = GaussianWriter::new(&request.file, budget);
    let (meta, radius, points) = read_rows(&request.file, &mut rows, stop)?;
    file_warnings(&request.file, &meta, 0).iter().for_each(|warning| crate::tell!("warning: {warning}"));
    let rows = rows.finish()?;
    let (count, sh_degree) = (rows.rows(), rows.sh_degree);
    let (config, options) = options_for(request, sh_degree, &meta)?;
    let layout =
        SlotLayout::new(capacity_bytes(options.page_rows, sh_degree), count.div_ceil(options.page_rows) as u64);
    let mut pages = PageWriter {
        store: NewStore::create(&request.out, layout, request.codec)?,
        rules: SceneRules::new(&options),
        payload: vec![0; capacity_bytes(options.page_rows, sh_degree).div_ceil(8)],
        pages: 0,
        failed: None,
    };
    let fill = first_fill(options.page_rows, options.strategy.grows());
    let written = rows.for_each_page(fill, &mut |id, state| {
        stop.check()?;
        pages.write(id, &state)
    });
    match pages.failed.take() {
        Some(error) => return Err(error),
        None => written?,
    }
    let state = first_state(&config, (&meta, radius), (count as u64, points), sh_degree)?;
    pages.store.commit(&state, format!("imported from {}", request.file.display()).as_bytes(), &[])?;
    let number = u64::from(pages.pages);
    pages.store.finish()?;
    Ok(Imported {
        store: request.out.clone(),
        gaussians: count as u64,
        dropped: meta.dropped,
        pages: number,
        sh_degree,
        host_bytes_peak: host_bytes_peak().unwrap_or(0),
    })
}

/// Streams the Gaussians of `file` into `rows`, in the axes of their dataset. Returns the metadata, the size of the scene in
/// the units of the file, which no file states, and the digest of the Gaussians.
fn read_rows(file: &Path, rows: &mut GaussianWriter<'_>, stop: &StopFlag) -> InputResult<(SceneMeta, f32, u64)> {
    let (header, sh_degree) = gaussians_header(file)?;
    let (mut sample, mut print) = (PositionSample::default(), GaussiansPrint::default());
    let meta = stream_columns(file, sh_degree, &mut |mut columns| {
        stop.check()?;
        rotate_back(&mut columns, &header);
        sample.add(&columns.means);
        print.add(&columns);
        rows.push_all(&columns)
    })?;
    Ok((meta, sample.radius().unwrap_or(1.0), print.digest()))
}

/// Encodes rows as pages and stores them.
struct PageWriter {
    store: NewStore,
    rules: SceneRules,
    /// As u64, so that tables are aligned.
    payload: Vec<u64>,
    pages: u32,
    failed: Option<TrainError>,
}

impl PageWriter {
    fn write(&mut self, id: PageId, state: &SceneState) -> InputResult<()> {
        let payload: &mut [u8] = bytemuck::cast_slice_mut(&mut self.payload);
        let layout: PageLayout = write_page(state, payload);
        let meta = self.rules.meta(id, state);
        self.pages += 1;
        self.store.put(id, &label(&meta), &payload[..layout.bytes()]).map_err(|error| {
            let told = InputError::new("the new store", error.to_string(), "see the cause");
            self.failed = Some(error.into());
            told
        })
    }
}

/// Memory for rows in transfer, bytes.
fn memory_for_rows(request: &ImportRequest) -> InputResult<usize> {
    // Pages in flight, and one being encoded.
    let pages = 20 * capacity_bytes(request.page_rows as usize, 3) as u64;
    let least = FIXED_BYTES + pages + 16 * MIB;
    if request.host_mem < least {
        let problem = format!("{} is not enough", format_bytes(request.host_mem));
        return Err(InputError::new("--host-mem", problem, format!("give at least {}", format_bytes_up(least))));
    }
    Ok((request.host_mem - FIXED_BYTES - pages) as usize)
}

/// Default config and options for Gaussians at their full SH degree.
fn options_for(request: &ImportRequest, sh_degree: u8, meta: &SceneMeta) -> InputResult<(TrainConfig, RunOptions)> {
    let config = TrainConfig {
        page_rows: request.page_rows,
        sh_degree,
        sh_every: 0,
        init_ply: std::path::absolute(&request.file).unwrap_or_else(|_| request.file.clone()).display().to_string(),
        export_frame: meta.frame,
        up: meta.upright.map_or(Up::Keep, |upright| Up::Along(upright.inverse().apply(VIEWER_UP))),
        ..TrainConfig::default()
    };
    config.check()?;
    let options = RunOptions { sh_degree_start: sh_degree, ..RunOptions::new(&config, 1.0) };
    Ok((config, options))
}

/// The run state before the first step.
fn first_state(
    config: &TrainConfig,
    (meta, scene_scale): (&SceneMeta, f32),
    (rows, points): (u64, u64),
    sh_degree: u8,
) -> Result<Vec<u8>, TrainError> {
    let (origin, scale) = match meta.frame {
        ExportFrame::Local => (meta.origin, meta.scale),
        ExportFrame::Dataset => ([0.0; 3], 1.0),
    };
    let text = toml::to_string(config).map_err(|e| CommitError::Contradiction(e.to_string()))?;
    let dataset = DatasetPrint { views: Vec::new(), first_rows: rows, points, scene_scale, origin, scale };
    let simd = limits::simd_path(config).name().to_string();
    let origin = Origin { config: text, simd, sh_degree_start: sh_degree, dataset, run: RunIdentity::default() };
    let state = RunState::without_history(origin, "none".to_string(), rows);
    Ok(state.to_bytes().map_err(CommitError::Contradiction)?)
}
