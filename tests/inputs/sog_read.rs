//! Streamed SOG folders read back by the library, against what was written and against the tests' own reader.

use super::ply::scene;
use super::sog::{leaves, read_chunk, tree, write};
use super::support::ExportedRow;
use gsscale::base::error::InputResult;
use gsscale::base::rng::{Purpose, Stream};
use gsscale::exchange::format::ExportFormat;
use gsscale::exchange::frames::to_local;
use gsscale::exchange::meta::{ExportFrame, SceneMeta};
use gsscale::exchange::sog::SogReader;
use gsscale::scene::columns::{Column, Columns};
use gsscale::scene::rotation::Rotation;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// A scene with few harmonics and two giants, its folder and `lod-meta.json`.
fn written(rows: usize, sh_degree: u8, meta: &SceneMeta) -> (Columns, TempDir, PathBuf) {
    let mut columns = scene(rows, sh_degree);
    let width = columns.sh_n.len() / rows;
    columns.sh_n = (0..rows).flat_map(|row| columns.sh_n[row % 4 * width..][..width].to_vec()).collect();
    columns.scales.iter_mut().for_each(|s| *s = s.clamp(-3.0, 1.0));
    [0, rows - 1].iter().for_each(|row| columns.scales[3 * row] = 4.0);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a/lod-meta.json");
    write(ExportFormat::Sog, &path, std::slice::from_ref(&columns), meta);
    (columns, folder, path)
}

#[test]
fn the_finest_level_holds_the_rows_in_the_coordinates_of_the_dataset() {
    for (sh_degree, up) in [(0, None), (1, Some([0.3, 0.2, 0.9])), (3, Some([0.0, 0.0, 1.0]))] {
        for frame in [ExportFrame::Dataset, ExportFrame::Local] {
            let upright = up.and_then(Rotation::upright);
            let origin = [3.0, -4.0, 5.0];
            let meta = SceneMeta { origin, scale: 2.0, scene_radius: 40.0, frame, upright, ..SceneMeta::default() };
            let (given, _folder, path) = written(400, sh_degree, &meta);
            let reader = SogReader::open(&path).unwrap();
            assert_eq!(reader.levels(), [0, 1, 2, 3]);
            let mut read = reader.rows(0).unwrap();
            assert_eq!((read.rows(), read.sh_degree), (400, sh_degree));
            assert_eq!(to_local(&mut read, reader.meta(), origin, 2.0), 0);
            let mut is_found = vec![false; 400];
            for row in 0..400 {
                let apart = |of: &usize| {
                    let off = |i: usize| f64::from(read.means[3 * row + i] - given.means[3 * of + i]).powi(2);
                    (0..3).map(off).sum::<f64>()
                };
                let of = (0..400).min_by(|a, b| apart(a).total_cmp(&apart(b))).unwrap();
                assert!(!std::mem::replace(&mut is_found[of], true), "row {of} twice");
                check_row(&read, row, &given, of);
            }
            let counts: Vec<usize> = (0..4).map(|level| reader.rows(level).unwrap().rows()).collect();
            // Two giants are in every level, and the others merged to a quarter each.
            assert_eq!(counts, [400, 2 + 100, 2 + 25, 2 + 7]);
        }
    }
}

/// Values are normal, of deviation 1: codes are rare in the tails, where half of the distance of two is .1.
fn check_row(read: &Columns, row: usize, given: &Columns, of: usize) {
    let pair = |column: Column| read.row(column, row).iter().zip(given.row(column, of)).map(|(a, b)| (*a, *b));
    let most = |column: Column| pair(column).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    let off = [Column::Scales, Column::Sh0].map(most);
    assert!(off.iter().all(|&off| off < 0.2), "row {of}: {off:?}");
    assert!(most(Column::ShN) < 0.2, "row {of}: {}", most(Column::ShN));
    let alpha = |logit: f32| 1.0 / (1.0 + (-logit).exp());
    assert!((alpha(read.opacities[row]) - alpha(given.opacities[of])).abs() < 0.5 / 255.0 + 1e-5, "row {of}");
    let length = |quat: &[f32]| quat.iter().map(|v| v * v).sum::<f32>().sqrt();
    let (a, b) = (read.row(Column::Quats, row), given.row(Column::Quats, of));
    let dot: f32 = pair(Column::Quats).map(|(a, b)| a * b).sum::<f32>() / length(a) / length(b);
    // As for the tests' own reader: steps of .0055.
    assert!((dot.abs() - 1.0).abs() < 5e-5, "row {of}: {dot}");
}

/// The rows of a level by the tests' own reader: those that are always shown, then those of the leaves in the order of files.
fn rows_of_level(path: &Path, level: usize) -> Vec<ExportedRow> {
    let (folder, tree) = (path.parent().unwrap(), tree(path.parent().unwrap()));
    let mut found = Vec::new();
    leaves(&tree["tree"], &mut found);
    let mut parts: Vec<[usize; 3]> = found.iter().map(|leaf| leaf.parts[level]).collect();
    parts.sort_unstable();
    let mut rows = read_chunk(&folder.join(tree["environment"].as_str().unwrap())).rows;
    for [file, first, count] in parts {
        let name = tree["filenames"][file].as_str().unwrap();
        rows.extend(read_chunk(&folder.join(name)).rows.drain(first..first + count));
    }
    rows
}

#[test]
fn levels_of_several_files_and_leaves_are_those_of_the_tests_own_reader() {
    let (_, _folder, path) = written(70_000, 1, &SceneMeta { scene_radius: 20.0, ..SceneMeta::default() });
    let reader = SogReader::open(&path).unwrap();
    for level in 0..4 {
        let (read, own) = (reader.rows(level).unwrap(), rows_of_level(&path, level));
        assert_eq!(read.rows(), own.len());
        for (row, own) in own.iter().enumerate() {
            // f32 rounds at 6e-8 of a value.
            let near = |column: Column, values: &[f64]| {
                read.row(column, row)
                    .iter()
                    .zip(values)
                    .all(|(&a, b)| (f64::from(a) - b).abs() < 2e-7 * (1.0 + b.abs()))
            };
            assert!(near(Column::Means, &own.position) && near(Column::Scales, &own.log_scales), "row {row}");
            assert!(near(Column::Quats, &own.quat) && near(Column::Sh0, &own.sh0), "row {row}");
            assert!(near(Column::ShN, &own.sh_n) && own.sh_n.len() == 9, "row {row}");
        }
    }
}

#[test]
fn files_of_other_programs_may_lack_what_ours_have() {
    let (_, _folder, path) = written(300, 1, &SceneMeta { scene_radius: 20.0, ..SceneMeta::default() });
    let inside = |name: &str| path.with_file_name(name);
    let edit = |name: &str, change: &dyn Fn(&mut serde_json::Value)| {
        let file = inside(name);
        let mut value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
        change(&mut value);
        std::fs::write(file, value.to_string()).unwrap();
    };
    let whole = SogReader::open(&path).unwrap();
    let whole: Vec<Columns> = (0..4).map(|level| whole.rows(level).unwrap()).collect();
    // No transform, a path with a dot, no level 1, no harmonics in one file, no first code, compensated opacities.
    std::fs::remove_file(inside("transform.json")).unwrap();
    edit("lod-meta.json", &|tree| {
        tree["asset"]["generator"] = "another program".into();
        tree["filenames"][0] = "./0_0/meta.json".into();
        tree["tree"]["lods"].as_object_mut().unwrap().remove("1");
    });
    edit("env/meta.json", &|meta| {
        meta.as_object_mut().unwrap().remove("shN");
    });
    edit("0_0/meta.json", &|meta| {
        meta["scales"]["codebook"][0] = serde_json::Value::Null;
        meta["antialias"] = true.into();
    });
    let reader = SogReader::open(&path).unwrap();
    assert_eq!(reader.levels(), [0, 2, 3]);
    assert_eq!(*reader.meta(), SceneMeta { antialiased: true, ..SceneMeta::default() });
    let rows: Vec<Columns> = (0..3).map(|level| reader.rows(level).unwrap()).collect();
    assert!(rows[1].means == whole[2].means && rows[2].scales == whole[3].scales, "other levels stay");
    let [read, given] = [&rows[0], &whole[0]];
    assert!(read.sh_degree == 1 && read.means == given.means);
    // The two giants of the first file have no harmonics now.
    assert!(read.sh_n[..18].iter().all(|&v| v == 0.0) && read.sh_n[18..] == given.sh_n[18..]);
    let least = given.scales[6..].iter().copied().fold(f32::INFINITY, f32::min);
    let moved = read.scales.iter().zip(&given.scales).filter(|(a, b)| a != b);
    // The first code is now a 255th of the range below the second.
    assert!(
        moved.clone().count() > 0 && moved.clone().all(|(a, &b)| b == least && (a - b).abs() < 1.0),
        "{:?}",
        moved.count()
    );
}

fn read_all(path: &Path) -> InputResult<Vec<Columns>> {
    let reader = SogReader::open(path)?;
    (0..reader.levels().len()).map(|level| reader.rows(level)).collect()
}

#[test]
fn damaged_files_give_errors_and_finite_rows() {
    let upright = Rotation::upright([0.3, 0.2, 0.9]);
    let (_, _folder, path) = written(300, 1, &SceneMeta { scene_radius: 20.0, upright, ..SceneMeta::default() });
    let inside = |name: &str| path.with_file_name(name);
    let names =
        ["lod-meta.json", "transform.json", "0_0/meta.json", "0_0/means_l.webp", "0_0/quats.webp", "env/sh0.webp"];
    let names = [&names[..], &["0_0/shN_labels.webp", "0_0/shN_centroids.webp", "1_0/scales.webp"]].concat();
    let mut refused = 0;
    for (key, file) in names.iter().map(|name| inside(name)).enumerate() {
        let whole = std::fs::read(&file).unwrap();
        for turn in 0..200u64 {
            let mut draw = Stream::new(12, Purpose::Test, key as u64, turn);
            let at = draw.below(whole.len() as u64) as usize;
            let mut bytes = whole.clone();
            match turn % 4 {
                0 => bytes.truncate(at),
                1 => bytes[at] ^= 1 << draw.below(8),
                2 => bytes[at] = b'0' + draw.below(10) as u8,
                _ => bytes[at] = draw.below(256) as u8,
            }
            std::fs::write(&file, &bytes).unwrap();
            match read_all(&path) {
                Ok(levels) => {
                    for level in levels {
                        let is_finite = |c: Column| level.column(c).iter().all(|v| v.is_finite());
                        assert!(Column::ALL.into_iter().all(is_finite), "{} byte {at}", file.display());
                    }
                }
                Err(e) => {
                    refused += 1;
                    assert!(e.file.starts_with(path.parent().unwrap()) && !e.remedy.is_empty(), "{e}");
                }
            }
        }
        std::fs::write(&file, whole).unwrap();
    }
    assert!(refused > 500, "{refused} of 1,800 were refused");
}

#[test]
fn names_that_leave_the_folder_and_numbers_that_files_lack_are_refused() {
    let (_, _folder, path) = written(300, 1, &SceneMeta { scene_radius: 20.0, ..SceneMeta::default() });
    let inside = |name: &str| path.with_file_name(name);
    let refuses = |file: &Path, from: &str, to: &str, words: &str| {
        let text = std::fs::read_to_string(file).unwrap();
        assert!(text.contains(from), "{from} in {text}");
        std::fs::write(file, text.replacen(from, to, 1)).unwrap();
        let error = read_all(&path).map(|_| format!("{to} is read")).unwrap_or_else(|e| e.to_string());
        assert!(error.contains(words), "{error}");
        std::fs::write(file, text).unwrap();
    };
    let chunk = inside("0_0/meta.json");
    refuses(&path, "0_0/meta.json", "../a/0_0/meta.json", "which is not in its folder");
    refuses(&path, "0_0/meta.json", "/0_0/meta.json", "which is not in its folder");
    refuses(&chunk, "means_l.webp", "../0_0/means_l.webp", "which is not in its folder");
    refuses(&path, "\"offset\":0", "\"offset\":9", "which do not exist");
    refuses(&path, "\"offset\":0", "\"offset\":18446744073709551615", "which do not exist");
    refuses(&path, "\"file\":0", "\"file\":77", "of file 77, which do not exist");
    refuses(&chunk, "\"count\":298", "\"count\":4000000000", "at most 4194304");
    refuses(&chunk, "\"count\":298", "\"count\":4000000", "are needed");
    refuses(&chunk, "\"bands\":1", "\"bands\":4", "4 bands");
    refuses(&chunk, "\"version\":2", "\"version\":1", "version 1 of SOG");
    let [from, to] = ["1.0", "1.5"].map(|first| format!("\"file_to_dataset\": [\n    [\n      {first}"));
    refuses(&inside("transform.json"), &from, &to, "file_to_dataset: is no scale");
    let leaf = serde_json::from_slice::<serde_json::Value>(&std::fs::read(&path).unwrap()).unwrap()["tree"].to_string();
    refuses(&path, &leaf, &format!("{{\"children\":[{leaf},{leaf}]}}"), "two leaves have row 0 of file 0");
    refuses(&path, "1_0/meta.json", "0_0/./meta.json", "names the file '0_0/./meta.json' twice");
    refuses(&path, "\"version\":1", "\"version\":2", "version 2 of Streamed SOG");
    refuses(
        &inside("0_0/meta.json"),
        "\"codebook\":[",
        "\"codebook\":[null,",
        "scales.codebook: a codebook has 1 to 256",
    );
    std::fs::rename(inside("transform.json"), inside("moved.json")).unwrap();
    let error = read_all(&path).map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("transform.json") && error.contains("the folder is not whole"), "{error}");
    std::fs::rename(inside("moved.json"), inside("transform.json")).unwrap();
    std::fs::remove_file(inside("0_0/sh0.webp")).unwrap();
    let error = read_all(&path).map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("sh0.webp") && error.contains("the folder is not whole"), "{error}");
}
