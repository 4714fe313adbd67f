//! Files of Gaussians in formats that are not read: what they are, and a converter.
//!
//! Not here: a PLY that is packed, which only its header tells ([`super::ply`]).

use super::sog::is_tree;
use crate::base::error::InputError;
use std::path::Path;

const ENDINGS: [&str; 4] = ["splat", "ksplat", "spz", "sog"];

/// The error for a file of Gaussians in a format that no reader knows; `None` for others.
pub fn foreign(path: &Path) -> Option<InputError> {
    let ending = path.extension().and_then(|ending| ending.to_str()).unwrap_or_default().to_ascii_lowercase();
    let problem = match (ENDINGS.contains(&ending.as_str()), is_tree(path)) {
        (true, _) => format!("a .{ending} file cannot be read here: Gaussians are read from a PLY"),
        (_, true) => "only gsscale-eval reads SOGs: Gaussians are read from a PLY".to_string(),
        _ => return None,
    };
    let (from, to) = (path.display(), path.with_extension("ply"));
    let remedy = format!(
        "give the PLY of which it was made, or convert it, for example with splat-transform \
         (npm install -g @playcanvas/splat-transform): splat-transform {from} {}",
        to.display()
    );
    Some(InputError::new(path, problem, remedy))
}
