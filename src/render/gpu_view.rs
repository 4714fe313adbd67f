//! Device state between the stages: that of the current view, and that of steps that are recorded without waiting.
//!
//! Not here: the stages.

use super::device_needs::ViewSizes;
use super::gpu_frame::{Blend, Demand, DemandReadback, Frame, FrameRoom, Pixels, Ranks};
use super::gpu_pages::PageTable;
use super::gpu_range_plan::PlannedRange;
use super::gpu_rows::DeviceColumns;
use super::gpu_segments::Segment;
use super::sequence::ViewOptions;
use crate::gpu::{Buffer, Readback, Recording};
use crate::kernels::image_loss::LossPlan;
use crate::kernels::splats::Grid;

/// Device state between `rows_in` and `picture`.
#[derive(Debug, Default)]
pub(super) struct RowsIn {
    /// The splats of the batches so far.
    pub segments: Vec<Segment>,
    /// The rows of a view of one batch that fits; its splats are the one segment.
    pub whole: Option<Box<WholeRows>>,
}

/// The rows of a view of one batch, on the device until their gradients are computed.
#[derive(Debug)]
pub(super) struct WholeRows {
    pub columns: DeviceColumns,
    pub ranks: Ranks,
    /// Upload and evaluation of the colours, not submitted yet: `picture` appends lists and blending.
    pub colors: Recording,
}

/// The buffer sizes that a frame needs. The picture is valid only if the frame had this room.
#[derive(Debug)]
pub(super) enum DemandState {
    Pending(Box<DemandReadback>),
    /// The host has read the demand.
    Known(Demand),
}

/// The tile lists of a view of which all lists fit at once.
#[derive(Debug)]
pub(super) struct WholeLists {
    pub ranks: Ranks,
    pub frame: Frame,
    pub demand: DemandState,
}

/// The tile lists of a view.
#[derive(Debug)]
pub(super) enum Lists {
    /// All of them are on the device.
    Whole(Box<WholeLists>),
    /// They are made for one range at a time.
    Ranges(Vec<PlannedRange>),
}

/// Device state of a view with a picture.
#[derive(Debug)]
pub(super) struct View {
    pub of: ViewOptions,
    pub segments: Vec<Segment>,
    /// The rows of a view of one batch; `None` if they must come again.
    pub columns: Option<DeviceColumns>,
    pub pixels: Pixels,
    pub lists: Lists,
    /// Whether it belongs to a step that is recorded without waiting: its gate reads the sums of the loss on the device.
    pub is_recorded: bool,
    /// Whether its rows are weighed.
    pub weighs: bool,
    /// Whether `GpuRenderer::image` holds the picture of this view.
    pub image_is_read: bool,
    /// Whether the caller may have changed `GpuRenderer::image`; the loss then compares that image.
    pub image_is_corrected: bool,
    pub loss: Option<Loss>,
    /// The tile stages of the backward pass, not submitted yet: the first `rows_out` appends the stages on rows.
    pub tiles_back: Option<Recording>,
    /// Rows with unusable gradients; [`Unusable::Uncounted`] until `picture_back`.
    pub unusable: Unusable,
}

/// The number of rows with unusable gradients.
#[derive(Debug)]
pub(super) enum Unusable {
    /// No stage counts them yet.
    Uncounted,
    /// One u32 on the device, until the first `rows_out`.
    OnDevice(Buffer),
    Pending(Readback),
    /// The host has read the number.
    Known(u64),
}

impl View {
    /// A view whose picture was submitted.
    pub fn new(
        of: ViewOptions,
        segments: Vec<Segment>,
        columns: Option<DeviceColumns>,
        pixels: Pixels,
        lists: Lists,
    ) -> View {
        View {
            of,
            segments,
            columns,
            pixels,
            lists,
            is_recorded: false,
            weighs: false,
            image_is_read: false,
            image_is_corrected: false,
            loss: None,
            tiles_back: None,
            unusable: Unusable::Uncounted,
        }
    }

    /// Tiles, background and clamp.
    pub fn blend(&self) -> Blend {
        blend_of(&self.of)
    }

    /// Rows, intersections and pixels. Lists are empty until a call has read the picture, the loss or a gradient.
    pub fn sizes(&self) -> ViewSizes {
        let demands = match &self.lists {
            Lists::Whole(lists) => match lists.demand {
                DemandState::Known(demand) => vec![demand],
                DemandState::Pending(_) => Vec::new(),
            },
            Lists::Ranges(ranges) => ranges.iter().map(|range| range.demand).collect(),
        };
        ViewSizes {
            rows: self.segments.iter().map(|segment| u64::from(segment.rows)).sum(),
            isects: demands.iter().map(|demand| u64::from(demand.isects)).sum(),
            pixels: self.of.camera.pixels() as u64,
        }
    }
}

/// Tiles, background and clamp of a view.
pub(super) fn blend_of(ViewOptions { camera, options }: &ViewOptions) -> Blend {
    let grid = Grid::new(camera.width, camera.height);
    Blend { grid, background: options.background, max_alpha: options.max_alpha }
}

/// A step while it is recorded.
#[derive(Debug)]
pub(super) struct Recorded {
    /// The pages of the step in their slots.
    pub table: PageTable,
    /// Listed rows of each page, then of all.
    pub counts: Buffer,
    /// Sizes of its lists.
    pub room: FrameRoom,
}

/// A step that is submitted and not finished.
#[derive(Debug)]
pub(super) struct InFlight {
    /// What the gate decided.
    pub verdict: Readback,
    /// What the update did to each page.
    pub results: Readback,
    pub plan: LossPlan,
}

/// A loss that was submitted.
#[derive(Debug)]
pub(super) struct Loss {
    pub plan: LossPlan,
    /// The photo, kept until the picture is known to be valid.
    pub target: Buffer,
    pub v_rgb: Buffer,
    /// The squared error of each pixel, if the rows are weighed.
    pub errors: Option<Buffer>,
    pub sums: LossSums,
}

/// The four sums from which the value of a loss follows.
#[derive(Debug)]
pub(super) enum LossSums {
    /// They and the gradient belong to an invalid picture, and must be computed again.
    Stale,
    /// They stay on the device, for the gate of a step that is recorded without waiting.
    OnDevice(Buffer),
    Pending(Readback),
    /// The host has read the sums; zeros for a picture without pixels.
    Known([f32; 4]),
}
