//! Camera poses for a folder of photos without any: COLMAP or pycolmap computes them, this room decides what they compute.
//!
//! In order: lists the photos ([`photos`]), chooses the pairs to compare ([`pairs`], [`similar`]), runs the phases of the program
//! ([`program`]), and writes the largest model into `sparse/0` of the scene ([`model`]), in metres where GPS allows ([`geo`]).
//!
//! The program works in the folder `poses` of the scene, on links of the photos under plain names: its lists of pairs have no way to
//! write a space. A phase that is finished is not done again, as long as photos and options are the same.
//!
//! Not here: reading the result ([`crate::dataset`]).
//!
//! Invariants: 1. photos are never changed, moved or deleted; 2. an existing model is never replaced; 3. only files that this room has
//! made are deleted, in a folder whose state file says that it is this room's; 4. `sparse` appears as a whole.

pub mod geo;
pub mod model;
pub mod pairs;
pub mod photos;
pub mod program;
pub mod similar;

use crate::base::count::Count;
use crate::base::error::{InputError, InputResult};
use crate::base::say::shell_word;
use crate::base::text::own_json;
use crate::base::units::{counted_are, format_grouped, format_seconds};
use crate::base::whole_file::{are_one_file, rename, write_whole};
use crate::base::whole_folder::remove_ours;
use crate::dataset::colmap::looks_like_colmap;
use crate::dataset::colmap_write::make_folder;
use crate::dataset::exif::GpsPlace;
use crate::dataset::model::{RawScene, ReadOptions};
use crate::dataset::read::{MORE_OVERLAP, SEARCH_END, SEARCH_FOLDER, SEARCH_STATE, read_scene};
use geo::{Similarity, metres_from, robust_similarity};
use glam::DVec3;
use pairs::{ChosenBy, choose_pairs, count_of, way_of};
use photos::{FoundPhoto, camera_groups, list_photos, modified_at};
use program::{CHUNK, DATABASE, FeatureOptions, LIST, PHOTOS, Phase, Program, ProgramPaths, SPARSE};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::fmt;
use std::fs::{DirEntry, File, Metadata, TryLockError};
use std::io::ErrorKind::NotFound;
use std::path::{Path, PathBuf};

/// The folder in the scene in which the program works.
pub const WORK_FOLDER: &str = SEARCH_FOLDER;
/// Where the origin of a model in metres lies, as OpenSfM names it.
pub const ORIGIN_FILE: &str = "reference_lla.json";
const STATE_FILE: &str = SEARCH_STATE;
const PAIRS_FILE: &str = "pairs.json";
/// What marks a work folder as ours.
const MADE_BY: &str = "gsscale-poses 1";
/// Photos of a camera from which all its lens parameters follow well; below, one parameter of distortion is sought.
const PHOTOS_FOR_OPENCV: usize = 10;
/// Chunks of pairs: progress is known between them.
const CHUNKS: usize = 50;
const CHUNK_LEAST: usize = 200;
/// Seconds of one core: features a megapixel, likeness a photo and a comparison of two, the model a photo of a small scene.
const FEATURES_SECONDS: f64 = 1.6;
const LIKENESS_SECONDS: f64 = 0.3;
const COMPARISON_SECONDS: f64 = 0.0007;
const MODEL_SECONDS: f64 = 0.5;
/// Photos from which a model takes noticeably longer for each photo.
const MODEL_GROWTH: f64 = 500.0;
/// Pixels of the longer side that may find more than the default.
const LARGER: u32 = 2400;
/// GPS that disagrees with the model by more than this part of the extent of the places aligns nothing.
const DISAGREEMENT_MAX: f64 = 0.3;

/// What the user asks for.
#[derive(Debug, Clone)]
pub struct PosesRequest {
    /// A folder of photos, or one that holds them in `images`.
    pub photos: PathBuf,
    /// The folder of the scene; `None` is that of the photos.
    pub out: Option<PathBuf>,
    pub places: ProgramPaths,
    pub features: FeatureOptions,
}

/// Shows progress: what is done, how much of it, and of how much.
pub type Watch<'a> = dyn FnMut(&'static str, u32, u32) + 'a;

impl PosesRequest {
    /// The request for these photos that leaves the rest to this room.
    pub fn of(photos: &Path) -> PosesRequest {
        let features = FeatureOptions { max_image_size: 1600, max_features: 8192 };
        PosesRequest { photos: photos.to_path_buf(), out: None, places: ProgramPaths::default(), features }
    }
}

/// A search that can begin: photos, program and folders are known.
#[derive(Debug)]
pub struct PoseSearch {
    /// Gets `sparse` and, if the photos are elsewhere, `images`.
    pub scene: PathBuf,
    /// Whether the scene needs links of the photos.
    links_photos: bool,
    photos: Vec<FoundPhoto>,
    groups: Vec<Vec<usize>>,
    program: Program,
    features: FeatureOptions,
    /// Sentences for the user, about photos that are left out.
    pub warnings: Vec<String>,
}

/// What a search found.
#[derive(Debug)]
pub struct FoundPoses {
    pub scene: PathBuf,
    pub photos: usize,
    pub registered: usize,
    /// Names of photos without a pose.
    pub missing: Vec<String>,
    /// What to do about these.
    remedy: String,
    /// Where the model's origin lies, and the median distance of its cameras from their GPS, metres.
    pub aligned: Option<(GpsPlace, f64)>,
    /// Sentences for the user.
    pub said: Vec<String>,
}

/// How far the work is, and for which photos and options.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
struct SearchState {
    made_by: String,
    program: String,
    options: String,
    photos: Vec<SearchedPhoto>,
    /// Finished phases.
    done: Vec<String>,
}

/// What tells a photo from another of its name.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct SearchedPhoto {
    name: String,
    bytes: u64,
    /// As [`FoundPhoto::modified`].
    modified: u64,
    /// Number of its camera group.
    group: usize,
}

impl PoseSearch {
    /// Looks at the photos and for a program. Writes nothing.
    /// Errors: no photos, a model is there already, photos in sub-folders without a folder for the scene, or no program.
    pub fn new(request: &PosesRequest) -> InputResult<PoseSearch> {
        let (home, folder) = home_of(&request.photos);
        let scene = request.out.clone().unwrap_or_else(|| home.clone());
        let same =
            |a: &Path, b: &Path| a == b || a.canonicalize().is_ok_and(|a| b.canonicalize().is_ok_and(|b| a == b));
        let links_photos = !same(&scene, &home);
        let sparse = scene.join(SPARSE);
        let is_empty = |folder: &Path| std::fs::read_dir(folder).is_ok_and(|mut entries| entries.next().is_none());
        if sparse.exists() && !is_empty(&sparse) {
            let remedy = format!(
                "to train with it: gsscale-train {}; for new poses: rename {}, remove {} and give the command again, or add --out FOLDER",
                shell_word(&scene),
                sparse.display(),
                scene.join(WORK_FOLDER).display()
            );
            return Err(InputError::new(sparse, "a model is here already", remedy));
        }
        let (photos, warnings) = list_photos(&folder, &scene).map_err(|error| {
            let is_empty_beside_photos = folder != request.photos && list_photos(&request.photos, &scene).is_ok();
            if is_empty_beside_photos {
                return InputError::new(
                    folder.clone(),
                    "holds no photos, but photos lie beside it",
                    "move them into it",
                );
            }
            error
        })?;
        let is_flat = !links_photos && same(&folder, &scene);
        if let Some(below) = photos.iter().find(|photo| is_flat && photo.name.contains('/')) {
            let problem = format!("photos lie in sub-folders ({})", below.name);
            return Err(InputError::new(
                folder,
                problem,
                "name a new folder, whose images/ will hold links to them: gsscale-poses PHOTOS --out FOLDER",
            ));
        }
        let program = Program::find(&request.places)?;
        let groups = camera_groups(&photos);
        Ok(PoseSearch { scene, links_photos, photos, groups, program, features: request.features, warnings })
    }

    /// What will be done, and about how long it takes.
    pub fn forecast(&self) -> String {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let (n, pairs) = (self.photos.len(), count_of(&self.photos));
        let places = self.photos.iter().filter(|photo| photo.place.is_some()).count();
        let way = match way_of(&self.photos) {
            ChosenBy::All => "each with each",
            ChosenBy::Distance => "the nearest by GPS",
            ChosenBy::SequenceAndLikeness => "the next by name, and those that look alike",
        };
        let megapixels = |photo: &FoundPhoto| {
            let [width, height] = [photo.header.width, photo.header.height].map(f64::from);
            width * height * (f64::from(self.features.max_image_size) / width.max(height)).min(1.0).powi(2) / 1e6
        };
        let likeness = match way_of(&self.photos) {
            ChosenBy::SequenceAndLikeness => {
                LIKENESS_SECONDS * n as f64 + COMPARISON_SECONDS * similar::comparisons(n) as f64
            }
            _ => 0.0,
        };
        let features = self.photos.iter().map(megapixels).sum::<f64>() * FEATURES_SECONDS;
        let of_features = (f64::from(self.features.max_features) / 8192.0).powi(2);
        let matches = pairs as f64 * self.program.seconds_a_pair() * of_features;
        let model = n as f64 * MODEL_SECONDS * (1.0 + n as f64 / MODEL_GROWTH);
        let parallel = if self.program.uses_gpu { 1.0 } else { cores as f64 };
        let seconds = (likeness + features) / cores as f64 + matches / parallel + model;
        format!(
            "{n} photos of {} camera(s), {places} with GPS; {} on {}\n\
             compares about {} pairs: {way}\n\
             forecast: {} to {}; a stopped search goes on where it was",
            self.groups.len(),
            self.program.name,
            if self.program.uses_gpu { "the GPU".to_string() } else { format!("{cores} core(s)") },
            format_grouped(pairs),
            format_seconds(seconds * 0.7),
            format_seconds(seconds * 2.0),
        )
    }

    /// [`PoseSearch::run`] with words about what it does and found, and with progress.
    /// Errors: those of `run`.
    pub fn run_shown(&self, quiet: bool) -> InputResult<FoundPoses> {
        self.warnings.iter().for_each(|warning| crate::tell!("warning: {warning}"));
        if !quiet {
            crate::tell!("{}", self.forecast());
        }
        let mut shown: Option<(&str, Count)> = None;
        let found = self.run(&mut |what, done, total| {
            if shown.as_ref().is_none_or(|(shown, _)| *shown != what) {
                // The bar before ends first.
                shown = None;
                shown = Some((what, Count::new(what, total, quiet)));
            }
            shown.iter().for_each(|(_, count)| count.show(done));
        });
        drop(shown);
        let found = found?;
        if !quiet {
            crate::tell!("{found}");
        } else {
            found.said.iter().for_each(|sentence| crate::tell!("warning: {sentence}"));
            if found.registered < found.photos * 9 / 10 {
                crate::tell!("warning: {} of {} photos have poses", found.registered, found.photos);
            }
        }
        Ok(found)
    }

    /// Finds the poses, and writes them as a scene.
    /// Errors: a folder that is not ours is in the way, the program fails or finds no model, or the disk fails.
    pub fn run(&self, watch: &mut Watch<'_>) -> InputResult<FoundPoses> {
        let work = self.scene.join(WORK_FOLDER);
        let (mut state, lock) = self.begin(&work)?;
        let place = (work.as_path(), &lock);
        self.link_photos(&work)?;
        self.find_features(place, &mut state, watch)?;
        if !state.is_done("matches") {
            let pairs = self.pairs(&work, &mut state, watch)?;
            let size = CHUNK_LEAST.max(pairs.len().div_ceil(CHUNKS));
            let mut done = 0;
            for chunk in pairs.chunks(size) {
                watch("pairs compared", done as u32, pairs.len() as u32);
                write_whole(&work.join(CHUNK), self.lines_of(chunk).as_bytes())?;
                self.program.run(Phase::Matches, &self.features, place, &mut |_| ())?;
                done += chunk.len();
            }
            state.finish("matches", &work)?;
        }
        if !state.is_done(SEARCH_END) {
            remove_ours(&work.join(SPARSE), is_of_model)?;
            make_folder(&work.join(SPARSE))?;
            let total = self.photos.len() as u32;
            let mut show = |line: &str| registered_in(line).into_iter().for_each(|n| watch("photos placed", n, total));
            self.program.run(Phase::Model, &self.features, place, &mut show)?;
            state.finish(SEARCH_END, &work)?;
        }
        self.write_scene(&work)
    }

    /// The state of the work folder, which is made, emptied if it is of other photos or options, or refused if it is not ours.
    /// With the lock of the folder.
    fn begin(&self, work: &Path) -> InputResult<(SearchState, File)> {
        let mut group_of = vec![0; self.photos.len()];
        for (g, group) in self.groups.iter().enumerate() {
            group.iter().for_each(|&i| group_of[i] = g);
        }
        let of_photo = |(i, photo): (usize, &FoundPhoto)| SearchedPhoto {
            name: photo.name.clone(),
            bytes: photo.bytes,
            modified: photo.modified,
            group: group_of[i],
        };
        let new = SearchState {
            made_by: MADE_BY.to_string(),
            program: self.program.name.clone(),
            options: format!("{} pixels, {} features", self.features.max_image_size, self.features.max_features),
            photos: self.photos.iter().enumerate().map(of_photo).collect(),
            done: Vec::new(),
        };
        let images = self.scene.join("images");
        let entries = || std::fs::read_dir(work).into_iter().flatten().flatten();
        // A search that was killed before its first word leaves its lock, and a part of the word.
        let is_trace = |entry: DirEntry| entry.file_name() == "lock" || entry.file_name() == ".state.json.part";
        let has_begun = work.exists() && !(work.is_dir() && entries().all(is_trace));
        if !has_begun {
            if self.links_photos && images.exists() {
                let remedy = "name a new folder: gsscale-poses PHOTOS --out FOLDER";
                return Err(InputError::new(images, "exists already", remedy));
            }
            make_folder(work)?;
            let lock = lock(work)?;
            new.write(work)?;
            return Ok((new, lock));
        }
        if SearchState::read(work).is_none() {
            let problem = "exists already, and is not a work folder of gsscale-poses";
            let remedy = "move it away, or name a new folder for the scene: gsscale-poses PHOTOS --out FOLDER";
            return Err(InputError::new(work, problem, remedy));
        }
        let lock = lock(work)?;
        // Another search may have changed it until now.
        let Some(old) = SearchState::read(work) else {
            return Err(InputError::new(work, "another search has just begun here", "start this one again"));
        };
        if (SearchState { done: Vec::new(), ..old.clone() }) == new {
            return Ok((old, lock));
        }
        let (was, is) = match (old.program == new.program, old.options == new.options) {
            _ if old.program.is_empty() => ("of an older gsscale-poses", "of this one"),
            (false, _) => (old.program.as_str(), new.program.as_str()),
            (_, false) => (old.options.as_str(), new.options.as_str()),
            _ => ("of other photos", "of these"),
        };
        crate::tell!("warning: the search begins again: it was {was}, and is {is} now");
        self.unlink_changed(&old, work)?;
        // First: nothing of the old search may count as done once its files go.
        new.write(work)?;
        clear(work)?;
        Ok((new, lock))
    }

    /// Makes the photos known under plain names in the work folder, and in `images` of a scene in another place.
    fn link_photos(&self, work: &Path) -> InputResult<()> {
        make_folder(&work.join(PHOTOS))?;
        for (i, photo) in self.photos.iter().enumerate() {
            let plain = work.join(PHOTOS).join(plain_name(i, &photo.name));
            let target = self.scene.join("images").join(&photo.name);
            let is_ours = are_one_file(&target, &plain);
            link(&photo.path, photo.bytes, &plain)?;
            if !self.links_photos || are_one_file(&target, &plain) {
                continue;
            }
            match std::fs::symlink_metadata(&target) {
                // A copy, or what somebody has made of it. An older file is not a copy of the photo as it is now.
                Ok(now) if !is_ours && now.len() == photo.bytes && modified_at(&now) >= photo.modified => continue,
                Ok(_) if !is_ours => {
                    let remedy = "move it away, or name a new folder: gsscale-poses PHOTOS --out FOLDER";
                    return Err(InputError::new(target, "another file has the name of a photo", remedy));
                }
                _ => {}
            }
            make_folder(target.parent().unwrap_or(&target))?;
            // From the copy, if it is one: the photos may lie on a slow card.
            link(&plain, photo.bytes, &target)?;
        }
        Ok(())
    }

    /// Removes our links in `images` to earlier photos of names that are other photos now.
    fn unlink_changed(&self, old: &SearchState, work: &Path) -> InputResult<()> {
        for (i, SearchedPhoto { name, .. }) in old.photos.iter().enumerate() {
            let (plain, target) = (work.join(PHOTOS).join(plain_name(i, name)), self.scene.join("images").join(name));
            let changed = |photo: &FoundPhoto| photo.name == *name && !are_one_file(&photo.path, &target);
            if self.links_photos && are_one_file(&plain, &target) && self.photos.iter().any(changed) {
                std::fs::remove_file(&target).map_err(|e| InputError::io(&target, "replacing a photo", &e))?;
            }
        }
        Ok(())
    }

    /// The pairs to compare: those that an interrupted search has chosen, if it did.
    fn pairs(&self, work: &Path, state: &mut SearchState, watch: &mut Watch<'_>) -> InputResult<Vec<(u32, u32)>> {
        let file = work.join(PAIRS_FILE);
        let is_pair = |&(a, b): &(u32, u32)| a < b && (b as usize) < self.photos.len();
        let chosen: Option<Vec<(u32, u32)>> = own_json(&file);
        if let Some(pairs) = chosen.filter(|pairs| state.is_done("pairs") && pairs.iter().all(is_pair)) {
            return Ok(pairs);
        }
        let total = self.photos.len() as u32;
        let mut show = |done: usize| watch("photos compared by likeness", done as u32, total);
        let pairs = choose_pairs(&self.photos, |most| similar::look_alikes(&self.photos, most, &mut show));
        write_whole(&file, serde_json::json!(pairs).to_string().as_bytes())?;
        state.finish("pairs", work)?;
        Ok(pairs)
    }

    fn lines_of(&self, pairs: &[(u32, u32)]) -> String {
        let name = |i: u32| plain_name(i as usize, &self.photos[i as usize].name);
        let line = |&(a, b): &(u32, u32)| format!("{} {}\n", name(a), name(b));
        pairs.iter().map(line).collect()
    }

    /// Features of every photo. An interrupted search begins them again: COLMAP would give the rest of a group another camera.
    fn find_features(
        &self,
        (work, lock): (&Path, &File),
        state: &mut SearchState,
        watch: &mut Watch<'_>,
    ) -> InputResult<()> {
        if state.is_done("features") {
            return Ok(());
        }
        remove_files(work, &|name| name.starts_with(DATABASE))?;
        let (single, shared): (Vec<&Vec<usize>>, Vec<_>) = self.groups.iter().partition(|group| group.len() == 1);
        let single: Vec<usize> = single.into_iter().flatten().copied().collect();
        let total = self.photos.len() as u32;
        let mut done = 0;
        for (group, one_camera) in shared.into_iter().map(|group| (group, true)).chain([(&single, false)]) {
            if group.is_empty() {
                continue;
            }
            let is_enough = one_camera && group.len() >= PHOTOS_FOR_OPENCV;
            let camera_model = if is_enough { "OPENCV" } else { "SIMPLE_RADIAL" };
            let names: String = group.iter().map(|&i| plain_name(i, &self.photos[i].name) + "\n").collect();
            write_whole(&work.join(LIST), names.as_bytes())?;
            let mut in_group = 0;
            let mut show = |line: &str| {
                if line.contains("Processed file [") {
                    in_group += 1;
                    watch("photos searched for features", done + in_group, total);
                }
            };
            let phase = Phase::Features { camera_model, one_camera };
            self.program.run(phase, &self.features, (work, lock), &mut show)?;
            done += group.len() as u32;
        }
        state.finish("features", work)
    }

    /// Writes the largest model into the scene, in metres if GPS allows.
    fn write_scene(&self, work: &Path) -> InputResult<FoundPoses> {
        let options = ReadOptions { images: Some(PHOTOS.to_string()), points_later: true, ..ReadOptions::default() };
        if !looks_like_colmap(work) {
            let problem = format!("no poses were found: its {} photos show too little in common", self.photos.len());
            return Err(InputError::new(&self.scene, problem, self.remedy()));
        }
        let raw = read_scene(work, &options)?;
        let index = |name: &str| name.split('.').next()?.parse::<usize>().ok().filter(|&i| i < self.photos.len());
        let mut is_placed = vec![false; self.photos.len()];
        raw.views.iter().filter_map(|view| index(&view.name)).for_each(|i| is_placed[i] = true);
        let missing: Vec<String> =
            self.photos.iter().zip(&is_placed).filter(|(_, is)| !**is).map(|(photo, _)| photo.name.clone()).collect();
        let registered = self.photos.len() - missing.len();
        let mut said: Vec<String> = raw.warnings.clone();
        let alignment = self.align(&raw, &index, &mut said);
        let moved = alignment.map_or(Similarity::IDENTITY, |(_, moved, _)| moved);
        let model = raw.points_path.as_deref().and_then(Path::parent).unwrap_or(work);
        let part = work.join("result");
        remove_ours(&part, is_of_model)?;
        make_folder(&part.join("0"))?;
        let name_of = |name: &str| index(name).map(|i| self.photos[i].name.clone());
        model::write_moved(model, &part.join("0"), &moved, &name_of)?;
        if let Some((origin, ..)) = alignment {
            let text = serde_json::json!({
                "latitude": origin.latitude, "longitude": origin.longitude, "altitude": origin.altitude,
            });
            write_whole(&self.scene.join(ORIGIN_FILE), format!("{text:#}\n").as_bytes())?;
        } else if self.scene.join(ORIGIN_FILE).is_file() {
            said.push(format!("{ORIGIN_FILE} is of an earlier model, not of this one: remove it"));
        }
        let sparse = self.scene.join(SPARSE);
        rename(&part, &sparse).map_err(|e| InputError::io(&sparse, "giving the model its name", &e))?;
        let aligned = alignment.map(|(origin, _, rest)| (origin, rest));
        let (scene, remedy) = (self.scene.clone(), self.remedy());
        Ok(FoundPoses { scene, photos: self.photos.len(), registered, missing, remedy, aligned, said })
    }

    /// What to do if photos have no pose.
    fn remedy(&self) -> String {
        let longest = self.photos.iter().map(|photo| photo.header.width.max(photo.header.height)).max().unwrap_or(0);
        match self.features.max_image_size < LARGER.min(longest) {
            true => format!(
                "{MORE_OVERLAP}; if all is sharp and overlaps, try gsscale-poses with --max-resolution {LARGER}"
            ),
            false => MORE_OVERLAP.to_string(),
        }
    }

    /// The place in the middle as the origin, the similarity from the model to metres east, north and up of it, and the median distance that
    /// remains; `None`, with a sentence, where places do not fix it.
    fn align(
        &self,
        raw: &RawScene,
        index: &dyn Fn(&str) -> Option<usize>,
        said: &mut Vec<String>,
    ) -> Option<(GpsPlace, Similarity, f64)> {
        let place = |name: &str| self.photos[index(name)?].place.filter(|place| place.altitude.is_some());
        let with_place = || raw.views.iter().filter_map(|view| Some((view.pose.centre(), place(&view.name)?)));
        // Medians: a place that is far off moves neither.
        let Some((_, first)) = with_place().next() else {
            if self.photos.iter().any(|photo| photo.place.is_some()) {
                said.push("the photos' GPS has no altitude, so the model has no metres and no north".to_string());
            }
            return None;
        };
        let of_first: Vec<DVec3> = with_place().map(|(_, place)| metres_from(&first, &place)).collect();
        let median_of = |values: &mut dyn Iterator<Item = f64>| {
            let mut values: Vec<f64> = values.collect();
            values.sort_unstable_by(f64::total_cmp);
            values[values.len() / 2]
        };
        let middle = DVec3::from([0, 1, 2].map(|axis| median_of(&mut of_first.iter().map(|at| at[axis]))));
        let extent = median_of(&mut of_first.iter().map(|at| at.distance(middle)));
        let nearest = |a: &(&DVec3, GpsPlace), b: &(&DVec3, GpsPlace)| {
            a.0.distance_squared(middle).total_cmp(&b.0.distance_squared(middle))
        };
        let origin = of_first.iter().zip(with_place().map(|(_, place)| place)).min_by(nearest)?.1;
        let (centres, metres): (Vec<_>, Vec<_>) =
            with_place().map(|(at, place)| (at, metres_from(&origin, &place))).unzip();
        let why = match robust_similarity(&centres, &metres) {
            Ok((moved, rest)) if rest <= DISAGREEMENT_MAX * extent => return Some((origin, moved, rest)),
            Ok((_, rest)) | Err(Some(rest)) if rest > DISAGREEMENT_MAX * extent => {
                &format!("GPS disagrees with the model by {rest:.1} m (one of them is wrong)")
            }
            _ => "GPS places are too few, too coarse or on a line",
        };
        said.push(format!("the photos' {why}, so the model has no metres and no north"));
        None
    }
}

impl fmt::Display for FoundPoses {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.said.iter().try_for_each(|sentence| writeln!(f, "{sentence}"))?;
        write!(f, "{} of {} photos have poses: {}", self.registered, self.photos, self.scene.join(SPARSE).display())?;
        if let Some((origin, rest)) = &self.aligned {
            let (latitude, longitude) = (origin.latitude, origin.longitude);
            write!(f, "\nin metres east, north and up of {latitude:.6}, {longitude:.6} ({ORIGIN_FILE}); ")?;
            write!(f, "median distance from GPS {rest:.1} m")?;
        }
        if !self.missing.is_empty() {
            let first = self.missing.iter().take(5).map(String::as_str).collect::<Vec<_>>().join(", ");
            let more = if self.missing.len() > 5 { ", ..." } else { "" };
            write!(f, "\nwithout poses: {first}{more}")?;
        }
        if self.registered < self.photos * 9 / 10 {
            write!(f, "\n  remedy: {}", self.remedy)?;
        }
        Ok(())
    }
}

impl SearchState {
    fn is_done(&self, phase: &str) -> bool {
        self.done.iter().any(|done| done == phase)
    }

    fn finish(&mut self, phase: &str, work: &Path) -> InputResult<()> {
        self.done.push(phase.to_string());
        self.write(work)
    }

    /// That of a work folder of ours.
    fn read(work: &Path) -> Option<SearchState> {
        // An older program may have kept less of each photo: then its search begins again.
        let state: serde_json::Value = own_json(&work.join(STATE_FILE))?;
        (state["made_by"] == MADE_BY).then(|| serde_json::from_value(state).unwrap_or_default())
    }

    fn write(&self, work: &Path) -> InputResult<()> {
        let file = work.join(STATE_FILE);
        let text = serde_json::to_vec(self).map_err(|e| {
            InputError::new(&file, e.to_string(), "name another folder: gsscale-poses PHOTOS --out FOLDER")
        })?;
        write_whole(&file, &text)
    }
}

/// Checks the model that a search has left for the photos in `named`; a model of another program passes.
/// Errors: a photo has come or changed since the search; fewer than half of the photos have a pose; the photos cannot be listed.
pub fn check_found(named: &Path) -> InputResult<()> {
    let (scene, folder) = home_of(named);
    let Some(state) = SearchState::read(&scene.join(WORK_FOLDER)) else { return Ok(()) };
    let (photos, _) = list_photos(&folder, &scene)?;
    let (place, sparse) = (shell_word(&scene), scene.join(SPARSE));
    let remedy = format!(
        "to search again, rename {}, remove {} and give the command again; to train with these: gsscale-train {place}",
        sparse.display(),
        scene.join(WORK_FOLDER).display()
    );
    let searched: BTreeSet<(&str, u64)> = state.photos.iter().map(|of| (of.name.as_str(), of.bytes)).collect();
    let new = photos.iter().filter(|photo| !searched.contains(&(photo.name.as_str(), photo.bytes))).count();
    if new > 0 {
        let problem = format!("{} new or changed since the search for poses", counted_are(new as u64, "photo"));
        return Err(InputError::new(named, problem, remedy));
    }
    let registered = read_scene(&scene, &ReadOptions { allow_missing: true, ..ReadOptions::default() })?.views.len();
    if 2 * registered < photos.len() {
        let problem = format!("only {registered} of {} photos have poses", photos.len());
        return Err(InputError::new(named, problem, format!("{MORE_OVERLAP}; {remedy}")));
    }
    Ok(())
}

/// The folder of the scene whose photos are named, and the folder of the photos.
fn home_of(named: &Path) -> (PathBuf, PathBuf) {
    let images = named.join("images");
    if images.is_dir() {
        return (named.to_path_buf(), images);
    }
    let whole = std::path::absolute(named).unwrap_or_else(|_| named.to_path_buf());
    // `images` has no parent, and `.` inside of it neither.
    match named.parent().filter(|above| !above.as_os_str().is_empty()).or(whole.parent()) {
        Some(above) if whole.file_name().is_some_and(|name| name == "images") => {
            (above.to_path_buf(), named.to_path_buf())
        }
        _ => (named.to_path_buf(), named.to_path_buf()),
    }
}

/// The number of photos that a line of the reconstruction says are placed: `Registering image #16 (num_reg_frames=2)`, or with
/// the number alone.
fn registered_in(line: &str) -> Option<u32> {
    let (_, rest) = line.split_once("Registering image #")?;
    let inside = rest.split_once('(')?.1.split(')').next()?;
    let number = inside.rsplit('=').next()?.parse::<u32>().ok()?;
    Some(number + 1)
}

/// Whether COLMAP's mapper writes a file of this path, or this room writes it, perhaps not to its end.
fn is_of_model(path: &Path) -> bool {
    const STEMS: [&str; 6] = ["cameras", "images", "points3D", "rigs", "frames", "project"];
    let word = |part: Option<&std::ffi::OsStr>| part.and_then(|part| part.to_str()).unwrap_or_default().to_string();
    let is_numbered = path.parent().is_some_and(|parent| word(Some(parent.as_os_str())).parse::<u32>().is_ok());
    let name = word(path.file_name());
    let whole = name.strip_prefix('.').and_then(|name| name.strip_suffix(".part")).unwrap_or(&name);
    is_numbered
        && whole.split_once('.').is_some_and(|(stem, end)| STEMS.contains(&stem) && ["bin", "ini"].contains(&end))
}

/// Removes what earlier work left in a folder of ours.
fn clear(work: &Path) -> InputResult<()> {
    remove_ours(&work.join(SPARSE), is_of_model)?;
    remove_files(work, &|name| name.starts_with(DATABASE))?;
    let is_plain =
        |name: &str| name.split_once('.').is_some_and(|(stem, _)| stem.len() >= 6 && stem.parse::<u64>().is_ok());
    if work.join(PHOTOS).is_dir() { remove_files(&work.join(PHOTOS), &is_plain) } else { Ok(()) }
}

/// Removes the files and links, but no folders, of a folder whose names are `ours`.
fn remove_files(folder: &Path, ours: &dyn Fn(&str) -> bool) -> InputResult<()> {
    let io = |e: &std::io::Error| InputError::io(folder, "removing what an earlier search left", e);
    for entry in std::fs::read_dir(folder).map_err(|e| io(&e))? {
        let entry = entry.map_err(|e| io(&e))?;
        let is_file = entry.file_type().is_ok_and(|kind| !kind.is_dir());
        if is_file && entry.file_name().to_str().is_some_and(ours) {
            std::fs::remove_file(entry.path()).map_err(|e| io(&e))?;
        }
    }
    Ok(())
}

/// Locks a work folder, as long as the file is open.
fn lock(work: &Path) -> InputResult<File> {
    let options = File::options().write(true).create(true).truncate(false).clone();
    let lock = options.open(work.join("lock")).map_err(|e| InputError::io(work, "locking the folder", &e))?;
    match lock.try_lock() {
        Err(TryLockError::WouldBlock) => {
            Err(InputError::new(work, "another search works in this folder", "wait for its end, or stop it"))
        }
        // Some file systems know no locks.
        _ => Ok(lock),
    }
}

/// The name in the work folder of the photo with this number.
fn plain_name(i: usize, name: &str) -> String {
    let ending = Path::new(name).extension().map(|ending| ending.to_string_lossy().to_lowercase());
    format!("{i:06}.{}", ending.unwrap_or_default())
}

/// Makes `name` a hard link to a photo of so many bytes, or a copy where the drive has no hard links. A link to the photo stays, and so does
/// a complete copy that is younger than the photo. Anything else under `name` is replaced, so the caller must know that it is ours.
/// Errors: the photo cannot be read, or the folder cannot be written.
fn link(photo: &Path, bytes: u64, name: &Path) -> InputResult<()> {
    // A link's own target, so that moving the link leaves the photo reachable.
    let photo = photo.canonicalize().unwrap_or_else(|_| photo.to_path_buf());
    let stays = |now: Metadata, of_photo: Metadata| {
        let younger = now.modified().ok().zip(of_photo.modified().ok()).is_some_and(|(now, of_photo)| now > of_photo);
        now.is_file() && now.len() == bytes && (younger || are_one_file(name, &photo))
    };
    if std::fs::symlink_metadata(name).is_ok_and(|now| std::fs::metadata(&photo).is_ok_and(|of| stays(now, of))) {
        return Ok(());
    }
    let fail = |e: std::io::Error| InputError::io(name, "copying a photo", &e);
    let part = name.with_file_name(format!(".{}.part", name.file_name().unwrap_or_default().to_string_lossy()));
    let absent = |done: std::io::Result<()>| done.or_else(|e| if e.kind() == NotFound { Ok(()) } else { Err(e) });
    absent(std::fs::remove_file(&part)).map_err(fail)?;
    if std::fs::hard_link(&photo, &part).is_err() {
        std::fs::copy(&photo, &part).map_err(fail)?;
    }
    // Two names of one file: a rename would leave both.
    absent(std::fs::remove_file(name)).map_err(fail)?;
    rename(&part, name).map_err(fail)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn progress_is_read_from_lines_of_old_and_new_versions() {
        let new =
            "I20261128 17:38:59.335402 140283 incremental_pipeline.cc:620] Registering image #16 (num_reg_frames=2)";
        assert_eq!(registered_in(new), Some(3));
        assert_eq!(registered_in("Registering image #9 (11)"), Some(12));
        assert_eq!(registered_in("Registering initial image pair #8 and #18"), None);
    }

    #[test]
    fn few_poses_are_told_what_to_do() {
        let missing: Vec<String> = (0..7).map(|i| format!("{i}.jpg")).collect();
        let place = GpsPlace { latitude: 43.25, longitude: -87.5, altitude: Some(210.0) };
        let (scene, said) = (PathBuf::from("scan"), Vec::new());
        let (remedy, aligned) = (MORE_OVERLAP.to_string(), Some((place, 0.4)));
        let found = FoundPoses { scene, photos: 18, registered: 11, missing, remedy, aligned, said };
        let text = found.to_string();
        let parts = [
            "11 of 18 photos have poses",
            "43.250000, -87.500000",
            "GPS 0.4 m",
            "0.jpg, 1.jpg",
            "4.jpg, ...",
            MORE_OVERLAP,
        ];
        assert!(parts.iter().all(|part| text.contains(part)), "{text}");
        let all = FoundPoses { registered: 18, missing: Vec::new(), aligned: None, ..found }.to_string();
        assert!(!all.contains("remedy") && !all.contains("GPS"), "{all}");
    }

    #[test]
    fn the_scene_of_photos_is_their_folder_or_the_one_above_images() {
        let root = tempfile::tempdir().unwrap();
        let images = root.path().join("a/images");
        std::fs::create_dir_all(&images).unwrap();
        let above = root.path().join("a");
        assert_eq!(home_of(&above), (above.clone(), images.clone()));
        assert_eq!(home_of(&images), (above, images.clone()));
        assert_eq!(home_of(root.path()), (root.path().to_path_buf(), root.path().to_path_buf()));
        // From inside of the scene.
        assert_eq!(home_of(Path::new("images")), (std::env::current_dir().unwrap(), PathBuf::from("images")));
    }

    #[test]
    fn a_photo_is_linked_whole_and_again_when_it_has_changed() {
        let root = tempfile::tempdir().unwrap();
        let [photo, name] = ["a.jpg", "b.jpg"].map(|name| root.path().join(name));
        std::fs::write(&photo, b"photo").unwrap();
        // A copy that was cut off, then one that is whole, then another photo of the same length.
        std::fs::write(&name, b"ph").unwrap();
        for content in ["photo", "photo", "other"] {
            if content == "other" {
                std::fs::remove_file(&photo).unwrap();
                std::fs::write(&photo, content).unwrap();
            }
            link(&photo, 5, &name).unwrap();
            assert_eq!(std::fs::read(&name).unwrap(), content.as_bytes());
        }
        assert_eq!(std::fs::read_dir(root.path()).unwrap().count(), 2, "no part is left");
    }

    /// A second search after the photos of the first have changed replaces its links, and no file of others.
    #[test]
    fn files_of_others_in_the_scene_stay() {
        let root = tempfile::tempdir().unwrap();
        let (from, scene) = (root.path().join("card"), root.path().join("scene"));
        std::fs::create_dir_all(&from).unwrap();
        let work = scene.join(WORK_FOLDER);
        let image = |name: &str| scene.join("images").join(name);
        let read = |name: &str| std::fs::read_to_string(image(name)).unwrap();
        let search = |photos: [(&str, &str); 3]| {
            let photos = photos.map(|(name, content)| {
                std::fs::remove_file(from.join(name)).ok();
                std::fs::write(from.join(name), content).unwrap();
                photos::tests::photo_at(&from, name)
            });
            let (photos, groups, features) = (photos.to_vec(), vec![vec![0, 1, 2]], PosesRequest::of(&from).features);
            let (scene, program, warnings) = (scene.clone(), Program::unused(), Vec::new());
            PoseSearch { scene, links_photos: true, photos, groups, program, features, warnings }
        };
        let first = search([("a.jpg", "first"), ("b.jpg", "b"), ("c.jpg", "c")]);
        let (state, lock) = first.begin(&work).unwrap();
        first.link_photos(&work).unwrap();
        drop(lock);
        assert_eq!([read("a.jpg"), read("b.jpg")], ["first", "b"]);
        // Somebody edits one of them, and takes another photo of the same name.
        std::fs::remove_file(image("b.jpg")).unwrap();
        std::fs::write(image("b.jpg"), "edited").unwrap();
        let second = search([("a.jpg", "the second"), ("b.jpg", "b"), ("c.jpg", "c")]);
        let (again, lock) = second.begin(&work).unwrap();
        assert_ne!(state.photos, again.photos);
        let refused = second.link_photos(&work).unwrap_err();
        assert!(refused.problem.contains("another file") && refused.remedy.contains("--out"), "{refused}");
        assert_eq!([read("a.jpg"), read("b.jpg")], ["the second", "edited"]);
        // A photo that changed at its length begins the search again; what is finished stays otherwise.
        let mut third = search([("a.jpg", "the second"), ("b.jpg", "b"), ("c.jpg", "c")]);
        drop(lock);
        let (mut state, lock) = third.begin(&work).unwrap();
        state.finish("features", &work).unwrap();
        drop(lock);
        let (state, lock) = third.begin(&work).unwrap();
        assert_eq!(state.done, ["features"]);
        drop(lock);
        third.photos[0].modified += 1;
        let (state, lock) = third.begin(&work).unwrap();
        assert!(state.done.is_empty());
        drop(lock);
        third.photos[0].modified -= 1;
        let (_, lock) = third.begin(&work).unwrap();
        // Of the same length it stays as well.
        std::fs::write(image("b.jpg"), "e").unwrap();
        second.link_photos(&work).unwrap();
        assert_eq!(read("b.jpg"), "e");
        // A search that was killed before its first word does not take a folder of photos over, and begins where there is none.
        drop(lock);
        std::fs::rename(work.join(STATE_FILE), work.join(".state.json.part")).unwrap();
        std::fs::remove_dir_all(work.join(PHOTOS)).unwrap();
        assert!(second.begin(&work).unwrap_err().problem.contains("exists already"));
        std::fs::remove_dir_all(scene.join("images")).unwrap();
        assert!(second.begin(&work).unwrap().0.done.is_empty());
    }

    #[test]
    fn only_what_a_search_makes_is_removed() {
        let root = tempfile::tempdir().unwrap();
        let work = root.path();
        for file in [
            "sparse/0/images.bin",
            "sparse/1/project.ini",
            "sparse/1/.points3D.bin.part",
            "database.db",
            "database.db-wal",
            "photos/000001.jpg",
            "photos/mine.jpg",
        ] {
            std::fs::create_dir_all(work.join(file).parent().unwrap()).unwrap();
            std::fs::write(work.join(file), b"").unwrap();
        }
        clear(work).unwrap();
        let left = |folder: &str| {
            std::fs::read_dir(work.join(folder)).unwrap().map(|e| e.unwrap().file_name()).collect::<Vec<_>>()
        };
        assert_eq!((left(""), left("photos")), (vec!["photos".into()], vec!["mine.jpg".into()]));
        std::fs::create_dir_all(work.join("sparse/0")).unwrap();
        std::fs::write(work.join("sparse/0/notes.txt"), b"mine").unwrap();
        assert!(clear(work).unwrap_err().problem.contains("notes.txt"));
    }
}
