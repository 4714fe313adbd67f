//! Uniforms of the stages on pages.
//!
//! Not here: buffers and dispatches.
//!
//! Invariant: each struct has the layout of its twin in `shaders/`, which documents its fields.

use crate::scene::camera::Camera;
use crate::scene::columns::Column;
use crate::scene::frustum::Frustum;
use crate::scene::optimizer_numbers::{RunNumbers, StepNumbers};

/// Limits within which rows may split, for bounds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SplitNumbers {
    /// Rows grow only above this mean growth score.
    pub grow_grad2d: f32,
    /// Growing rows split only above this largest standard deviation.
    pub split_scale: f32,
    /// Largest distance of a child's mean from its parent's, in the parent's largest standard deviation.
    pub reach: f32,
}

crate::wgsl_struct! {
    /// Uniform of `gather.wgsl`.
    pub struct GatherUniforms {
        /// Rows of the pose.
        pub world_to_camera: [[f32; 4]; 3],
        /// Slopes of the side planes.
        pub slopes: [f32; 4],
        /// Reach of a footprint in x and y, in sigmas.
        pub reach: [f32; 2],
        /// Near and far plane.
        pub depth_range: [f32; 2],
        /// Rounding slack of a camera coordinate: constant part, and factor.
        pub slack: [f32; 2],
        /// Factor on the slack for the side planes.
        pub side_slack: f32,
        /// Steps done.
        pub now: u32,
        /// The slab that is bound.
        pub slab: u32,
        /// Pages of the batch.
        pub page_count: u32,
        /// Listed rows of this dispatch.
        pub row_count: u32,
        /// Column to evaluate.
        pub column: u32,
        /// Floats per row of the output.
        pub width: u32,
        /// The first of them in the row of the page.
        pub first_element: u32,
        /// Base rate of the column.
        pub rate: f32,
        /// Base rate of the means.
        pub means_rate: f32,
        /// Base rate of the log-scales.
        pub scales_rate: f32,
        /// Limits within which rows may split.
        pub grow_grad2d: f32,
        /// Largest standard deviation of rows that do not split.
        pub split_scale: f32,
        /// Reach of children.
        pub split_reach: f32,
    }

    /// Uniform of `update.wgsl`.
    pub struct UpdateUniforms {
        /// The slab that is bound.
        pub slab: u32,
        /// Listed rows of this dispatch; pages, where statistics are cleared.
        pub row_count: u32,
        /// Column to rewrite.
        pub column: u32,
        /// Floats per row of its values and gradients.
        pub width: u32,
        /// The first of them in the row of the page.
        pub first_element: u32,
        /// Steps done.
        pub now: u32,
        /// Rate of the column over the bias of the first moment.
        pub step_size: f32,
        /// 1 / sqrt(1 - beta2^t).
        pub inv_root_correction: f32,
        /// Half of the image size, pixels.
        pub half_size: [f32; 2],
        /// 1 if this step collects statistics.
        pub collects: u32,
        /// 1 if blending weights are among them, and a row has two footprints.
        pub weighs: u32,
    }
}

impl GatherUniforms {
    /// Uniforms of a step on the pages of a batch; slab, rows and column are set for each dispatch.
    pub fn new(camera: &Camera, run: &RunNumbers, now: u32, splits: &SplitNumbers, page_count: u32) -> GatherUniforms {
        let frustum = Frustum::new(camera);
        let rate = |column: Column| run.base_rates[column as usize];
        GatherUniforms {
            world_to_camera: frustum.viewmat,
            slopes: frustum.slopes,
            reach: frustum.reach,
            depth_range: frustum.depth_range,
            slack: frustum.slack(),
            side_slack: frustum.side_slack(),
            now,
            slab: 0,
            page_count,
            row_count: 0,
            column: 0,
            width: 1,
            first_element: 0,
            rate: 0.0,
            means_rate: rate(Column::Means),
            scales_rate: rate(Column::Scales),
            grow_grad2d: splits.grow_grad2d,
            split_scale: splits.split_scale,
            split_reach: splits.reach,
        }
    }

    /// The same for a part of a column: `width` floats per row, from float `first_element` of the row on.
    pub fn of_column(&self, run: &RunNumbers, column: Column, width: usize, first_element: usize) -> GatherUniforms {
        GatherUniforms {
            column: column as u32,
            width: width as u32,
            first_element: first_element as u32,
            rate: run.base_rates[column as usize],
            ..*self
        }
    }
}

impl UpdateUniforms {
    /// Uniforms of a step; slab, rows and column are set for each dispatch.
    pub fn new(camera: &Camera, step: &StepNumbers, collects: bool, weighs: bool) -> UpdateUniforms {
        UpdateUniforms {
            slab: 0,
            row_count: 0,
            column: 0,
            width: 1,
            first_element: 0,
            now: step.now,
            step_size: 0.0,
            inv_root_correction: step.inv_root_correction,
            half_size: [camera.width, camera.height].map(|n| n as f32 * 0.5),
            collects: u32::from(collects),
            weighs: u32::from(weighs),
        }
    }

    /// The same for a part of a column, as [`GatherUniforms::of_column`].
    pub fn of_column(&self, step: &StepNumbers, column: Column, width: usize, first_element: usize) -> UpdateUniforms {
        UpdateUniforms {
            column: column as u32,
            width: width as u32,
            first_element: first_element as u32,
            step_size: step.step_sizes[column as usize],
            ..*self
        }
    }
}
