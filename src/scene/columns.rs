//! The six columns of a Gaussian, and a table of rows of them.
//!
//! Invariants: 1. values are stored *before* activation: log-scales, logit opacities, quaternions w-first and not
//! necessarily unit; 2. every column holds exactly `rows * width` floats, row-major; 3. `sh_n` is coefficient-major
//! (`[K-1][3]`, band 1 first), the order of the field's tensors; the exchange converts to PLY's channel-major order.

use crate::base::room;

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Column {
    /// Positions, local frame.
    Means,
    /// Rotations, w x y z.
    Quats,
    /// Log of the three standard deviations.
    Scales,
    /// Logit of the opacity.
    Opacities,
    /// Constant band of the colour.
    Sh0,
    /// Higher bands of the colour.
    ShN,
}

impl Column {
    pub const ALL: [Column; 6] =
        [Column::Means, Column::Quats, Column::Scales, Column::Opacities, Column::Sh0, Column::ShN];

    /// Floats of one row, for scenes stored with `sh_degree` (0 to 3).
    pub fn width(self, sh_degree: u8) -> usize {
        match self {
            Column::Means | Column::Scales | Column::Sh0 => 3,
            Column::Quats => 4,
            Column::Opacities => 1,
            Column::ShN => sh_n_width(sh_degree),
        }
    }
}

/// Floats of `shN` at a degree: 3 ((degree + 1)^2 - 1).
pub fn sh_n_width(sh_degree: u8) -> usize {
    let d = sh_degree as usize + 1;
    3 * (d * d - 1)
}

/// Floats of a whole row at a degree: 14 + [`sh_n_width`] (59 at degree 3).
pub fn row_width(sh_degree: u8) -> usize {
    14 + sh_n_width(sh_degree)
}

/// Something for each column: vectors, shared slices or exclusive slices of `[rows][width]` floats.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct ColumnSet<T> {
    /// Degree that `sh_n` is stored with, 0 to 3.
    pub sh_degree: u8,
    /// `[rows][3]`.
    pub means: T,
    /// `[rows][4]`, w x y z.
    pub quats: T,
    /// `[rows][3]`, log.
    pub scales: T,
    /// `[rows]`, logit.
    pub opacities: T,
    /// `[rows][3]`.
    pub sh0: T,
    /// `[rows][(degree + 1)^2 - 1][3]`.
    pub sh_n: T,
}

/// Rows of Gaussians by column; also gradients (`v_*`), `exp_avg` and `exp_avg_sq`, which have the same shape.
pub type Columns = ColumnSet<Vec<f32>>;

/// Gradients of one batch of a view, one entry per row.
#[derive(Debug, Clone, Default)]
pub struct Gradients {
    /// Gradient with respect to the stored (pre-activation) columns.
    pub columns: Columns,
    /// Gradient with respect to the projected mean, signed, in pixel units.
    pub means2d: Vec<[f32; 2]>,
    /// Half extents of the footprint, pixels; [0, 0] for a row that was not drawn.
    pub radii: Vec<[u32; 2]>,
    /// If the renderer was asked for it: the blending weight alpha T of each row, and the weight times the
    /// squared error of the picture (mean over channels), summed over the pixels; zeros for rows that were not drawn.
    /// Empty otherwise.
    pub weights: Vec<[f32; 2]>,
}

impl<T> ColumnSet<T> {
    #[inline(always)]
    pub fn column(&self, column: Column) -> &T {
        match column {
            Column::Means => &self.means,
            Column::Quats => &self.quats,
            Column::Scales => &self.scales,
            Column::Opacities => &self.opacities,
            Column::Sh0 => &self.sh0,
            Column::ShN => &self.sh_n,
        }
    }

    #[inline(always)]
    pub fn column_mut(&mut self, column: Column) -> &mut T {
        match column {
            Column::Means => &mut self.means,
            Column::Quats => &mut self.quats,
            Column::Scales => &mut self.scales,
            Column::Opacities => &mut self.opacities,
            Column::Sh0 => &mut self.sh0,
            Column::ShN => &mut self.sh_n,
        }
    }

    pub fn each_mut(&mut self) -> ColumnSet<&mut T> {
        ColumnSet {
            sh_degree: self.sh_degree,
            means: &mut self.means,
            quats: &mut self.quats,
            scales: &mut self.scales,
            opacities: &mut self.opacities,
            sh0: &mut self.sh0,
            sh_n: &mut self.sh_n,
        }
    }

    /// Something else for each column, in storage order.
    #[inline(always)]
    pub fn map_columns<U>(self, mut of: impl FnMut(Column, T) -> U) -> ColumnSet<U> {
        ColumnSet {
            sh_degree: self.sh_degree,
            means: of(Column::Means, self.means),
            quats: of(Column::Quats, self.quats),
            scales: of(Column::Scales, self.scales),
            opacities: of(Column::Opacities, self.opacities),
            sh0: of(Column::Sh0, self.sh0),
            sh_n: of(Column::ShN, self.sh_n),
        }
    }
}

impl Columns {
    pub fn zeros(rows: usize, sh_degree: u8) -> Self {
        let mut c = Columns { sh_degree, ..Columns::default() };
        c.resize(rows);
        c
    }

    /// Keeps the rows for which `is_kept` is true, in order; returns the number of the others.
    pub fn retain_rows(&mut self, is_kept: impl Fn(&Columns, usize) -> bool) -> u64 {
        let (rows, mut kept) = (self.rows(), 0);
        for row in 0..rows {
            if !is_kept(self, row) {
                continue;
            }
            if kept != row {
                for column in Column::ALL {
                    let width = column.width(self.sh_degree);
                    self.column_mut(column).copy_within(row * width..(row + 1) * width, kept * width);
                }
            }
            kept += 1;
        }
        self.resize(kept);
        (rows - kept) as u64
    }

    pub fn rows(&self) -> usize {
        self.opacities.len()
    }

    /// Changes the number of rows; new rows are zeros. Keeps the allocation.
    pub fn resize(&mut self, rows: usize) {
        for column in Column::ALL {
            let width = column.width(self.sh_degree);
            room::resize(self.column_mut(column), rows * width, 0.0);
        }
    }

    /// Adds the bands up to `degree`, as zeros, if they are missing.
    pub fn raise_sh_degree(&mut self, degree: u8) {
        if degree <= self.sh_degree {
            return;
        }
        let (from, to) = (sh_n_width(self.sh_degree), sh_n_width(degree));
        let mut sh_n = vec![0.0; self.rows() * to];
        if from > 0 {
            for (wide, narrow) in sh_n.chunks_exact_mut(to).zip(self.sh_n.chunks_exact(from)) {
                // Bands are stored lowest first.
                wide[..from].copy_from_slice(narrow);
            }
        }
        (self.sh_n, self.sh_degree) = (sh_n, degree);
    }

    pub fn bytes(&self) -> usize {
        Column::ALL.iter().map(|&column| 4 * self.column(column).capacity()).sum()
    }

    /// The floats of one row of one column.
    pub fn row(&self, column: Column, row: usize) -> &[f32] {
        let width = column.width(self.sh_degree);
        &self.column(column)[row * width..(row + 1) * width]
    }

    pub fn row_mut(&mut self, column: Column, row: usize) -> &mut [f32] {
        let width = column.width(self.sh_degree);
        &mut self.column_mut(column)[row * width..(row + 1) * width]
    }
}
