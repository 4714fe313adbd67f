//! The stages in order on a GPU, forward and backward, on the rows of one view at a time.
//!
//! Not here: the stages themselves (`gpu_rows`, `gpu_tiles`, `gpu_loss`), the device and its memory (`crate::gpu`).
//!
//! What crosses the bus in a step, with n rows in view, p pixels and all colour bands: 236 n bytes of values and 4 p of
//! the photo up, 236 n of gradients and 16 n for densification down, and some KiB of counts and uniforms. Less is not
//! possible while the truth of every value is on the host (the photo's mask could be left out where there is none).
//! What waits for what:
//!
//! | crosses | while |
//! | --- | --- |
//! | geometry up (44 n) | nothing: it is the first thing that the device needs |
//! | colours up (192 n) | the device projects and sorts |
//! | photo up (4 p), commands of the loss | the device finishes the colours, makes the lists and blends |
//! | two counts down, commands of the backward stages | the device computes the loss |
//! | gradients of colours down (192 n) | the device goes from splats to geometry |
//! | gradients of geometry down (60 n) | nothing: they are the last thing that the device makes |
//!
//! So the device waits for the host between two steps only. There the next step's values are not known yet: each row in
//! view was just rewritten by the optimizer, and the cull of the next view reads the means that it wrote. The rows of the
//! next view that this one does not see are known (their values are a function of the stored state and the step), but
//! which these are follows from a cull too; that, and keeping rows on the device, is for the device tier. The next photo
//! is known, but has its place above, where it delays nothing.
//!
//! Invariants: 1. only the rows of the last view, its lists and its picture are on the device; 2. the same input gives
//! the same bits on the same device; 3. nothing is returned that was made of buffers that were too small: such a frame
//! and its loss are recorded again with larger ones; 4. after an error there is no view until the next `forward`.

use super::gpu_loss::{LossStage, value};
use super::gpu_rows::{DeviceColumns, FOOTPRINT_BYTES, RowStages, band_into_sh_n};
use super::gpu_tiles::{Blend, Demand, DemandReadback, Frame, Ranks, TileStages, splat_bytes};
use super::gpu_tiles_bwd::PictureGradients;
use super::{Gradients, LossOptions, LossValue, RenderError, RenderOptions, Renderer};
use crate::base::room;
use crate::gpu::{Buffer, DeviceKind, Gpu, GpuResult, Readback, Recorder, Traffic};
use crate::kernels::image_loss::LossPlan;
use crate::kernels::splats::Grid;
use crate::kernels::uniforms::pack_target;
use crate::scene::camera::Camera;
use crate::scene::columns::Columns;
use crate::scene::image::{Image, Target};

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

/// What the device holds of the last view.
#[derive(Debug)]
struct View {
    camera: Camera,
    options: RenderOptions,
    columns: DeviceColumns,
    splats: Buffer,
    ranks: Ranks,
    frame: Frame,
    need: Need,
    /// Whether `image` holds its picture.
    image_is_read: bool,
}

/// A view whose picture is right.
struct Settled {
    view: View,
    demand: Demand,
    /// Its frame was recorded again: what was made of the picture before is void.
    again: bool,
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
    view: Option<View>,
    image: Image,
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
    sums: Option<Readback>,
}

/// A loss that is under way.
struct Loss {
    v_rgb: Buffer,
    /// None for a picture without pixels.
    sums: Option<Readback>,
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
            view: None,
            image: Image::default(),
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
    /// Without a forward pass, or when the device failed.
    pub fn alpha(&mut self) -> Result<Vec<f32>, RenderError> {
        let view = self.view.take().ok_or(RenderError::NoForward)?;
        let Settled { view, .. } = self.settle(view)?;
        let mut alpha = vec![0.0; view.camera.pixels()];
        let mut recorder = self.gpu.begin("coverage");
        let bytes = recorder.read_back("rasterize_fwd", &view.frame.t_final.view())?;
        self.gpu.submit(recorder)?;
        bytes.copy_to(&self.gpu, &mut alpha)?;
        self.view = Some(view);
        alpha.iter_mut().for_each(|t| *t = 1.0 - *t);
        Ok(alpha)
    }

    /// Submits the forward stages; does not wait for them.
    fn render(&mut self, rows: &Columns, camera: &Camera, options: &RenderOptions) -> GpuResult<View> {
        let gpu = &self.gpu;
        // The caller has checked that the count fits.
        let count = rows.rows() as u32;
        let columns = DeviceColumns::new(gpu, count, options.sh_degree)?;
        let splats = gpu.buffer("splats", splat_bytes(count))?;
        let mut recorder = gpu.begin("forward");
        columns.upload_geometry(&mut recorder, rows)?;
        self.rows.project_fwd(gpu, &mut recorder, camera, options.eps2d, &columns, &splats)?;
        let grid = Grid::new(camera.width, camera.height);
        let blend = Blend { grid, background: options.background, max_alpha: options.max_alpha };
        let ranks = self.tiles.order(gpu, &mut recorder, &splats.view(), count, grid)?;
        gpu.submit(recorder)?;
        // The device projects and sorts while colours, four fifths of a row, are on their way.
        let mut recorder = gpu.begin("forward");
        columns.upload_colors(&mut recorder, rows, &mut self.scratch.band)?;
        self.rows.sh_fwd(gpu, &mut recorder, camera, options.sh_degree, &columns, &splats)?;
        let (frame, demand) = self.tiles.frame(gpu, &mut recorder, &splats.view(), &ranks, blend)?;
        gpu.submit(recorder)?;
        let (camera, options, need) = (*camera, *options, Need::UnderWay(demand));
        Ok(View { camera, options, columns, splats, ranks, frame, need, image_is_read: false })
    }

    /// Waits for what the view's frame needs. A frame with too little room is recorded again, with more.
    fn settle(&mut self, mut view: View) -> GpuResult<Settled> {
        let (gpu, mut again) = (&self.gpu, false);
        loop {
            let demand = match view.need {
                Need::Met(demand) => demand,
                Need::UnderWay(readback) => readback.wait(gpu)?,
            };
            view.need = Need::Met(demand);
            if self.tiles.fits(&view.frame, demand)? {
                return Ok(Settled { view, demand, again });
            }
            again = true;
            self.frames_again += 1;
            let blend = view.frame.blend;
            drop(view.frame); // its memory is free for the next
            let mut recorder = gpu.begin("forward again");
            let (frame, demand) = self.tiles.frame(gpu, &mut recorder, &view.splats.view(), &view.ranks, blend)?;
            gpu.submit(recorder)?;
            (view.frame, view.need) = (frame, Need::UnderWay(demand));
        }
    }

    fn read_image(&mut self, view: &View) -> GpuResult<()> {
        let Camera { width, height, .. } = view.camera;
        let mut recorder = self.gpu.begin("picture");
        let bytes = recorder.read_back("rasterize_fwd", &view.frame.rgb.view())?;
        self.gpu.submit(recorder)?;
        (self.image.width, self.image.height) = (width, height);
        self.image.rgb.resize(3 * view.camera.pixels(), 0.0);
        bytes.copy_to(&self.gpu, &mut self.image.rgb)
    }

    /// Submits the backward stages behind `v_rgb`, and what is read back of them.
    fn submit_backward(
        &self,
        mut recorder: Recorder<'_>,
        Settled { view, demand, .. }: &Settled,
        v_rgb: &Buffer,
        v_alpha: Option<&Buffer>,
    ) -> GpuResult<GradientReadbacks> {
        let (gpu, camera, splats) = (&self.gpu, &view.camera, &view.splats);
        let (eps2d, sh_degree) = (view.options.eps2d, view.options.sh_degree);
        let v_splats = gpu.buffer("v_splats", splat_bytes(view.ranks.rows))?;
        let v_alpha = v_alpha.map(Buffer::view);
        self.tiles.backward(
            gpu,
            &mut recorder,
            &splats.view(),
            &view.ranks,
            &view.frame,
            *demand,
            PictureGradients { v_rgb: &v_rgb.view(), v_alpha: v_alpha.as_ref() },
            &v_splats.view(),
        )?;
        let grads = DeviceColumns::new(gpu, view.ranks.rows, sh_degree)?;
        self.rows.sh_bwd(gpu, &mut recorder, camera, sh_degree, &view.columns, splats, &v_splats, &grads)?;
        let colors: Vec<Readback> = std::iter::once(&grads.sh0)
            .chain(&grads.bands)
            .map(|buffer| recorder.read_back("sh_bwd", &buffer.view()))
            .collect::<GpuResult<_>>()?;
        gpu.submit(recorder)?;
        // Colours, four fifths of a row, are copied on the host while the device does the rest.
        let mut recorder = gpu.begin("backward");
        let footprints = gpu.buffer("footprints", FOOTPRINT_BYTES * u64::from(view.ranks.rows))?;
        let (columns, into) = (&view.columns, &mut recorder);
        self.rows.project_bwd(gpu, into, camera, eps2d, columns, splats, &v_splats, &grads, &footprints)?;
        let geometry = [&grads.means, &grads.quats, &grads.scales, &grads.opacities]
            .map(|buffer| recorder.read_back("project_bwd", &buffer.view()));
        let back = GradientReadbacks {
            colors,
            geometry: geometry.into_iter().collect::<GpuResult<_>>()?,
            footprints: recorder.read_back("project_bwd", &footprints.view())?,
            sums: None,
        };
        gpu.submit(recorder)?;
        Ok(back)
    }

    /// Submits the loss of the view's picture, whether or not it is right yet.
    fn submit_loss(
        &self,
        mut recorder: Recorder<'_>,
        view: &View,
        pixels: &Buffer,
        plan: &LossPlan,
    ) -> GpuResult<Loss> {
        let gpu = &self.gpu;
        let v_rgb = gpu.buffer("v_rgb", view.frame.rgb.size())?;
        let size = [view.camera.width, view.camera.height];
        let (rgb, target) = (view.frame.rgb.view(), pixels.view());
        let sums = self.loss.run(gpu, &mut recorder, size, plan, &rgb, &target, &v_rgb.view())?;
        let sums = sums.map(|sums| recorder.read_back("image_loss", &sums.slice(0, 16))).transpose()?;
        gpu.submit(recorder)?;
        Ok(Loss { v_rgb, sums })
    }

    fn run_loss(
        &mut self,
        view: View,
        target: &Target,
        plan: &LossPlan,
        sh_degree: u8,
        grads: &mut Gradients,
    ) -> GpuResult<(View, LossValue)> {
        // The device blends while the photo is packed, crosses the bus, and the loss is recorded behind it.
        pack_target(target, &mut self.scratch.target);
        let mut recorder = self.gpu.begin("image_loss");
        let pixels = recorder.buffer_with("target", &self.scratch.target)?;
        let mut loss = self.submit_loss(recorder, &view, &pixels, plan)?;
        let settled = self.settle(view)?;
        if settled.again {
            drop(loss); // of a picture that was not right
            loss = self.submit_loss(self.gpu.begin("image_loss"), &settled.view, &pixels, plan)?;
        }
        let back = self.submit_backward(self.gpu.begin("backward"), &settled, &loss.v_rgb, None)?;
        let back = GradientReadbacks { sums: loss.sums, ..back };
        let sums = self.finish(&settled.view, back, sh_degree, grads)?;
        Ok((settled.view, value(plan, sums)))
    }

    /// Waits for the gradients and puts them where the caller wants them; returns the sums of the loss.
    fn finish(
        &mut self,
        view: &View,
        back: GradientReadbacks,
        sh_degree: u8,
        grads: &mut Gradients,
    ) -> GpuResult<[f32; 4]> {
        let rows = view.ranks.rows as usize;
        let mut sums = [0.0f32; 4];
        if let Some(bytes) = back.sums {
            bytes.copy_to(&self.gpu, &mut sums)?;
        }
        let out = &mut grads.columns;
        out.sh_degree = sh_degree;
        out.resize(rows);
        if view.options.sh_degree < sh_degree {
            out.sh_n.fill(0.0); // bands that are not in use
        }
        let mut colors = back.colors.into_iter();
        for bytes in colors.by_ref().take(1) {
            bytes.copy_to(&self.gpu, &mut out.sh0)?;
        }
        for (band, bytes) in colors.enumerate() {
            let values = &mut self.scratch.band;
            values.clear();
            values.resize(rows * super::gpu_rows::BAND_WIDTHS[band], 0.0);
            bytes.copy_to(&self.gpu, values)?;
            band_into_sh_n(values, band, out);
        }
        let geometry = [&mut out.means, &mut out.quats, &mut out.scales, &mut out.opacities];
        for (to, bytes) in geometry.into_iter().zip(back.geometry) {
            bytes.copy_to(&self.gpu, to)?;
        }
        let footprints = &mut self.scratch.footprints;
        room::resize(footprints, rows, [0.0; 4]);
        back.footprints.copy_to(&self.gpu, footprints)?;
        grads.radii.clear();
        grads.radii.extend(footprints.iter().map(|f| [f[2] as u32, f[3] as u32]));
        grads.means2d.clear();
        grads.means2d.extend(footprints.iter().map(|f| [f[0], f[1]]));
        Ok(sums)
    }

    /// Gradients of the last view's rows, from `v_rgb` (`[3][height][width]`) and `v_alpha` (`[height][width]`), as
    /// [`super::cpu::CpuRenderer::backward`].
    ///
    /// # Errors
    /// Without a forward pass of these rows, or when the device failed.
    pub fn backward(
        &mut self,
        rows: &Columns,
        v_rgb: &[f32],
        v_alpha: Option<&[f32]>,
        grads: &mut Gradients,
    ) -> Result<(), RenderError> {
        let view = self.take_view(rows)?;
        let settled = self.settle(view)?;
        let gpu = &self.gpu;
        let mut recorder = gpu.begin("backward");
        let v_rgb = recorder.buffer_with("v_rgb", v_rgb)?;
        let v_alpha = v_alpha.map(|v| recorder.buffer_with("v_alpha", v)).transpose()?;
        let back = self.submit_backward(recorder, &settled, &v_rgb, v_alpha.as_ref())?;
        self.finish(&settled.view, back, rows.sh_degree, grads)?;
        self.view = Some(settled.view);
        Ok(())
    }

    /// The last view, if it is one of so many rows.
    fn take_view(&mut self, rows: &Columns) -> Result<View, RenderError> {
        match self.view.take() {
            Some(view) if view.ranks.rows as usize == rows.rows() => Ok(view),
            other => {
                self.view = other;
                Err(RenderError::NoForward)
            }
        }
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
        let traffic = self.gpu.traffic();
        // Such adapters have no memory of their own.
        let is_shared = matches!(self.gpu.summary().kind, DeviceKind::Integrated | DeviceKind::Software);
        let device = if is_shared { traffic.device_bytes_peak } else { 0 };
        (4 * floats + size_of::<Footprint>() * s.footprints.capacity()) as u64 + traffic.staging_bytes + device
    }

    fn forward(&mut self, rows: &Columns, camera: &Camera, options: &RenderOptions) -> Result<(), RenderError> {
        super::check_view(rows, camera, options)?;
        // What the last view held is free for this one.
        self.view = None;
        self.view = Some(self.render(rows, camera, options)?);
        Ok(())
    }

    fn image(&mut self) -> Result<&Image, RenderError> {
        let view = self.view.take().ok_or(RenderError::NoForward)?;
        let Settled { mut view, .. } = self.settle(view)?;
        if !view.image_is_read {
            self.read_image(&view)?;
            view.image_is_read = true;
        }
        self.view = Some(view);
        Ok(&self.image)
    }

    fn loss_backward(
        &mut self,
        rows: &Columns,
        target: &Target,
        options: &LossOptions,
        grads: &mut Gradients,
    ) -> Result<LossValue, RenderError> {
        let view = self.take_view(rows)?;
        let (image, size) = ((view.camera.width, view.camera.height), (target.width, target.height));
        if size != image {
            self.view = Some(view);
            return Err(RenderError::TargetSize { target: size, image });
        }
        let plan = LossPlan::new(size.0 as usize, size.1 as usize, target.mask.as_deref(), options);
        let (view, value) = self.run_loss(view, target, &plan, rows.sh_degree, grads)?;
        self.view = Some(view);
        Ok(value)
    }
}
