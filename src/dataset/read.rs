//! Chooses the reader for a path.

use crate::base::error::{InputError, InputResult};
use crate::base::say::shell_word;
use crate::base::text::{as_windows_1252, has_raw_bytes, head_of, own_json, shown};
use crate::base::units::{counted, counted_are};
use crate::dataset::gathered::{listed, sort_views};
use crate::dataset::model::RawScene;
pub use crate::dataset::model::ReadOptions;
use crate::dataset::name_index::{photos_below, photos_in, unreadable_below};
use crate::dataset::{colmap, mega_nerf, opensfm, reality_capture, transforms};
use std::path::{Path, PathBuf};

/// Reads a scene: a folder with a COLMAP model, with a model for each of `train` and `val`, with `transforms*.json`, in
/// MatrixCity's or in Mega-NeRF's layout, with OpenSfM's `reconstruction.json` or RealityCapture's CSV, or such a JSON or CSV
/// file. If a folder matches several, the first of these applies.
/// Errors: any problem with the files; if nothing matches, the error lists what was searched for.
pub fn read_scene(path: &Path, options: &ReadOptions) -> InputResult<RawScene> {
    let facts = std::fs::metadata(path).map_err(|e| match e.kind() {
        std::io::ErrorKind::NotFound => InputError {
            kind: Some(e.kind()),
            ..InputError::new(path, "there is no such scene", "check the path, and the folder that you are in")
        },
        _ => InputError::io(path, "opening the scene", &e),
    })?;
    let root = if facts.is_file() { path.parent().unwrap_or(Path::new("")) } else { path };
    let mut scene = read_kind(path, facts.is_file(), options)?;
    make_readable(path, &mut scene)?;
    let is_above = !scene.root.as_os_str().is_empty();
    Ok(if is_above { scene } else { RawScene { root: root.to_path_buf(), ..scene } })
}

type SceneReader = (fn(&Path) -> bool, fn(&Path, &ReadOptions) -> InputResult<RawScene>);

/// Whether a reader would find something in a folder, and the reader; the first one applies.
const READERS: [SceneReader; 7] = [
    (colmap::looks_like_colmap, colmap::read_colmap),
    (colmap::parts::looks_like_parts, colmap::parts::read_parts),
    (transforms::looks_like_transforms, transforms::read_transforms),
    (transforms::looks_like_matrix_city, transforms::read_matrix_city),
    (mega_nerf::looks_like_mega_nerf, mega_nerf::read_mega_nerf),
    (opensfm::looks_like_opensfm, opensfm::read_opensfm),
    (reality_capture::looks_like_reality_capture, reality_capture::read_reality_capture),
];

fn read_kind(path: &Path, is_file: bool, options: &ReadOptions) -> InputResult<RawScene> {
    if is_file {
        let ends_with = |ending: &str| path.extension().is_some_and(|e| e.eq_ignore_ascii_case(ending));
        if let Some(error) = file_of_results(path) {
            return Err(error);
        }
        return match () {
            // OpenSfM's file holds a list, the others an object.
            () if ends_with("json") && head_of(path, 4096).trim_start().starts_with('[') => {
                opensfm::read_opensfm(path, options)
            }
            () if ends_with("json") => transforms::read_transforms(path, options),
            () if ends_with("csv") => reality_capture::read_reality_capture(path, options),
            () => {
                let problem =
                    "a scene is a folder, a transforms.json, a reconstruction.json or a CSV of RealityCapture";
                Err(InputError::new(path, problem, "give the folder that holds it"))
            }
        };
    }
    if let Some((_, read)) = READERS.iter().find(|(knows, _)| knows(path)) {
        let mut scene = read(path, options)?;
        let is_colmap = colmap::looks_like_colmap(path) || colmap::parts::looks_like_parts(path);
        if is_colmap && transforms::looks_like_transforms(path) {
            let what = "transforms.json is not read, nor its split and its masks, because there is a COLMAP model";
            scene.warnings.push(format!("{}: {what}: name the file itself to train on it", path.display()));
        }
        return Ok(scene);
    }
    if let Err(e) = std::fs::metadata(path)
        .and_then(|found| if found.is_dir() { std::fs::read_dir(path).map(|_| ()) } else { Ok(()) })
    {
        return Err(InputError::io(path, "reading the scene", &e));
    }
    let has = |name: &str| path.join(name).is_file();
    if has("config.toml") && ["metrics.jsonl", "summary.json", "point_cloud.ply"].into_iter().any(has) {
        let folder = shell_word(path);
        let remedy = format!(
            "to continue the run: gsscale-train --resume {folder}; to measure its result: gsscale-eval {folder}; its config.toml \
             names the scene that it trained on"
        );
        return Err(InputError::new(path, "the output folder of a run, not a scene", remedy));
    }
    if let Some((above, images)) = scene_above(path) {
        let images = options.images.clone().or(Some(images));
        let mut scene = read_scene(&above, &ReadOptions { images, ..options.clone() })?;
        let (photos, above) = (path.display(), above.display());
        scene.warnings.insert(
            0,
            format!("{photos} holds photos without poses: the scene is read from the folder above, {above}"),
        );
        return Ok(scene);
    }
    if let Some(error) = without_poses(path) {
        return Err(error);
    }
    Err(InputError::new(
        path,
        format!(
            "no scene here; looked for {}, for the same in train and val, for transforms_train.json and transforms.json, for \
             MatrixCity's pose/block_all, for Mega-NeRF's coordinates.pt, for reconstruction.json and opensfm/reconstruction.json, \
             and for a CSV of RealityCapture",
            colmap::LOOKED_FOR
        ),
        "give the folder that holds 'sparse' and 'images' or a transforms.json",
    ))
}

/// The error for Gaussians or points in the place of a scene.
fn file_of_results(path: &Path) -> Option<InputError> {
    let name = path.file_name()?.to_str()?.to_ascii_lowercase();
    let is_tree = name == "lod-meta.json";
    let is_rows = ["ply", "splat", "ksplat", "spz", "sog"].iter().any(|ending| name.ends_with(&format!(".{ending}")));
    if !is_tree && !is_rows {
        return None;
    }
    let file = shell_word(path);
    let remedy = match name.ends_with(".ply") {
        true => {
            format!("to measure it: gsscale-eval {file} SCENE; to start from it: gsscale-train SCENE --init-ply {file}")
        }
        false if is_tree => format!("to measure it: gsscale-eval {file} SCENE"),
        false => {
            "name the folder with photos and poses; to start from this file, convert it to a PLY for --init-ply, for \
                  example with splat-transform"
                .to_string()
        }
    };
    Some(InputError::new(path, "a result, not a scene with photos and poses", remedy))
}

/// The folder above, if it holds poses, and the name in it of `folder`, if that holds photos.
fn scene_above(folder: &Path) -> Option<(PathBuf, String)> {
    // The name as it was given is kept where it says what is above.
    let resolved = folder.canonicalize().ok()?;
    let given = folder.parent().filter(|above| !above.as_os_str().is_empty() && folder.file_name().is_some());
    let above = given.or(resolved.parent())?;
    let name = folder.file_name().or(resolved.file_name())?.to_str()?.to_string();
    let has_poses = colmap::looks_like_colmap(above)
        || transforms::looks_like_transforms(above)
        || opensfm::looks_like_opensfm(above)
        || reality_capture::looks_like_reality_capture(above);
    (has_poses && photos_in(folder) > 0).then(|| (above.to_path_buf(), name))
}

/// Whether `path` is a folder of photos without poses that a reader knows, in it or above it.
pub fn lacks_poses(path: &Path) -> bool {
    path.is_dir()
        && !READERS.iter().any(|(knows, _)| knows(path))
        && scene_above(path).is_none()
        && without_poses(path).is_some()
}

/// The folder inside a scene in which [`crate::poses`] searches for poses, and the file there that says how far the search is.
pub const SEARCH_FOLDER: &str = "poses";
pub const SEARCH_STATE: &str = "state.json";
/// The last phase of a search.
pub const SEARCH_END: &str = "model";
/// What to do if photos have no pose.
pub const MORE_OVERLAP: &str = "take more photos between the gaps, so that neighbours share two thirds of their content; leave out \
    blurred photos";
/// What to do with photos that cannot be read.
pub const CONVERT_PHOTOS: &str =
    "convert them to JPEG, for example with ImageMagick: mogrify -format jpg *.HEIC (or *.TIF, *.DNG)";
/// What to do where there are too few photos.
pub const PICTURES_OF_VIDEO: &str = "name a folder with at least three photos that overlap; of a video, take pictures first: ffmpeg -i VIDEO -vf \
    fps=2 -qscale:v 2 PHOTOS/%05d.jpg";
/// Fewest photos for which poses can be found.
pub const PHOTOS_LEAST: usize = 3;

/// Whether a search for the poses of a scene has come to its end.
fn is_searched(scene: &Path) -> bool {
    let state: serde_json::Value = own_json(&scene.join(SEARCH_FOLDER).join(SEARCH_STATE)).unwrap_or_default();
    state["done"].as_array().is_some_and(|done| done.iter().any(|phase| phase == SEARCH_END))
}

/// Photos of a drone's card lie in folders of folders.
const FOLDERS_DEEP: usize = 3;

/// A file of a COLMAP model without its partner, and the name of the partner: poses take both `cameras` and `images`.
fn file_without_partner(folder: &Path) -> Option<(PathBuf, String)> {
    let places = ["sparse/0", "sparse", ""].map(|place| folder.join(place));
    let pairs = places.iter().flat_map(|place| ["bin", "txt"].map(|ending| (place, ending)));
    pairs.into_iter().find_map(|(place, ending)| {
        let [cameras, images] = ["cameras", "images"].map(|name| place.join(format!("{name}.{ending}")));
        match (cameras.is_file(), images.is_file()) {
            (true, false) => Some((cameras, format!("images.{ending}"))),
            (false, true) => Some((images, format!("cameras.{ending}"))),
            _ => None,
        }
    })
}

/// The error, which says how to get poses, for a folder of photos without a model that a reader knows.
fn without_poses(folder: &Path) -> Option<InputError> {
    let images = folder.join("images");
    let search = folder.join(SEARCH_FOLDER);
    let of_search = if search.join(SEARCH_STATE).is_file() { photos_below(&search, FOLDERS_DEEP - 1) } else { 0 };
    let counts = [photos_below(&images, FOLDERS_DEEP), photos_below(folder, FOLDERS_DEEP).saturating_sub(of_search)];
    let Some(count) = counts.into_iter().find(|n| *n > 0) else {
        let others = unreadable_below(folder, FOLDERS_DEEP) as u64;
        let problem = format!("{} here neither JPEG nor PNG", counted_are(others, "picture"));
        return (others > 0).then(|| InputError::new(folder, problem, CONVERT_PHOTOS));
    };
    let place = shell_word(folder);
    if let Some((file, missing)) = file_without_partner(folder) {
        let problem = format!("there is no {missing} beside it");
        return Some(InputError::new(file, problem, "copy the whole model: cameras, images and points3D"));
    }
    // gsscale-poses needs --out where all photos lie in sub-folders.
    let is_nested = counts[0] == 0 && photos_below(folder, 0) == 0;
    let out_flag = if is_nested { " --out FOLDER" } else { "" };
    // What would only send the user back.
    if is_searched(folder) {
        let problem = format!("gsscale-poses has found no poses: the {count} photos show too little in common");
        let remedy = format!("{MORE_OVERLAP}; then gsscale-poses {place} again");
        return Some(InputError::new(folder, problem, remedy));
    }
    if count < PHOTOS_LEAST {
        let problem = format!("{}, but no camera poses", counted(count as u64, "photo"));
        let remedy =
            "take some dozens of photos from places around, of which neighbours share two thirds of their content";
        return Some(InputError::new(folder, problem, remedy));
    }
    let problem = format!("{count} photos, but no camera poses");
    let remedy = format!(
        "find the poses first, with COLMAP or pycolmap:  gsscale-poses {place}{out_flag}\n  \
         (--poses auto does that, and then trains), or with another program:\n  \
         OpenDroneMap:   its project folder (with opensfm/reconstruction.json and images/) is read as it is\n  \
         RealityScan, RealityCapture:  export 'Internal/External camera parameters' (CSV) into {place}\n  \
         Metashape:      File > Export > Export Cameras, as COLMAP, into {place}\n\
         tools/POSES.md says more"
    );
    Some(InputError::new(folder, problem, remedy))
}

/// Gives the views whose names have bytes of a code page names to show, and says which they are.
/// Errors: two views have the same name then.
fn make_readable(file: &Path, scene: &mut RawScene) -> InputResult<()> {
    let (mut found, mut lost) = (Vec::new(), Vec::new());
    for view in scene.views.iter_mut().filter(|view| has_raw_bytes(&view.name)) {
        let bytes = shown(&view.name);
        let parts = view.name.split('/').count();
        let components: Option<Vec<&str>> = view.image_path.iter().map(|part| part.to_str()).collect();
        let of_path = components
            .filter(|_| view.image_path.is_file())
            .map(|all| all[all.len().saturating_sub(parts)..].join("/"));
        let is_there = view.image_path.is_file();
        view.name = of_path.unwrap_or_else(|| if is_there { as_windows_1252(&view.name) } else { bytes.clone() });
        match is_there {
            true => found.push(format!("{bytes} is {}", view.name)),
            false => lost.push(bytes),
        }
    }
    if found.is_empty() && lost.is_empty() {
        return Ok(());
    }
    for (names, what) in [(&found, "matched with the photos"), (&lost, "no photo, or more than one, fits them")] {
        if !names.is_empty() {
            let (file, are, names) = (file.display(), counted_are(names.len() as u64, "name"), listed(names));
            scene.warnings.push(format!("{file}: {are} not UTF-8 but of a code page; {what}: {names}"));
        }
    }
    sort_views(file, &mut scene.views)
}
