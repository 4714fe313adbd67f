//! [`GpuRenderer`]: the stages of a view on a GPU, forward and backward, one view at a time.
//!
//! Not here: the recording of each stage (`gpu_rows`, `gpu_tiles`, `gpu_tiles_bwd`, `gpu_loss`), the device and its
//! memory (`crate::gpu`).
//!
//! # Bus traffic
//! A step with n rows in view, p pixels and all colour bands uploads 236 n bytes of values and 4 p bytes of photo. The
//! step downloads 236 n bytes of gradients and 16 n bytes for densification. Counts and uniforms add some KiB. While
//! the host holds the master copy of every value, only the mask byte of photos without a mask could be saved.
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
//! (`gpu_batches`) uploads the rows of each batch twice, one submission each way, and sorts in `picture`.
//!
//! The device is therefore idle only between two steps. The optimizer has just rewritten every row in view, and the
//! cull of the next view reads the new means, so the next upload cannot start earlier. Rows of the next view that the
//! current view does not see have known values (a function of the stored state and the step), but their list also needs
//! the cull. Early upload of those rows belongs to a future device tier that keeps rows on the device. The next photo
//! is known, but its upload in `loss` already costs no time.
//!
//! Invariants: 1. the device holds the rows, lists and picture of the last view only; 2. the same input gives the same
//! bits on the same device; 3. no result comes from buffers that were too small: the frame and its loss are recorded
//! again with larger buffers; 4. after a device error there is no view until the next `begin_view`.

use super::gpu_batches::{self, SplatBatch};
use super::gpu_loss::{LossStage, value};
use super::gpu_rows::{DeviceColumns, FOOTPRINT_BYTES, RowStages, band_into_sh_n};
use super::gpu_tiles::{Blend, Demand, DemandReadback, Frame, Ranks, TileStages, splat_bytes};
use super::gpu_tiles_bwd::PictureGradientBuffers;
use super::sequence::{Sequence, ViewOptions};
use super::{Gradients, LossOptions, LossValue, PictureGradient, RenderError, RenderOptions, Renderer, RowBatches};
use crate::base::room;
use crate::gpu::{Buffer, DeviceKind, Gpu, GpuResult, Readback, Recorder, Recording, Traffic};
use crate::kernels::image_loss::LossPlan;
use crate::kernels::splats::Grid;
use crate::kernels::uniforms::pack_target;
use crate::scene::camera::Camera;
use crate::scene::columns::Columns;
use crate::scene::image::{Image, Target};
use std::ops::Range;

/// Densification input of one row: gradient with respect to the projected mean (2), radii (2).
type Footprint = [f32; 4];

/// The buffer sizes that a frame needs. The picture is valid only if the frame had this room.
#[derive(Debug)]
enum DemandState {
    /// The readback is pending.
    Pending(DemandReadback),
    /// The host has read the demand.
    Known(Demand),
}

/// Device state between `rows_in` and `picture`.
#[derive(Debug)]
enum RowsIn {
    /// Of a view of one batch.
    Whole(Box<WholeRows>),
    /// Of a view of several batches.
    Batches(Vec<SplatBatch>),
}

/// The rows of a view of one batch.
#[derive(Debug)]
struct WholeRows {
    columns: DeviceColumns,
    splats: Buffer,
    ranks: Ranks,
    /// Upload and evaluation of the colours, not submitted yet: `picture` appends lists and blending.
    colors: Recording,
}

/// Device state of a view with a picture.
#[derive(Debug)]
struct View {
    of: ViewOptions,
    /// The rows of a view of one batch; `None` for several batches, whose rows come again.
    columns: Option<DeviceColumns>,
    splats: Buffer,
    ranks: Ranks,
    frame: Frame,
    demand: DemandState,
    /// Whether `GpuRenderer::image` holds the picture of this view.
    image_is_read: bool,
    /// Whether the caller may have changed `GpuRenderer::image`; the loss then compares that image.
    image_is_corrected: bool,
    loss: Option<Loss>,
    splat_gradients: Option<SplatGradients>,
}

/// A loss that was submitted.
#[derive(Debug)]
struct Loss {
    plan: LossPlan,
    /// The photo, kept until the picture is known to be valid.
    target: Buffer,
    v_rgb: Buffer,
    sums: LossSums,
}

/// The four sums from which the value of a loss follows.
#[derive(Debug)]
enum LossSums {
    /// The picture has no pixels.
    Empty,
    /// The readback is pending.
    Pending(Readback),
    /// The host has read the sums.
    Known([f32; 4]),
}

/// Gradients of the splats.
#[derive(Debug)]
struct SplatGradients {
    v_splats: Buffer,
    /// The tile stages that write `v_splats`, not submitted yet: the first `rows_out` appends the stages on rows.
    tiles: Option<Recording>,
}

/// Host memory that is reused between views.
#[derive(Debug, Default)]
struct Scratch {
    band: Vec<f32>,
    target: Vec<u32>,
    footprints: Vec<Footprint>,
}

/// Renders views on a GPU.
#[derive(Debug)]
pub struct GpuRenderer {
    gpu: Gpu,
    rows: RowStages,
    tiles: TileStages,
    loss: LossStage,
    sequence: Sequence,
    rows_in: Option<RowsIn>,
    view: Option<View>,
    image: Image,
    /// The gradient of the picture, valid if `gradient_on_host`.
    gradient: PictureGradient,
    /// Whether the caller requested the gradient of the picture, and the host copy therefore replaces the device's.
    gradient_on_host: bool,
    scratch: Scratch,
    frames_rerecorded: u64,
}

/// Pending readbacks of the gradients of the rows.
struct GradientReadbacks {
    /// sh0, then the bands in use.
    colors: Vec<Readback>,
    /// means, quats, scales, opacities.
    geometry: Vec<Readback>,
    footprints: Readback,
}

impl GpuRenderer {
    /// Compiles the stages for `gpu`.
    ///
    /// # Errors
    /// The device rejects a shader.
    pub fn new(gpu: Gpu) -> GpuResult<Self> {
        Ok(GpuRenderer {
            rows: RowStages::new(&gpu)?,
            tiles: TileStages::new(&gpu)?,
            loss: LossStage::new(&gpu)?,
            gpu,
            sequence: Sequence::default(),
            rows_in: None,
            view: None,
            image: Image::default(),
            gradient: PictureGradient::default(),
            gradient_on_host: false,
            scratch: Scratch::default(),
            frames_rerecorded: 0,
        })
    }

    /// The device.
    pub fn gpu(&self) -> &Gpu {
        &self.gpu
    }

    /// Sets the capacity of the next view in intersections. The capacity grows on demand.
    pub fn set_capacity(&mut self, isects: u32) {
        self.tiles.set_capacity(isects);
    }

    /// Frames so far that were recorded again because a buffer was too small.
    pub fn frames_rerecorded(&self) -> u64 {
        self.frames_rerecorded
    }

    /// Intersections of the last view; 0 until a call has read the picture, the loss or a gradient.
    pub fn isects(&self) -> u32 {
        match self.view.as_ref().map(|view| &view.demand) {
            Some(DemandState::Known(demand)) => demand.isects,
            _ => 0,
        }
    }

    /// Coverage 1 - T of the last picture, `[height][width]`.
    ///
    /// # Errors
    /// As [`Renderer::image`], or when the device failed.
    pub fn alpha(&mut self) -> Result<Vec<f32>, RenderError> {
        self.sequence.image()?;
        self.with_view("coverage", |renderer, view| {
            let (view, _) = renderer.wait_for_valid_frame(view)?;
            let gpu = &renderer.gpu;
            let mut alpha = vec![0.0; view.of.camera.pixels()];
            let mut recorder = gpu.begin("coverage");
            let bytes = recorder.read_back("rasterize_fwd", &view.frame.t_final.view())?;
            gpu.submit(recorder)?;
            bytes.copy_to(&mut alpha)?;
            alpha.iter_mut().for_each(|t| *t = 1.0 - *t);
            Ok((view, alpha))
        })
    }

    /// Drops the view and its device memory.
    fn drop_view(&mut self) {
        self.sequence.drop_view();
        (self.rows_in, self.view) = (None, None);
    }

    /// Runs a stage on a view with a picture. A failed stage drops the view.
    fn with_view<T>(
        &mut self,
        call: &'static str,
        stage: impl FnOnce(&mut Self, View) -> Result<(View, T), RenderError>,
    ) -> Result<T, RenderError> {
        let view = self.view.take().ok_or(RenderError::OutOfOrder { call, needs: "picture" })?;
        match stage(self, view) {
            Ok((view, value)) => {
                self.view = Some(view);
                Ok(value)
            }
            Err(error) => {
                self.drop_view();
                Err(error)
            }
        }
    }

    /// Submits upload, projection and depth sort of the rows; records upload and evaluation of colours. Does not wait.
    fn submit_rows(&mut self, rows: &Columns, view: &ViewOptions) -> GpuResult<WholeRows> {
        let (gpu, ViewOptions { camera, options }) = (&self.gpu, view);
        // `Sequence::rows_in` has checked that the count fits.
        let count = rows.rows() as u32;
        let columns = DeviceColumns::new(gpu, count, options.sh_degree)?;
        let splats = gpu.buffer("splats", splat_bytes(count))?;
        let mut recorder = gpu.begin("forward");
        columns.upload_geometry(&mut recorder, rows)?;
        self.rows.project_fwd(gpu, &mut recorder, camera, options.eps2d, &columns, &splats)?;
        let grid = Grid::new(camera.width, camera.height);
        let ranks = self.tiles.order(gpu, &mut recorder, &splats.view(), count, grid)?;
        gpu.submit(recorder)?;
        // The device projects and sorts during the upload of the colours, four fifths of a row.
        let mut recorder = gpu.begin("forward");
        columns.upload_colors(&mut recorder, rows, &mut self.scratch.band)?;
        self.rows.sh_fwd(gpu, &mut recorder, camera, options.sh_degree, &columns, &splats)?;
        Ok(WholeRows { columns, splats, ranks, colors: recorder.set_aside() })
    }

    /// Submits what is recorded of the rows, the tile lists and the blending. Does not wait.
    fn submit_picture(&mut self, of: ViewOptions, rows: RowsIn) -> GpuResult<View> {
        let (gpu, ViewOptions { camera, options }) = (&self.gpu, &of);
        let grid = Grid::new(camera.width, camera.height);
        let blend = Blend { grid, background: options.background, max_alpha: options.max_alpha };
        let (mut recorder, columns, splats, ranks) = match rows {
            RowsIn::Whole(whole) => {
                let WholeRows { columns, splats, ranks, colors } = *whole;
                (gpu.resume(colors), Some(columns), splats, ranks)
            }
            RowsIn::Batches(batches) => {
                let mut recorder = gpu.begin("forward");
                let (splats, rows) = gpu_batches::concatenate(gpu, &mut recorder, &batches)?;
                let ranks = self.tiles.order(gpu, &mut recorder, &splats.view(), rows, grid)?;
                (recorder, None, splats, ranks)
            }
        };
        let (frame, demand) = self.tiles.frame(gpu, &mut recorder, &splats.view(), &ranks, blend)?;
        gpu.submit(recorder)?;
        Ok(View {
            of,
            columns,
            splats,
            ranks,
            frame,
            demand: DemandState::Pending(demand),
            image_is_read: false,
            image_is_corrected: false,
            loss: None,
            splat_gradients: None,
        })
    }

    /// Waits until the frame of the view is known to have had enough room. A frame with too little room is recorded
    /// again with larger buffers, and so is the loss of its picture.
    fn wait_for_valid_frame(&mut self, mut view: View) -> GpuResult<(View, Demand)> {
        let (gpu, mut again) = (&self.gpu, false);
        let demand = loop {
            let demand = match view.demand {
                DemandState::Known(demand) => demand,
                DemandState::Pending(readback) => readback.wait()?,
            };
            view.demand = DemandState::Known(demand);
            if self.tiles.fits(&view.frame, demand)? {
                break demand;
            }
            again = true;
            self.frames_rerecorded += 1;
            let blend = view.frame.blend;
            drop(view.frame); // frees memory for the larger frame
            let mut recorder = gpu.begin("forward again");
            let (frame, demand) = self.tiles.frame(gpu, &mut recorder, &view.splats.view(), &view.ranks, blend)?;
            gpu.submit(recorder)?;
            (view.frame, view.demand) = (frame, DemandState::Pending(demand));
        };
        if again && let Some(Loss { plan, target, v_rgb, sums }) = view.loss.take() {
            drop((v_rgb, sums)); // computed from the invalid picture
            view.loss = Some(self.submit_loss(gpu.begin("image_loss"), &view, &view.frame.rgb, plan, target)?);
        }
        Ok((view, demand))
    }

    fn read_image(&mut self, view: &View) -> GpuResult<()> {
        let Camera { width, height, .. } = view.of.camera;
        let mut recorder = self.gpu.begin("picture");
        let bytes = recorder.read_back("rasterize_fwd", &view.frame.rgb.view())?;
        self.gpu.submit(recorder)?;
        (self.image.width, self.image.height) = (width, height);
        self.image.rgb.resize(3 * view.of.camera.pixels(), 0.0);
        bytes.copy_to(&mut self.image.rgb)
    }

    /// Submits the loss of `rgb`: the picture of the view, which may still turn out invalid, or the corrected picture.
    fn submit_loss(
        &self,
        mut recorder: Recorder<'_>,
        view: &View,
        rgb: &Buffer,
        plan: LossPlan,
        target: Buffer,
    ) -> GpuResult<Loss> {
        let gpu = &self.gpu;
        let v_rgb = gpu.buffer("v_rgb", view.frame.rgb.size())?;
        let size = [view.of.camera.width, view.of.camera.height];
        let (rgb, photo) = (rgb.view(), target.view());
        let sums = self.loss.run(gpu, &mut recorder, size, &plan, &rgb, &photo, &v_rgb.view())?;
        let sums = match sums {
            Some(sums) => LossSums::Pending(recorder.read_back("image_loss", &sums.slice(0, 16))?),
            None => LossSums::Empty,
        };
        gpu.submit(recorder)?;
        Ok(Loss { plan, target, v_rgb, sums })
    }

    /// Reads the gradient of the loss into `self.gradient`; zeros if no loss ran.
    fn read_gradient(&mut self, view: View) -> GpuResult<View> {
        self.gradient.reset(view.of.camera.pixels());
        if view.loss.is_none() {
            return Ok(view);
        }
        let (view, _) = self.wait_for_valid_frame(view)?;
        if let Some(loss) = &view.loss {
            let mut recorder = self.gpu.begin("picture gradient");
            let bytes = recorder.read_back("image_loss", &loss.v_rgb.view())?;
            self.gpu.submit(recorder)?;
            bytes.copy_to(&mut self.gradient.v_rgb)?;
        }
        Ok(view)
    }

    /// Records the backward pass from the picture to the splats, once the picture is valid.
    fn record_picture_back(&mut self, view: View) -> Result<View, RenderError> {
        let (mut view, demand) = self.wait_for_valid_frame(view)?;
        let gpu = &self.gpu;
        let mut recorder = gpu.begin("backward");
        let (mut uploaded, mut v_alpha) = (None, None);
        if self.gradient_on_host {
            uploaded = Some(recorder.buffer_with("v_rgb", &self.gradient.v_rgb)?);
            v_alpha = self.gradient.v_alpha.as_ref().map(|v| recorder.buffer_with("v_alpha", v)).transpose()?;
        }
        let v_rgb = uploaded.as_ref().or(view.loss.as_ref().map(|loss| &loss.v_rgb));
        let v_rgb = v_rgb.ok_or(RenderError::OutOfOrder { call: "picture_back", needs: "loss or picture_gradient" })?;
        let v_splats = gpu.buffer("v_splats", splat_bytes(view.ranks.rows))?;
        let (v_rgb, v_alpha) = (v_rgb.view(), v_alpha.as_ref().map(Buffer::view));
        self.tiles.backward(
            gpu,
            &mut recorder,
            &view.splats.view(),
            &view.ranks,
            &view.frame,
            demand,
            PictureGradientBuffers { v_rgb: &v_rgb, v_alpha: v_alpha.as_ref() },
            &v_splats.view(),
        )?;
        view.splat_gradients = Some(SplatGradients { v_splats, tiles: Some(recorder.set_aside()) });
        Ok(view)
    }

    /// Submits the backward pass to the rows of the batch at `place`, behind the tile stages if they are not submitted yet, and
    /// the readbacks of the gradients. Does not wait.
    fn submit_rows_out(
        &mut self,
        view: &mut View,
        rows: &Columns,
        place: &Range<usize>,
    ) -> Result<GradientReadbacks, RenderError> {
        let gradients = view.splat_gradients.as_mut();
        let gradients = gradients.ok_or(RenderError::OutOfOrder { call: "rows_out", needs: "picture_back" })?;
        let (gpu, sh_degree) = (&self.gpu, view.of.options.sh_degree);
        let mut recorder = gradients.tiles.take().map_or_else(|| gpu.begin("backward"), |tiles| gpu.resume(tiles));
        let (splats, v_splats) = (&view.splats, &gradients.v_splats);
        if let Some(columns) = &view.columns {
            return Ok(self.submit_gradients(recorder, &view.of, columns, [splats, v_splats])?);
        }
        let columns = gpu_batches::upload(gpu, &mut recorder, rows, sh_degree, &mut self.scratch.band)?;
        let splats = gpu_batches::copy_rows(gpu, &mut recorder, "splats", splats, place)?;
        let v_splats = gpu_batches::copy_rows(gpu, &mut recorder, "v_splats", v_splats, place)?;
        Ok(self.submit_gradients(recorder, &view.of, &columns, [&splats, &v_splats])?)
    }

    /// Submits the stages on rows of the backward pass and the readbacks of their gradients.
    fn submit_gradients(
        &self,
        mut recorder: Recorder<'_>,
        ViewOptions { camera, options }: &ViewOptions,
        columns: &DeviceColumns,
        [splats, v_splats]: [&Buffer; 2],
    ) -> GpuResult<GradientReadbacks> {
        let (gpu, RenderOptions { eps2d, sh_degree, .. }) = (&self.gpu, *options);
        let grads = DeviceColumns::new(gpu, columns.rows, sh_degree)?;
        self.rows.sh_bwd(gpu, &mut recorder, camera, sh_degree, columns, splats, v_splats, &grads)?;
        let colors: Vec<Readback> = std::iter::once(&grads.sh0)
            .chain(&grads.bands)
            .map(|buffer| recorder.read_back("sh_bwd", &buffer.view()))
            .collect::<GpuResult<_>>()?;
        gpu.submit(recorder)?;
        // The host copies the gradients of colours, four fifths of a row, while the device runs `project_bwd`.
        let mut recorder = gpu.begin("backward");
        let footprints = gpu.buffer("footprints", FOOTPRINT_BYTES * u64::from(columns.rows))?;
        let into = &mut recorder;
        self.rows.project_bwd(gpu, into, camera, eps2d, columns, splats, v_splats, &grads, &footprints)?;
        let geometry = [&grads.means, &grads.quats, &grads.scales, &grads.opacities]
            .map(|buffer| recorder.read_back("project_bwd", &buffer.view()));
        let readbacks = GradientReadbacks {
            colors,
            geometry: geometry.into_iter().collect::<GpuResult<_>>()?,
            footprints: recorder.read_back("project_bwd", &footprints.view())?,
        };
        gpu.submit(recorder)?;
        Ok(readbacks)
    }

    /// Waits for the gradients of the rows and copies them to `grads`.
    fn read_row_gradients(
        &mut self,
        view: &View,
        readbacks: GradientReadbacks,
        (rows, sh_degree): (usize, u8),
        grads: &mut Gradients,
    ) -> GpuResult<()> {
        let out = &mut grads.columns;
        out.sh_degree = sh_degree;
        out.resize(rows);
        if view.of.options.sh_degree < sh_degree {
            out.sh_n.fill(0.0); // the unused bands stay zero
        }
        let mut colors = readbacks.colors.into_iter();
        for bytes in colors.by_ref().take(1) {
            bytes.copy_to(&mut out.sh0)?;
        }
        for (band, bytes) in colors.enumerate() {
            let values = &mut self.scratch.band;
            values.clear();
            values.resize(rows * super::gpu_rows::BAND_WIDTHS[band], 0.0);
            bytes.copy_to(values)?;
            band_into_sh_n(values, band, out);
        }
        let geometry = [&mut out.means, &mut out.quats, &mut out.scales, &mut out.opacities];
        for (to, bytes) in geometry.into_iter().zip(readbacks.geometry) {
            bytes.copy_to(to)?;
        }
        let footprints = &mut self.scratch.footprints;
        room::resize(footprints, rows, [0.0; 4]);
        readbacks.footprints.copy_to(footprints)?;
        grads.radii.clear();
        grads.radii.extend(footprints.iter().map(|f| [f[2] as u32, f[3] as u32]));
        grads.means2d.clear();
        grads.means2d.extend(footprints.iter().map(|f| [f[0], f[1]]));
        Ok(())
    }

    /// Waits for the sums of the loss of a valid picture and returns the value of the loss.
    fn read_loss_value(&mut self, view: View) -> Result<(View, LossValue), RenderError> {
        let (mut view, _) = self.wait_for_valid_frame(view)?;
        let Some(loss) = &mut view.loss else {
            return Err(RenderError::OutOfOrder { call: "loss_value", needs: "loss" });
        };
        let sums = match std::mem::replace(&mut loss.sums, LossSums::Empty) {
            LossSums::Empty => [0.0; 4],
            LossSums::Pending(readback) => {
                let mut sums = [0.0f32; 4];
                readback.copy_to(&mut sums)?;
                sums
            }
            LossSums::Known(sums) => sums,
        };
        loss.sums = LossSums::Known(sums);
        let value = value(&loss.plan, sums);
        Ok((view, value))
    }
}

impl Renderer for GpuRenderer {
    fn name(&self) -> &'static str {
        "gpu"
    }

    fn device(&self) -> String {
        let summary = self.gpu.summary();
        format!("{} ({})", summary.name, summary.backend)
    }

    fn traffic(&self) -> Traffic {
        self.gpu.traffic()
    }

    fn host_bytes(&self) -> u64 {
        let s = &self.scratch;
        let floats = s.band.capacity() + s.target.capacity() + self.image.rgb.capacity();
        let gradient = self.gradient.bytes();
        let traffic = self.gpu.traffic();
        // Integrated and software adapters allocate device memory from host memory.
        let is_shared = matches!(self.gpu.summary().kind, DeviceKind::Integrated | DeviceKind::Software);
        let device = if is_shared { traffic.device_bytes_peak } else { 0 };
        (4 * floats + size_of::<Footprint>() * s.footprints.capacity()) as u64
            + gradient
            + traffic.staging_bytes
            + device
    }

    fn set_list_bytes(&mut self, _bytes: Option<u64>) {
        // The lists of a device lie in its own memory, which `--device-mem` bounds.
    }

    fn begin_view(&mut self, camera: &Camera, options: &RenderOptions, batches: RowBatches) -> Result<(), RenderError> {
        // Frees the memory of the last view before this view allocates.
        self.drop_view();
        self.gradient_on_host = false;
        self.sequence.begin(camera, options, batches)
    }

    fn rows_in(&mut self, rows: &Columns) -> Result<(), RenderError> {
        let (view, _) = self.sequence.rows_in(rows)?;
        if self.sequence.batches() == Some(RowBatches::One) {
            let submitted = self.submit_rows(rows, &view).inspect_err(|_| self.drop_view())?;
            self.rows_in = Some(RowsIn::Whole(Box::new(submitted)));
            return Ok(());
        }
        let band = &mut self.scratch.band;
        let batch = gpu_batches::submit_batch(&self.gpu, &self.rows, rows, &view, band);
        let batch = batch.inspect_err(|_| self.drop_view())?;
        match &mut self.rows_in {
            Some(RowsIn::Batches(batches)) => batches.push(batch),
            _ => self.rows_in = Some(RowsIn::Batches(vec![batch])),
        }
        Ok(())
    }

    fn picture(&mut self) -> Result<(), RenderError> {
        let of = self.sequence.picture()?;
        let rows = self.rows_in.take().ok_or(RenderError::OutOfOrder { call: "picture", needs: "rows_in" })?;
        let view = self.submit_picture(of, rows).inspect_err(|_| self.drop_view())?;
        self.view = Some(view);
        Ok(())
    }

    fn image(&mut self) -> Result<&Image, RenderError> {
        self.sequence.image()?;
        self.with_view("image", |renderer, view| {
            let (mut view, _) = renderer.wait_for_valid_frame(view)?;
            if !view.image_is_read {
                renderer.read_image(&view)?;
                view.image_is_read = true;
            }
            Ok((view, ()))
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
        let plan = LossPlan::new(target.width as usize, target.height as usize, target.mask.as_deref(), options);
        self.with_view("loss", |renderer, mut view| {
            view.loss = None;
            // The device blends while the host packs and uploads the photo and records the loss.
            pack_target(target, &mut renderer.scratch.target);
            let mut recorder = renderer.gpu.begin("image_loss");
            let pixels = recorder.buffer_with("target", &renderer.scratch.target)?;
            let corrected = match view.image_is_corrected {
                true => Some(recorder.buffer_with("corrected picture", &renderer.image.rgb)?),
                false => None,
            };
            let rgb = corrected.as_ref().unwrap_or(&view.frame.rgb);
            view.loss = Some(renderer.submit_loss(recorder, &view, rgb, plan, pixels)?);
            Ok((view, ()))
        })
    }

    fn picture_gradient(&mut self) -> Result<&mut PictureGradient, RenderError> {
        self.sequence.picture_gradient()?;
        if !self.gradient_on_host {
            self.with_view("picture_gradient", |renderer, view| Ok((renderer.read_gradient(view)?, ())))?;
            self.gradient_on_host = true;
        }
        Ok(&mut self.gradient)
    }

    fn picture_back(&mut self) -> Result<(), RenderError> {
        self.sequence.picture_back(self.gradient_on_host.then_some(&self.gradient))?;
        self.with_view("picture_back", |renderer, view| Ok((renderer.record_picture_back(view)?, ())))
    }

    fn rows_out(&mut self, batch: usize, rows: &Columns, grads: &mut Gradients) -> Result<(), RenderError> {
        let (_, place) = self.sequence.rows_out(batch, rows)?;
        self.with_view("rows_out", |renderer, mut view| {
            let readbacks = renderer.submit_rows_out(&mut view, rows, &place)?;
            renderer.read_row_gradients(&view, readbacks, (place.len(), rows.sh_degree), grads)?;
            Ok((view, ()))
        })
    }

    fn loss_value(&mut self) -> Result<LossValue, RenderError> {
        if self.view.as_ref().is_none_or(|view| view.loss.is_none()) {
            return Err(RenderError::OutOfOrder { call: "loss_value", needs: "loss" });
        }
        self.with_view("loss_value", |renderer, view| renderer.read_loss_value(view))
    }
}
