//! The stages in order on a GPU, forward and backward, on the rows of one view at a time.
//!
//! Not here: the stages themselves (`gpu_rows`, `gpu_tiles`, `gpu_loss`), the device and its memory (`crate::gpu`).
//!
//! What crosses the bus in a step, with n rows in view, p pixels and all colour bands: 236 n bytes of values and 4 p of
//! the photo up, 236 n of gradients and 16 n for densification down, and some KiB of counts and uniforms. Less is not
//! possible while the truth of every value is on the host (the photo's mask could be left out where there is none).
//! What waits for what:
//!
//! | stage | crosses | while |
//! | --- | --- | --- |
//! | `rows_in` | geometry up (44 n) | nothing: it is the first thing that the device needs |
//! | `rows_in` | colours up (192 n) | the device projects and sorts |
//! | `loss` | photo up (4 p), commands of the loss | the device finishes the colours, makes the lists and blends |
//! | `picture_back` | two counts down, commands of the backward stages | the device computes the loss |
//! | `rows_out` | gradients of colours down (192 n) | the device goes from splats to geometry |
//! | `rows_out` | gradients of geometry down (60 n) | nothing: they are the last thing that the device makes |
//!
//! Five submissions carry this: two of `rows_in` and `picture`, which share the second; one of `loss`; two of
//! `picture_back` and `rows_out`, which share the first. `picture_back` waits for the two counts, `rows_out` for the
//! gradients. [`Renderer::picture_mut`] and [`Renderer::picture_gradient`] cost their callers 12 p down and 12 p up, each
//! with a submission and a wait of its own.
//! The stages hold one batch: sorting needs the geometry of all rows, so it is recorded with that of the only batch.
//!
//! So the device waits for the host between two steps only. There the next step's values are not known yet: each row in
//! view was just rewritten by the optimizer, and the cull of the next view reads the means that it wrote. The rows of the
//! next view that this one does not see are known (their values are a function of the stored state and the step), but
//! which these are follows from a cull too; that, and keeping rows on the device, is for the device tier. The next photo
//! is known, but has its place above, where it delays nothing.
//!
//! Invariants: 1. only the rows of the last view, its lists and its picture are on the device; 2. the same input gives
//! the same bits on the same device; 3. nothing is returned that was made of buffers that were too small: such a frame
//! and its loss are recorded again with larger ones; 4. after an error of the device there is no view until the next
//! `begin_view`.

use super::gpu_loss::{LossStage, value};
use super::gpu_rows::{DeviceColumns, FOOTPRINT_BYTES, RowStages, band_into_sh_n};
use super::gpu_tiles::{Blend, Demand, DemandReadback, Frame, Ranks, TileStages, splat_bytes};
use super::gpu_tiles_bwd::PictureGradientBuffers;
use super::sequence::{Sequence, ViewOptions};
use super::{Gradients, LossOptions, LossValue, PictureGradient, RenderError, RenderOptions, Renderer};
use crate::base::room;
use crate::gpu::{Buffer, DeviceKind, Gpu, GpuResult, Readback, Recorder, Recording, Traffic};
use crate::kernels::image_loss::LossPlan;
use crate::kernels::splats::Grid;
use crate::kernels::uniforms::pack_target;
use crate::scene::camera::Camera;
use crate::scene::columns::Columns;
use crate::scene::image::{Image, Target};

/// Batches of a view that the device takes.
const BATCHES_MAX: usize = 1;

/// A row of what densification needs: the gradient by the mean on the screen, and the radii.
type Footprint = [f32; 4];

/// What the frame of a view needs, which tells whether its picture is right.
#[derive(Debug)]
enum Need {
    /// On its way to the host.
    UnderWay(DemandReadback),
    /// The frame had room for it.
    Met(Demand),
}

/// What the device holds of a view whose rows are in.
#[derive(Debug)]
struct RowsIn {
    columns: DeviceColumns,
    splats: Buffer,
    ranks: Ranks,
    /// Upload and evaluation of the colours, which the lists and the picture are to follow in one submission.
    colors: Recording,
}

/// What the device holds of a view that has a picture.
#[derive(Debug)]
struct View {
    of: ViewOptions,
    columns: DeviceColumns,
    splats: Buffer,
    ranks: Ranks,
    frame: Frame,
    need: Need,
    /// Whether `image` holds its picture.
    image_is_read: bool,
    /// Whether the caller may have changed `image`: then that is what the loss compares.
    image_is_corrected: bool,
    loss: Option<Loss>,
    back: Option<Back>,
}

/// A loss that is under way or done.
#[derive(Debug)]
struct Loss {
    plan: LossPlan,
    /// The photo, kept until the picture is known to be right.
    target: Buffer,
    v_rgb: Buffer,
    sums: Sums,
}

/// The four numbers that the value of a loss is made of.
#[derive(Debug)]
enum Sums {
    /// A picture without pixels has none.
    Nothing,
    /// On their way to the host.
    UnderWay(Readback),
    /// On the host.
    Here([f32; 4]),
}

/// Gradients of the splats.
#[derive(Debug)]
struct Back {
    v_splats: Buffer,
    /// The tile stages that write them, which the stages on rows are to follow in one submission.
    tiles: Recording,
}

/// Host memory that is kept between views.
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
    /// The gradient of the picture, where the caller has had it on the host.
    gradient: PictureGradient,
    gradient_is_here: bool,
    scratch: Scratch,
    frames_again: u64,
}

/// Gradients on their way to the host.
struct GradientReadbacks {
    /// sh0 and the bands in use.
    colors: Vec<Readback>,
    /// Means, quats, scales, opacities.
    geometry: Vec<Readback>,
    footprints: Readback,
}

impl GpuRenderer {
    /// Compiles the stages for `gpu`.
    ///
    /// # Errors
    /// The device refuses a shader.
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
            gradient_is_here: false,
            scratch: Scratch::default(),
            frames_again: 0,
        })
    }

    /// The device.
    pub fn gpu(&self) -> &Gpu {
        &self.gpu
    }

    /// Sets how many intersections the next view has room for; it grows again on demand.
    pub fn set_capacity(&mut self, isects: u32) {
        self.tiles.set_capacity(isects);
    }

    /// Frames so far that were recorded again because their buffers were too small.
    pub fn frames_again(&self) -> u64 {
        self.frames_again
    }

    /// Intersections of the last view; 0 before its loss or picture was taken.
    pub fn isects(&self) -> u32 {
        match self.view.as_ref().map(|view| &view.need) {
            Some(Need::Met(demand)) => demand.isects,
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
            let (view, _) = renderer.settle(view)?;
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

    /// Gives up the view, and what the device holds of it.
    fn give_up(&mut self) {
        self.sequence.give_up();
        (self.rows_in, self.view) = (None, None);
    }

    /// Runs a stage on the view that has a picture. When the device fails there is no view any more.
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
                self.give_up();
                Err(error)
            }
        }
    }

    /// Submits geometry, projection and order of the rows; records their colours. Does not wait.
    fn submit_rows(&mut self, rows: &Columns, view: &ViewOptions) -> GpuResult<RowsIn> {
        let (gpu, ViewOptions { camera, options }) = (&self.gpu, view);
        // The sequence of stages has checked that the count fits.
        let count = rows.rows() as u32;
        let columns = DeviceColumns::new(gpu, count, options.sh_degree)?;
        let splats = gpu.buffer("splats", splat_bytes(count))?;
        let mut recorder = gpu.begin("forward");
        columns.upload_geometry(&mut recorder, rows)?;
        self.rows.project_fwd(gpu, &mut recorder, camera, options.eps2d, &columns, &splats)?;
        let grid = Grid::new(camera.width, camera.height);
        let ranks = self.tiles.order(gpu, &mut recorder, &splats.view(), count, grid)?;
        gpu.submit(recorder)?;
        // The device projects and sorts while colours, four fifths of a row, are on their way.
        let mut recorder = gpu.begin("forward");
        columns.upload_colors(&mut recorder, rows, &mut self.scratch.band)?;
        self.rows.sh_fwd(gpu, &mut recorder, camera, options.sh_degree, &columns, &splats)?;
        Ok(RowsIn { columns, splats, ranks, colors: recorder.set_aside() })
    }

    /// Submits the colours that were recorded, the lists of the tiles and the picture; does not wait.
    fn submit_picture(&mut self, of: ViewOptions, rows: RowsIn) -> GpuResult<View> {
        let (gpu, ViewOptions { camera, options }) = (&self.gpu, &of);
        let RowsIn { columns, splats, ranks, colors } = rows;
        let grid = Grid::new(camera.width, camera.height);
        let blend = Blend { grid, background: options.background, max_alpha: options.max_alpha };
        let mut recorder = gpu.resume(colors);
        let (frame, demand) = self.tiles.frame(gpu, &mut recorder, &splats.view(), &ranks, blend)?;
        gpu.submit(recorder)?;
        Ok(View {
            of,
            columns,
            splats,
            ranks,
            frame,
            need: Need::UnderWay(demand),
            image_is_read: false,
            image_is_corrected: false,
            loss: None,
            back: None,
        })
    }

    /// Waits for what the view's frame needs. A frame with too little room is recorded again, with more, and so is the
    /// loss of its picture.
    fn settle(&mut self, mut view: View) -> GpuResult<(View, Demand)> {
        let (gpu, mut again) = (&self.gpu, false);
        let demand = loop {
            let demand = match view.need {
                Need::Met(demand) => demand,
                Need::UnderWay(readback) => readback.wait()?,
            };
            view.need = Need::Met(demand);
            if self.tiles.fits(&view.frame, demand)? {
                break demand;
            }
            again = true;
            self.frames_again += 1;
            let blend = view.frame.blend;
            drop(view.frame); // its memory is free for the next
            let mut recorder = gpu.begin("forward again");
            let (frame, demand) = self.tiles.frame(gpu, &mut recorder, &view.splats.view(), &view.ranks, blend)?;
            gpu.submit(recorder)?;
            (view.frame, view.need) = (frame, Need::UnderWay(demand));
        };
        if again && let Some(Loss { plan, target, v_rgb, sums }) = view.loss.take() {
            drop((v_rgb, sums)); // of a picture that was not right
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

    /// Submits the loss of `rgb`, the view's picture, whether or not it is right yet, or what the caller made of it.
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
            Some(sums) => Sums::UnderWay(recorder.read_back("image_loss", &sums.slice(0, 16))?),
            None => Sums::Nothing,
        };
        gpu.submit(recorder)?;
        Ok(Loss { plan, target, v_rgb, sums })
    }

    /// Reads the gradient that the loss left, of a picture that is right, into `gradient`; zeros where there was no loss.
    fn read_gradient(&mut self, view: View) -> GpuResult<View> {
        self.gradient.reset(view.of.camera.pixels());
        if view.loss.is_none() {
            return Ok(view);
        }
        let (view, _) = self.settle(view)?;
        if let Some(loss) = &view.loss {
            let mut recorder = self.gpu.begin("picture gradient");
            let bytes = recorder.read_back("image_loss", &loss.v_rgb.view())?;
            self.gpu.submit(recorder)?;
            bytes.copy_to(&mut self.gradient.v_rgb)?;
        }
        Ok(view)
    }

    /// Records the way back to the splats, once the picture is right.
    fn record_back(&mut self, view: View) -> Result<View, RenderError> {
        let (mut view, demand) = self.settle(view)?;
        let gpu = &self.gpu;
        let mut recorder = gpu.begin("backward");
        let (mut here, mut v_alpha) = (None, None);
        if self.gradient_is_here {
            here = Some(recorder.buffer_with("v_rgb", &self.gradient.v_rgb)?);
            v_alpha = self.gradient.v_alpha.as_ref().map(|v| recorder.buffer_with("v_alpha", v)).transpose()?;
        }
        let v_rgb = here.as_ref().or(view.loss.as_ref().map(|loss| &loss.v_rgb));
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
        view.back = Some(Back { v_splats, tiles: recorder.set_aside() });
        Ok(view)
    }

    /// Submits the way back from the picture to the rows, and what is read back of it; does not wait.
    fn submit_back(&self, view: &View, Back { v_splats, tiles }: Back) -> GpuResult<GradientReadbacks> {
        let (gpu, camera, splats, columns) = (&self.gpu, &view.of.camera, &view.splats, &view.columns);
        let RenderOptions { eps2d, sh_degree, .. } = view.of.options;
        let mut recorder = gpu.resume(tiles);
        let grads = DeviceColumns::new(gpu, view.ranks.rows, sh_degree)?;
        self.rows.sh_bwd(gpu, &mut recorder, camera, sh_degree, columns, splats, &v_splats, &grads)?;
        let colors: Vec<Readback> = std::iter::once(&grads.sh0)
            .chain(&grads.bands)
            .map(|buffer| recorder.read_back("sh_bwd", &buffer.view()))
            .collect::<GpuResult<_>>()?;
        gpu.submit(recorder)?;
        // Colours, four fifths of a row, are copied on the host while the device does the rest.
        let mut recorder = gpu.begin("backward");
        let footprints = gpu.buffer("footprints", FOOTPRINT_BYTES * u64::from(view.ranks.rows))?;
        let into = &mut recorder;
        self.rows.project_bwd(gpu, into, camera, eps2d, columns, splats, &v_splats, &grads, &footprints)?;
        let geometry = [&grads.means, &grads.quats, &grads.scales, &grads.opacities]
            .map(|buffer| recorder.read_back("project_bwd", &buffer.view()));
        let back = GradientReadbacks {
            colors,
            geometry: geometry.into_iter().collect::<GpuResult<_>>()?,
            footprints: recorder.read_back("project_bwd", &footprints.view())?,
        };
        gpu.submit(recorder)?;
        Ok(back)
    }

    /// Waits for the gradients and puts them where the caller wants them.
    fn finish(&mut self, view: &View, back: GradientReadbacks, sh_degree: u8, grads: &mut Gradients) -> GpuResult<()> {
        let rows = view.ranks.rows as usize;
        let out = &mut grads.columns;
        out.sh_degree = sh_degree;
        out.resize(rows);
        if view.of.options.sh_degree < sh_degree {
            out.sh_n.fill(0.0); // bands that are not in use
        }
        let mut colors = back.colors.into_iter();
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
        for (to, bytes) in geometry.into_iter().zip(back.geometry) {
            bytes.copy_to(to)?;
        }
        let footprints = &mut self.scratch.footprints;
        room::resize(footprints, rows, [0.0; 4]);
        back.footprints.copy_to(footprints)?;
        grads.radii.clear();
        grads.radii.extend(footprints.iter().map(|f| [f[2] as u32, f[3] as u32]));
        grads.means2d.clear();
        grads.means2d.extend(footprints.iter().map(|f| [f[0], f[1]]));
        Ok(())
    }

    /// The value of the view's loss, once its picture is right and its sums have arrived.
    fn read_value(&mut self, view: View) -> Result<(View, LossValue), RenderError> {
        let (mut view, _) = self.settle(view)?;
        let Some(loss) = &mut view.loss else {
            return Err(RenderError::OutOfOrder { call: "loss_value", needs: "loss" });
        };
        let sums = match std::mem::replace(&mut loss.sums, Sums::Nothing) {
            Sums::Nothing => [0.0; 4],
            Sums::UnderWay(readback) => {
                let mut sums = [0.0f32; 4];
                readback.copy_to(&mut sums)?;
                sums
            }
            Sums::Here(sums) => sums,
        };
        loss.sums = Sums::Here(sums);
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
        // Such adapters have no memory of their own.
        let is_shared = matches!(self.gpu.summary().kind, DeviceKind::Integrated | DeviceKind::Software);
        let device = if is_shared { traffic.device_bytes_peak } else { 0 };
        (4 * floats + size_of::<Footprint>() * s.footprints.capacity()) as u64
            + gradient
            + traffic.staging_bytes
            + device
    }

    fn begin_view(&mut self, camera: &Camera, options: &RenderOptions, batches: usize) -> Result<(), RenderError> {
        // What the last view held is free for this one.
        self.give_up();
        self.gradient_is_here = false;
        self.sequence.begin(camera, options, batches, BATCHES_MAX)
    }

    fn rows_in(&mut self, rows: &Columns) -> Result<(), RenderError> {
        let (view, _) = self.sequence.rows_in(rows)?;
        let submitted = self.submit_rows(rows, &view).inspect_err(|_| self.give_up())?;
        self.rows_in = Some(submitted);
        Ok(())
    }

    fn picture(&mut self) -> Result<(), RenderError> {
        let of = self.sequence.picture()?;
        let rows = self.rows_in.take().ok_or(RenderError::OutOfOrder { call: "picture", needs: "rows_in" })?;
        let view = self.submit_picture(of, rows).inspect_err(|_| self.give_up())?;
        self.view = Some(view);
        Ok(())
    }

    fn image(&mut self) -> Result<&Image, RenderError> {
        self.sequence.image()?;
        self.with_view("image", |renderer, view| {
            let (mut view, _) = renderer.settle(view)?;
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
        self.gradient_is_here = false;
        let plan = LossPlan::new(target.width as usize, target.height as usize, target.mask.as_deref(), options);
        self.with_view("loss", |renderer, mut view| {
            view.loss = None;
            // The device blends while the photo is packed, crosses the bus, and the loss is recorded behind it.
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
        if !self.gradient_is_here {
            self.with_view("picture_gradient", |renderer, view| Ok((renderer.read_gradient(view)?, ())))?;
            self.gradient_is_here = true;
        }
        Ok(&mut self.gradient)
    }

    fn picture_back(&mut self) -> Result<(), RenderError> {
        self.sequence.picture_back(self.gradient_is_here.then_some(&self.gradient))?;
        self.with_view("picture_back", |renderer, view| Ok((renderer.record_back(view)?, ())))
    }

    fn rows_out(&mut self, batch: usize, rows: &Columns, grads: &mut Gradients) -> Result<(), RenderError> {
        self.sequence.rows_out(batch, rows)?;
        self.with_view("rows_out", |renderer, mut view| {
            let back = view.back.take().ok_or(RenderError::OutOfOrder { call: "rows_out", needs: "picture_back" })?;
            let back = renderer.submit_back(&view, back)?;
            renderer.finish(&view, back, rows.sh_degree, grads)?;
            Ok((view, ()))
        })
    }

    fn loss_value(&mut self) -> Result<LossValue, RenderError> {
        if self.view.as_ref().is_none_or(|view| view.loss.is_none()) {
            return Err(RenderError::OutOfOrder { call: "loss_value", needs: "loss" });
        }
        self.with_view("loss_value", |renderer, view| renderer.read_value(view))
    }
}
