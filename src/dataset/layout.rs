//! The folder layouts of published scenes: names, appearance, and what a folder lacks of one.
//!
//! The readers decide what can be read ([`super::read`]). This file tells the user beforehand which layout a folder has
//! or, if none, exactly what is missing. It checks only names and opens no file.

use super::colmap::{self, parts};
use super::mega_nerf::looks_like_mega_nerf;
use super::transforms::{looks_like_matrix_city, looks_like_transforms};
use crate::base::error::{InputError, InputResult};
use crate::base::names::names;
use std::path::{Path, PathBuf};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Layout {
    /// A COLMAP model and its photos.
    Colmap,
    /// COLMAP models and photos in a training and a held-out folder; or one model, with the photos in these two
    /// folders.
    ColmapMerged,
    /// Mega-NeRF's: torch files with poses.
    MegaNerf,
    /// GauU-Scene's: a COLMAP model and its photos, under the drone's names.
    Gauu,
    /// MatrixCity's: JSON files over folders of photos, and a PLY cloud.
    MatrixCity,
    /// `transforms*.json` beside the photos (Nerfstudio, Blender).
    Transforms,
}

// In the order of preference for a folder that has several.
names!(Layout {
    Colmap = "colmap",
    Gauu = "gauu",
    ColmapMerged = "colmap-merged",
    Transforms = "transforms",
    MatrixCity = "matrixcity",
    MegaNerf = "mega-nerf",
});

impl Layout {
    pub fn tree(self) -> &'static str {
        match self {
            Layout::Colmap => {
                "\
<folder>/
  images/                    photos (JPEG or PNG), named as in the model
  sparse/0/                  cameras, images, points3D: .bin or .txt"
            }
            Layout::Gauu => {
                "\
<folder>/
  images/                    photos (DJI_....JPG), named as in the model
  sparse/ or sparse/0/       cameras, images, points3D: .bin or .txt"
            }
            Layout::ColmapMerged => {
                "\
<folder>/
  train/rgbs/                photos to train on (or train/images/, train/input/)
  train/sparse/0/            cameras, images, points3D: .bin or .txt
  val/rgbs/                  held-out photos; the folder may be called test/ as well
  val/sparse/0/              cameras, images
or, with one model for all of them, sparse/0/ in <folder> instead of the two"
            }
            Layout::MegaNerf => {
                "\
<folder>/
  coordinates.pt             origin and scale of the poses
  train/metadata/*.pt        one for each photo: size, intrinsics, pose
  train/rgbs/                photos of the same names
  val/metadata/*.pt          the same for the held-out photos
  val/rgbs/
  points.ply                 optional: points in the frame of the poses, metres; without, some are found where photos agree"
            }
            Layout::MatrixCity => {
                "\
<folder>/                    small_city/aerial
  pose/block_all/            transforms_train.json, transforms_test.json
  train/block_1/ ...         photos, unpacked from block_1.tar (also in block_1/input, rgb or block_1 inside it)
  test/block_1_test/ ...     held-out photos
  points.ply                 or point_cloud_ds20/aerial/Block_all.ply, or the same in small_city_pointcloud/
without pose/, train/*/transforms.json and test/*/transforms.json are read"
            }
            Layout::Transforms => {
                "\
<folder>/
  transforms.json            or transforms_train.json and transforms_test.json
  images/                    photos, named as in the JSON"
            }
        }
    }

    /// What a folder lacks of this layout: paths and their expected content. Empty if it has the layout.
    pub fn missing(self, folder: &Path) -> Vec<String> {
        let mut missing = Vec::new();
        let mut need = |is_there: bool, what: &str| {
            if !is_there {
                missing.push(what.to_string());
            }
        };
        let has = |name: &str| folder.join(name).exists();
        match self {
            Layout::Colmap | Layout::Gauu => {
                need(colmap::looks_like_colmap(folder), "a model (cameras and images) in sparse/0");
                need(has("images"), "images/ with the photos");
            }
            Layout::ColmapMerged => {
                let model_of_all = colmap::looks_like_colmap(folder);
                for (part, names) in [("train", &["train"][..]), ("val", &["val", "test"])] {
                    let folders: Vec<PathBuf> = names.iter().map(|n| folder.join(n)).collect();
                    let model = model_of_all || folders.iter().any(|f| colmap::looks_like_colmap(f));
                    need(model, &format!("a model (cameras and images) in {part}/sparse/0"));
                    let photos = folders.iter().any(|f| parts::photo_folder(f).is_some());
                    need(photos, &format!("{part}/rgbs/ with photos"));
                }
            }
            Layout::MegaNerf => {
                need(looks_like_mega_nerf(folder), "coordinates.pt");
                for part in ["train", "val"] {
                    for sub in ["metadata", "rgbs"] {
                        need(has(&format!("{part}/{sub}")), &format!("{part}/{sub}/"));
                    }
                }
            }
            Layout::MatrixCity => {
                let poses = looks_like_matrix_city(folder);
                need(poses, "pose/block_all/transforms_train.json (or train/*/transforms.json)");
                need(has("train"), "train/ with folders of photos");
                need(has("test"), "test/ with folders of photos");
            }
            Layout::Transforms => need(looks_like_transforms(folder), "transforms.json or transforms_train.json"),
        }
        missing
    }
}

impl std::str::FromStr for Layout {
    type Err = String;

    fn from_str(text: &str) -> Result<Layout, String> {
        let names = || Layout::ALL.map(Layout::name).join(", ");
        Layout::from_name(text).ok_or_else(|| format!("unknown layout '{text}'; use one of {}", names()))
    }
}

/// The first layout of `accepted` (not empty) of which the folder lacks nothing.
/// Errors: the folder does not exist or has none of the layouts: the error names what each lacks, shows the expected trees, and
/// `fetch`, where to get the data.
pub fn find_layout(folder: &Path, accepted: &[Layout], fetch: &[String]) -> InputResult<Layout> {
    let remedy = |layouts: &[Layout]| {
        let trees: Vec<String> = layouts.iter().map(|l| format!("{}:\n{}", l.name(), l.tree())).collect();
        let fetch: String = fetch.iter().map(|f| format!("\n  {f}")).collect();
        let trees: String = trees.join("\nor\n").lines().map(|line| format!("    {line}\n")).collect();
        format!("fetch it and arrange the folder like this\n{trees}published at{fetch}")
    };
    if !folder.is_dir() {
        return Err(InputError::new(folder, "the dataset's folder does not exist", remedy(accepted)));
    }
    let lacks: Vec<(Layout, Vec<String>)> = accepted.iter().map(|l| (*l, l.missing(folder))).collect();
    if let Some((layout, _)) = lacks.iter().find(|(_, missing)| missing.is_empty()) {
        return Ok(*layout);
    }
    let each: Vec<String> =
        lacks.iter().map(|(l, missing)| format!("  as {}: {} missing", l.name(), missing.join(", "))).collect();
    // A folder that has part of a layout is meant to be that layout: its tree comes first.
    let nowhere = folder.join("nothing of this name");
    let has = |(layout, missing): &(Layout, Vec<String>)| layout.missing(&nowhere).len() - missing.len();
    let mut near = lacks;
    near.sort_by_key(|lack| std::cmp::Reverse(has(lack)));
    let near: Vec<Layout> = near.into_iter().map(|(l, _)| l).collect();
    Err(InputError::new(folder, format!("the dataset is not complete\n{}", each.join("\n")), remedy(&near)))
}
