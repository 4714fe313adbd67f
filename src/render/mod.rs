//! From rows to a picture, from the picture to a loss, and from the loss to gradients of the rows; and image metrics.
//!
//! [`Renderer`] is the interface of every backend: the stages of one view, in order, on batches of rows.

pub mod color_correct;
pub mod cpu;
pub mod gpu;
pub mod gpu_loss;
pub mod gpu_rows;
pub mod gpu_tiles;
pub mod gpu_tiles_bwd;
pub mod lpips;
pub mod metrics;
mod sequence;

use crate::base::simd::SimdPath;
use crate::gpu::GpuError;
pub use crate::gpu::Traffic;
pub use crate::kernels::image_loss::{LossOptions, LossValue, SsimPadding};
use crate::kernels::splats::Grid;
use crate::scene::camera::Camera;
use crate::scene::columns::Columns;
use crate::scene::image::{Image, Target};

/// What a rendering depends on besides rows and camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RenderOptions {
    /// Bands in use now, 0 to 3; at most the degree the rows are stored with.
    pub sh_degree: u8,
    /// Upper clamp of alpha.
    pub max_alpha: f32,
    /// Blur of the projected covariance, px^2.
    pub eps2d: f32,
    /// RGB added behind everything.
    pub background: [f32; 3],
    /// Instruction path of the CPU kernels.
    pub simd: SimdPath,
}

impl Default for RenderOptions {
    fn default() -> Self {
        RenderOptions { sh_degree: 3, max_alpha: 0.99, eps2d: 0.3, background: [0.0; 3], simd: SimdPath::best() }
    }
}

/// Gradients of one batch of a view, one entry per row.
#[derive(Debug, Clone, Default)]
pub struct Gradients {
    /// With respect to the stored (pre-activation) columns.
    pub columns: Columns,
    /// With respect to the pixel position of the mean, signed, pixel units.
    pub means2d: Vec<[f32; 2]>,
    /// Half extents of the footprint, pixels; [0, 0]: the row was not drawn.
    pub radii: Vec<[u32; 2]>,
}

/// Gradient of a loss with respect to a picture, on the host: what the way back starts from.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PictureGradient {
    /// `[3][height][width]`.
    pub v_rgb: Vec<f32>,
    /// `[height][width]`, for the coverage 1 - T; none: zeros.
    pub v_alpha: Option<Vec<f32>>,
}

impl PictureGradient {
    /// Becomes a gradient of zeros for so many pixels; keeps the allocation.
    fn reset(&mut self, pixels: usize) {
        self.v_rgb.clear();
        self.v_rgb.resize(3 * pixels, 0.0);
        self.v_alpha = None;
    }

    /// Bytes held.
    fn bytes(&self) -> u64 {
        let floats = self.v_rgb.capacity() + self.v_alpha.as_ref().map_or(0, Vec::capacity);
        (4 * floats) as u64
    }
}

/// Why a view could not be rendered.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RenderError {
    /// Tiles are numbered in 24 bits.
    #[error("an image of {width}x{height} is too large: a side holds at most {} pixels", Grid::SIDE_MAX)]
    ImageTooLarge {
        /// Pixels.
        width: u32,
        /// Pixels.
        height: u32,
    },
    /// Rows are numbered in 32 bits within a view.
    #[error("{0} Gaussians are too many for one view")]
    TooManyRows(usize),
    /// More bands were asked for than the rows hold.
    #[error("SH degree {asked} was asked for, but the rows are stored with degree {stored}")]
    ShDegree {
        /// Of the options.
        asked: u8,
        /// Of the rows.
        stored: u8,
    },
    /// The photo does not have the size of the picture.
    #[error("the target is {}x{}, the picture {}x{}", .target.0, .target.1, .image.0, .image.1)]
    TargetSize {
        /// Width and height of the target.
        target: (u32, u32),
        /// Width and height of the picture.
        image: (u32, u32),
    },
    /// A stage was called before one that it needs.
    #[error("{call} was called, but it needs {needs} first")]
    OutOfOrder {
        /// The stage.
        call: &'static str,
        /// What must come before it.
        needs: &'static str,
    },
    /// The rows of a view were to come in a number of batches that this backend does not take.
    #[error("a view in {asked} batches of rows was asked for; it may have 1 to {most}")]
    Batches {
        /// Of the caller.
        asked: usize,
        /// Of the backend.
        most: usize,
    },
    /// The rows that went in as this batch were others.
    #[error("batch {batch} of this view is not one of {given} rows")]
    BatchRows {
        /// Counted from 0.
        batch: usize,
        /// Rows that the caller gave.
        given: usize,
    },
    /// The gradient of the picture does not have the size of the picture.
    #[error("the gradient of the picture does not belong to a picture of {pixels} pixels")]
    GradientSize {
        /// Of the picture.
        pixels: usize,
    },
    /// The device could not do its part, or the view does not fit it; the stage or buffer is named.
    #[error(transparent)]
    Device(#[from] GpuError),
}

impl RenderError {
    /// What the user can do about it; `None` when the text says so itself.
    pub fn remedy(&self) -> Option<&'static str> {
        match self {
            RenderError::Device(GpuError::OutOfBudget { .. } | GpuError::OutOfMemory { .. }) => None,
            RenderError::Device(GpuError::BufferTooLarge { .. } | GpuError::BindingTooLarge { .. }) => {
                Some("make the photos smaller with --max-resolution or --data-factor, or render with --device cpu")
            }
            RenderError::Device(GpuError::DeviceLost { .. }) => {
                Some("update the graphics driver if this happens again, or render with --device cpu")
            }
            RenderError::Device(_) => Some("render with --device cpu, and report a bug"),
            _ => Some(
                "make the photos smaller with --max-resolution or --data-factor; if they are not large, report a bug",
            ),
        }
    }
}

/// Renders one view at a time, in stages:
///
/// ```text
/// begin_view ──> rows_in (each batch) ──> picture ──> loss ──> picture_back ──> rows_out (each batch) ──> loss_value
///                                            │          │
///                                            │          └> picture_gradient: read it, add to it, take it through a correction
///                                            └> image; picture_mut: correct it
/// ```
///
/// A batch is a part of the view's rows; the batches together are the view's rows in their order, and their number
/// changes no bit. One batch is the ordinary case. The rows of a batch are needed while it goes in and while it comes
/// out, not between. A device may still be at work on a stage when its call returns: what it fails at later is an error
/// of the call that needs the result. A stage out of order is [`RenderError::OutOfOrder`] and changes nothing. After a
/// [`RenderError::Device`] there is no view until the next `begin_view`.
pub trait Renderer: Send {
    /// Name for reports.
    fn name(&self) -> &'static str;

    /// The device, for reports.
    fn device(&self) -> String {
        self.name().to_string()
    }

    /// What crossed the bus to the device so far, and its memory; zeros where there is no device.
    fn traffic(&self) -> Traffic {
        Traffic::default()
    }

    /// Host memory held for views, bytes.
    fn host_bytes(&self) -> u64;

    /// Begins a view whose rows come in `batches` batches. The view before is given up.
    ///
    /// # Errors
    /// The picture is too large, or this backend does not take as many batches.
    fn begin_view(&mut self, camera: &Camera, options: &RenderOptions, batches: usize) -> Result<(), RenderError>;

    /// Projects and colours the rows of the next batch: its splats are appended to the view's.
    ///
    /// # Errors
    /// All batches are in, there are too many rows, they hold fewer bands than the options ask for, or a device has no
    /// room for them.
    fn rows_in(&mut self, rows: &Columns) -> Result<(), RenderError>;

    /// Sorts the splats by depth, lists them by tile and blends them.
    ///
    /// # Errors
    /// Not all batches are in, or a device has no room for the lists.
    fn picture(&mut self) -> Result<(), RenderError>;

    /// The picture.
    ///
    /// # Errors
    /// Without a picture, or while its gradient is on the way back to the rows.
    fn image(&mut self) -> Result<&Image, RenderError>;

    /// The values of the picture on the host, `[3][height][width]`, to be corrected: [`Renderer::loss`] compares what
    /// the caller makes of them. The gradient is then that of the corrected picture, and the caller takes it back
    /// through the correction, by [`Renderer::picture_gradient`]. On a device the picture crosses the bus twice.
    ///
    /// # Errors
    /// As [`Renderer::image`].
    fn picture_mut(&mut self) -> Result<&mut [f32], RenderError>;

    /// Computes the loss of the picture against `target`, and the gradient of the picture, which replaces any other.
    ///
    /// # Errors
    /// As [`Renderer::image`], or when the target's size differs.
    fn loss(&mut self, target: &Target, options: &LossOptions) -> Result<(), RenderError>;

    /// The gradient of the picture on the host, as the loss left it, or zeros where there was no loss. What the caller
    /// makes of it is what [`Renderer::picture_back`] starts from: here a second term of the loss adds its gradient, and
    /// a correction of the picture takes the gradient back through itself. On a device the gradient crosses the bus
    /// twice.
    ///
    /// # Errors
    /// As [`Renderer::image`].
    fn picture_gradient(&mut self) -> Result<&mut PictureGradient, RenderError>;

    /// Takes the gradient of the picture back to the view's splats.
    ///
    /// # Errors
    /// Without a gradient, or when the caller changed its size.
    fn picture_back(&mut self) -> Result<(), RenderError>;

    /// Takes the gradients of the splats back to the rows of a batch (counted from 0), which are given again. Batches
    /// come out in any order, each once. Every entry of `grads` is written, zeros for rows that were not drawn.
    ///
    /// # Errors
    /// Before [`Renderer::picture_back`], when the batch is out already, or when it had another number of rows.
    fn rows_out(&mut self, batch: usize, rows: &Columns, grads: &mut Gradients) -> Result<(), RenderError>;

    /// The value of the last [`Renderer::loss`]. On a device it is there without waiting once rows are out.
    ///
    /// # Errors
    /// Without a loss.
    fn loss_value(&mut self) -> Result<LossValue, RenderError>;

    /// The stages of a view of one batch up to its picture.
    ///
    /// # Errors
    /// Those of the stages.
    fn draw(&mut self, rows: &Columns, camera: &Camera, options: &RenderOptions) -> Result<(), RenderError> {
        self.begin_view(camera, options, 1)?;
        self.rows_in(rows)?;
        self.picture()
    }

    /// The stages of a view of one batch from the gradient of its picture back to its rows.
    ///
    /// # Errors
    /// Those of the stages.
    fn backpropagate(&mut self, rows: &Columns, grads: &mut Gradients) -> Result<(), RenderError> {
        self.picture_back()?;
        self.rows_out(0, rows, grads)
    }
}
