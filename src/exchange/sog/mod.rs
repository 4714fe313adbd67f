//! Writes and reads Streamed SOG, version 1: a folder that viewers load in parts, near parts in detail and far ones coarsely. Each part is
//! a SOG of version 2 (`developer.playcanvas.com`, "The SOG Format" and "The Streamed SOG Format").
//!
//! `lod-meta.json` holds a tree of boxes. A leaf has its rows once in every level, as a range of a SOG: a folder of pictures, whose
//! pixels are the values of one Gaussian each. The axes are those of a PLY.
//!
//! | file | task |
//! | --- | --- |
//! | `write` | the sink: groups, leaves, files of each level |
//! | `order` | neighbours in space next to each other |
//! | `merge`, `symmetric` | coarser levels |
//! | `chunk`, `codebook`, `palette` | one SOG: pictures, values that stand for others |
//! | `tree` | `lod-meta.json` |
//! | `read`, `read_chunk` | the rows of a level, for its evaluation |

mod chunk;
mod codebook;
mod merge;
mod order;
mod palette;
mod read;
mod read_chunk;
mod symmetric;
mod tree;
mod write;

pub use read::SogReader;
pub use tree::{TREE_FILE, is_tree};
pub use write::{SogWriter, folder_of_tree, is_of_sog, memory_bytes};
