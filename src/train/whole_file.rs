//! Atomic writes of whole files: write a temporary file, sync it, rename it, sync the folder.

use crate::base::error::{InputError, InputResult};
use crate::page::engine::segment_files::sync_folder;
use std::fs::File;
use std::io::Write;
use std::path::Path;

/// The folder that a path lies in.
pub(super) fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Writes a file through a temporary file beside it; content and name are durable when this returns.
///
/// # Errors
/// The folder cannot be written.
pub fn write_whole(path: &Path, bytes: &[u8]) -> InputResult<()> {
    let mut name = path.file_name().unwrap_or_default().to_os_string();
    name.push(".part");
    let part = path.with_file_name(name);
    let io = |e: std::io::Error| InputError::io(path, "writing", &e);
    let mut file = File::create(&part).map_err(io)?;
    file.write_all(bytes).and_then(|()| file.sync_all()).map_err(io)?;
    std::fs::rename(&part, path).map_err(io)?;
    // Without this sync a power cut can lose the new name.
    sync_folder(folder_of(path)).map_err(io)
}
