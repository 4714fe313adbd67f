//! The correction of a whole picture, and the way back of its gradient.
//!
//! A photo cannot show more than white. Where it is white (255) and the corrected picture at least as bright, the two are
//! taken as equal: the picture becomes 1 there and gets no gradient.
//!
//! Invariants: 1. each pixel is a function of that pixel alone, so the bits are the same for any number of threads;
//! 2. a pixel without a gradient, such as a masked one, passes none on, whatever its colour.

use super::model::{CHANNEL_VALUES, IMAGE_VALUES, PixelModel};
use crate::scene::camera::Camera;
use crate::scene::image::Target;
use rayon::prelude::*;

/// Position of pixels on a lens.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct LensPlane {
    /// Principal point, pixels.
    pub centre: [f32; 2],
    /// One over half the diagonal of the picture, 1/pixels.
    pub scale: f32,
}

impl LensPlane {
    pub fn of(camera: &Camera) -> LensPlane {
        let (width, height) = (camera.width as f32, camera.height as f32);
        let diagonal = (width * width + height * height).sqrt().max(1.0);
        LensPlane { centre: [camera.cx, camera.cy], scale: 2.0 / diagonal }
    }

    /// The position of the centre of pixel (x, y).
    #[inline(always)]
    pub fn at(&self, x: usize, y: usize) -> [f32; 2] {
        [(x as f32 + 0.5 - self.centre[0]) * self.scale, (y as f32 + 0.5 - self.centre[1]) * self.scale]
    }
}

/// The correction of one view.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Look {
    /// Exposure in stops and homography of the photo; see [`super::model`].
    pub image: [f64; IMAGE_VALUES],
    /// Vignetting of the camera, by channel.
    pub falloff: [[f64; CHANNEL_VALUES]; 3],
    pub lens: LensPlane,
}

/// Whether the photo is white and the value at least 1: the photo then says no more about the value.
#[inline(always)]
fn is_white(photo: u8, value: f32) -> bool {
    photo == u8::MAX && value >= 1.0
}

impl Look {
    /// Corrects a picture `[3][height][width]`. With the photo, the picture is white where the photo cannot show more.
    ///
    /// # Panics
    /// The length is not that of a picture `width` pixels wide, or of the photo.
    pub fn correct(&self, picture: &mut [f32], width: usize, photo: Option<&Target>) {
        let model = PixelModel::<f32>::new(&self.image, &self.falloff);
        for_pixels(picture, width, |i, x, y, color| {
            let mut color = model.of(self.lens.at(x, y), color);
            if let Some(photo) = photo {
                for (c, value) in color.iter_mut().enumerate() {
                    *value = if is_white(photo.rgb[3 * i + c], *value) { 1.0 } else { *value };
                }
            }
            color
        });
    }

    /// Turns the gradient with respect to the corrected picture into that with respect to the picture as it was `drawn`.
    ///
    /// # Panics
    /// The lengths differ.
    pub fn back(&self, drawn: &[f32], photo: &Target, v_rgb: &mut [f32]) {
        let model = PixelModel::<f32>::new(&self.image, &self.falloff);
        let pixels = photo.pixels();
        assert_eq!((drawn.len(), v_rgb.len()), (3 * pixels, 3 * pixels), "picture and photo differ in size");
        for_pixels(v_rgb, photo.width as usize, |i, x, y, mut v| {
            if v == [0.0; 3] {
                return v;
            }
            let (at, color) = (self.lens.at(x, y), std::array::from_fn(|c| drawn[c * pixels + i]));
            let corrected = model.of(at, color);
            for c in 0..3 {
                v[c] = if is_white(photo.rgb[3 * i + c], corrected[c]) { 0.0 } else { v[c] };
            }
            model.back(at, color, v)
        });
    }
}

/// Replaces every pixel of a planar picture: `of` takes its number, column, row and values.
fn for_pixels(planes: &mut [f32], width: usize, of: impl Fn(usize, usize, usize, [f32; 3]) -> [f32; 3] + Sync) {
    let pixels = planes.len() / 3;
    let (red, rest) = planes.split_at_mut(pixels);
    let (green, blue) = rest.split_at_mut(pixels);
    let width = width.max(1);
    let rows = red.par_chunks_mut(width).zip(green.par_chunks_mut(width)).zip(blue.par_chunks_mut(width)).enumerate();
    rows.for_each(|(y, ((red, green), blue))| {
        for x in 0..red.len() {
            [red[x], green[x], blue[x]] = of(y * width + x, x, y, [red[x], green[x], blue[x]]);
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    fn photo(rgb: Vec<u8>) -> Target {
        Target::new([2, 1], rgb)
    }

    #[test]
    fn white_photos_ask_for_no_more_than_white() {
        let look = Look { image: [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], ..Look::default() };
        let photo = photo(vec![255, 10, 255, 255, 255, 255]);
        let drawn = [0.75, 0.25, 0.75, 0.25, 0.25, 0.25];
        let mut picture = drawn;
        look.correct(&mut picture, 2, Some(&photo));
        assert_eq!(picture, [1.0, 0.5, 1.5, 0.5, 0.5, 0.5]);
        let mut v = [1.0; 6];
        look.back(&drawn, &photo, &mut v);
        assert_eq!(v, [0.0, 2.0, 2.0, 2.0, 2.0, 2.0]);
        let mut picture = drawn;
        look.correct(&mut picture, 2, None);
        assert_eq!(picture, [1.5, 0.5, 1.5, 0.5, 0.5, 0.5]);
    }

    #[test]
    fn pixels_without_a_gradient_pass_none_on() {
        let look = Look { image: [0.5, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], ..Look::default() };
        let drawn = [f32::NAN, 0.5, 0.2, 0.5, 0.1, 0.5];
        let mut v = [0.0, 1.0, 0.0, 0.0, 0.0, 0.0];
        look.back(&drawn, &photo(vec![9; 6]), &mut v);
        assert_eq!([v[0], v[2], v[4]], [0.0; 3]);
        assert!(v[1] > 1.0);
    }
}
