//! What the user asks of the photos, the split and the frame of a dataset; [`super::loader`] and `photo_checks` apply it.

use crate::base::error::{InputError, InputResult};
use std::path::PathBuf;

#[derive(Debug, Clone, PartialEq)]
pub struct LoadOptions {
    /// Photos are downscaled by this factor, at least 1; each side is rounded to nearest.
    pub data_factor: f64,
    /// Limit of the longer side after `data_factor`, pixels.
    pub max_resolution: Option<u32>,
    /// Every N-th registered view, sorted by name (index % N == 0), is a test view; `None` or 0: none.
    pub test_every: Option<u32>,
    /// Registered views with index > N are test views; overrides `test_every`.
    pub test_after: Option<u32>,
    /// Whether masks are used, and the alpha of photos as a mask.
    pub masks: bool,
    /// The colour of transparent pixels where alpha is no mask, sRGB.
    pub background: [u8; 3],
    /// Keep black instead of white.
    pub invert_masks: bool,
    /// Drop views without a photo instead of failing.
    pub allow_missing: bool,
    /// Near plane in robust scene sizes, the local unit (see [`super::frame::Extent::frame`]): gsplat uses 0.01 in a scene normalised
    /// to a median camera distance of 1.
    pub near_plane: f64,
    /// Folder that the views' names are relative to; `None`: derived from the first view's name and path.
    pub image_folder: Option<PathBuf>,
}

impl Default for LoadOptions {
    fn default() -> Self {
        LoadOptions {
            data_factor: 1.0,
            max_resolution: None,
            test_every: Some(8),
            test_after: None,
            masks: true,
            background: [0; 3],
            invert_masks: false,
            allow_missing: false,
            near_plane: 0.01,
            image_folder: None,
        }
    }
}

impl LoadOptions {
    /// Refuses a value out of range.
    pub(super) fn check(&self) -> InputResult<()> {
        let (factor, near) = (self.data_factor, self.near_plane);
        let (flag, problem, remedy) = if !(1.0..=1e4).contains(&factor) {
            ("--data-factor", format!("{factor} is not between 1 and 10000"), "give 1 or more")
        } else if self.max_resolution == Some(0) {
            ("--max-resolution", "0 leaves no pixel".to_string(), "give the longer side in pixels")
        } else if !(near > 0.0 && near <= 1e3) {
            ("--near-plane", format!("{near} is not between 0 and 1000"), "the usual value is 0.01")
        } else {
            return Ok(());
        };
        Err(InputError::new(flag, problem, remedy))
    }
}
