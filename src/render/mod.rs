//! Rendering forward and backward: rows to a picture, picture to a loss, loss to gradients of the rows. Also the image
//! metrics of reports.
//!
//! [`Renderer`] is the interface of every backend: the stages of one view, in order, on batches of rows. The CPU
//! backend is [`cpu`]. The device backend is [`gpu`], with its stages in `gpu_rows`, `gpu_tiles`, `gpu_tiles_bwd` and
//! `gpu_loss`. A device that also holds the pages of a run is a [`pages::PageRenderer`]. The kernels themselves are in [`crate::kernels`] and `shaders/`.

pub mod color_correct;
pub mod cpu;
pub mod device_check;
pub mod device_needs;
pub mod gpu;
mod gpu_back;
pub mod gpu_frame;
mod gpu_gradients;
pub mod gpu_loss;
mod gpu_paged;
pub mod gpu_pages;
mod gpu_picture;
mod gpu_range_plan;
mod gpu_ranges;
mod gpu_recorded;
pub mod gpu_rows;
mod gpu_segments;
pub mod gpu_slots;
pub mod gpu_tiles;
pub mod gpu_tiles_bwd;
mod gpu_update;
mod gpu_view;
pub mod lpips;
pub mod metrics;
pub mod pages;
mod sequence;
pub mod view_sizes;

use crate::base::simd::SimdPath;
use crate::gpu::GpuError;
pub use crate::gpu::Traffic;
pub use crate::kernels::image_loss::{LossOptions, LossValue, SsimPadding};
use crate::kernels::splats::Grid;
use crate::scene::camera::Camera;
use crate::scene::columns::Columns;
pub use crate::scene::columns::Gradients;
pub use crate::scene::image::PictureGradient;
use crate::scene::image::{Image, Target};
use view_sizes::ViewSizes;

/// The parameters of a rendering besides rows and camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RenderOptions {
    /// SH degree to evaluate, 0 to 3; at most the degree that the rows are stored with.
    pub sh_degree: u8,
    /// Upper clamp of alpha.
    pub max_alpha: f32,
    /// Blur of the projected covariance, px^2.
    pub eps2d: f32,
    /// Background colour, RGB, weighted by the transmittance that is left.
    pub background: [f32; 3],
    /// Instruction path of the CPU kernels.
    pub simd: SimdPath,
}

impl Default for RenderOptions {
    fn default() -> Self {
        RenderOptions { sh_degree: 3, max_alpha: 0.99, eps2d: 0.3, background: [0.0; 3], simd: SimdPath::best() }
    }
}

/// How the rows of a view come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RowBatches {
    /// In one batch: the ordinary case. A device keeps the rows until the gradients are computed.
    One,
    /// In any number of batches, at least one. A device keeps the splats and drops the rows.
    Several,
}

/// Why a view could not be rendered.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RenderError {
    /// A side of the picture is longer than [`Grid::SIDE_MAX`]: tile numbers have 24 bits.
    #[error("an image of {width}x{height} is too large: each side may have at most {} pixels", Grid::SIDE_MAX)]
    ImageTooLarge { width: u32, height: u32 },
    /// A view has more rows than 32-bit row numbers can count.
    #[error("{0} Gaussians are too many for one view: the limit is {max}", max = u32::MAX - 1)]
    TooManyRows(usize),
    /// The options ask for a higher SH degree than the rows hold.
    #[error("SH degree {asked} was requested, but the rows are stored with degree {stored}")]
    ShDegree { asked: u8, stored: u8 },
    /// The photo and the picture differ in size.
    #[error("the target is {}x{}, the picture {}x{}", .target.0, .target.1, .image.0, .image.1)]
    TargetSize { target: (u32, u32), image: (u32, u32) },
    /// A stage was called before a stage that it depends on.
    #[error("the stage {call} must follow {needs}")]
    OutOfOrder { call: &'static str, needs: &'static str },
    /// The view has no such batch, or the batch had another number of rows on the way in.
    #[error("this view has no batch {batch} with {given} rows")]
    BatchRows { batch: usize, given: usize },
    /// The gradient of the picture and the picture differ in size.
    #[error("the gradient of the picture must have the size of the picture, {pixels} pixels")]
    GradientSize { pixels: usize },
    /// Pages or an optimizer were asked of a backend that has neither.
    #[error("the {backend} backend holds no pages of this run")]
    NoPages { backend: &'static str },
    /// The device has no memory for a single page.
    #[error("the device has no memory for a page of {bytes} bytes beside a view")]
    NoSlots { bytes: u64 },
    /// The device failed, or the view exceeds a limit of the device. The error names the stage or buffer.
    #[error(transparent)]
    Device(#[from] GpuError),
}

/// `None` where the device has too little memory for the work, which a caller can do in smaller parts or later.
/// Errors: every other error.
pub(crate) fn none_if_out_of_memory<T>(done: Result<T, RenderError>) -> Result<Option<T>, RenderError> {
    match done {
        Ok(done) => Ok(Some(done)),
        Err(RenderError::Device(error)) if error.is_out_of_memory() => Ok(None),
        Err(error) => Err(error),
    }
}

impl RenderError {
    /// What the user can do about the error; `None` when the message itself contains the remedy.
    pub fn remedy(&self) -> Option<&'static str> {
        match self {
            RenderError::Device(
                GpuError::OutOfBudget { .. } | GpuError::OutOfMemory { .. } | GpuError::DeviceFull { .. },
            ) => None,
            RenderError::Device(GpuError::BufferTooLarge { .. } | GpuError::BindingTooLarge { .. }) => {
                Some("make the photos smaller with --max-resolution or --data-factor, or render with --device cpu")
            }
            RenderError::Device(GpuError::DeviceLost { .. }) => Some(
                "update the graphics driver if this happens again, or render with --device cpu (with --optimizer-on host \
                     --accept-changes, if the optimizer was on the device)",
            ),
            RenderError::Device(_) => Some("render with --device cpu, and report a bug"),
            RenderError::NoPages { .. } => Some("train with --optimizer-on host"),
            RenderError::NoSlots { .. } => Some("raise --device-mem, or train with --optimizer-on host"),
            _ => Some(
                "make the photos smaller with --max-resolution or --data-factor; if they are not large, report a bug",
            ),
        }
    }
}

/// Renders one view at a time, in stages:
///
/// ```text
/// begin_view ──> rows_in (each batch) ──> picture ──> loss ──> picture_back ──> rows_out (each batch) ──> loss_value,
///                                            │          │                                                 unusable_splats
///                                            │          └> picture_gradient: read or change the gradient
///                                            └> image: read the picture; picture_mut: correct the picture
/// ```
///
/// A batch is a consecutive part of the view's rows. All batches in order make up the view. The number of batches
/// changes no bit of the result; one batch is the ordinary case. The caller provides the rows of a batch to `rows_in`
/// and again to `rows_out`, and may drop the rows between the two calls.
///
/// A device may still execute a stage when the call returns. A later failure is then reported by the call that needs
/// the result. A stage that is called out of order returns [`RenderError::OutOfOrder`] and changes nothing. A
/// [`RenderError::Device`] drops the view; the next call must be `begin_view`.
pub trait Renderer: Send {
    /// Name of the backend, for reports.
    fn name(&self) -> &'static str;

    /// Name of the device, for reports.
    fn device(&self) -> String {
        self.name().to_string()
    }

    /// Bytes transferred to and from the device so far, and device memory; zeros for a backend without a device.
    fn traffic(&self) -> Traffic {
        Traffic::default()
    }

    /// The backend as one that can hold pages; `None` for a backend without a device.
    fn pages(&mut self) -> Option<&mut dyn pages::PageRenderer> {
        None
    }

    /// Host memory that the renderer holds, bytes: the most of any view since [`Renderer::free_rows`].
    fn host_bytes(&self) -> u64;

    /// The part of [`Renderer::host_bytes`] that grows with the rows of a view. 0 for a backend whose rows lie in device memory.
    fn host_bytes_of_rows(&self) -> u64 {
        0
    }

    /// What [`Renderer::host_bytes_of_rows`] is at most after a view with this many rows, if nothing is held before it.
    fn host_bytes_for_rows(&self, _rows: u64) -> u64 {
        0
    }

    /// Frees the buffers that grow with the rows of a view, between views. The next view allocates the buffers again.
    fn free_rows(&mut self) {}

    /// The sizes of the last view, from which its device memory follows; `None` for a backend without a device.
    fn device_sizes(&self) -> Option<ViewSizes> {
        None
    }

    /// Limits the memory for intersection lists and per-intersection sums of the next views, bytes; `None` stands for no limit.
    /// A picture whose lists need more is blended in ranges of tiles, at least one tile at a time. The limit changes no bit of
    /// the result.
    fn set_list_bytes(&mut self, bytes: Option<u64>);

    /// Whether the backward passes of the next views also collect [`Gradients::weights`]. The error that they weigh is
    /// that of the picture which [`Renderer::loss`] compared, zero where the photo is masked. Changes no bit of picture,
    /// loss and gradients.
    /// Errors: the device rejects a shader that this needs: shaders are compiled the first time.
    fn weigh_rows(&mut self, is_wanted: bool) -> Result<(), RenderError>;

    /// Begins a view. Drops the previous view.
    /// Errors: the picture is too large.
    fn begin_view(&mut self, camera: &Camera, options: &RenderOptions, batches: RowBatches) -> Result<(), RenderError>;

    /// Projects and colours the rows of the next batch and appends the splats to those of the view.
    /// Errors: the view has one batch, which was given already, the view has too many rows, the rows hold a lower SH degree than the options
    /// request, or device memory is exhausted.
    fn rows_in(&mut self, rows: &Columns) -> Result<(), RenderError>;

    /// Sorts the splats by depth, lists the splats of each tile and blends the lists.
    /// Errors: the view has no batch of rows yet, or device memory is exhausted.
    fn picture(&mut self) -> Result<(), RenderError>;

    /// The picture.
    /// Errors: the view has no picture yet, or `picture_back` ran and `rows_out` of a batch is still due.
    fn image(&mut self) -> Result<&Image, RenderError>;

    /// The values of the picture in host memory, `[3][height][width]`, for the caller to correct. [`Renderer::loss`]
    /// then compares the corrected picture, and the gradient is that of the corrected picture. The caller must
    /// propagate the gradient through the correction, in [`Renderer::picture_gradient`]. On a device the picture
    /// crosses the bus twice.
    fn picture_mut(&mut self) -> Result<&mut [f32], RenderError>;

    /// Computes the loss of the picture against `target` and the gradient of the picture. Replaces an earlier gradient.
    /// Errors: as [`Renderer::image`], or target and picture differ in size.
    fn loss(&mut self, target: &Target, options: &LossOptions) -> Result<(), RenderError>;

    /// The gradient of the picture in host memory: the gradient of the loss, or zeros if no loss ran.
    /// [`Renderer::picture_back`] starts from the values that the caller leaves here. A second loss term adds its
    /// gradient here, and a correction of the picture propagates the gradient here. On a device the gradient crosses
    /// the bus twice.
    fn picture_gradient(&mut self) -> Result<&mut PictureGradient, RenderError>;

    /// Propagates the gradient of the picture back to the splats of the view.
    /// Errors: the picture has no gradient, or the caller changed the size of the gradient.
    fn picture_back(&mut self) -> Result<(), RenderError>;

    /// Propagates the gradients of the splats back to the rows of one batch (counted from 0). The caller provides the
    /// same rows as to [`Renderer::rows_in`]. Batches may come in any order, each once. Every entry of `grads` is
    /// written; rows that were not drawn get zeros.
    /// Errors: [`Renderer::picture_back`] has not run, the batch was processed already, or the batch had another number of
    /// rows.
    fn rows_out(&mut self, batch: usize, rows: &Columns, grads: &mut Gradients) -> Result<(), RenderError>;

    /// The number of rows of the view whose splats have a gradient that is not finite, or beyond
    /// [`crate::base::math::LARGEST_SPLAT_GRAD`]: too large for the optimizer. To be called after the first `rows_out`; a
    /// device does not wait then.
    /// Errors: no batch is out yet, or the device failed.
    fn unusable_splats(&mut self) -> Result<u64, RenderError>;

    /// The value of the last [`Renderer::loss`]. On a device, a call after `rows_out` does not wait.
    fn loss_value(&mut self) -> Result<LossValue, RenderError>;

    /// Runs the stages of a one-batch view up to the picture.
    fn draw(&mut self, rows: &Columns, camera: &Camera, options: &RenderOptions) -> Result<(), RenderError> {
        self.begin_view(camera, options, RowBatches::One)?;
        self.rows_in(rows)?;
        self.picture()
    }

    /// Runs the stages of a one-batch view from the gradient of the picture back to the rows.
    fn backpropagate(&mut self, rows: &Columns, grads: &mut Gradients) -> Result<(), RenderError> {
        self.picture_back()?;
        self.rows_out(0, rows, grads)
    }
}
