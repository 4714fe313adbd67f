//! The trainable state of rows: values, moments, stamps, identities, statistics.
//!
//! Invariants: 1. every vector has one entry (or one column width) per row; 2. `columns` holds the values after the
//! last update, not the current ones: [`crate::optim::deferred`] evaluates those; 3. a row is rewritten as a whole; 4.
//! rows are removed and appended in all vectors at once, and remaining rows keep their order.

use super::columns::{Column, Columns, row_width};
use super::rows::{RowTables, Rows, RowsMut};
use rayon::prelude::*;
use std::collections::TryReserveError;

#[derive(Debug, Clone, Default, PartialEq)]
pub struct SceneState {
    /// Values after the last update of each row.
    pub columns: Columns,
    /// First moments after the last update, without bias correction.
    pub exp_avg: Columns,
    /// Second moments after the last update, without bias correction.
    pub exp_avg_sq: Columns,
    /// Number of optimizer steps contained in the row: s + 1 after an update in 0-based step s.
    pub stamp: Vec<u32>,
    /// Identity, kept when the row moves: the initial index, or a hash of (parent, event, child).
    pub uid: Vec<u64>,
    /// Sum of the growth scores since the last round; for the strategy `default`, of the norms of the screen-space mean
    /// gradients (NDC units).
    pub grad2d: Vec<f32>,
    /// Views that drew the row since the last round, and its blending weight in them ([`super::sightings`]).
    pub count: Vec<u32>,
}

/// Bytes of one row in memory at a degree: values and two moments, stamp, uid, statistics (728 at degree 3).
pub fn row_bytes(sh_degree: u8) -> usize {
    row_width(sh_degree) * 4 * 3 + 4 + 8 + 4 + 4
}

impl SceneState {
    /// New rows: uids 0..n, zero moments, no step contained, no statistics.
    pub fn from_columns(columns: Columns) -> Self {
        let rows = columns.rows();
        let sh_degree = columns.sh_degree;
        SceneState {
            columns,
            exp_avg: Columns::zeros(rows, sh_degree),
            exp_avg_sq: Columns::zeros(rows, sh_degree),
            stamp: vec![0; rows],
            uid: (0..rows as u64).collect(),
            grad2d: vec![0.0; rows],
            count: vec![0; rows],
        }
    }

    pub fn rows(&self) -> usize {
        self.stamp.len()
    }

    pub fn sh_degree(&self) -> u8 {
        self.columns.sh_degree
    }

    pub fn view(&self) -> Rows<'_> {
        RowTables {
            first_row: 0,
            columns: self.columns.view(),
            exp_avg: self.exp_avg.view(),
            exp_avg_sq: self.exp_avg_sq.view(),
            stamp: &self.stamp,
            uid: &self.uid,
            grad2d: &self.grad2d,
            count: &self.count,
        }
    }

    pub fn view_mut(&mut self) -> RowsMut<'_> {
        RowTables {
            first_row: 0,
            columns: self.columns.view_mut(),
            exp_avg: self.exp_avg.view_mut(),
            exp_avg_sq: self.exp_avg_sq.view_mut(),
            stamp: &mut self.stamp,
            uid: &mut self.uid,
            grad2d: &mut self.grad2d,
            count: &mut self.count,
        }
    }

    /// Removes the rows in `removed` (ascending, each once); the others keep their order.
    pub fn remove(&mut self, removed: &[u32]) {
        if removed.is_empty() {
            return;
        }
        let sh_degree = self.sh_degree();
        let SceneState { columns, exp_avg, exp_avg_sq, stamp, uid, grad2d, count } = self;
        let mut floats: Vec<(usize, &mut Vec<f32>)> = Vec::new();
        for table in [columns, exp_avg, exp_avg_sq] {
            table.each_mut().map_columns(|column, values| floats.push((column.width(sh_degree), values)));
        }
        floats.push((1, grad2d));
        floats.par_iter_mut().for_each(|(width, values)| remove_runs(values, *width, removed));
        remove_runs(stamp, 1, removed);
        remove_runs(uid, 1, removed);
        remove_runs(count, 1, removed);
    }

    /// Reserves memory for exactly `more` further rows, so that a scene's memory is determined by its rows and not by
    /// the doubling of vectors. Grows one vector at a time.
    /// Errors: not enough memory; some of the vectors may have grown.
    pub fn try_reserve_exact(&mut self, more: usize) -> Result<(), TryReserveError> {
        let sh_degree = self.sh_degree();
        for table in [&mut self.columns, &mut self.exp_avg, &mut self.exp_avg_sq] {
            for column in Column::ALL {
                table.column_mut(column).try_reserve_exact(more.saturating_mul(column.width(sh_degree)))?;
            }
        }
        self.stamp.try_reserve_exact(more)?;
        self.uid.try_reserve_exact(more)?;
        self.grad2d.try_reserve_exact(more)?;
        self.count.try_reserve_exact(more)
    }

    /// Adds the bands up to `degree`, as zeros with zero moments.
    pub fn raise_sh_degree(&mut self, degree: u8) {
        self.columns.raise_sh_degree(degree);
        self.exp_avg.raise_sh_degree(degree);
        self.exp_avg_sq.raise_sh_degree(degree);
    }

    /// A copy of the listed rows, in the order of the list.
    #[must_use]
    pub fn select(&self, rows: &[u32]) -> SceneState {
        let of = |from: &Columns| {
            from.view().map_columns(|column, _| {
                let mut values = Vec::with_capacity(rows.len() * column.width(from.sh_degree));
                rows.iter().for_each(|&row| values.extend_from_slice(from.row(column, row as usize)));
                values
            })
        };
        SceneState {
            columns: of(&self.columns),
            exp_avg: of(&self.exp_avg),
            exp_avg_sq: of(&self.exp_avg_sq),
            stamp: rows.iter().map(|&row| self.stamp[row as usize]).collect(),
            uid: rows.iter().map(|&row| self.uid[row as usize]).collect(),
            grad2d: rows.iter().map(|&row| self.grad2d[row as usize]).collect(),
            count: rows.iter().map(|&row| self.count[row as usize]).collect(),
        }
    }

    /// Appends all rows of `other`, which must have the same SH degree.
    pub fn append(&mut self, other: &SceneState) {
        assert_eq!(self.sh_degree(), other.sh_degree(), "rows of another degree cannot be appended");
        for (table, more) in [
            (&mut self.columns, &other.columns),
            (&mut self.exp_avg, &other.exp_avg),
            (&mut self.exp_avg_sq, &other.exp_avg_sq),
        ] {
            for column in Column::ALL {
                table.column_mut(column).extend_from_slice(more.column(column));
            }
        }
        self.stamp.extend_from_slice(&other.stamp);
        self.uid.extend_from_slice(&other.uid);
        self.grad2d.extend_from_slice(&other.grad2d);
        self.count.extend_from_slice(&other.count);
    }
}

/// Closes the gaps of removed rows, with one move per run of remaining rows.
fn remove_runs<T: Copy>(values: &mut Vec<T>, width: usize, removed: &[u32]) {
    let Some(&first) = removed.first() else { return };
    if width == 0 {
        return; // `sh_n` at degree 0
    }
    let rows = values.len() / width;
    let mut to = first as usize;
    for (i, &gap) in removed.iter().enumerate() {
        let from = gap as usize + 1;
        let end = removed.get(i + 1).map_or(rows, |&next| next as usize);
        values.copy_within(from * width..end * width, to * width);
        to += end - from;
    }
    values.truncate(to * width);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn numbered(rows: usize, sh_degree: u8) -> SceneState {
        let mut columns = Columns::zeros(rows, sh_degree);
        for column in Column::ALL {
            let width = column.width(sh_degree);
            for (i, x) in columns.column_mut(column).iter_mut().enumerate() {
                *x = (i / width) as f32;
            }
        }
        SceneState::from_columns(columns)
    }

    #[test]
    fn removing_and_appending_keeps_all_vectors_consistent() {
        for sh_degree in 0..=3 {
            let mut state = numbered(10, sh_degree);
            state.remove(&[0, 3, 4, 9]);
            let more = numbered(2, sh_degree);
            state.append(&more);
            let want = [1u64, 2, 5, 6, 7, 8, 0, 1];
            assert_eq!(state.uid, want);
            for column in Column::ALL {
                for (row, &uid) in want.iter().enumerate() {
                    assert!(state.columns.row(column, row).iter().all(|&x| x == uid as f32), "{column:?} {row}");
                    assert_eq!(state.exp_avg.row(column, row).len(), column.width(sh_degree));
                }
            }
            assert_eq!(state.rows(), 8);
            assert_eq!(state.grad2d.len(), 8);
            assert_eq!(state.count.len(), 8);
            state.remove(&[0, 2, 4, 6]);
            assert_eq!(state.uid, [2, 6, 8, 1]);
            state.remove(&[0, 1, 2, 3]);
            assert_eq!(state.rows(), 0);
        }
    }
}
