//! Appearance: what differs between the photos of one scene besides the pose. An exposure and a colour homography per
//! photo, and vignetting per camera, act on the rendered picture before the loss.
//!
//! The model is that of PPISP (arXiv 2601.18336) without its response curve: the picture is multiplied by 2^dt and by the
//! falloff of the lens, then a homography changes chromaticities ([`model`]). Scene and correction share a freedom: a
//! brighter scene under darker exposures gives the same pictures. So what acts on a photo is its value less the mean over
//! the photos seen ([`state`]), and small weights pull it towards no change.
//!
//! Values follow one damped Gauss-Newton step per sighting ([`fit`]) instead of Adam. A run of 1,500 steps sees each of
//! 150 photos ten times; Adam at a rate of .002 would move an exposure by .02 stops in that time. The nine values of a
//! photo are well determined by one sighting, so their optimum is computed. Later sightings count less, so that the values
//! settle.
//!
//! Invariants: 1. sums over pixels are f64 in row order, so the bits are the same for any number of threads; 2. no value
//! that is not finite, or out of bounds, is stored; 3. masked pixels count nowhere.
//!
//! Not here: which step corrects what (`train`), and the bytes of a commit (`checkpoint`).

pub mod first_values;
pub mod fit;
pub mod model;
pub mod picture;
pub mod state;

/// Which corrections are trained.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum AppearanceMode {
    /// None.
    #[default]
    Off,
    /// An exposure per photo.
    Exposure,
    /// Exposure and colour homography per photo, vignetting per camera.
    Full,
}

impl AppearanceMode {
    /// Whether anything is corrected.
    pub fn is_on(self) -> bool {
        self != AppearanceMode::Off
    }

    /// The name in files and on the command line.
    pub fn name(self) -> &'static str {
        match self {
            AppearanceMode::Off => "off",
            AppearanceMode::Exposure => "exposure",
            AppearanceMode::Full => "full",
        }
    }

    /// How many of a photo's values are trained, from the first.
    pub fn image_values(self) -> usize {
        match self {
            AppearanceMode::Off => 0,
            AppearanceMode::Exposure => 1,
            AppearanceMode::Full => model::IMAGE_VALUES,
        }
    }
}
