//! Where the pages of a run live, by `--spill-dir` and `--frames`.

use super::file::TrainConfig;
use std::path::{Path, PathBuf};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Residence<'a> {
    /// All pages in memory; the run commits to its output folder.
    Memory,
    /// In `--frames` frames over a store in memory, without commits; for comparisons.
    Frames,
    /// In frames over this spill directory, which is also the checkpoint of the run.
    SpillDir(&'a Path),
}

impl<'a> Residence<'a> {
    /// The spill directory, if any.
    pub fn spill_dir(self) -> Option<&'a Path> {
        match self {
            Residence::SpillDir(folder) => Some(folder),
            Residence::Memory | Residence::Frames => None,
        }
    }

    /// The folder of the checkpoint of a run with the output folder `out`.
    pub fn checkpoint_folder(self, out: &Path) -> PathBuf {
        self.spill_dir().map_or_else(|| checkpoint_folder(out), Path::to_path_buf)
    }
}

/// The folder of the checkpoint of a run without a spill directory.
pub fn checkpoint_folder(out: &Path) -> PathBuf {
    out.join("checkpoint")
}

impl TrainConfig {
    /// Where the pages of the run live.
    pub fn residence(&self) -> Residence<'_> {
        match (self.spill_dir.as_str(), self.frames) {
            ("", 0) => Residence::Memory,
            ("", _) => Residence::Frames,
            (folder, _) => Residence::SpillDir(Path::new(folder)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_residence_follows_from_both_keys() {
        let of =
            |spill_dir: &str, frames| TrainConfig { spill_dir: spill_dir.into(), frames, ..TrainConfig::default() };
        assert_eq!(of("", 0).residence(), Residence::Memory);
        assert_eq!(of("", 7).residence(), Residence::Frames);
        for frames in [0, 7] {
            let config = of("pages", frames);
            assert_eq!(config.residence(), Residence::SpillDir(Path::new("pages")));
            assert_eq!(config.residence().checkpoint_folder(Path::new("out")), Path::new("pages"));
        }
        assert_eq!(of("", 7).residence().checkpoint_folder(Path::new("out")), Path::new("out/checkpoint"));
    }
}
