//! From the rows of a view to its picture and its loss on a GPU: the recording of the rows, lists, whole or in ranges of tiles,
//! and whether the picture came from buffers that were large enough.
//!
//! Not here: the recording of each stage (`gpu_rows`, `gpu_tiles`, `gpu_ranges`, `gpu_loss`), the order of a view (`gpu`), the way
//! back (`gpu_back`).
//!
//! Invariant: a picture whose lists lacked room is drawn again, and so is its loss, before anything of it is read.

use super::gpu_frame::{Blend, Demand, Pairs, Pixels, splat_bytes};
use super::gpu_loss::LossStage;
use super::gpu_ranges::{PLACE_BYTES, RangeStages, Ranges};
use super::gpu_rows::{DeviceColumns, RowSource, RowStages, SplatRows};
use super::gpu_segments::{Segment, submit_rows};
use super::gpu_tiles::TileStages;
use super::gpu_view::{DemandState, Lists, Loss, LossSums, RowsIn, View, WholeLists, WholeRows, blend_of};
use super::sequence::ViewOptions;
use crate::gpu::{Buffer, Gpu, GpuError, GpuResult, Recorder};
use crate::kernels::splats::Grid;
use crate::kernels::tile_range::TileRange;

/// A device with the compiled stages of a view.
#[derive(Debug)]
pub(super) struct ViewStages {
    pub gpu: Gpu,
    pub rows: RowStages,
    pub tiles: TileStages,
    pub ranges: RangeStages,
    pub loss: LossStage,
    /// Frames so far that were recorded again because a buffer was too small.
    pub frames_rerecorded: u64,
}

impl ViewStages {
    /// Compiles the stages for `gpu`.
    pub fn new(gpu: Gpu) -> GpuResult<Self> {
        Ok(ViewStages {
            rows: RowStages::new(&gpu)?,
            tiles: TileStages::new(&gpu)?,
            ranges: RangeStages::new(&gpu)?,
            loss: LossStage::new(&gpu)?,
            gpu,
            frames_rerecorded: 0,
        })
    }

    /// Submits rows, projection and depth sort of a view of one batch; records the colours. Does not wait.
    fn submit_whole(&self, rows: &mut dyn RowSource, view: &ViewOptions) -> GpuResult<RowsIn> {
        let gpu = &self.gpu;
        let ViewOptions { camera, options } = view;
        // `Sequence::rows_in` has checked that the count fits.
        let (count, all) = (rows.rows() as u32, 0..rows.rows());
        let columns = DeviceColumns::new(gpu, count, options.sh_degree)?;
        let splats = gpu.buffer("splats", splat_bytes(count))?;
        let mut recorder = gpu.begin("forward");
        rows.geometry(gpu, &mut recorder, &columns, &all)?;
        let into = SplatRows::from(&splats);
        let keys = Pairs::new(gpu, count)?;
        self.rows.project_fwd(gpu, &mut recorder, camera, options.eps2d, &columns, into, Some(&keys))?;
        let grid = Grid::new(camera.width, camera.height);
        let ranks =
            self.tiles.order(gpu, &mut recorder, &splats.view(), count, grid, TileRange::all(grid), Some(keys))?;
        gpu.submit(recorder)?;
        // The device projects and sorts during the upload of the colours, four fifths of a row.
        let mut recorder = gpu.begin("forward");
        rows.colors(&mut recorder, &columns, &all)?;
        self.rows.sh_fwd(gpu, &mut recorder, camera, &columns, into)?;
        let whole = Box::new(WholeRows { columns, ranks, colors: recorder.set_aside() });
        let segment = Segment { first: 0, rows: count, splats, v_splats: None };
        Ok(RowsIn { segments: vec![segment], whole: Some(whole) })
    }

    /// Submits the rows of a batch, which begins at row `first` of the view: in one piece if `is_whole` and memory allow, else in
    /// chunks.
    pub fn submit_batch(
        &self,
        rows: &mut dyn RowSource,
        view: &ViewOptions,
        first: usize,
        is_whole: bool,
    ) -> GpuResult<RowsIn> {
        if is_whole {
            match self.submit_whole(rows, view) {
                Err(error) if error.is_out_of_memory() => {}
                submitted => return submitted,
            }
        }
        let segments = submit_rows(&self.gpu, &self.rows, rows, first, view)?;
        Ok(RowsIn { segments, whole: None })
    }

    /// Frees device memory that a view can do without: the columns of its rows, then its lists. Returns whether it did.
    pub fn give_back(&mut self, view: &mut View) -> GpuResult<bool> {
        if view.columns.take().is_some() {
            return Ok(true);
        }
        if matches!(view.lists, Lists::Ranges(_)) {
            return Ok(false);
        }
        self.wait_for_valid_picture(view)?;
        if matches!(view.lists, Lists::Whole(_)) {
            self.draw_in_ranges(view)?;
        }
        Ok(true)
    }

    /// The stages on ranges of tiles.
    fn in_ranges<'a>(&'a self, of: &ViewOptions, pixels: &'a Pixels) -> Ranges<'a> {
        Ranges { gpu: &self.gpu, tiles: &self.tiles, stages: &self.ranges, blend: blend_of(of), pixels }
    }

    /// Replaces the lists of a view by ranges of tiles and draws the picture again. Waits.
    pub fn draw_in_ranges(&self, view: &mut View) -> GpuResult<()> {
        view.lists = Lists::Ranges(Vec::new()); // frees the lists
        let bytes = self.bytes_for_lists(&view.of, &view.segments);
        view.lists = Lists::Ranges(self.in_ranges(&view.of, &view.pixels).draw(&view.segments, bytes)?);
        Ok(())
    }

    /// Device memory for the lists of a range, after a reserve for later buffers of the view: gradients of the splats,
    /// places of the rows, and the photo, the gradient and the derivatives of the loss.
    fn bytes_for_lists(&self, of: &ViewOptions, segments: &[Segment]) -> u64 {
        let rows: u64 =
            segments.iter().map(|segment| splat_bytes(segment.rows) + PLACE_BYTES * u64::from(segment.rows)).sum();
        let reserved = (rows + (12 + 12 + 4) * of.camera.pixels() as u64) / 4 * 5;
        // The reserve is an estimate: without room beside it, lists may still fit.
        let room = self.gpu.room();
        room.saturating_sub(reserved).max(room / 8)
    }

    /// Submits the recorded stages of the rows, the tile lists and the blending. Waits only if the lists do not fit at
    /// once.
    pub fn submit_picture(&mut self, of: ViewOptions, rows: RowsIn) -> GpuResult<View> {
        let (gpu, blend) = (&self.gpu, blend_of(&of));
        let RowsIn { segments, whole } = rows;
        if let (Some(whole), Some(segment)) = (whole, segments.first()) {
            let WholeRows { columns, ranks, colors } = *whole;
            let mut recorder = gpu.resume(colors);
            let recorded = Pixels::new(gpu, blend.grid).and_then(|pixels| {
                let splats = segment.splats.view();
                let frame = self.tiles.frame(gpu, &mut recorder, &splats, &ranks, blend, &pixels)?;
                Ok((pixels, frame))
            });
            // Submit the colours in any case: the picture in ranges needs them.
            gpu.submit(recorder)?;
            match recorded {
                Ok((pixels, (frame, demand))) => {
                    let lists = WholeLists { ranks, frame, demand: DemandState::Pending(Box::new(demand)) };
                    return Ok(View::new(of, segments, Some(columns), pixels, Lists::Whole(Box::new(lists))));
                }
                // Smaller views may need less than the largest so far.
                Err(error) if error.is_out_of_memory() => self.tiles.halve_capacity(),
                Err(error) => return Err(error),
            }
        }
        let gpu = &self.gpu;
        let pixels = Pixels::new(gpu, blend.grid)?;
        let mut view = View::new(of, segments, None, pixels, Lists::Ranges(Vec::new()));
        self.draw_in_ranges(&mut view)?;
        Ok(view)
    }

    /// Waits until the picture of the view is known to be valid. A frame with too little room is recorded again with larger
    /// buffers, or drawn in ranges where these do not fit, and so is the loss of its picture.
    pub fn wait_for_valid_picture(&mut self, view: &mut View) -> GpuResult<()> {
        let blend = view.blend();
        while let Lists::Whole(lists) = &mut view.lists {
            let unread = DemandState::Known(Demand { isects: 0, list_max: 0 });
            let demand = match std::mem::replace(&mut lists.demand, unread) {
                DemandState::Known(demand) => demand,
                DemandState::Pending(readback) => {
                    let demand = readback.wait()?;
                    self.tiles.note(demand);
                    demand
                }
            };
            lists.demand = DemandState::Known(demand);
            let fits = self.tiles.fits(&lists.frame, demand);
            if let Ok(true) = fits {
                break;
            }
            if let Some(loss) = &mut view.loss {
                loss.sums = LossSums::Stale;
            }
            self.frames_rerecorded += 1;
            let recorded = fits.and_then(|_| self.frame_again(view, blend));
            match recorded {
                Ok(()) => {}
                Err(error) if error.is_out_of_memory() => {
                    self.tiles.halve_capacity();
                    view.columns = None;
                    self.draw_in_ranges(view)?;
                }
                Err(error) => return Err(error),
            }
        }
        if let Some(loss) = view.loss.as_mut().filter(|loss| matches!(loss.sums, LossSums::Stale)) {
            let size = [view.of.camera.width, view.of.camera.height];
            loss.sums =
                self.submit_loss(self.gpu.begin("image_loss"), size, &view.pixels.rgb, loss, view.is_recorded)?;
        }
        Ok(())
    }

    /// Records lists and blending again, with buffers of the sizes that are known now.
    fn frame_again(&self, view: &mut View, blend: Blend) -> GpuResult<()> {
        let whole = (std::mem::replace(&mut view.lists, Lists::Ranges(Vec::new())), view.segments.first());
        let (Lists::Whole(lists), Some(segment)) = whole else {
            let problem = "a view without whole lists has no frame to record again".to_string();
            return Err(GpuError::Bindings { stage: "forward".to_string(), problem });
        };
        let WholeLists { ranks, frame, .. } = *lists;
        drop(frame); // frees memory for the larger frame
        let mut recorder = self.gpu.begin("forward again");
        let splats = segment.splats.view();
        let (frame, demand) = self.tiles.frame(&self.gpu, &mut recorder, &splats, &ranks, blend, &view.pixels)?;
        self.gpu.submit(recorder)?;
        view.lists =
            Lists::Whole(Box::new(WholeLists { ranks, frame, demand: DemandState::Pending(Box::new(demand)) }));
        Ok(())
    }

    /// Submits the loss of `rgb`: the picture of the view, which may still turn out invalid, or the corrected picture. Writes the
    /// gradient of `loss`, and returns its sums.
    pub fn submit_loss(
        &self,
        mut recorder: Recorder<'_>,
        size: [u32; 2],
        rgb: &Buffer,
        loss: &Loss,
        is_recorded: bool,
    ) -> GpuResult<LossSums> {
        let gpu = &self.gpu;
        let (rgb, photo, v_rgb) = (rgb.view(), loss.target.view(), loss.v_rgb.view());
        let sums = self.loss.run(gpu, &mut recorder, size, &loss.plan, &rgb, &photo, &v_rgb)?;
        if let Some(errors) = &loss.errors {
            self.loss.errors(&mut recorder, size, &loss.plan, [&rgb, &photo, &errors.view()])?;
        }
        let sums = match sums {
            Some(sums) if is_recorded => LossSums::OnDevice(sums),
            Some(sums) => LossSums::Pending(recorder.read_back("image_loss", &sums.slice(0, 16))?),
            None => LossSums::Known([0.0; 4]),
        };
        gpu.submit(recorder)?;
        Ok(sums)
    }
}
