//! SPZ files, read as its specification says (`github.com/nianticlabs/spz`): by a reader of the tests' own.

use super::ply::scene;
use super::sog::write;
use super::support::ExportedRow as Row;
use flate2::read::GzDecoder;
use gsscale::exchange::format::ExportFormat;
use gsscale::exchange::meta::{ExportFrame, SceneMeta};
use gsscale::exchange::ply::{PlyContent, read_ply};
use gsscale::scene::columns::{Column, Columns};
use gsscale::scene::rotation::Rotation;
use std::io::Read;
use std::path::Path;

/// Signs of the harmonics under half a turn about x: those of the polynomials y, z, x, xy, yz and so on.
const SIGNS: [f64; 15] = [-1.0, -1.0, 1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0, -1.0, 1.0, -1.0, 1.0];

/// The rows of a file, and the size of the smallest step of its positions.
fn read_spz(path: &Path) -> (Vec<Row>, f64) {
    let mut bytes = Vec::new();
    GzDecoder::new(std::fs::File::open(path).unwrap()).read_to_end(&mut bytes).unwrap();
    assert_eq!((&bytes[..4], &bytes[4..8]), (&b"NGSP"[..], &3u32.to_le_bytes()[..]));
    let n = u32::from_le_bytes(bytes[8..12].try_into().unwrap()) as usize;
    let (degree, bits) = (usize::from(bytes[12]), bytes[13]);
    assert_eq!(bytes[14..16], [0, 0], "neither antialiased nor extended");
    let coefficients = (degree + 1) * (degree + 1) - 1;
    let mut rest = &bytes[16..];
    let mut take = |each: usize| {
        let (array, tail) = rest.split_at(n * each);
        rest = tail;
        array.chunks_exact(each.max(1)).map(<[u8]>::to_vec).collect::<Vec<_>>()
    };
    let (positions, alphas, colors, scales) = (take(9), take(1), take(3), take(3));
    let (rotations, harmonics) = (take(4), take(3 * coefficients));
    assert!(rest.is_empty(), "{} bytes too many", rest.len());
    let step = 1.0 / f64::from(1u32 << bits);
    let row = |i: usize| {
        let fixed = |k: usize| {
            let b = &positions[i][3 * k..3 * k + 3];
            // The third byte has the sign.
            f64::from(i32::from_le_bytes([0, b[0], b[1], b[2]]) >> 8) * step
        };
        let of = |bytes: &[u8], f: &dyn Fn(f64) -> f64| [0, 1, 2].map(|k| f(f64::from(bytes[k])));
        let sh_n = harmonics.get(i).map_or(Vec::new(), |bytes| {
            bytes.iter().enumerate().map(|(k, &b)| (f64::from(b) - 128.0) / 128.0 * SIGNS[k / 3]).collect()
        });
        let [x, y, z, w] = smallest_three(u32::from_le_bytes(rotations[i][..].try_into().unwrap()));
        Row {
            position: [fixed(0), -fixed(1), -fixed(2)],
            alpha: f64::from(alphas[i][0]) / 255.0,
            sh0: of(&colors[i], &|c| (c / 255.0 - 0.5) / 0.15),
            log_scales: of(&scales[i], &|s| s / 16.0 - 10.0),
            quat: [w, x, -y, -z],
            sh_n,
        }
    };
    ((0..n).map(row).collect(), step)
}

/// x, y, z, w.
fn smallest_three(bits: u32) -> [f64; 4] {
    let largest = (bits >> 30) as usize;
    let mut q = [0.0; 4];
    for (k, i) in (0..4).filter(|&i| i != largest).enumerate() {
        let ten = bits >> (20 - 10 * k);
        let magnitude = f64::from(ten & 511) / 511.0 * std::f64::consts::FRAC_1_SQRT_2;
        q[i] = if ten & 512 == 0 { magnitude } else { -magnitude };
    }
    q[largest] = (1.0 - q.iter().map(|v| v * v).sum::<f64>()).max(0.0).sqrt();
    q
}

/// Both files of the same rows and metadata.
fn both(columns: &Columns, meta: &SceneMeta) -> (Columns, Vec<Row>, f64) {
    let folder = tempfile::tempdir().unwrap();
    let [ply, spz] = [(ExportFormat::Ply, "a.ply"), (ExportFormat::Spz, "a.spz")].map(|(format, name)| {
        let path = folder.path().join(name);
        let written = write(format, &path, std::slice::from_ref(columns), meta);
        assert_eq!(written.rows, columns.rows() as u64);
        path
    });
    let names = std::fs::read_dir(folder.path()).unwrap().count();
    assert_eq!(names, 2, "a temporary file is left");
    let PlyContent::Gaussians { columns, .. } = read_ply(&ply).unwrap() else { panic!("no Gaussians") };
    let (rows, step) = read_spz(&spz);
    (columns, rows, step)
}

#[test]
fn an_spz_file_holds_what_the_ply_holds() {
    for sh_degree in 0..=3u8 {
        let columns = scene(500, sh_degree);
        for upright in [None, Rotation::upright([0.3, 0.2, 0.9])] {
            let meta = SceneMeta {
                origin: [3.0, -4.0, 5.0],
                scale: 2.0,
                scene_radius: 20.0,
                frame: ExportFrame::Dataset,
                upright,
                ..SceneMeta::default()
            };
            let (ply, spz, step) = both(&columns, &meta);
            for (row, of) in spz.iter().enumerate() {
                check_row(&ply, row, of, step);
            }
        }
    }
}

/// Rounding is by half a step of each attribute, and f32 arithmetic before it.
fn check_row(ply: &Columns, row: usize, of: &Row, step: f64) {
    let near = |a: f64, b: f64, by: f64, what: &str| assert!((a - b).abs() <= by, "{what} of row {row}: {a}, {b}");
    let value = |column: Column, i: usize| f64::from(ply.row(column, row)[i]);
    for i in 0..3 {
        near(of.position[i], value(Column::Means, i), 0.5 * step + 1e-5, "position");
        near(of.log_scales[i], value(Column::Scales, i).clamp(-10.0, 5.9375), 0.5 / 16.0 + 1e-5, "scale");
        near(of.sh0[i], value(Column::Sh0, i).clamp(-0.5 / 0.15, 0.5 / 0.15), 0.5 / 255.0 / 0.15 + 1e-5, "colour");
    }
    near(of.alpha, 1.0 / (1.0 + (-f64::from(ply.opacities[row])).exp()), 0.5 / 255.0 + 1e-5, "opacity");
    let dot: f64 = (0..4).map(|i| of.quat[i] * value(Column::Quats, i)).sum();
    // Three components are off by at most half of a step of .0014 each; the angle is then at most 2 sqrt(3) times that, and
    // half as much again where the largest one is barely larger.
    near(dot.abs(), 1.0, 6e-6, "rotation");
    for (i, &given) in of.sh_n.iter().enumerate() {
        // Half of a bucket, and the rounding to 1/128 before it.
        let by = if i < 9 { 4.5 } else { 8.5 } / 128.0 + 1e-5;
        near(given, value(Column::ShN, i).clamp(-1.0, 127.0 / 128.0), by + 1.0 / 128.0, "harmonic");
    }
}

#[test]
fn positions_take_the_bits_that_their_reach_leaves() {
    let mut columns = scene(50, 3);
    let meta = SceneMeta::default();
    let (_, _, near) = both(&columns, &meta);
    columns.means[0] = 3000.0;
    let (_, rows, far) = both(&columns, &meta);
    assert!(near <= 1e-5 && far == 1.0 / 2048.0, "{near}, {far}");
    assert!((rows[0].position[0] - 3000.0).abs() <= far);
}

#[test]
fn rows_that_no_spz_file_can_hold_are_left_out_and_counted() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.spz");
    let mut columns = scene(5, 3);
    columns.means[0] = 1e7;
    columns.means[4] = f32::NAN;
    let write = |columns: &Columns| {
        let mut sink = ExportFormat::Spz.create(&path, columns.sh_degree, 5, &SceneMeta::default()).unwrap();
        sink.write(columns).unwrap();
        sink.finish()
    };
    let written = write(&columns).unwrap();
    assert_eq!((written.rows, written.skipped), (3, 2));
    assert_eq!(read_spz(&path).0.len(), 3);
    let before = std::fs::read(&path).unwrap();
    columns.means.fill(f32::NAN);
    assert!(write(&columns).unwrap_err().to_string().contains("none of the 5"));
    columns.means.fill(1e7);
    let said = write(&columns).unwrap_err().to_string();
    assert!(said.contains("all 5 Gaussians lie beyond") && said.contains("--export-frame local"), "{said}");
    assert_eq!(std::fs::read(&path).unwrap(), before, "the target is unchanged");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    assert!(ExportFormat::of_path(Path::new("a.splat")).unwrap_err().to_string().contains(".spz"));
    assert_eq!(ExportFormat::of_path(Path::new("A.SPZ")).unwrap(), ExportFormat::Spz);
}

#[test]
fn what_the_format_cannot_hold_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let told = |columns: &Columns| {
        let path = folder.path().join("a.spz");
        let mut sink = ExportFormat::Spz.create(&path, columns.sh_degree, 2000, &SceneMeta::default()).unwrap();
        sink.write(columns).unwrap();
        sink.finish().unwrap().warnings
    };
    let plain = scene(2000, 0);
    assert!(told(&plain).is_empty(), "{:?}", told(&plain));
    // A sigma of 403 units, and one of 364.
    let mut large = plain.clone();
    (large.scales[0], large.scales[3]) = (6.0, 5.9);
    let of_large = told(&large);
    assert!(
        of_large.len() == 1 && of_large[0].contains("a.spz: 1 Gaussian is larger than a sigma of 379 units"),
        "{of_large:?}"
    );
    // Two rows of 2000 are few, three are a part of the scene.
    let mut far = plain;
    (far.means[0], far.means[3]) = (3e6, -3e6);
    let of_far = told(&far);
    assert!(
        of_far.len() == 1
            && of_far[0].contains("2 Gaussians are so far out that SPZ rounds all positions to 0.5 units"),
        "{of_far:?}"
    );
    // But then the others lie on a coarse grid.
    far.means[6] = 3e6;
    let of_part = told(&far);
    assert!(
        of_part.len() == 1 && of_part[0].contains("smaller than the 0.5 units to which SPZ rounds all positions"),
        "{of_part:?}"
    );
}
