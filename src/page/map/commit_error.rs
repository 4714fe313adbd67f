//! Errors of commits and of opening a store, with their remedies.

use crate::base::error::{REMEDY_TOO_MANY_FILES, is_too_many_files};
use crate::page::map::entries::MapError;
use crate::page::versions::page_error::PageError;
use std::io;

/// Why a store cannot be created, opened, or committed to.
#[derive(Debug, thiserror::Error)]
pub enum CommitError {
    /// Pages could not be made durable.
    #[error(transparent)]
    Pages(#[from] PageError),
    #[error("{0}\n  remedy: acknowledged commits are intact; check the drive, then start again")]
    Map(#[from] MapError),
    /// No space. Nothing is lost; the commit may be repeated once there is space.
    #[error(
        "there is no space for a commit: {0}\n  remedy: free space on the drive of the pages: of the spill directory, or of the output folder of a run in memory"
    )]
    Full(io::Error),
    /// A file beside the map cannot be used.
    #[error("{name} cannot be used: {source}\n  remedy: {}", file_remedy(.source))]
    File {
        /// Name of the file in the store's folder.
        name: &'static str,
        source: io::Error,
    },
    /// An earlier error ended all commits of this process.
    #[error("commits stopped after a drive error ({0})\n  remedy: check the drive, then start again")]
    Poisoned(String),
    /// The folder contains no store.
    #[error("there is no page map in this folder")]
    NoStore,
    /// The map is undamaged, but its content is impossible.
    #[error("the page map contradicts itself: {0}\n  remedy: `gsscale-ckpt salvage` can rebuild it from the pages")]
    Contradiction(String),
    /// Segments are missing or have another length.
    #[error(
        "pages are missing: {0}\n  remedy: restore the segment files; `gsscale-ckpt salvage` recovers the remaining pages"
    )]
    Segments(String),
    /// The requested generation is not kept.
    #[error("generation {0} is not kept\n  remedy: `gsscale-ckpt ls` lists the kept generations")]
    NotKept(u64),
}

/// The remedy when a file beside the map cannot be used.
fn file_remedy(source: &io::Error) -> &'static str {
    match is_too_many_files(source) {
        true => REMEDY_TOO_MANY_FILES,
        false => "check the drive; `gsscale-ckpt salvage` can rebuild the map",
    }
}

impl CommitError {
    /// The error of the system about the file `name`.
    pub(in crate::page) fn file(name: &'static str) -> impl Fn(io::Error) -> CommitError {
        move |source| CommitError::File { name, source }
    }

    /// Whether the error is only a lack of space: a later attempt may succeed.
    pub fn is_out_of_space(&self) -> bool {
        match self {
            CommitError::Full(_) | CommitError::Map(MapError::Full(_)) => true,
            CommitError::Pages(error) => error.is_out_of_space(),
            _ => false,
        }
    }
}
