//! The sizes of a view from which its device memory follows. Not here: the sums (`device_needs`).

/// Most tiles that a row of a grown scene is expected to reach, on average over the rows in view.
const ISECTS_PER_ROW: u64 = 32;

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ViewSizes {
    pub rows: u64,
    /// Intersections of splats and tiles.
    pub isects: u64,
    pub pixels: u64,
}

impl ViewSizes {
    /// The larger of each size.
    pub fn widest(self, other: ViewSizes) -> ViewSizes {
        ViewSizes {
            rows: self.rows.max(other.rows),
            isects: self.isects.max(other.isects),
            pixels: self.pixels.max(other.pixels),
        }
    }

    /// The view with `growth` times as many Gaussians. Few Gaussians that cover the picture reach more tiles each than
    /// many smaller ones, so the grown view has at most the intersections of ordinary scenes.
    pub fn grown(self, growth: f64) -> ViewSizes {
        let [rows, isects] = [self.rows, self.isects].map(|size| (size as f64 * growth).ceil() as u64);
        let isects = isects.min(self.isects.max(rows.saturating_mul(ISECTS_PER_ROW)));
        ViewSizes { rows, isects, ..self }
    }
}
