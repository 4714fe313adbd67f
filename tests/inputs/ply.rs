//! PLY export and import: files match what viewers read, round trips keep the rows, and malformed files are refused
//! safely.

use gsscale::base::error::InputError;
use gsscale::base::rng::{Purpose, Stream};
use gsscale::exchange::frames::to_local;
use gsscale::exchange::meta::{ExportFrame, SceneMeta};
use gsscale::exchange::ply::{PlyContent, parse_ply, read_ply, stream_points, write_gaussians};
use gsscale::scene::columns::{Column, Columns};
use gsscale::scene::rotation::Rotation;
use std::path::Path;

/// Rows with unit quaternions.
pub(super) fn scene(rows: usize, sh_degree: u8) -> Columns {
    let mut columns = Columns::zeros(rows, sh_degree);
    for (at, column) in Column::ALL.into_iter().enumerate() {
        let mut s = Stream::new(3, Purpose::Test, at as u64, 0);
        columns.column_mut(column).fill_with(|| s.normal() as f32);
    }
    for q in columns.quats.chunks_exact_mut(4) {
        let norm = q.iter().map(|&v| f64::from(v) * f64::from(v)).sum::<f64>().sqrt();
        q.iter_mut().for_each(|v| *v = (f64::from(*v) / norm) as f32);
    }
    columns
}

fn meta(frame: ExportFrame) -> SceneMeta {
    SceneMeta {
        step: Some(29_999),
        origin: [1_234.567_890_123_456_7, -0.1, 3e-9],
        scale: 0.1 + 0.2,
        frame,
        scene_radius: 10.0,
        ..SceneMeta::default()
    }
}

fn gaussians(content: PlyContent) -> (Columns, SceneMeta) {
    match content {
        PlyContent::Gaussians { columns, meta } => (columns, meta),
        PlyContent::Points { .. } => panic!("these are points"),
    }
}

fn parse(bytes: &[u8]) -> Result<PlyContent, InputError> {
    parse_ply(std::io::Cursor::new(bytes), bytes.len() as u64, Path::new("in.ply"))
}

/// An error that names the place and a remedy.
fn error_of(bytes: &[u8]) -> String {
    let error = parse(bytes).expect_err("this file is bad");
    assert!(!error.place.is_empty() && !error.remedy.is_empty(), "{error:?}");
    error.to_string()
}

fn written(columns: &Columns, meta: &SceneMeta) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("out.ply");
    write_gaussians(&path, columns, meta).unwrap();
    std::fs::read(&path).unwrap()
}

fn header_of(bytes: &[u8]) -> (String, &[u8]) {
    let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    (String::from_utf8(bytes[..end].to_vec()).unwrap(), &bytes[end..])
}

#[test]
fn the_local_frame_round_trips_bit_for_bit() {
    let folder = tempfile::tempdir().unwrap();
    for sh_degree in 0..=3 {
        // More than one block of rows.
        let columns = scene(5000, sh_degree);
        let path = folder.path().join(format!("{sh_degree}.ply"));
        let report = write_gaussians(&path, &columns, &meta(ExportFrame::Local)).unwrap();
        assert_eq!((report.frame, report.rows, report.skipped), (ExportFrame::Local, 5000, 0));
        assert_eq!(report.bytes, std::fs::metadata(&path).unwrap().len());
        let (back, back_meta) = gaussians(read_ply(&path).unwrap());
        assert_eq!(back, columns);
        let same = SceneMeta { scene_radius: back_meta.scale, is_stated: true, ..meta(ExportFrame::Local) };
        assert_eq!(back_meta, same);
        let mut local = back;
        assert_eq!(to_local(&mut local, &back_meta, back_meta.origin, back_meta.scale), 0);
        assert_eq!(local, columns);
    }
    // Nothing but the files themselves is left behind.
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 4);
}

#[test]
fn the_dataset_frame_round_trips_within_rounding() {
    let columns = scene(300, 3);
    let meta = meta(ExportFrame::Dataset);
    let (mut back, back_meta) = gaussians(parse(&written(&columns, &meta)).unwrap());
    assert_eq!(back_meta.frame, ExportFrame::Dataset);
    for (file, local) in back.means.chunks(3).zip(columns.means.chunks(3)) {
        for i in 0..3 {
            assert_eq!(file[i], (f64::from(local[i]) * meta.scale + meta.origin[i]) as f32);
        }
    }
    assert_eq!(to_local(&mut back, &back_meta, meta.origin, meta.scale), 0);
    for (got, want) in back.means.iter().zip(&columns.means) {
        // The file's f32 is off by half a unit in the last place of at most 1,236, which is 6.2e-5, and the way back
        // divides that by the scale of 0.3 and rounds once more.
        assert!((got - want).abs() <= 6.2e-5 / 0.3 + 3e-7, "{got} {want}");
    }
    for (got, want) in back.scales.iter().zip(&columns.scales) {
        // Two roundings of log-scales below 8.
        assert!((got - want).abs() <= 5e-7, "{got} {want}");
    }
    let unchanged = [Column::Quats, Column::Opacities, Column::Sh0, Column::ShN];
    assert!(unchanged.into_iter().all(|c| back.column(c) == columns.column(c)));
}

#[test]
fn another_local_frame_is_reached_through_the_datasets() {
    let columns = scene(50, 0);
    let file = meta(ExportFrame::Local);
    let (mut back, back_meta) = gaussians(parse(&written(&columns, &file)).unwrap());
    let (origin, scale) = ([1200.0, 2.0, -1.0], 20.0);
    to_local(&mut back, &back_meta, origin, scale);
    for row in 0..50 {
        for i in 0..3 {
            let world = f64::from(columns.means[3 * row + i]) * file.scale + file.origin[i];
            // One rounding of values below 4.
            assert!((f64::from(back.means[3 * row + i]) - (world - origin[i]) / scale).abs() < 3e-7);
            let radius = f64::from(columns.scales[3 * row + i]).exp() * file.scale / scale;
            // Half a unit in the last place of log-scales below 16 is 4.8e-7; the exponential makes it relative.
            assert!((f64::from(back.scales[3 * row + i]).exp() / radius - 1.0).abs() < 1e-6);
        }
    }
}

#[test]
fn an_offset_too_far_for_f32_stays_local_and_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("utm.ply");
    let columns = scene(10, 0);
    let utm = SceneMeta { origin: [5e5, 5e6, 100.0], scale: 200.0, scene_radius: 200.0, ..meta(ExportFrame::Dataset) };
    let report = write_gaussians(&path, &columns, &utm).unwrap();
    assert_eq!(report.frame, ExportFrame::Local);
    let (back, back_meta) = gaussians(read_ply(&path).unwrap());
    assert_eq!((back_meta.frame, back_meta.origin, back_meta.scale), (ExportFrame::Local, utm.origin, utm.scale));
    assert_eq!(back, columns);
}

#[test]
fn an_upright_file_is_turned_back_on_reading() {
    let folder = tempfile::tempdir().unwrap();
    let up = [0.36, -0.48, 0.8];
    let upright = Rotation::upright(up);
    for frame in [ExportFrame::Local, ExportFrame::Dataset] {
        let columns = scene(200, 3);
        let meta = SceneMeta { upright, ..meta(frame) };
        let bytes = written(&columns, &meta);
        let (header, _) = header_of(&bytes);
        assert!(header.contains("comment Vertical axis: y\n"), "Brush reads this line: {header}");
        let (mut back, back_meta) = gaussians(parse(&bytes).unwrap());
        assert_eq!(back_meta.upright, upright);
        // A point above another one in the dataset is above it in the file, where up is -y.
        let height = |p: &[f32], up: [f64; 3]| (0..3).map(|i| f64::from(p[i]) * up[i]).sum::<f64>();
        let unit = if frame == ExportFrame::Local { 1.0 } else { meta.scale };
        let rise = |c: &Columns, up| height(c.row(Column::Means, 0), up) - height(c.row(Column::Means, 1), up);
        // Positions of 1,236 are rounded to half of 1.2e-4, two of them.
        assert!((rise(&back, [0.0, -1.0, 0.0]) - rise(&columns, up) * unit).abs() < 2.0 * 1.3e-4);
        assert_eq!(to_local(&mut back, &back_meta, meta.origin, meta.scale), 0);
        for (column, slack) in [
            // As in the dataset's frame without turning, and in each of three axes.
            (Column::Means, 3.0 * (6.2e-5 / 0.3 + 3e-7)),
            (Column::Scales, 5e-7),
            // Four products of values up to 1, rounded to f32 twice on each way.
            (Column::Quats, 4.0 * 1.2e-7),
            // Up to seven products of values below 5, likewise.
            (Column::ShN, 2.0 * 7.0 * 2.4e-7),
            (Column::Sh0, 0.0),
            (Column::Opacities, 0.0),
        ] {
            let pairs = back.column(column).iter().zip(columns.column(column));
            let most = pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(most <= slack, "{column:?}: {most}");
        }
    }
    // Nothing turns where up is the viewer's up already.
    let (columns, path) = (scene(3, 2), folder.path().join("a.ply"));
    let flat = SceneMeta { upright: Some(Rotation::IDENTITY), ..meta(ExportFrame::Local) };
    write_gaussians(&path, &columns, &flat).unwrap();
    let (mut back, back_meta) = gaussians(read_ply(&path).unwrap());
    assert_eq!((&back, back_meta.upright), (&columns, Some(Rotation::IDENTITY)));
    to_local(&mut back, &back_meta, flat.origin, flat.scale);
    assert_eq!(back, columns);
}

#[test]
fn properties_are_in_the_fields_order() {
    let mut columns = Columns::zeros(1, 2);
    columns.means.copy_from_slice(&[1.0, 2.0, 3.0]);
    columns.sh0.copy_from_slice(&[4.0, 5.0, 6.0]);
    // Coefficient k of channel c is 10 (k + 1) + c.
    for k in 0..8u8 {
        for c in 0..3u8 {
            columns.sh_n[usize::from(3 * k + c)] = f32::from(10 * (k + 1) + c);
        }
    }
    columns.opacities[0] = 7.0;
    columns.scales.copy_from_slice(&[-1.0, -2.0, -3.0]);
    columns.quats.copy_from_slice(&[0.0, 3.0, 0.0, 4.0]);
    let bytes = written(&columns, &meta(ExportFrame::Local));
    let (header, body) = header_of(&bytes);
    let lines: Vec<&str> = header.lines().collect();
    // The viewer of the 3DGS code takes the third word of the third line for the count.
    assert_eq!(lines[..3], ["ply", "format binary_little_endian 1.0", "comment vertices 1"]);
    // Readers give comments behind an element to it instead of the file.
    let element = lines.iter().position(|line| *line == "element vertex 1").unwrap();
    assert!(lines[element..].iter().all(|line| !line.starts_with("comment")), "{header}");
    let comments: Vec<&str> = lines.iter().filter_map(|l| l.strip_prefix("comment ")).collect();
    let version = concat!("Generated by gsscale ", env!("CARGO_PKG_VERSION"));
    let want = [
        "vertices 1",
        version,
        "step 29999",
        "SH degree: 2",
        "origin 1234.5678901234567 -0.1 0.000000003",
        "scale 0.30000000000000004",
        "frame local",
        "SplatRenderMode: default",
    ];
    assert_eq!(comments, want);
    let properties: Vec<&str> = lines.iter().filter_map(|l| l.strip_prefix("property float ")).collect();
    let rest: Vec<String> = (0..24).map(|i| format!("f_rest_{i}")).collect();
    let mut names = vec!["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"];
    names.extend(rest.iter().map(String::as_str));
    names.extend(["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]);
    assert_eq!(properties, names);
    let values: Vec<f32> = body.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
    let mut expected = vec![1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 4.0, 5.0, 6.0];
    for c in 0..3u8 {
        expected.extend((0..8u8).map(|k| f32::from(10 * (k + 1) + c)));
    }
    expected.extend([7.0, -1.0, -2.0, -3.0, 0.0, 0.6, 0.0, 0.8]);
    assert_eq!(values, expected);
}

#[test]
fn rows_that_are_not_finite_are_left_out_and_counted() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("out.ply");
    let mut columns = scene(100, 1);
    columns.row_mut(Column::ShN, 3)[1] = f32::NAN;
    columns.row_mut(Column::Quats, 50)[0] = f32::INFINITY;
    columns.row_mut(Column::Quats, 70).fill(0.0);
    // Finite in the local frame only.
    columns.row_mut(Column::Means, 99)[2] = 3e38;
    let far = SceneMeta { scale: 100.0, ..meta(ExportFrame::Dataset) };
    let report = write_gaussians(&path, &columns, &far).unwrap();
    assert_eq!((report.rows, report.skipped), (97, 3));
    let (back, _) = gaussians(read_ply(&path).unwrap());
    assert_eq!(back.rows(), 97);
    assert_eq!(back.row(Column::Quats, 68), [1.0, 0.0, 0.0, 0.0]);

    columns.opacities.fill(f32::NAN);
    let before = std::fs::read(&path).unwrap();
    assert!(write_gaussians(&path, &columns, &far).unwrap_err().to_string().contains("none of the 100"));
    assert_eq!(std::fs::read(&path).unwrap(), before, "a refused export must not touch the file");
    let error = write_gaussians(&folder.path().join("no/such/folder.ply"), &scene(1, 0), &far).unwrap_err();
    assert!(error.to_string().contains("remedy"), "{error}");
    // The target is a folder: the unfinished file must go too.
    std::fs::create_dir_all(folder.path().join("dir.ply/x")).unwrap();
    assert!(write_gaussians(&folder.path().join("dir.ply"), &scene(1, 0), &far).is_err());
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 2);
}

/// The Gaussians as ascii or big endian, properties in reverse, strangers and a list between them, behind faces.
fn foreign(columns: &Columns, ascii: bool) -> Vec<u8> {
    let little = written(columns, &meta(ExportFrame::Local));
    let (header, body) = header_of(&little);
    let names: Vec<&str> = header.lines().filter_map(|l| l.strip_prefix("property float ")).collect();
    let format = if ascii { "ascii" } else { "binary_big_endian" };
    let mut out =
        format!("ply\r\nformat {format} 1.0\r\ncomment SplatRenderMode: mip\r\ncomment step x\r\n").into_bytes();
    out.extend(b"obj_info nothing\r\nelement face 2\r\nproperty list uchar int vertex_indices\r\n");
    out.extend(format!("element vertex {}\r\nproperty uchar flag\r\n", columns.rows()).bytes());
    for name in names.iter().rev() {
        out.extend(format!("property {} {name}\r\n", if *name == "x" { "double" } else { "float32" }).bytes());
    }
    out.extend(b"property list ushort short neighbours\r\nend_header\r\n");
    if ascii {
        out.extend(b"3 0 1 2\r\n\r\n0\r\n");
    } else {
        out.extend([3, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 2, 0]);
    }
    for row in body.chunks(4 * names.len()) {
        let values = row.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b));
        if ascii {
            out.extend(b"7");
            values.rev().for_each(|v| out.extend(format!(" {v}").bytes()));
            out.extend(b" 2 -5 6\r\n");
        } else {
            out.push(7);
            for (value, name) in values.zip(&names).rev() {
                match *name {
                    "x" => out.extend(f64::from(value).to_be_bytes()),
                    _ => out.extend(value.to_be_bytes()),
                }
            }
            out.extend([0, 2, 0xff, 0xfb, 0, 6]);
        }
    }
    out
}

#[test]
fn every_format_and_order_is_read() {
    let columns = scene(40, 3);
    for ascii in [false, true] {
        let (back, back_meta) = gaussians(parse(&foreign(&columns, ascii)).unwrap());
        assert_eq!(back, columns, "ascii: {ascii}");
        // Not our file: its comment 'step x' is none of our business.
        assert_eq!(back_meta, SceneMeta { antialiased: true, ..SceneMeta::default() });
    }
}

#[test]
fn quaternions_of_any_length_keep_their_rotation() {
    let unit = scene(20, 0);
    let mut long = unit.clone();
    for (row, q) in long.quats.chunks_exact_mut(4).enumerate() {
        q.iter_mut().for_each(|v| *v *= (row as f32 + 0.5) * 1e3);
    }
    let (back, _) = gaussians(parse(&written(&long, &meta(ExportFrame::Local))).unwrap());
    for (got, want) in back.quats.iter().zip(&unit.quats) {
        // The product rounds once and the quotient once, each within 6e-8 of values up to 1.
        assert!((got - want).abs() < 2e-7);
    }
}

fn points(content: PlyContent) -> (Vec<[f64; 3]>, Vec<[u8; 3]>, u64) {
    match content {
        PlyContent::Points { positions, colors, dropped } => (positions, colors, dropped),
        PlyContent::Gaussians { .. } => panic!("these are Gaussians"),
    }
}

fn ascii_points(properties: &str, rows: &[&str]) -> Vec<u8> {
    let properties: String = properties.split(',').map(|p| format!("property {p}\n")).collect();
    let head = format!("ply\nformat ascii 1.0\nelement vertex {}\n{properties}end_header\n", rows.len());
    (head + &rows.join("\n") + "\n").into_bytes()
}

#[test]
fn coloured_points_are_read() {
    let position = "double x,double y,double z";
    let byte_colors =
        ascii_points(&format!("{position},uchar red,uchar green,uchar blue"), &["500000.125 -2 3e2 0 128 255"]);
    assert_eq!(points(parse(&byte_colors).unwrap()), (vec![[500_000.125, -2.0, 300.0]], vec![[0, 128, 255]], 0));
    let fractions = ascii_points(&format!("{position},float red,float green,float blue"), &["1 2 3 0 0.5 1"]);
    assert_eq!(points(parse(&fractions).unwrap()).1, [[0, 128, 255]]);
    // Floating-point colours of 0 to 255, and fractions of which one exceeds 1 a little; streamed as well.
    for (kind, rows, want) in [
        ("float", ["1 2 3 0 128 255", "1 2 3 1 1 0.25"], [[0, 128, 255], [1, 1, 0]]),
        ("double", ["1 2 3 0 32896 65535", "1 2 3 257 257 0"], [[0, 128, 255], [1, 1, 0]]),
        ("float", ["1 2 3 0 0.5 1.01", "1 2 3 1 1 0.25"], [[0, 128, 255], [255, 255, 64]]),
    ] {
        let bytes = ascii_points(&format!("{position},{kind} red,{kind} green,{kind} blue"), &rows);
        assert_eq!(points(parse(&bytes).unwrap()).1, want, "{kind}");
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("a.ply");
        std::fs::write(&file, &bytes).unwrap();
        let mut streamed = Vec::new();
        let mut take = |_, color| {
            streamed.push(color);
            Ok(())
        };
        stream_points(&file, &mut take).unwrap();
        assert_eq!(streamed, want, "{kind}");
    }
    let wide = ascii_points(&format!("{position},ushort red,ushort green,ushort blue"), &["1 2 3 0 32896 65535"]);
    assert_eq!(points(parse(&wide).unwrap()).1, [[0, 128, 255]]);
    assert_eq!(points(parse(&ascii_points(position, &["1 2 3"])).unwrap()).1, [[128; 3]]);

    let mut rows = vec!["1 2 3"; 200];
    rows[5] = "nan 2 3";
    rows[6] = "1 -inf 3";
    let (kept, _, dropped) = points(parse(&ascii_points(position, &rows)).unwrap());
    assert_eq!((kept.len(), dropped), (198, 2));
    rows[7] = "1 2 1e999";
    let error = error_of(&ascii_points(position, &rows));
    assert!(error.contains("3 of 200") && error.contains("vertex 5"), "{error}");
}

#[test]
fn hostile_files_are_refused_with_place_and_remedy() {
    let good = written(&scene(30, 3), &meta(ExportFrame::Local));
    let (header, body) = header_of(&good);
    let with_header = |from: &str, to: &str| {
        assert!(header.contains(from), "{from}");
        [header.replace(from, to).as_bytes(), body].concat()
    };
    let cases: Vec<(Vec<u8>, &str)> = vec![
        (vec![], "not a PLY file"),
        (b"solid cube\n".to_vec(), "not a PLY file"),
        (good[..good.len() - 1].to_vec(), "need 7440 bytes, but 7439 are left"),
        (header.as_bytes()[..100].to_vec(), "ends inside the header"),
        (with_header("element vertex 30", "element vertex 31"), "31 rows"),
        (with_header("element vertex 30", "element vertex 18446744073709551615"), "18446744073709551615 rows"),
        (with_header("element vertex 30", "element vertex 18446744073709551616"), "not a count"),
        (with_header("element vertex 30", "element vertex -1"), "not a count"),
        (with_header("element vertex 30", "element vertex 0"), "no vertices"),
        (with_header("element vertex 30", "element point 30"), "no element 'vertex'"),
        (with_header("element vertex 30", "element a 99999999999\nelement vertex 30"), "no properties"),
        (with_header("binary_little_endian", "binary_middle_endian"), "unknown format"),
        (with_header("format binary_little_endian 1.0\n", ""), "no format line"),
        (with_header("property float rot_3", "property float rot_2"), "appears twice"),
        (with_header("property float scale_2", "property float other"), "2D Gaussians"),
        (with_header("property float rot_3", "property float other"), "'rot_3'"),
        (with_header("property float f_rest_44", "property float other"), "44 f_rest"),
        (with_header("property float f_rest_44", "property float f_rest_45"), "'f_rest_44'"),
        (with_header("property float rot_3", "property list uchar float rot_3"), "is a list"),
        (with_header("property float rot_3", "property list float float rot_3"), "is a floating-point type"),
        (with_header("property float rot_3", "property quad rot_3"), "unknown type"),
        (with_header("property float rot_3", "nonsense"), "unknown keyword"),
        (with_header("comment frame local", "comment frame sideways"), "frame sideways"),
        (with_header("comment scale 0.3", "comment scale -0.3"), "scale -0.3"),
        (with_header("comment origin ", "comment origin 1 "), "origin 1 "),
        (with_header("comment origin ", "comment origin nan "), "origin nan"),
        (with_header("comment frame", "comment rotation 1 1 0 0\ncomment frame"), "rotation 1 1 0 0"),
        (with_header("comment frame", "comment rotation 1 0 0\ncomment frame"), "rotation 1 0 0"),
        (with_header("comment step", &"comment x\n".repeat(8000)), "no end_header within"),
        (b"ply\nproperty float x\n".to_vec(), "before any element"),
    ];
    for (bytes, want) in cases {
        let error = error_of(&bytes);
        assert!(error.contains(want), "'{error}' should say '{want}'");
    }
}

#[test]
fn broken_rows_are_named_by_line_or_byte() {
    let xyz = "float x,float y,float z";
    let at = |rows: &[&str]| error_of(&ascii_points(xyz, rows));
    // The header has 7 lines.
    assert!(at(&["1.5 2.5 3.5", "1 2"]).contains("line 9: the row ends before property 'z'"));
    assert!(at(&["1 2 3", "1 2 3 4"]).contains("line 9: the row has more values"));
    assert!(at(&["1 2 3", "1 two 3"]).contains("line 9: 'two' is not a number for property 'y'"));
    let mut cut = ascii_points(xyz, &["100 200 300", "100 200 300"]);
    cut.truncate(cut.len() - 12);
    assert!(error_of(&cut).contains("line 9: the file ends before the last row"));
    let listed = "list uchar int l,float x,float y,float z";
    let error = error_of(&ascii_points(listed, &["4000000000 1 2 3"]));
    assert!(error.contains("list 'l' does not have as many"), "{error}");

    let binary = |count: &str, list: &[u8]| {
        let head = "ply\nformat binary_little_endian 1.0\nelement face 1\n";
        let rest = "element vertex 1\nproperty char x\nproperty char y\nproperty char z\nend_header\n";
        [format!("{head}property list {count} double l\n{rest}").as_bytes(), list, &[1, 2, 3]].concat()
    };
    assert_eq!(points(parse(&binary("int", &[0; 4])).unwrap()).0, [[1.0, 2.0, 3.0]]);
    assert!(error_of(&binary("int", &[255; 4])).contains("a list has -1 values"));
    let huge = error_of(&binary("uint", &[255; 4]));
    assert!(huge.contains("a list needs 34359738360 bytes") && huge.contains("byte "), "{huge}");
}

#[test]
fn missing_files_and_folders_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let missing = read_ply(&folder.path().join("none.ply")).unwrap_err().to_string();
    assert!(missing.contains("none.ply") && missing.contains("remedy"), "{missing}");
    assert!(read_ply(folder.path()).unwrap_err().to_string().contains("regular file"));
}
