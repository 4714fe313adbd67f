//! [`GpuRenderer`]: the stages of a view on a GPU, forward and backward, one view at a time.
//!
//! Not here: the picture and its validity (`gpu_picture`), loss and gradients (`gpu_back`), the recording of each stage (`gpu_rows`,
//! `gpu_tiles`, `gpu_tiles_bwd`, `gpu_loss`), rows in chunks (`gpu_segments`, `gpu_gradients`), pages on the device (`gpu_paged`,
//! `gpu_update`), the picture in ranges of tiles (`gpu_ranges`), steps without waits (`gpu_recorded`), the device (`crate::gpu`).
//!
//! # Memory
//! The ordinary view keeps its rows and tile lists on the device. If the budget or the device refuses a buffer, the view first
//! gives up its rows, which are then processed in chunks. If that is not enough, the view gives up its lists, which are then made
//! for one range of tiles at a time. What must stay is 96 bytes a row in view (splats and gradients), 8 bytes a row for the
//! places in a range, some 60 bytes a pixel, and the splats and lists of one tile. The result has the same bits on every path.
//!
//! # Bus traffic
//! A step with n rows in view, p pixels and all colour bands uploads 236 n bytes of values and 4 p bytes of photo. The
//! step downloads 236 n bytes of gradients and 16 n bytes for densification, 32 n bytes where rows are weighed. Counts and uniforms add some KiB. While
//! the host holds the master copy of every value, only the mask byte of photos without a mask could be saved. All threads of the host
//! take part in packing, copying and unpacking rows.
//!
//! | stage | transfer | device work at the same time |
//! | --- | --- | --- |
//! | `rows_in` | geometry up (44 n) | none: the first stage needs the geometry |
//! | `rows_in` | colours up (192 n) | projection and depth sort |
//! | `loss` | photo up (4 p), commands of the loss | colours, tile lists, blending |
//! | `picture_back` | two counts down, commands of the backward stages | loss |
//! | `rows_out` | gradients of colours down (192 n) | gradients of splats to gradients of geometry |
//! | `rows_out` | gradients of geometry down (60 n) | none: the last stage writes these gradients |
//!
//! A step has five submissions: two in `rows_in` and `picture`, which share the second; one in `loss`; two in
//! `picture_back` and `rows_out`, which share the first. `picture_back` waits for the two counts, `rows_out` waits for
//! the gradients. [`Renderer::picture_mut`] and [`Renderer::picture_gradient`] each add 12 p bytes down, 12 p bytes up,
//! one submission and one wait.
//!
//! A view of one batch keeps its rows on the device, and its depth sort is recorded in `rows_in`. A view of several batches
//! uploads the rows of each batch twice, and sorts the splats of each range of tiles. The device is idle only between
//! two steps: the cull of the next view must read the means that the optimizer on the host has just rewritten.
//!
//! A device that holds pages ([`super::pages`]) uploads 4 p bytes of photo, some 50 KB of tables and uniforms, and the payloads that it
//! lacks; it downloads 52 bytes a page, and the payloads of pages that leave their slots. It waits for the number of listed rows, the
//! two counts, and the results of the pages. A step that is recorded without waiting (`gpu_recorded`) has three submissions and two
//! read-backs, which the host waits for once it has submitted the next step.
//!
//! # Errors
//! Functions of the `gpu_*` files fail where the device failed or has no memory left, constructors of stages also where the device
//! rejects a shader. Their comments name other errors only.
//!
//! Invariants: 1. the device holds the rows, lists and picture of the last view only; 2. the same input gives the same
//! bits on the same device; 3. no result comes from buffers that were too small: the frame and its loss are recorded
//! again with larger buffers; 4. after a device error there is no view until the next `begin_view`.

use super::device_needs::ViewSizes;
use super::gpu_back::{read_gradient, read_loss_value, read_unusable, record_picture_back, rows_out};
use super::gpu_gradients::Scratch;
use super::gpu_pages::{DevicePages, PagesView};
use super::gpu_picture::ViewStages;
use super::gpu_rows::HostRows;
use super::gpu_view::{InFlight, Lists, Loss, LossSums, Recorded, RowsIn, View};
use super::pages::PageRenderer;
use super::sequence::Sequence;
use super::{
    Gradients, LossOptions, LossValue, PictureGradient, RenderError, RenderOptions, Renderer, RowBatches,
    none_if_out_of_memory,
};
use crate::base::room;
use crate::gpu::{DeviceKind, Gpu, GpuResult, Traffic};
use crate::kernels::image_loss::LossPlan;
use crate::kernels::uniforms::pack_target;
use crate::scene::camera::Camera;
use crate::scene::columns::Columns;
use crate::scene::image::{Image, Target};
use std::collections::VecDeque;

/// Renders views on a GPU.
#[derive(Debug)]
pub struct GpuRenderer {
    pub(super) stages: ViewStages,
    pub(super) sequence: Sequence,
    pub(super) rows_in: Option<RowsIn>,
    pub(super) view: Option<View>,
    /// The pages of a run, if this device holds them.
    pub(super) pages: Option<Box<DevicePages>>,
    /// What the view knows of the pages that its rows come from.
    pub(super) pages_view: Option<PagesView>,
    image: Image,
    /// The gradient of the picture, valid if `gradient_on_host`.
    gradient: PictureGradient,
    /// Whether the caller requested the gradient of the picture, and the host copy therefore replaces the device's.
    gradient_on_host: bool,
    scratch: Scratch,
    packed_target: Vec<u32>,
    /// A step that is recorded without waiting, while it is recorded.
    pub(super) records: Option<Recorded>,
    /// Steps that are recorded and not finished, the first first.
    pub(super) in_flight: VecDeque<InFlight>,
    /// Whether the next views collect weights of rows, and whether this view does.
    weighs_next: bool,
    pub(super) weighs: bool,
}

impl GpuRenderer {
    /// Compiles the stages for `gpu`.
    pub fn new(gpu: Gpu) -> GpuResult<Self> {
        Ok(GpuRenderer {
            stages: ViewStages::new(gpu)?,
            sequence: Sequence::default(),
            rows_in: None,
            view: None,
            pages: None,
            pages_view: None,
            image: Image::default(),
            gradient: PictureGradient::default(),
            gradient_on_host: false,
            scratch: Scratch::default(),
            packed_target: Vec::new(),
            records: None,
            in_flight: VecDeque::new(),
            weighs_next: false,
            weighs: false,
        })
    }

    pub fn gpu(&self) -> &Gpu {
        &self.stages.gpu
    }

    /// Sets the capacity of the next view in intersections. The capacity grows on demand.
    pub fn set_capacity(&mut self, isects: u32) {
        self.stages.tiles.set_capacity(isects);
    }

    /// Sets the most pairs of a pixel and a list entry in one dispatch.
    pub fn set_dispatch_pairs(&mut self, pairs: u64) {
        self.stages.tiles.back.dispatch_pairs = pairs;
    }

    /// Frames so far that were recorded again because a buffer was too small.
    pub fn frames_rerecorded(&self) -> u64 {
        self.stages.frames_rerecorded
    }

    /// Intersections of the last view; 0 until a call has read the picture, the loss or a gradient.
    pub fn isects(&self) -> u32 {
        self.view.as_ref().map_or(0, |view| u32::try_from(view.sizes().isects).unwrap_or(u32::MAX))
    }

    /// Ranges of tiles in which the last picture was blended.
    pub fn ranges(&self) -> usize {
        match self.view.as_ref().map(|view| &view.lists) {
            None => 0,
            Some(Lists::Whole(_)) => 1,
            Some(Lists::Ranges(ranges)) => ranges.len(),
        }
    }

    /// Coverage 1 - T of the last picture, `[height][width]`.
    /// Errors: as [`Renderer::image`], or when the device failed.
    pub fn alpha(&mut self) -> Result<Vec<f32>, RenderError> {
        self.sequence.image()?;
        self.with_view("coverage", |renderer, view| {
            renderer.stages.wait_for_valid_picture(view)?;
            let gpu = &renderer.stages.gpu;
            let mut alpha = vec![0.0; view.of.camera.pixels()];
            let mut recorder = gpu.begin("coverage");
            let bytes = recorder.read_back("rasterize_fwd", &view.pixels.t_final.view())?;
            gpu.submit(recorder)?;
            bytes.copy_to(&mut alpha)?;
            alpha.iter_mut().for_each(|t| *t = 1.0 - *t);
            Ok(alpha)
        })
    }

    /// Drops the view and its device memory.
    pub(super) fn drop_view(&mut self) {
        self.sequence.drop_view();
        (self.rows_in, self.view, self.pages_view, self.records) = (None, None, None, None);
    }

    /// Runs a stage on a view with a picture. A stage that lacks device memory runs again while the view can give some back. A
    /// failed stage drops the view.
    pub(super) fn with_view<T>(
        &mut self,
        call: &'static str,
        mut stage: impl FnMut(&mut Self, &mut View) -> Result<T, RenderError>,
    ) -> Result<T, RenderError> {
        let mut view = self.view.take().ok_or(RenderError::OutOfOrder { call, needs: "picture" })?;
        let result = loop {
            match stage(self, &mut view) {
                Err(RenderError::Device(error)) if error.is_out_of_memory() => match self.stages.give_back(&mut view) {
                    Ok(true) => {}
                    Ok(false) => break Err(error.into()),
                    Err(other) => break Err(other.into()),
                },
                result => break result,
            }
        };
        match result {
            Ok(value) => {
                self.view = Some(view);
                Ok(value)
            }
            Err(error) => {
                self.drop_view();
                Err(error)
            }
        }
    }

    /// Appends the rows of a batch to those of the view; drops the view if they could not be submitted.
    pub(super) fn append(&mut self, submitted: GpuResult<RowsIn>) -> GpuResult<()> {
        let rows = submitted.inspect_err(|_| self.drop_view())?;
        match (&mut self.rows_in, rows.whole.is_some()) {
            (Some(before), false) => before.segments.extend(rows.segments),
            _ => self.rows_in = Some(rows),
        }
        Ok(())
    }

    /// Gives up the view of a step that could not be recorded; false where memory is short.
    pub(super) fn false_if_out_of_memory(&mut self, recorded: Result<(), RenderError>) -> Result<bool, RenderError> {
        if recorded.is_err() {
            self.drop_view();
        }
        Ok(none_if_out_of_memory(recorded)?.is_some())
    }
}

impl Renderer for GpuRenderer {
    fn name(&self) -> &'static str {
        "gpu"
    }

    fn device(&self) -> String {
        let summary = self.stages.gpu.summary();
        format!("{} ({})", summary.name, summary.backend)
    }

    fn traffic(&self) -> Traffic {
        self.stages.gpu.traffic()
    }

    fn host_bytes(&self) -> u64 {
        let floats = self.packed_target.capacity() + self.image.rgb.capacity();
        let traffic = self.stages.gpu.traffic();
        // Integrated and software adapters allocate device memory from host memory.
        let is_shared = matches!(self.stages.gpu.summary().kind, DeviceKind::Integrated | DeviceKind::Software);
        let device = if is_shared { traffic.device_bytes_peak } else { traffic.staging_bytes };
        4 * floats as u64 + self.scratch.bytes() + self.gradient.bytes() + device
    }

    fn device_sizes(&self) -> Option<ViewSizes> {
        Some(self.view.as_ref().map_or(ViewSizes::default(), View::sizes))
    }

    fn set_list_bytes(&mut self, _bytes: Option<u64>) {
        // The lists of a device lie in its own memory, which `--device-mem` bounds.
    }

    fn weigh_rows(&mut self, is_wanted: bool) -> Result<(), RenderError> {
        if is_wanted && !self.weighs_next {
            let ViewStages { gpu, rows, tiles, loss, .. } = &mut self.stages;
            rows.weigh_rows(gpu)?;
            tiles.back.weigh_rows(gpu)?;
            loss.weigh_rows(gpu)?;
        }
        self.weighs_next = is_wanted;
        Ok(())
    }

    fn begin_view(&mut self, camera: &Camera, options: &RenderOptions, batches: RowBatches) -> Result<(), RenderError> {
        // Frees the memory of the last view before this view allocates.
        self.drop_view();
        self.gradient_on_host = false;
        self.weighs = self.weighs_next;
        self.sequence.begin(camera, options, batches)
    }

    fn rows_in(&mut self, rows: &Columns) -> Result<(), RenderError> {
        let (view, place) = self.sequence.rows_in(rows.rows(), rows.sh_degree)?;
        let mut source = HostRows { rows, bands: &mut self.scratch.bands };
        let is_whole = self.sequence.batches() == Some(RowBatches::One);
        let submitted = self.stages.submit_batch(&mut source, &view, place.start, is_whole);
        Ok(self.append(submitted)?)
    }

    fn pages(&mut self) -> Option<&mut dyn PageRenderer> {
        Some(self)
    }

    fn picture(&mut self) -> Result<(), RenderError> {
        let of = self.sequence.picture()?;
        let rows = self.rows_in.take().ok_or(RenderError::OutOfOrder { call: "picture", needs: "rows_in" })?;
        let view = self.stages.submit_picture(of, rows).inspect_err(|_| self.drop_view())?;
        self.view = Some(View { weighs: self.weighs, ..view });
        Ok(())
    }

    fn image(&mut self) -> Result<&Image, RenderError> {
        self.sequence.image()?;
        self.with_view("image", |renderer, view| {
            renderer.stages.wait_for_valid_picture(view)?;
            if !view.image_is_read {
                let (gpu, image, Camera { width, height, .. }) =
                    (&renderer.stages.gpu, &mut renderer.image, view.of.camera);
                let mut recorder = gpu.begin("picture");
                let bytes = recorder.read_back("rasterize_fwd", &view.pixels.rgb.view())?;
                gpu.submit(recorder)?;
                (image.width, image.height) = (width, height);
                room::resize(&mut image.rgb, 3 * view.of.camera.pixels(), 0.0);
                bytes.copy_to(&mut image.rgb)?;
                view.image_is_read = true;
            }
            Ok(())
        })?;
        Ok(&self.image)
    }

    fn picture_mut(&mut self) -> Result<&mut [f32], RenderError> {
        self.image()?;
        if let Some(view) = &mut self.view {
            view.image_is_corrected = true;
        }
        Ok(&mut self.image.rgb)
    }

    fn loss(&mut self, target: &Target, options: &LossOptions) -> Result<(), RenderError> {
        self.sequence.loss(target)?;
        self.gradient_on_host = false;
        let (width, height) = (target.width as usize, target.height as usize);
        self.with_view("loss", |renderer, view| {
            view.loss = None;
            let plan = LossPlan::new(width, height, target.mask.as_deref(), options);
            // The device blends while the host packs and uploads the photo and records the loss.
            pack_target(target, &mut renderer.packed_target);
            let gpu = &renderer.stages.gpu;
            let mut recorder = gpu.begin("image_loss");
            let pixels = recorder.buffer_with("target", &renderer.packed_target)?;
            let corrected = match view.image_is_corrected {
                true => Some(recorder.buffer_with("corrected picture", &renderer.image.rgb)?),
                false => None,
            };
            let rgb = corrected.as_ref().unwrap_or(&view.pixels.rgb);
            let v_rgb = gpu.buffer("v_rgb", view.pixels.rgb.size())?;
            let errors = view.weighs.then(|| gpu.buffer("squared errors", view.pixels.t_final.size()));
            let mut loss = Loss { plan, target: pixels, v_rgb, errors: errors.transpose()?, sums: LossSums::Stale };
            loss.sums =
                renderer.stages.submit_loss(recorder, [target.width, target.height], rgb, &loss, view.is_recorded)?;
            view.loss = Some(loss);
            Ok(())
        })
    }

    fn picture_gradient(&mut self) -> Result<&mut PictureGradient, RenderError> {
        self.sequence.picture_gradient()?;
        if !self.gradient_on_host {
            self.with_view("picture_gradient", |renderer, view| {
                Ok(read_gradient(&mut renderer.stages, view, &mut renderer.gradient)?)
            })?;
            self.gradient_on_host = true;
        }
        Ok(&mut self.gradient)
    }

    fn picture_back(&mut self) -> Result<(), RenderError> {
        self.sequence.picture_back(self.gradient_on_host.then_some(&self.gradient))?;
        self.with_view("picture_back", |renderer, view| {
            let of_host = renderer.gradient_on_host.then_some(&renderer.gradient);
            record_picture_back(&mut renderer.stages, view, of_host)
        })
    }

    fn rows_out(&mut self, batch: usize, rows: &Columns, grads: &mut Gradients) -> Result<(), RenderError> {
        let (_, place) = self.sequence.rows_out(batch, rows.rows())?;
        self.with_view("rows_out", |renderer, view| {
            Ok(rows_out(&renderer.stages, view, (rows, &place), grads, &mut renderer.scratch)?)
        })
    }

    fn unusable_splats(&mut self) -> Result<u64, RenderError> {
        self.sequence.splat_gradients("unusable_splats")?;
        self.with_view("unusable_splats", |_, view| read_unusable(view))
    }

    fn loss_value(&mut self) -> Result<LossValue, RenderError> {
        if self.view.as_ref().is_none_or(|view| view.loss.is_none()) {
            return Err(RenderError::OutOfOrder { call: "loss_value", needs: "loss" });
        }
        self.with_view("loss_value", |renderer, view| read_loss_value(&mut renderer.stages, view))
    }
}
