//! The derivative of a loss by the motion of the camera, from the gradients of the rows, against central finite differences of the
//! second renderer, whose camera itself moves.

use crate::gradients::{FAINT, OPAQUE, Recipe, camera};
use crate::support::reference64::{Pose64, Rows64, pose_of, render_from};
use glam::{DMat3, DVec3};
use gsscale::base::rng::{Purpose, Stream};
use gsscale::photos::pose::Motion;
use gsscale::photos::pose::MotionSum;
use gsscale::render::cpu::CpuRenderer;
use gsscale::render::{Gradients, PictureGradient, Renderer};
use gsscale::scene::columns::Columns;

/// As for the gradients of rows (`gradients`): far from every kink, and rounding stays below 1e-6 of the derivative.
const STEP: f64 = 2e-7;
/// Relative L2 error of a shift, of a turn: ten times what f32 leaves here.
const ERROR_MOST: f64 = 3e-6;

/// The pose after a motion, by the matrices of the textbook.
fn moved(pose: &Pose64, motion: &Motion) -> Pose64 {
    let rotation = DMat3::from_cols_array_2d(&[0, 1, 2].map(|j| pose.map(|row| row[j])));
    let centre = -(rotation.transpose() * DVec3::from(pose.map(|row| row[3]))) + DVec3::from(motion.shift);
    let turn = DVec3::from(motion.turn);
    let turned = match turn.length() {
        0.0 => rotation,
        angle => rotation * DMat3::from_axis_angle(turn / angle, angle).transpose(),
    };
    let translation = -(turned * centre);
    std::array::from_fn(|i| [turned.row(i).x, turned.row(i).y, turned.row(i).z, translation[i]])
}

/// Loss gradients of a picture, one random number a value.
fn upstream(pixels: usize) -> PictureGradient {
    let mut rng = Stream::new(79, Purpose::Test, 4, 0);
    let mut draw = |count: usize| (0..count).map(|_| rng.normal() as f32).collect::<Vec<f32>>();
    PictureGradient::new(draw(3 * pixels), draw(pixels))
}

fn check(recipe: &Recipe) {
    let (rows, _) = recipe.scene();
    let (camera, options, settings) = (camera(), recipe.options(), recipe.settings());
    let pixels = camera.pixels();
    let gradient = upstream(pixels);
    let mut renderer = CpuRenderer::new();
    renderer.draw(&rows, &camera, &options).unwrap();
    *renderer.picture_gradient().unwrap() = gradient.clone();
    let mut grads = Gradients::default();
    renderer.backpropagate(&rows, &mut grads).unwrap();
    let mut sum = MotionSum::default();
    sum.add(&rows, &grads.columns, &camera, options.sh_degree);
    let [x, y, z, a, b, c] = sum.gradient();
    let (rows64, pose) = (Rows64::new(&rows), pose_of(&camera));
    let v_alpha = gradient.v_alpha.unwrap();
    let loss = |motion: &Motion| -> f64 {
        let picture = render_from(&rows64, (&camera, &moved(&pose, motion)), &settings);
        let of_pixel = |i: usize| {
            let rgb = (0..3).map(|c| f64::from(gradient.v_rgb[c * pixels + i]) * picture.rgb[i][c]).sum::<f64>();
            rgb + f64::from(v_alpha[i]) * picture.alpha[i]
        };
        (0..pixels).map(of_pixel).sum()
    };
    let along = |axis: usize, by: f64| std::array::from_fn(|i| if i == axis { by } else { 0.0 });
    let difference = |of: &dyn Fn(f64) -> Motion| (loss(&of(STEP)) - loss(&of(-STEP))) / (2.0 * STEP);
    let shift: [f64; 3] =
        std::array::from_fn(|axis| difference(&|by| Motion { shift: along(axis, by), turn: [0.0; 3] }));
    let turn: [f64; 3] =
        std::array::from_fn(|axis| difference(&|by| Motion { shift: [0.0; 3], turn: along(axis, by) }));
    for (what, want, got) in [("shift", shift, [x, y, z]), ("turn", turn, [a, b, c])] {
        let (want, got) = (DVec3::from(want), DVec3::from(got));
        let error = (got - want).length() / want.length();
        println!("{what}: {want:.4}, error {error:.1e}");
        assert!(want.length() > 1.0 && error < ERROR_MOST, "{what}: {got} instead of {want}, off by {error:e}");
    }
}

#[test]
fn the_motion_of_a_camera_has_the_gradient_of_finite_differences() {
    check(&FAINT);
    check(&OPAQUE);
}

#[test]
fn a_motion_moves_a_camera_as_the_textbook_does() {
    let motion = Motion { shift: [0.01, -0.02, 0.015], turn: [0.004, 0.01, -0.006] };
    let (camera, want) = (camera(), moved(&pose_of(&camera()), &motion));
    let got = pose_of(&motion.applied_to(&camera));
    // The angle of a turn differs by a twelfth of its cube, 2e-7; f32 rounds translations of 4 by 2e-7.
    let off = want.as_flattened().iter().zip(got.as_flattened()).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(off < 2e-6, "off by {off:e}");
}

#[test]
fn threads_and_batches_change_no_bit_of_the_sum() {
    let (rows, _) = FAINT.scene();
    let (camera, degree) = (camera(), FAINT.options().sh_degree);
    let mut grads = rows.clone();
    grads.means.iter_mut().enumerate().for_each(|(i, x)| *x = (i as f32 - 7.3) * 1e-7);
    let only = |columns: &Columns, row: usize| {
        let mut one = columns.clone();
        one.retain_rows(|_, at| at == row);
        one
    };
    let all = |order: &mut dyn Iterator<Item = usize>| {
        let mut sum = MotionSum::default();
        order.for_each(|row| sum.add(&only(&rows, row), &only(&grads, row), &camera, degree));
        sum
    };
    let mut whole = MotionSum::default();
    whole.add(&rows, &grads, &camera, degree);
    assert_eq!(all(&mut (0..rows.rows())), whole);
    assert_eq!(all(&mut (0..rows.rows()).rev()), whole);
}
