//! A table of text with aligned columns, for the end of a sweep or a ladder.

/// Lines of the table: `names` over `rows`. The first `words` columns are aligned left, figures right. Every row has as many
/// cells as there are names.
pub fn table(names: &[&str], words: usize, rows: &[Vec<String>]) -> String {
    let head: Vec<String> = names.iter().map(|name| (*name).to_string()).collect();
    let lines: Vec<&Vec<String>> = std::iter::once(&head).chain(rows).collect();
    let width = |column: usize| lines.iter().map(|line| line[column].chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..names.len()).map(width).collect();
    let mut text = String::new();
    for line in lines {
        let cells = line.iter().zip(&widths).enumerate().map(|(i, (cell, &width))| match i < words {
            true => format!("{cell:<width$}"),
            false => format!("{cell:>width$}"),
        });
        text.push_str(cells.collect::<Vec<_>>().join("  ").trim_end());
        text.push('\n');
    }
    text
}

/// A figure with `digits` decimals, or nothing.
pub fn figure(value: Option<f64>, digits: usize) -> String {
    value.map_or(String::new(), |value| format!("{value:.digits$}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_aligned() {
        let rows = [vec!["base".into(), figure(Some(24.316), 2)], vec!["groups:9".into(), figure(None, 2)]];
        assert_eq!(table(&["setting", "PSNR"], 1, &rows), "setting    PSNR\nbase      24.32\ngroups:9\n");
    }
}
