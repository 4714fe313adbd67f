//! Digests of the dataset properties on which training depends: taken when a run begins, compared when it resumes.
//!
//! The digest of a photo covers its file: the length, and the whole content up to 256 KiB, or head, middle and tail of
//! 64 KiB each. That costs three small reads per photo instead of a pass over a dataset that may exceed memory. It
//! detects a replaced photo, another size or quality, and edited pixels, because a compressing encoder then changes the
//! length and all later bytes. It does not detect single flipped bits; those fail to decode or affect one photo of
//! thousands. The digest of the points covers all of them, since a run reads all points at its start.

use crate::base::error::{InputError, InputResult};
use crate::checkpoint::run_state::ViewPrint;
use crate::dataset::import::PointSource;
use crate::dataset::loader::View;
use crate::dataset::model::Split;
use crate::scene::columns::{Column, Columns};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;
use xxhash_rust::xxh3::Xxh3;

/// Files up to this length are read whole.
const WHOLE_BYTES: u64 = 256 << 10;
/// Length of one sample of a longer file.
const SAMPLE_BYTES: u64 = 64 << 10;

pub(crate) fn view_print(view: &View) -> InputResult<ViewPrint> {
    let camera = &view.camera;
    let mut pose = Xxh3::new();
    pose.update(view.name.as_bytes());
    pose.update(&[u8::from(view.split == Split::Train)]);
    let placed = camera.viewmat.as_flattened().iter().map(|x| x.to_bits());
    placed.chain(camera.lens_words()).for_each(|word| pose.update(&word.to_le_bytes()));
    let mut photo = Xxh3::new();
    add_file(&mut photo, &view.photo.image_path)?;
    if let Some(mask) = &view.photo.mask {
        photo.update(&[u8::from(mask.invert)]);
        add_file(&mut photo, &mask.path)?;
    }
    Ok(ViewPrint { pose: pose.digest(), photo: photo.digest() })
}

/// Adds the length of a file and its content or samples of it to the digest.
fn add_file(digest: &mut Xxh3, path: &Path) -> InputResult<()> {
    let io = |e: std::io::Error| InputError::io(path, "reading the file for its digest", &e);
    let mut file = File::open(path).map_err(io)?;
    let length = file.metadata().map_err(io)?.len();
    digest.update(&length.to_le_bytes());
    let places = match length {
        0..=WHOLE_BYTES => vec![(0, WHOLE_BYTES)],
        _ => [0, (length - SAMPLE_BYTES) / 2, length - SAMPLE_BYTES].map(|at| (at, SAMPLE_BYTES)).to_vec(),
    };
    let mut bytes = Vec::new();
    for (at, most) in places {
        file.seek(SeekFrom::Start(at)).map_err(io)?;
        bytes.clear();
        Read::by_ref(&mut file).take(most).read_to_end(&mut bytes).map_err(io)?;
        digest.update(&bytes);
    }
    Ok(())
}

/// Digest and number of the points from which the first Gaussians are made.
/// Errors: the points cannot be read.
pub(crate) fn points_print(points: &dyn PointSource) -> InputResult<(u64, u64)> {
    let (mut digest, mut count) = (Xxh3::new(), 0);
    points.read(&mut |position, color| {
        let [x, y, z] = position.map(f32::to_bits);
        let color = u32::from_le_bytes([color[0], color[1], color[2], 0]);
        digest.update(bytemuck::bytes_of(&[x, y, z, color].map(u32::to_le)));
        count += 1;
        Ok(())
    })?;
    Ok((digest.digest(), count))
}

/// Digest of the Gaussians from which a run starts; the same for streamed and whole input.
#[derive(Default)]
pub(crate) struct GaussiansPrint(Xxh3);

impl GaussiansPrint {
    /// Adds the next Gaussians.
    pub fn add(&mut self, columns: &Columns) {
        for row in 0..columns.rows() {
            Column::ALL.into_iter().for_each(|column| self.0.update(bytemuck::cast_slice(columns.row(column, row))));
        }
    }

    pub fn digest(&self) -> u64 {
        self.0.digest()
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;

    fn digest_of(path: &Path) -> u64 {
        let mut digest = Xxh3::new();
        add_file(&mut digest, path).unwrap();
        digest.digest()
    }

    #[test]
    fn files_are_told_by_length_and_content() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("photo");
        for length in [0usize, 1, 5000, WHOLE_BYTES as usize, WHOLE_BYTES as usize + 1, 3_000_000] {
            let bytes: Vec<u8> = (0..length).map(|i| (i * 7 / 3) as u8).collect();
            std::fs::write(&path, &bytes).unwrap();
            let first = digest_of(&path);
            assert_eq!(digest_of(&path), first);
            std::fs::write(&path, [&bytes[..], &[0]].concat()).unwrap();
            assert_ne!(digest_of(&path), first, "longer by one byte");
            // First, middle and last byte: in a sample whatever the length.
            for at in [0, length / 2, length.saturating_sub(1)].into_iter().filter(|_| length > 0) {
                let mut changed = bytes.clone();
                changed[at] ^= 1;
                std::fs::write(&path, &changed).unwrap();
                assert_ne!(digest_of(&path), first, "byte {at} of {length}");
            }
        }
        std::fs::remove_file(&path).unwrap();
        assert!(add_file(&mut Xxh3::new(), &path).is_err());
    }
}
