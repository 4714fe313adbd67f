//! The stages in order: forward, loss, backward; and image metrics.

pub mod color_correct;
pub mod cpu;
pub mod gpu;
pub mod gpu_loss;
pub mod gpu_rows;
pub mod gpu_tiles;
pub mod gpu_tiles_bwd;
pub mod lpips;
pub mod metrics;

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

/// Gradients of one view, one entry per row of the working set.
#[derive(Debug, Clone, Default)]
pub struct Gradients {
    /// With respect to the stored (pre-activation) columns.
    pub columns: Columns,
    /// With respect to the pixel position of the mean, signed, pixel units.
    pub means2d: Vec<[f32; 2]>,
    /// Half extents of the footprint, pixels; [0, 0]: the row was not drawn.
    pub radii: Vec<[u32; 2]>,
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
    /// `image` or `loss_backward` came before `forward`, or with other rows.
    #[error("no view was rendered from these rows yet")]
    NoForward,
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

/// Whether a view can be rendered at all, on any backend.
fn check_view(rows: &Columns, camera: &Camera, options: &RenderOptions) -> Result<(), RenderError> {
    let Camera { width, height, .. } = *camera;
    if width.max(height) > Grid::SIDE_MAX {
        return Err(RenderError::ImageTooLarge { width, height });
    }
    if rows.rows() >= u32::MAX as usize {
        return Err(RenderError::TooManyRows(rows.rows()));
    }
    if options.sh_degree > rows.sh_degree {
        return Err(RenderError::ShDegree { asked: options.sh_degree, stored: rows.sh_degree });
    }
    Ok(())
}

/// Renders one view at a time: `forward`, then what is wanted of it.
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

    /// Renders `rows` as seen by `camera`. A device may still be at it when this returns.
    ///
    /// # Errors
    /// When the view is too large or does not fit the rows. What a device fails at later is an error of the call that
    /// needs the result.
    fn forward(&mut self, rows: &Columns, camera: &Camera, options: &RenderOptions) -> Result<(), RenderError>;

    /// The picture of the last forward pass.
    ///
    /// # Errors
    /// Without a forward pass.
    fn image(&mut self) -> Result<&Image, RenderError>;

    /// Loss of that picture against `target`, and the gradients of the rows it was made from: every entry of `grads` is
    /// written, zeros for rows that were not drawn.
    ///
    /// # Errors
    /// Without a forward pass of the same rows, or when the target's size differs.
    fn loss_backward(
        &mut self,
        rows: &Columns,
        target: &Target,
        options: &LossOptions,
        grads: &mut Gradients,
    ) -> Result<LossValue, RenderError>;
}
