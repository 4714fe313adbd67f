//! Photos and masks whose names or places are not those that the model states, through the real binary: a run on them gives the
//! bytes of a run on the scene as it was, and says what it did.

use crate::support::scenes::TextModel;
use crate::support::workdir::Workdir;
use std::fs;
use std::path::{Path, PathBuf};

/// The Gaussians of a short run of a scene, and what it said.
fn run_of(work: &Workdir, scene: &str) -> (Vec<u8>, String) {
    let said = work.train(&format!("{scene} --out out --steps 12 --overwrite"));
    (work.ply("out"), said)
}

fn run(work: &Workdir) -> (Vec<u8>, String) {
    run_of(work, "scene")
}

fn rename_photos(folder: &Path, new: impl Fn(&str) -> String) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_str().unwrap().to_string();
        if name.ends_with(".jpg") {
            let to = folder.join(new(&name));
            fs::create_dir_all(to.parent().unwrap()).unwrap();
            fs::rename(&path, to).unwrap();
        }
    }
}

/// COLMAP ran with the scene as its folder of photos, so its names begin with the folders in it.
#[test]
fn photos_in_several_folders_of_a_scene_are_found() {
    let (work, mut model) = Workdir::small_model();
    let (expected, _) = run(&work);
    for (i, view) in model.views.iter_mut().enumerate() {
        let name = format!("cam{}/{}", i / 6, view.name);
        fs::create_dir_all(work.path(&format!("scene/cam{}", i / 6))).unwrap();
        fs::rename(work.path(&format!("scene/images/{}", view.name)), work.path(&format!("scene/{name}"))).unwrap();
        view.name = name;
    }
    fs::remove_dir(work.path("scene/images")).unwrap();
    model.write(&work.scene());
    let (ply, said) = run(&work);
    assert!(ply == expected && said.contains("the photos are read from cam0, cam1"), "{said}");
    work.refuses("scene --dry-run --images cam0", &["6 of 12 photos are missing", "--images ."]);
}

#[test]
fn models_whose_names_nearly_match_train_as_if_they_matched() {
    let (work, model) = Workdir::small_model();
    let scene = work.scene();
    let (expected, said) = run(&work);
    assert!(!said.contains("other names"), "{said}");
    type Rename<'a> = &'a dyn Fn(&str) -> String;
    let rename: [(&str, Rename); 8] = [
        ("another case", &|name| name.replace(".jpg", ".JPG")),
        ("another ending", &|name| name.replace(".jpg", ".ARW")),
        ("another folder in front", &|name| format!("flight/{name}")),
        ("an absolute path inside", &|name| scene.join("images").join(name).to_str().unwrap().to_string()),
        ("an absolute path of another machine", &|name| format!("/home/bob/my city/images/{name}")),
        ("a path of Windows", &|name| format!("C:\\Users\\Bob\\city\\images\\{name}")),
        ("a climbing path", &|name| format!("../../city/images/{name}")),
        ("an address of a file", &|name| format!("file:///home/bob/images/{name}")),
    ];
    for (what, new) in rename {
        let mut changed = model.clone();
        changed.views.iter_mut().for_each(|view| view.name = new(&view.name));
        changed.write(&scene);
        let (ply, said) = run(&work);
        assert!(said.contains("12 of 12 photos have other names than the model states"), "{what}: {said}");
        assert!(ply == expected, "{what}: other Gaussians");
    }
}

#[test]
fn photos_that_were_renamed_or_moved_are_found() {
    let (work, model) = Workdir::small_model();
    let scene = work.scene();
    let (expected, _) = run(&work);
    let images = scene.join("images");
    // Accents in the other Unicode form, as macOS and unzip write them.
    let mut composed = model.clone();
    composed.views.iter_mut().for_each(|view| view.name = format!("\u{e9}t\u{e9}_{}", view.name));
    composed.write(&scene);
    rename_photos(&images, |name| format!("e\u{301}te\u{301}_{name}"));
    let (ply, said) = run(&work);
    assert!(ply == expected && said.contains("12 of 12 photos have other names"), "{said}");
    rename_photos(&images, |name| name.replace("e\u{301}te\u{301}_", ""));
    model.write(&scene);
    // One level deeper.
    rename_photos(&images, |name| format!("flight1/{name}"));
    let (ply, said) = run(&work);
    assert!(ply == expected && said.contains("images/flight1/"), "{said}");
    rename_photos(&images.join("flight1"), |name| format!("../{name}"));
    // The folder of photos is named as the scene.
    let (ply, said) = run_of(&work, "scene/images");
    assert!(ply == expected && said.contains("the scene is read from the folder above"), "{said}");
    // Another name of the folder, then photos beside the model.
    fs::rename(&images, scene.join("Images")).unwrap();
    let (ply, said) = run(&work);
    assert!(ply == expected && said.contains("the photos are read from"), "{said}");
    fs::rename(scene.join("Images"), scene.join("input")).unwrap();
    let (ply, said) = run(&work);
    assert!(ply == expected && said.contains("the photos are read from"), "{said}");
    rename_photos(&scene.join("input"), |name| format!("../{name}"));
    fs::remove_dir_all(scene.join("input")).unwrap();
    let (ply, said) = run(&work);
    assert!(ply == expected && !said.contains("warning"), "{said}");
}

#[test]
fn transforms_and_exports_find_photos_as_models_do() {
    let (work, model) = Workdir::small_model();
    let scene = work.scene();
    fs::remove_dir_all(scene.join("sparse")).unwrap();
    model.write_transforms(&scene);
    let (expected, _) = run(&work);
    let json = fs::read_to_string(scene.join("transforms.json")).unwrap();
    for (what, prefix) in [("absolute", "/home/bob/scene/images/"), ("Windows", "C:\\\\scene\\\\images\\\\")] {
        let changed = json.replace("images/", prefix).replace("\"points.ply\"", "\"/home/bob/scene/points.ply\"");
        fs::write(scene.join("transforms.json"), changed).unwrap();
        let (ply, said) = run(&work);
        assert!(ply == expected && said.contains("12 of 12 photos have other names"), "{what}: {said}");
    }
    // The photos of an export beside its file, with the names in capitals.
    fs::remove_file(scene.join("transforms.json")).unwrap();
    model.write_reconstruction(&scene.join("reconstruction.json"));
    let (expected, _) = run(&work);
    rename_photos(&scene.join("images"), |name| format!("../{}", name.to_uppercase()));
    let (ply, said) = run(&work);
    assert!(ply == expected && said.contains("12 of 12 photos have other names"), "{said}");
}

#[test]
fn what_fits_several_is_named_and_not_guessed() {
    let (work, model) = Workdir::small_model();
    let scene = work.scene();
    let refused = |words: &[&str]| work.refuses("scene --out refused --steps 12", words);
    let first = &model.views[0].name;
    let images = scene.join("images");
    // Two files fit.
    fs::copy(images.join(first), images.join(first.replace(".jpg", ".Jpg"))).unwrap();
    fs::rename(images.join(first), images.join(first.replace(".jpg", ".JPG"))).unwrap();
    refused(&["1 of 12 photos is missing", ".JPG or", ".Jpg"]);
    fs::remove_file(images.join(first.replace(".jpg", ".Jpg"))).unwrap();
    run(&work);
    // The only file that fits belongs to another view.
    let mut doubled = model.clone();
    doubled.views[1].name = first.replace(".jpg", ".png");
    doubled.write(&scene);
    refused(&["2 of 12 photos are missing", "may be"]);
    // A link that leads nowhere, as git-annex leaves it.
    model.write(&scene);
    #[cfg(unix)]
    {
        fs::remove_file(images.join(first.replace(".jpg", ".JPG"))).unwrap();
        std::os::unix::fs::symlink("../.git/annex/objects/none", images.join(first)).unwrap();
        refused(&["1 of 12 photos is missing", "git annex get"]);
        // What is there, and is no file.
        fs::remove_file(images.join(first)).unwrap();
        std::os::unix::fs::symlink(first, images.join(first)).unwrap();
        let said = refused(&["1 of 12 photos is missing", "is there, but is no file"]);
        assert!(!said.contains("git annex"), "{said}");
        fs::remove_file(images.join(first)).unwrap();
        fs::create_dir(images.join(first)).unwrap();
        refused(&["is there, but is no file"]);
    }
}

/// Writes a mask for every photo with these values in its left and right half.
fn write_masks(model: &TextModel, [left, right]: [u8; 2], path_of: impl Fn(&str) -> PathBuf) {
    for view in &model.views {
        let mask = image::GrayImage::from_fn(96, 64, |x, _| image::Luma([if x < 48 { left } else { right }]));
        let path = path_of(&view.name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        mask.save(path).unwrap();
    }
}

#[test]
fn masks_in_the_forms_of_other_programs_are_used_and_named() {
    let (work, model) = Workdir::small_model();
    let scene = work.scene();
    let (unmasked, _) = run(&work);
    let masks = scene.join("masks");
    write_masks(&model, [255, 0], |name| masks.join(format!("{name}.png")));
    let (expected, said) = run(&work);
    assert!(expected != unmasked && !said.contains("masks:"), "{said}");
    fs::remove_dir_all(&masks).unwrap();
    for form in ["masks/X_mask.png", "images/X.mask.png"] {
        write_masks(&model, [255, 0], |name| scene.join(form.replace('X', name.trim_end_matches(".jpg"))));
        let (ply, said) = run(&work);
        assert!(ply == expected && said.contains("masks: 12 of the form X"), "{form}: {said}");
        assert!(!said.contains("not in the model"), "{form}: {said}");
        for view in &model.views {
            fs::remove_file(scene.join(form.replace('X', view.name.trim_end_matches(".jpg")))).unwrap();
        }
    }
    // Labels of 0 and 1.
    write_masks(&model, [1, 0], |name| masks.join(name.replace(".jpg", ".png")));
    let (ply, said) = run(&work);
    assert!(ply == expected && said.contains("1 counts as white"), "{said}");
    fs::remove_dir_all(&masks).unwrap();
    // White is left out.
    write_masks(&model, [0, 255], |name| scene.join(format!("images/dynamic_mask_{}", name.replace(".jpg", ".png"))));
    let (ply, said) = run(&work);
    assert!(ply == expected && said.contains("in which white is left out"), "{said}");
}

#[cfg(unix)]
#[test]
fn masks_behind_links_are_used() {
    use std::os::unix::fs::symlink;
    let (work, model) = Workdir::small_model();
    let scene = work.scene();
    let masks = scene.join("masks");
    write_masks(&model, [255, 0], |name| masks.join(format!("{name}.png")));
    let (expected, _) = run(&work);
    let store = work.path("store");
    fs::rename(&masks, &store).unwrap();
    // Each file is a link; then all files lie in a folder that is one; a link back to its own folder ends.
    fs::create_dir(&masks).unwrap();
    for entry in fs::read_dir(&store).unwrap() {
        let path = entry.unwrap().path();
        symlink(&path, masks.join(path.file_name().unwrap())).unwrap();
    }
    assert!(run(&work).0 == expected);
    fs::remove_dir_all(&masks).unwrap();
    fs::create_dir(&masks).unwrap();
    symlink(&masks, masks.join("again")).unwrap();
    symlink(&store, masks.join("images")).unwrap();
    assert!(run(&work).0 == expected);
    // Their content was never fetched.
    fs::remove_file(store.join(format!("{}.png", model.views[0].name))).unwrap();
    symlink("../nowhere.png", store.join(format!("{}.png", model.views[0].name))).unwrap();
    let (_, said) = run(&work);
    assert!(said.contains("1 masks are links whose target is not on this machine"), "{said}");
}
