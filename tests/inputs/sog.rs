//! Streamed SOG folders, read as their specification says ("The SOG Format", "The Streamed SOG Format" on
//! `developer.playcanvas.com`): by a reader of the tests' own.

use super::ply::scene;
use super::support::{ExportedRow as Row, files};
use gsscale::exchange::format::ExportFormat;
use gsscale::exchange::meta::{ExportFrame, SceneMeta};
use gsscale::exchange::ply::{PlyContent, read_ply};
use gsscale::exchange::sink::Written;
use gsscale::scene::columns::{Column, Columns};
use gsscale::scene::rotation::Rotation;
use serde_json::Value;
use std::path::{MAIN_SEPARATOR, Path, PathBuf};

/// A chunk, with what its values are rounded to.
pub(super) struct Chunk {
    pub rows: Vec<Row>,
    /// Of the logarithms of positions.
    steps: [f64; 3],
    scales: Vec<f64>,
    colours: Vec<f64>,
    harmonics: Vec<f64>,
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect()
}

fn pixels(path: &Path) -> (usize, Vec<[u8; 4]>) {
    let mut decoder = image_webp::WebPDecoder::new(std::io::Cursor::new(std::fs::read(path).unwrap())).unwrap();
    assert!(!decoder.is_lossy(), "{}", path.display());
    let mut bytes = vec![0; decoder.output_buffer_size().unwrap()];
    decoder.read_image(&mut bytes).unwrap();
    let width = decoder.dimensions().0 as usize;
    match decoder.has_alpha() {
        true => (width, bytes.as_chunks::<4>().0.to_vec()),
        false => (width, bytes.as_chunks::<3>().0.iter().map(|&[r, g, b]| [r, g, b, 255]).collect()),
    }
}

pub(super) fn read_chunk(meta_file: &Path) -> Chunk {
    let meta: Value = serde_json::from_slice(&std::fs::read(meta_file).unwrap()).unwrap();
    assert_eq!(meta["version"], 2);
    let count = meta["count"].as_u64().unwrap() as usize;
    let file = |part: &str, i: usize| meta_file.with_file_name(meta[part]["files"][i].as_str().unwrap());
    let of = |part: &str, i: usize| {
        let (_, pixels) = pixels(&file(part, i));
        assert!(pixels.len() >= count);
        pixels
    };
    let (low, high, quats) = (of("means", 0), of("means", 1), of("quats", 0));
    let (sizes, sh0) = (of("scales", 0), of("sh0", 0));
    let (mins, maxs) = (numbers(&meta["means"]["mins"]), numbers(&meta["means"]["maxs"]));
    let steps = [0, 1, 2].map(|i| (maxs[i] - mins[i]) / 65535.0);
    let [scales, colours] = ["scales", "sh0"].map(|part| numbers(&meta[part]["codebook"]));
    let harmonics = meta.get("shN").map_or(Vec::new(), |sh| numbers(&sh["codebook"]));
    let coefficients = meta.get("shN").map_or(0, |sh| [0, 3, 8, 15][sh["bands"].as_u64().unwrap() as usize]);
    let (labels, palette) = match coefficients {
        0 => (Vec::new(), Vec::new()),
        _ => (of("shN", 1), pixels(&file("shN", 0)).1),
    };
    let entries = meta["shN"]["count"].as_u64().unwrap_or(0) as usize;
    assert!(palette.len() >= entries * coefficients && palette.len() % (64 * coefficients).max(1) == 0);
    let row = |i: usize| {
        let fixed = |k: usize| f64::from(u16::from_le_bytes([low[i][k], high[i][k]]));
        let position = [0, 1, 2].map(|k| {
            let log = mins[k] + steps[k] * fixed(k);
            (log.abs().exp() - 1.0).copysign(log)
        });
        let coded = |book: &[f64], pixel: [u8; 4]| [0, 1, 2].map(|k| book[usize::from(pixel[k])]);
        let label = labels.get(i).map_or(0, |l| usize::from(u16::from_le_bytes([l[0], l[1]])));
        assert!(coefficients == 0 || label < entries);
        // 64 entries a line, so entries follow each other.
        let entry = palette.iter().skip(label * coefficients).take(coefficients);
        Row {
            position,
            alpha: f64::from(sh0[i][3]) / 255.0,
            sh0: coded(&colours, sh0[i]),
            log_scales: coded(&scales, sizes[i]),
            quat: smallest_three(quats[i]),
            sh_n: entry.flat_map(|&pixel| coded(&harmonics, pixel)).collect(),
        }
    };
    Chunk { rows: (0..count).map(row).collect(), steps, scales, colours, harmonics }
}

/// w, x, y, z.
fn smallest_three(pixel: [u8; 4]) -> [f64; 4] {
    let largest = usize::from(pixel[3].checked_sub(252).unwrap());
    let mut q = [0.0; 4];
    for (&byte, i) in pixel.iter().zip((0..4).filter(|&i| i != largest)) {
        q[i] = (f64::from(byte) / 255.0 * 2.0 - 1.0) * std::f64::consts::FRAC_1_SQRT_2;
    }
    q[largest] = (1.0 - q.iter().map(|v| v * v).sum::<f64>()).max(0.0).sqrt();
    q
}

pub(super) fn write(format: ExportFormat, path: &Path, parts: &[Columns], meta: &SceneMeta) -> Written {
    let rows = parts.iter().map(|part| part.rows() as u64).sum();
    let mut sink = format.create(path, parts[0].sh_degree, rows, meta).unwrap();
    parts.iter().for_each(|part| sink.write(part).unwrap());
    sink.finish().unwrap()
}

/// A PLY and a SOG of the same rows and metadata: the rows of the PLY, the folder of the SOG.
fn both(folder: &Path, columns: &Columns, meta: &SceneMeta) -> (Columns, PathBuf) {
    let (ply, sog) = (folder.join("a.ply"), folder.join("a"));
    let written = write(ExportFormat::Sog, &sog.join("lod-meta.json"), std::slice::from_ref(columns), meta);
    assert_eq!((written.rows, written.skipped), (columns.rows() as u64, 0));
    write(ExportFormat::Ply, &ply, std::slice::from_ref(columns), meta);
    let names = std::fs::read_dir(folder).unwrap().count();
    assert_eq!(names, 2, "a temporary folder is left");
    let PlyContent::Gaussians { columns, .. } = read_ply(&ply).unwrap() else { panic!("no Gaussians") };
    (columns, sog)
}

pub(super) fn tree(sog: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(sog.join("lod-meta.json")).unwrap()).unwrap()
}

/// Half of the distance between the values of a codebook around `value`.
fn half_gap(book: &[f64], value: f64) -> f64 {
    let above = book.partition_point(|&v| v < value).clamp(1, book.len() - 1);
    0.5 * (book[above] - book[above - 1])
}

#[test]
fn a_sog_holds_what_the_ply_holds() {
    for sh_degree in 0..=3u8 {
        let mut columns = scene(500, sh_degree);
        // Few harmonics, which the palette then holds as they are.
        let width = columns.sh_n.len() / 500;
        let few: Vec<f32> = (0..500).flat_map(|row| columns.sh_n[row % 4 * width..][..width].to_vec()).collect();
        columns.sh_n = few;
        for upright in [None, Rotation::upright([0.3, 0.2, 0.9])] {
            let meta = SceneMeta {
                origin: [3.0, -4.0, 5.0],
                scale: 2.0,
                scene_radius: 1e4,
                frame: ExportFrame::Dataset,
                upright,
                ..SceneMeta::default()
            };
            let folder = tempfile::tempdir().unwrap();
            let (ply, sog) = both(folder.path(), &columns, &meta);
            let chunk = read_chunk(&sog.join("0_0/meta.json"));
            assert_eq!(chunk.rows.len(), 500);
            let mut is_found = vec![false; 500];
            for row in &chunk.rows {
                let apart = |of: &usize| {
                    (0..3).map(|i| (row.position[i] - f64::from(ply.means[3 * of + i])).powi(2)).sum::<f64>()
                };
                let of = (0..500).min_by(|a, b| apart(a).total_cmp(&apart(b))).unwrap();
                assert!(!std::mem::replace(&mut is_found[of], true), "row {of} twice");
                check_row(&ply, of, row, &chunk);
            }
        }
    }
}

/// Rounding is by half a step of each attribute, and f32 arithmetic before it.
fn check_row(ply: &Columns, row: usize, of: &Row, chunk: &Chunk) {
    let near = |a: f64, b: f64, by: f64, what: &str| assert!((a - b).abs() <= by, "{what} of row {row}: {a}, {b}");
    let value = |column: Column, i: usize| f64::from(ply.row(column, row)[i]);
    for i in 0..3 {
        let x = value(Column::Means, i);
        let log = |x: f64| x.abs().ln_1p().copysign(x);
        near(log(of.position[i]), log(x), 0.5 * chunk.steps[i] + 1e-6, "position");
        let (scale, colour) = (value(Column::Scales, i), value(Column::Sh0, i));
        near(of.log_scales[i], scale, half_gap(&chunk.scales, scale) + 1e-6, "scale");
        near(of.sh0[i], colour, half_gap(&chunk.colours, colour) + 1e-6, "colour");
    }
    near(of.alpha, 1.0 / (1.0 + (-f64::from(ply.opacities[row])).exp()), 0.5 / 255.0 + 1e-5, "opacity");
    let dot: f64 = (0..4).map(|i| of.quat[i] * value(Column::Quats, i)).sum();
    // Three components are off by at most half of a step of .0055 each; the distance is then at most sqrt(3) times that, and
    // twice as much where the largest one, from the others, is barely larger. 1 - cos is half of its square.
    near(dot.abs(), 1.0, 5e-5, "rotation");
    for (i, &given) in of.sh_n.iter().enumerate() {
        let want = value(Column::ShN, i);
        near(given, want, half_gap(&chunk.harmonics, want) + 1e-5, "harmonic");
    }
}

pub(super) struct Leaf {
    low: Vec<f64>,
    high: Vec<f64>,
    /// File, offset and count in each level.
    pub parts: Vec<[usize; 3]>,
}

pub(super) fn leaves(node: &Value, found: &mut Vec<Leaf>) {
    let [low, high] = ["min", "max"].map(|corner| numbers(&node["bound"][corner]));
    if let Some(children) = node["children"].as_array() {
        for child in children {
            for i in 0..3 {
                assert!(child["bound"]["min"][i].as_f64().unwrap() >= low[i]);
                assert!(child["bound"]["max"][i].as_f64().unwrap() <= high[i]);
            }
            leaves(child, found);
        }
        return;
    }
    let lods = node["lods"].as_object().unwrap();
    let part = |level: usize| {
        let lod = &lods[&level.to_string()];
        ["file", "offset", "count"].map(|key| lod[key].as_u64().unwrap() as usize)
    };
    found.push(Leaf { low, high, parts: (0..lods.len()).map(part).collect() });
}

fn part_of(columns: &Columns, rows: std::ops::Range<usize>) -> Columns {
    let mut part = Columns::zeros(0, columns.sh_degree);
    for row in rows {
        Column::ALL.into_iter().for_each(|c| part.column_mut(c).extend_from_slice(columns.row(c, row)));
    }
    part
}

#[test]
fn leaves_cover_every_level_and_bytes_do_not_depend_on_parts_or_threads() {
    let mut columns = scene(150_000, 0);
    columns.means.iter_mut().for_each(|x| *x *= 20.0);
    columns.scales.iter_mut().for_each(|s| *s = *s * 0.3 - 2.0);
    let meta = SceneMeta { scene_radius: 50.0, ..SceneMeta::default() };
    let folder = tempfile::tempdir().unwrap();
    let sog = folder.path().join("whole");
    let written = write(ExportFormat::Sog, &sog.join("lod-meta.json"), std::slice::from_ref(&columns), &meta);
    let parts = [0..1, 1..70_000, 70_000..70_007, 70_007..150_000].map(|rows| part_of(&columns, rows));
    let in_parts = folder.path().join("parts");
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    pool.install(|| write(ExportFormat::Sog, &in_parts.join("lod-meta.json"), &parts, &meta));
    assert!(files(&sog) == files(&in_parts), "the bytes differ");
    let bytes: usize = files(&sog).values().map(Vec::len).sum();
    assert_eq!(written.bytes, bytes as u64);

    let tree = tree(&sog);
    assert_eq!((&tree["version"], tree.get("environment")), (&Value::from(1), None));
    let names: Vec<&str> = tree["filenames"].as_array().unwrap().iter().map(|name| name.as_str().unwrap()).collect();
    let chunks: Vec<Chunk> = names.iter().map(|name| read_chunk(&sog.join(name))).collect();
    let mut found = Vec::new();
    leaves(&tree["tree"], &mut found);
    let mut taken: Vec<Vec<(usize, usize)>> = vec![Vec::new(); chunks.len()];
    let mut counts = vec![0; tree["lodLevels"].as_u64().unwrap() as usize];
    for Leaf { low, high, parts } in &found {
        assert_eq!(parts.len(), counts.len());
        for (level, &[file, first, rows]) in parts.iter().enumerate() {
            assert!(names[file].starts_with(&format!("{level}_")) && rows > 0);
            taken[file].push((first, rows));
            counts[level] += rows;
            for row in &chunks[file].rows[first..first + rows] {
                // Positions are rounded to some thousandths.
                assert!((0..3).all(|i| row.position[i] >= low[i] - 0.01 && row.position[i] <= high[i] + 0.01));
            }
        }
    }
    for (mut taken, chunk) in taken.into_iter().zip(&chunks) {
        taken.sort_unstable();
        let end = taken.iter().fold(0, |end, &(first, rows)| {
            assert_eq!(first, end, "a gap or an overlap");
            first + rows
        });
        assert_eq!(end, chunk.rows.len());
    }
    assert_eq!(numbers(&tree["counts"]), counts.iter().map(|&n| n as f64).collect::<Vec<_>>());
    assert_eq!(written.levels.unwrap().rows.to_vec(), counts.iter().map(|&n| n as u64).collect::<Vec<_>>());
    assert_eq!(counts[0], 150_000);
    for pair in counts.windows(2) {
        assert!(pair[1] >= pair[0] / 4 && pair[1] <= pair[0] / 4 + found.len(), "{counts:?}");
    }
    check_levels(&found, &chunks);
}

/// Merging keeps the weighted means and colours of a leaf, where opacities are not cut.
fn check_levels(found: &[Leaf], chunks: &[Chunk]) {
    let sums = |&[file, first, rows]: &[usize; 3]| {
        let mut sums = [0.0; 7];
        for row in &chunks[file].rows[first..first + rows] {
            let mut sigmas = row.log_scales.map(f64::exp);
            sigmas.sort_by(f64::total_cmp);
            let weight = -(1.0 - row.alpha.min(0.99)).ln() * sigmas[1] * sigmas[2];
            let values = [1.0, row.position[0], row.position[1], row.position[2], row.sh0[0], row.sh0[1], row.sh0[2]];
            sums.iter_mut().zip(values).for_each(|(sum, value)| *sum += weight * value);
        }
        sums
    };
    for Leaf { low, high, parts } in found {
        let levels: Vec<[f64; 7]> = parts.iter().map(sums).collect();
        for level in &levels[1..] {
            for i in 1..7 {
                let (fine, coarse) = (levels[0][i] / levels[0][0], level[i] / level[0]);
                let whole = if i < 4 { high[i - 1] - low[i - 1] } else { 2.0 };
                assert!((fine - coarse).abs() < 0.06 * whole, "{i}: {fine} {coarse} of {whole}");
            }
        }
    }
}

#[test]
fn giants_are_kept_apart_and_counted() {
    let mut columns = scene(900, 1);
    columns.scales.iter_mut().for_each(|s| *s = s.clamp(-3.0, 1.0));
    for row in [3, 500, 899] {
        columns.scales[3 * row + 1] = 4.0;
    }
    // The radius is 20 in units of the file, e^4 is 55.
    let meta = SceneMeta { scene_radius: 20.0, ..SceneMeta::default() };
    let folder = tempfile::tempdir().unwrap();
    let sog = folder.path().join("a");
    let written = write(ExportFormat::Sog, &sog.join("lod-meta.json"), std::slice::from_ref(&columns), &meta);
    let levels = written.levels.unwrap();
    assert_eq!((written.rows, levels.always_shown, levels.rows[0]), (900, 3, 897));
    let giants = read_chunk(&sog.join(tree(&sog)["environment"].as_str().unwrap()));
    assert!(giants.rows.len() == 3 && giants.rows.iter().all(|row| (row.log_scales[1] - 4.0).abs() < 1e-6));
    assert!(levels.to_string().contains("897, 225, 57, 15") && levels.to_string().contains("3 giants"), "{levels}");
    // Nothing but giants: viewers need a leaf.
    columns.scales.fill(4.0);
    let written = write(ExportFormat::Sog, &sog.join("lod-meta.json"), std::slice::from_ref(&columns), &meta);
    assert_eq!(written.levels.unwrap().rows[0], 900);
    assert!(tree(&sog).get("environment").is_none() && !sog.join("env").exists(), "the older folder is gone");
}

#[test]
fn a_folder_appears_whole_and_never_replaces_files_of_others() {
    let folder = tempfile::tempdir().unwrap();
    let sog = folder.path().join("a");
    let path = sog.join("lod-meta.json");
    let create = |path: &Path| ExportFormat::Sog.create(path, 3, 5, &SceneMeta::default());
    let mut columns = scene(5, 3);
    columns.means[4] = f32::NAN;
    let mut sink = create(&path).unwrap();
    sink.write(&columns).unwrap();
    assert!(!sog.exists());
    drop(sink);
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    let written = write(ExportFormat::Sog, &path, std::slice::from_ref(&columns), &SceneMeta::default());
    assert_eq!((written.rows, written.skipped), (4, 1));
    let before = files(&sog);
    columns.means.fill(f32::NAN);
    let mut sink = create(&path).unwrap();
    sink.write(&columns).unwrap();
    assert!(sink.finish().unwrap_err().to_string().contains("none of the 5"));
    assert!(files(&sog) == before, "the target is unchanged");
    for inside in ["photo.jpg", "0_0/notes.txt"] {
        std::fs::write(sog.join(inside), b"mine").unwrap();
        let said = create(&path).err().unwrap().to_string().replace(MAIN_SEPARATOR, "/");
        assert!(said.contains(inside) && said.contains("name a new folder"), "{said}");
        std::fs::remove_file(sog.join(inside)).unwrap();
    }
    for lonely in ["lod-meta.json", "../lod-meta.json", "/lod-meta.json"] {
        let said = create(Path::new(lonely)).err().unwrap().to_string();
        assert!(said.contains("a folder of its own"), "{said}");
    }
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    assert_eq!(ExportFormat::of_path(&path).unwrap(), ExportFormat::Sog);
}
