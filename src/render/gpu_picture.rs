//! The picture of a view on a GPU: its lists, whole or in ranges of tiles, and whether it came from buffers that were large enough.
//!
//! Not here: the recording of the stages (`gpu_tiles`, `gpu_ranges`), the order of a view (`gpu`), loss and gradients (`gpu_back`).
//!
//! Invariant: a picture whose lists lacked room is drawn again, and so is its loss, before anything of it is read.

use super::gpu::GpuRenderer;
use super::gpu_frame::{Blend, Demand, Pixels, splat_bytes};
use super::gpu_ranges::{PLACE_BYTES, Ranges};
use super::gpu_segments::Segment;
use super::gpu_view::{DemandState, Lists, LossSums, RowsIn, View, WholeLists, WholeRows, blend_of};
use super::sequence::ViewOptions;
use crate::gpu::{GpuError, GpuResult};
use crate::scene::camera::Camera;

impl GpuRenderer {
    /// Frees device memory that a view can do without: the columns of its rows, then its lists. Returns whether it did.
    pub(super) fn give_back(&mut self, view: &mut View) -> GpuResult<bool> {
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
    pub(super) fn draw_in_ranges(&self, view: &mut View) -> GpuResult<()> {
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
    pub(super) fn submit_picture(&mut self, of: ViewOptions, rows: RowsIn) -> GpuResult<View> {
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
            // Without a frame, the colours at least.
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
    pub(super) fn wait_for_valid_picture(&mut self, view: &mut View) -> GpuResult<()> {
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
            loss.sums = self.submit_loss(self.gpu.begin("image_loss"), size, &view.pixels.rgb, loss)?;
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

    pub(super) fn read_image(&mut self, view: &View) -> GpuResult<()> {
        let Camera { width, height, .. } = view.of.camera;
        let mut recorder = self.gpu.begin("picture");
        let bytes = recorder.read_back("rasterize_fwd", &view.pixels.rgb.view())?;
        self.gpu.submit(recorder)?;
        (self.image.width, self.image.height) = (width, height);
        self.image.rgb.resize(3 * view.of.camera.pixels(), 0.0);
        bytes.copy_to(&mut self.image.rgb)
    }
}
