//! Files of Gaussians in formats that are not read: what they are, and a converter.
//!
//! Not here: a PLY that is packed, which only its header tells ([`super::ply`]).

use super::sog::{TREE_FILE, is_tree};
use crate::base::error::{InputError, InputResult};
use crate::base::say::shell_word;
use std::path::{Path, PathBuf};

const ENDINGS: [&str; 4] = ["splat", "ksplat", "spz", "sog"];

/// The error for a file of Gaussians in a format that no reader knows; `None` for others.
pub fn foreign(path: &Path) -> Option<InputError> {
    let ending = path.extension().and_then(|ending| ending.to_str()).unwrap_or_default().to_ascii_lowercase();
    let problem = match (ENDINGS.contains(&ending.as_str()), is_tree(path)) {
        (true, _) => format!("a .{ending} file cannot be read here: Gaussians are read from a PLY"),
        (_, true) => {
            "SOGs cannot be read here, only by gsscale-eval, gsscale-view and gsscale-train --init-ply".to_string()
        }
        _ => return None,
    };
    let ply = ply_of(path);
    if ply.is_file() {
        return Some(InputError::new(path, problem, format!("give the PLY beside it: {}", ply.display())));
    }
    // An SPZ is upside down for other programs.
    let turn = if ending == "spz" { " -r 180,0,0" } else { "" };
    let remedy = format!(
        "give the PLY of which it was made, or convert it, for example with splat-transform \
         (npm install -g @playcanvas/splat-transform): splat-transform {}{turn} {}",
        shell_word(path),
        shell_word(ply)
    );
    Some(InputError::new(path, problem, remedy))
}

/// The PLY of which a run makes this file.
fn ply_of(path: &Path) -> PathBuf {
    let Some(folder) = path.parent().filter(|_| is_tree(path)) else { return path.with_extension("ply") };
    let name = folder.file_name().unwrap_or_default().to_string_lossy();
    folder.with_file_name(format!("{}.ply", name.strip_suffix("_sog").unwrap_or(&name)))
}

/// Refuses a folder of SOGs where its tree is meant.
/// Errors: it is one.
pub fn refuse_folder_of_sogs(path: &Path) -> InputResult<()> {
    let tree = path.join(TREE_FILE);
    if !tree.is_file() {
        return Ok(());
    }
    Err(InputError::new(path, "this is a folder of SOGs", format!("name its file: {}", tree.display())))
}
