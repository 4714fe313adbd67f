//! The size of a photo whose model does not state it.

use crate::base::error::InputResult;
use crate::dataset::photo_header::read_header;
use std::path::Path;

/// Width and height from the photo's header; nothing is decoded.
pub(in crate::dataset) fn read_size(path: &Path) -> InputResult<(u64, u64)> {
    let header = read_header(path).map_err(|mut error| {
        error.problem.insert_str(0, "the photo's size cannot be read: ");
        error
    })?;
    Ok((u64::from(header.width), u64::from(header.height)))
}
