//! Text of scenes in encodings of other programs: byte order marks, UTF-16, names in code pages, numbers that are none, and the
//! separators of a CSV.

use super::write::{HEADER, model, refused, scene_folder, warned};
use gsscale::base::error::InputResult;
use gsscale::dataset::model::RawScene;
use gsscale::dataset::read::{ReadOptions, read_scene};
use std::fs;
use std::path::Path;
use tempfile::TempDir;

fn read(folder: &Path) -> InputResult<RawScene> {
    read_scene(folder, &ReadOptions::default())
}

/// A folder with these files, and photos of 40x30 pixels of these names in `images/`.
fn scene_of(files: &[(&str, &[u8])], photos: &[&str]) -> TempDir {
    let scene = scene_folder();
    for (name, bytes) in files {
        fs::create_dir_all(scene.path().join(name).parent().unwrap()).unwrap();
        fs::write(scene.path().join(name), bytes).unwrap();
    }
    for name in photos {
        fs::create_dir_all(scene.path().join("images").join(name).parent().unwrap()).unwrap();
        image::RgbImage::new(40, 30).save(scene.path().join("images").join(name)).unwrap();
    }
    scene
}

/// The text with a mark, and as UTF-16 of both byte orders with and without.
fn encoded(text: &str) -> Vec<Vec<u8>> {
    let little: Vec<u8> = text.encode_utf16().flat_map(u16::to_le_bytes).collect();
    let big: Vec<u8> = text.encode_utf16().flat_map(u16::to_be_bytes).collect();
    vec![
        [b"\xef\xbb\xbf", text.as_bytes()].concat(),
        [&b"\xff\xfe"[..], &little].concat(),
        [&b"\xfe\xff"[..], &big].concat(),
        little,
        big,
    ]
}

/// Views and points alone, which must not depend on the folder.
fn content(scene: &RawScene) -> String {
    let views: Vec<_> = scene.views.iter().map(|v| (&v.name, v.pose, v.intrinsics)).collect();
    format!("{views:?} {:?} {:?}", scene.points, scene.warnings.len())
}

fn transforms(name: &str, w: &str, x: &str) -> String {
    let frame = |name: &str, x: &str| {
        format!(
            "{{\"file_path\": \"images/{name}\", \"transform_matrix\": [[1,0,0,{x}],[0,1,0,2],[0,0,1,3],[0,0,0,1]]}}"
        )
    };
    format!(
        "{{\"w\": {w}, \"h\": 30, \"fl_x\": 30, \"aabb\": NaN, \"frames\": [{}, {}]}}",
        frame(name, x),
        frame("b.png", "1")
    )
}

fn reconstruction(name: &str, focal: &str, x: &str) -> String {
    let shot = |x: &str| {
        format!("{{\"rotation\": [0, 0, 0.5], \"translation\": [{x}, 2, 3], \"camera\": \"c\", \"gps_dop\": Infinity}}")
    };
    format!(
        "[{{\"cameras\": {{\"c\": {{\"projection_type\": \"perspective\", \"width\": 40, \"height\": 30, \"focal\": {focal}}}}}, \
         \"shots\": {{\"{name}\": {}, \"b.png\": {}}}, \"points\": {{\"1\": {{\"coordinates\": [1, NaN, 2], \"color\": [1, 2, 3]}}, \
         \"2\": {{\"coordinates\": [1, 2, 3], \"color\": [1, 2, 3]}}}}}}]",
        shot(x),
        shot("1")
    )
}

fn csv(name: &str, x: &str) -> String {
    let line = |name: &str, x: &str| format!("{name},{x},2,3,0,0,0,18,0.1,0,0,0,0,0,0,0\n");
    format!("{HEADER}\n{}{}", line(name, x), line("b.png", "1"))
}

#[test]
fn a_byte_order_mark_and_utf_16_change_nothing() {
    let mut m = model(3);
    m.images.iter_mut().zip(["ä図.png", "b.png", "c.png", "d.png"]).for_each(|(image, name)| image.name = name.into());
    let (cameras, images, points) = (m.cameras_txt(), m.images_txt(), m.points_txt());
    let plain =
        [("sparse/0/cameras.txt", &cameras), ("sparse/0/images.txt", &images), ("sparse/0/points3D.txt", &points)];
    let plain = plain.map(|(name, text)| (name, text.as_bytes()));
    let same_in_all = |files: &[(&str, &[u8])]| {
        let photos = ["ä図.png", "b.png", "c.png", "d.png"];
        let want = content(&read(scene_of(files, &photos).path()).unwrap());
        for at in 0..files.len() {
            for (number, bytes) in encoded(std::str::from_utf8(files[at].1).unwrap()).iter().enumerate() {
                let mut files = files.to_vec();
                files[at].1 = bytes;
                let found =
                    read(scene_of(&files, &photos).path()).unwrap_or_else(|e| panic!("{}: {number}: {e}", files[at].0));
                assert_eq!(content(&found), want, "{}: {number}", files[at].0);
            }
        }
    };
    same_in_all(&plain);
    same_in_all(&[("transforms.json", transforms("ä図.png", "40", "1").as_bytes())]);
    same_in_all(&[("reconstruction.json", reconstruction("ä図.png", "1", "1").as_bytes())]);
    same_in_all(&[("poses.csv", csv("ä図.png", "1").as_bytes())]);
    // A file named by itself.
    let scene = scene_of(&[("r.json", &encoded(&reconstruction("b2.png", "1", "1"))[1])], &["b2.png", "b.png"]);
    assert_eq!(read(&scene.path().join("r.json")).unwrap().views.len(), 2);
}

#[test]
fn names_in_a_code_page_find_their_photos() {
    // Windows-1252, code page 850, GBK, Shift-JIS.
    for (bytes, photo) in [
        (&b"Stra\xdfe_1.png"[..], "Straße_1.png"),
        (b"Stra\xe1e_1.png", "Straße_1.png"),
        (b"\xd0\xb4\xd5\xe6_1.png", "写真_1.png"),
        (b"\x83A\x83e\x83l_1.png", "アテネ_1.png"),
        (b"\xfcber/x_1.png", "über/x_1.png"),
    ] {
        let named = |text: String| {
            let (before, after) = text.split_once("NAME").unwrap();
            [before.as_bytes(), bytes, after.as_bytes()].concat()
        };
        let mut m = model(3);
        m.images.truncate(1);
        m.images[0].name = bytes.to_vec();
        let (cameras, points) = (m.cameras_bin(), m.points_bin());
        let images = m.images_bin();
        m.images[0].name = b"NAME".to_vec();
        for files in [
            &[("sparse/cameras.bin", &cameras[..]), ("sparse/images.bin", &images), ("sparse/points3D.bin", &points)][..],
            &[("sparse/cameras.txt", m.cameras_txt().as_bytes()), ("sparse/images.txt", &named(m.images_txt()))],
            &[("transforms.json", &named(transforms("NAME", "40", "1")))],
            &[("reconstruction.json", &named(reconstruction("NAME", "1", "1")))],
            &[("poses.csv", &named(csv("NAME", "1")))],
        ] {
            let scene = scene_of(files, &[photo, "other_2.png", "b.png"]);
            let found = read(scene.path()).unwrap_or_else(|e| panic!("{}: {e}", files[0].0));
            let view = found
                .views
                .iter()
                .find(|view| view.name.ends_with(photo))
                .unwrap_or_else(|| panic!("{:?}", found.views));
            assert_eq!(view.image_path, scene.path().join("images").join(photo));
            warned(&found, &["1 name is not UTF-8", "\\x", &view.name]);
        }
    }
}

/// On Unix the name of a file is bytes, and need not be UTF-8.
#[cfg(unix)]
#[test]
fn a_name_of_the_same_bytes_is_the_photo() {
    use std::os::unix::ffi::OsStrExt;
    let bytes = b"n\xe9_1.png";
    let mut m = model(1);
    m.images.truncate(1);
    m.images[0].name = bytes.to_vec();
    let (cameras, images) = (m.cameras_bin(), m.images_bin());
    let scene = scene_of(&[("sparse/cameras.bin", &cameras), ("sparse/images.bin", &images)], &["x.png"]);
    let photo = scene.path().join("images").join(std::ffi::OsStr::from_bytes(bytes));
    fs::rename(scene.path().join("images/x.png"), &photo).unwrap();
    let found = read(scene.path()).unwrap();
    assert_eq!((found.views[0].name.as_str(), &found.views[0].image_path), ("né_1.png", &photo));
    warned(&found, &["n\\xE9_1.png is né_1.png"]);
    // Without it the name is shown by its bytes.
    fs::remove_file(&photo).unwrap();
    let found = read(scene.path()).unwrap();
    assert_eq!(found.views[0].name, "n\\xE9_1.png");
    warned(&found, &["no photo, or more than one, fits", "n\\xE9_1.png"]);
}

#[test]
fn numbers_that_are_none_leave_out_a_view_or_are_named() {
    let photos = ["a.png", "b.png"];
    for word in ["NaN", "Infinity", "-Infinity", "nan", "-nan(ind)", "inf"] {
        for (file, text) in [
            ("transforms.json", transforms("a.png", "40", word)),
            ("reconstruction.json", reconstruction("a.png", "1", word)),
        ] {
            let found =
                read(scene_of(&[(file, text.as_bytes())], &photos).path()).unwrap_or_else(|e| panic!("{word}: {e}"));
            assert_eq!((found.views.len(), found.views[0].name.ends_with("b.png")), (1, true));
            warned(&found, &["1 view left out", "a.png", "not finite"]);
        }
    }
    let found =
        read(scene_of(&[("reconstruction.json", reconstruction("a.png", "1", "1").as_bytes())], &photos).path());
    let found = found.unwrap();
    assert_eq!((found.views.len(), found.points.positions.len()), (2, 1));
    warned(&found, &["1 points are not finite"]);
    let scene = scene_of(&[("transforms.json", transforms("a.png", "NaN", "1").as_bytes())], &photos);
    refused(read(scene.path()), "transforms.json", &["w: NaN is not a number"]);
    let scene = scene_of(&[("reconstruction.json", reconstruction("a.png", "NaN", "1").as_bytes())], &photos);
    refused(read(scene.path()), "reconstruction.json", &["line 1 column", "camera \"c\"", "NaN"]);
}

#[test]
fn a_csv_may_have_other_separators_and_a_decimal_comma() {
    let photos = ["a.png", "b.png", "c/d.png"];
    let want = content(&read(scene_of(&[("poses.csv", csv("a.png", "1.5").as_bytes())], &photos).path()).unwrap());
    let plain = csv("a.png", "1.5");
    let comma = |text: String| text.replace('.', ",").replace(",png", ".png");
    for (what, text) in [
        ("semicolons", plain.replace(',', ";")),
        ("tabs", plain.replace(',', "\t")),
        ("decimal commas", comma(plain.replace(',', ";"))),
        ("decimal commas and tabs", comma(plain.replace(',', "\t"))),
        ("quoted", plain.replace("a.png,1.5,2", "\"a.png\",\"1,5\",\"2\"")),
        ("spaces", plain.replace(',', " , ")),
        ("z", plain.replace("alt", "z")),
        ("capitals and quotes", plain.replace("#name,x,y,alt", "\"#Name\",\"X\",\"Y\",\"Alt\"")),
        ("an empty cell at the end", plain.replace('\n', ",\n")),
        ("an empty cell at the end of lines", plain.replacen("0\n", "0,\n", 1)),
        ("excel's first line", format!("sep=;\n{}", plain.replace(',', ";"))),
    ] {
        let found =
            read(scene_of(&[("poses.csv", text.as_bytes())], &photos).path()).unwrap_or_else(|e| panic!("{what}: {e}"));
        assert_eq!(content(&found), want, "{what}");
    }
    // Of a path the longest end that exists counts, so that two photos of one name stay apart.
    for (stated, file) in [
        ("C:\\Users\\me\\images\\a.png", "images/a.png"),
        ("/mnt/c/photos/a.png", "images/a.png"),
        ("D:/x/images/c/d.png", "images/c/d.png"),
    ] {
        let text = plain.replace("a.png", stated);
        let found = read(scene_of(&[("poses.csv", text.as_bytes())], &photos).path()).unwrap();
        assert!(found.views.iter().any(|view| view.image_path.ends_with(file)), "{stated}: {:?}", found.views);
        assert!(
            found.warnings.iter().any(|line| line.contains("1 of 2 photos have other names")),
            "{:?}",
            found.warnings
        );
    }
    let text = plain.replace("a.png", "\"e, \"\"f\"\".png\"");
    let missing = read(scene_of(&[("poses.csv", text.as_bytes())], &photos).path());
    refused(missing, "poses.csv", &["e, \"f\".png"]);
    for (text, words) in [
        (plain.replacen("1.5,2,3", "1,5,2,3", 1), &["line 2", "17 cells", "16 columns", "decimal comma"][..]),
        (plain.replacen(",0,0,0\n", ",0,0\n", 1), &["line 2", "15 cells", "16 columns"]),
        (plain.replacen("1.5", "1.234,5", 1).replacen("1.234,5", "\"1.234,5\"", 1), &["line 2", "column 'x'"]),
    ] {
        refused(read(scene_of(&[("poses.csv", text.as_bytes())], &photos).path()), "poses.csv", words);
    }
    // Ground control points begin like poses.
    let points = "name,x,y,z\nP1,1,2,3\n";
    let both = scene_of(&[("poses.csv", plain.as_bytes()), ("gcp.csv", points.as_bytes())], &photos);
    assert_eq!(content(&read(both.path()).unwrap()), want);
}
